"""Command lines: what a number may be, where defaults come from, what --help shows."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import get_type_hints

import mbpo
import numpy as np
import pfpn_sac
import pods
import pytest
import sac_baseline
import sapo
import torch
from learners import SCRIPTS, assert_refuses, refusal

import bptt
import diffsim
import gps
import pfpn
import ppo_baseline
import rpo
import shac
from diffsim.training import checkpoint, errors, flags, parse, ranges
from diffsim.training.evaluation import make_env
from diffsim_cli import view
from diffsim_cli.commands import find_learners
from diffsim_robots.terrain import uneven


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def save(args: flags.Flags, **further: object) -> Path:
    """A checkpoint with as much as the flags of its successor depend on, and with further arguments."""
    values = {name: None if isinstance(v, Path) else v for name, v in dataclasses.asdict(args).items()}
    path = Path("saved") / "checkpoint.pt"
    path.parent.mkdir(exist_ok=True)
    state = dict(
        script=args.script(), args=values | further, iteration=5, modules={}, policy=dict(layers=[], weights={})
    )
    rank = {"env": None, "rng": torch.get_rng_state()}
    state |= dict(control_steps=0, seconds=0.0, totals={}, episodes=[], ranks=[rank])
    torch.save({"format": checkpoint.FORMAT} | state, path)
    return path


# Ranges ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("script", "arguments", "allowed"),
    [
        (shac, "--num-envs 0", "from 1 to 1,000,000,000"),
        (shac, "--threads -1", "from 0 to 1,000,000,000"),
        (shac, "--critic-iterations 2147483648", "from 0 to 1,000,000,000"),
        (shac, "--actor-hidden 4611686018427387904", "from 1 to 16,384"),
        (shac, "--critic-hidden -1", "from 1 to 16,384"),
        (sapo, "--critics 2147483648", "from 1 to 1,000"),
        (sac_baseline, "--batch-size 1000000000", "from 1 to 1,000,000"),
        (pods, "--epochs 1000000000", "from 1 to 10,000"),
        (shac, "--seed 99999999999999999999", "below 2^62 in size"),
        (shac, "--actor-lr inf", "finite"),
        (shac, "--gamma nan", "finite"),
        (shac, "--initial-log-std inf", "finite"),
        (shac, "--actor-lr 1e+39", "finite in single precision"),
        (shac, "--critic-lr 0.0", "positive"),
        (ppo_baseline, "--entropy-coef -1.0", "at least 0"),
        (bptt, "--gamma 1.5", "in [0, 1]"),
        (pfpn, "--dead 1.0", "in [0, 1)"),
        (sapo, "--target-entropy 0 nan", "finite"),
        (sac_baseline, "--hidden ()", "at least one number"),
    ],
)
def test_a_number_out_of_range_is_named_before_anything_is_written(script, arguments, allowed, tmp_path, capsys):
    name, *values = arguments.split()
    words = [word for word in arguments.split() if word != "()"]
    complaint = f"script.py: {name} must be {allowed}, not {values[-1]}"
    assert refusal(lambda: script.main(words), capsys) == complaint
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env anty", "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant, humanoid"),
        (
            "--env walker --accuracy fast",
            "task 'walker' has no preset 'fast' on soft contact; choose from default, accurate",
        ),
        ("--env my/robot.xml", "my/robot.xml is a robot without a task: give a file with a class, my_task.py"),
        ("--env cartpole --horizon 500000000", "states and actions of a horizon of 500,000,000 steps would take"),
        ("--env cartpole:rough=10", "cartpole touches no ground, so it has no terrain"),
        ("--env ant:clip.npz", "task 'ant' has no option 'clip.npz': write rough=20, randomise=none or a range like"),
        ("--env humanoid_imitation:nowhere", "no such clip: nowhere; give an .npz or .csv file"),
        ("--env go2:rough=50", "'rough=50': the steepest slope must be above 0 and at most 45 degrees"),
        ("--env go2:push=2:1", "'push=2:1': must be from 0 to inf, the smaller one first"),
        ("--contact mujoco --implicit", "--implicit is for --contact soft, and the contact is MuJoCo's"),
        ("--device nonsense", "nonsense"),
        ("--device cuda", "device 'cuda' asked for, but PyTorch sees 0 CUDA GPUs here; choose cpu"),
        ("--run-dir {file}", "cannot write to run directory {file}: Not a directory"),
        ("--run-dir {file}/deeper", "cannot write to run directory {file}/deeper: Not a directory"),
        (f"--run-dir {300 * 'a'}", "File name too long"),
        ("--run-dir {trained}", "{trained} holds another run's checkpoint.pt"),
        ("--evaluate {other}", "{other} is a checkpoint of 'other', not of shac.py"),
        ("--resume {elsewhere} --device cpu --iterations 9", "{elsewhere} was trained on cuda:0, which cpu cannot"),
        ("--evaluate {trained}/checkpoint.pt --run-dir {file}", "cannot write to run directory {file}"),
        ("--resume {trained}/checkpoint.pt", "is at iteration 2 already"),
        ("--resume {trained}", "{trained}/checkpoint.pt is at iteration 2 already"),
        ("--resume {file} --evaluate {file}", "--resume and --evaluate exclude each other"),
        (
            "--env cartpole --num-envs 3 --horizon 4 --critic-minibatches 13",
            "13 are more than the 12 samples",
        ),
        ("--num_env 3", "Unrecognized options: --num_env, 3; Perhaps you meant: --num-envs INT parallel"),
        ("--seed 1.5", "Error parsing --seed: invalid literal for int() with base 10: '1.5'; For full helptext, see "),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message, tiny_run, tmp_path, capsys):
    assert_refuses(shac, arguments, message, tiny_run, tmp_path, capsys)


@pytest.mark.parametrize(
    ("script", "arguments", "message"),
    [
        (
            sapo,
            "--env cartpole --num-envs 10 --population 4",
            "--num-envs 10 cannot be split evenly among --pop",
        ),
        *((x, "--env humanoid_imitation", "depends on the past, which planned states do not") for x in (gps, pods)),
        (mbpo, "--env humanoid_imitation --sample-enhance 4", "do not hold the past, on which humanoid_imitation"),
        *((x, "--env cartpole:mass=0.9:1.1", "one robot on a plane, but cartpole:mass=0.9:1.1") for x in (gps, pods)),
        (pods, "--env cartpole --horizon 100", "--horizon 100 does not divide the 240 control steps of an episode"),
        (pfpn, "--particles 1", "--particles must be from 2 to 1,000, not 1"),
        (pfpn, "--lr-bounds 1e-2 1e-3", "must be two numbers, the first not above the second, not (0.01, 0.001)"),
        *((pfpn, f"--initial-log-std {x}", f"--initial-log-std must be from -5 to 2, not {x}") for x in ("nan", "2.5")),
        (pfpn_sac, "--buffer-size 10", "--buffer-size 10 is smaller than a rollout of 4096 steps"),
        (sac_baseline, "--seed-steps 640 --iterations 20", "640 leave no update in --iterations 20: at most 639"),
        (sac_baseline, "--actor-updates 2", "--actor-updates 2 are more than --updates-per-step 1"),
        (sac_baseline, "--critics 2 --critic-subset 3", "--critic-subset 3 is larger than --critics 2"),
        (sac_baseline, "--buffer-size 10", "--buffer-size 10 holds no iteration of 32 steps of 128"),
        (sac_baseline, "--tau 2", "--tau must be in [0, 1]"),
        (mbpo, "--seed-steps 64 --iterations 4", "--seed-steps 64 leave no update in --iterations 4: at most 63"),
        (mbpo, "--num-envs 1", "--num-envs must be at least 2: one environment is held out"),
        (mbpo, "--rollout-lengths 3 2", "--rollout-lengths 3 2: the first must not exceed the second"),
        (mbpo, "--buffer-size 10", "--buffer-size 10 is less than the 64 transitions of a step"),
        (
            mbpo,
            "--env ant:mass=0.9:1.1 --sample-enhance 1",
            "takes Jacobians of one robot, but ant:mass=0.9:1.1 has ranges",
        ),
        (mbpo, "--env ant:rough=5 --sample-enhance 1", "Jacobians of a robot on a plane, but ant:rough=5 is rough"),
    ],
)
def test_flags_of_a_learner_that_do_not_go_together_are_one_line(script, arguments, message, tmp_path, capsys):
    words = arguments.split() if "--env" in arguments else ["--env", "ant", *arguments.split()]
    assert message in refusal(lambda: script.main(words), capsys)
    assert not list(tmp_path.iterdir())


def test_what_tyro_cannot_parse_is_told_without_boxes_and_colours(tiny_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    for encoding in ("utf-8", "ascii"):
        monkeypatch.setattr(type(sys.stdout), "encoding", encoding)
        message = "script.py: Missing value for argument '--gamma'. Expected 1 values; For full helptext, run script.py"
        assert refusal(lambda: parse(shac.Args, ["--gamma"]), capsys).startswith(message)
        for word in ("x" * 300, "a," * 90, "-----", "a-----b"):
            assert f" {word}" in refusal(lambda word=word: parse(shac.Args, ["--seeds", word]), capsys)


def test_help_names_the_script_without_its_folder(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["/a/folder/script.py"])  # as `diffsim train` starts it
    assert help_of(shac, capsys).startswith("usage: script.py [-h]")
    assert help_of(view, capsys).startswith("usage: diffsim view [-h]")


def test_tyros_help_has_the_terminals_width_and_its_warnings_are_told(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "70")
    with pytest.raises(SystemExit, match="0"):
        parse(shac.Args, ["--help"])
    boxes = capsys.readouterr().out.partition("options ")[2]
    assert max(map(len, boxes.splitlines())) == 70
    for columns in ("70", None):
        monkeypatch.delenv("COLUMNS") if columns is None else monkeypatch.setenv("COLUMNS", columns)
        with errors.in_one_line([]):
            print("beware", file=sys.stderr)
        assert capsys.readouterr().err == "beware\n" and os.environ.get("COLUMNS") == columns


@pytest.mark.parametrize(
    "arguments",
    [
        "--num-envs 1 --horizon 1 --iterations 1 --substeps 1 --eval-episodes 1 --critic-minibatches 1",
        "--eval-every 0 --save-every 0 --threads 0",
        "--gamma 0 --td-lambda 0 --target-alpha 0 --critic-iterations 0",
        "--gamma 1 --td-lambda 1 --target-alpha 1 --initial-log-std 2",
        "--initial-log-std=-inf",
        "--actor-hidden --critic-hidden 1 2 3 4",
    ],
)
def test_ends_of_ranges_are_within(arguments):
    parse(shac.Args, ["--env", "cartpole", *arguments.split()])


@pytest.mark.parametrize("script", [importlib.import_module(name) for name in find_learners()])
def test_every_number_has_a_range(script):
    """But the seed, and pods.py's order, of which there are two."""
    for name, hint in get_type_hints(script.Args, include_extras=True).items():
        value = getattr(script.Args, name)
        numbers = value if isinstance(value, tuple) else [value]
        if name not in ("seed", "order") and type(numbers[0] if numbers else None) in (int, float):
            assert len(
                [number for number, _ in ranges._ranges(hint, value) if number is not value or numbers == [value]]
            ) == len(numbers), name


# Defaults -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_defaults_are_the_tables(script, device):
    """The learner's row, what the device and the contact change, and then what the task sets itself."""
    name, on_cpu = script.__name__, device == "cpu"
    for env, task in diffsim.TASKS.items():
        args = parse(script.Args, ["--env", env, "--device", device])
        like = task.like or env
        expected = dict(zip(script.COLUMNS, script.PER_TASK[like], strict=True)) if like in script.PER_TASK else {}
        if hasattr(script, "CPU") and on_cpu:
            expected |= {name: min(expected.get(name, most), most) for name, most in script.CPU.items()}
        expected |= getattr(script, "ON_CPU" if on_cpu else "ON_GPU", {}).get(env if on_cpu else like, {})
        preset = getattr(script, "INTEGRATION", {}).get(env) or task.integration("default")
        if preset.contact == "mujoco" and name in ("shac", "rpo", "sapo"):  # shorter rollouts of more environments
            expected |= {"horizon": 8} | getattr(script, "MUJOCO", {})
            if on_cpu or name != "sapo":
                expected["num_envs"] = 4 * expected.get("num_envs", script.Args().num_envs)
        expected |= {**task.defaults.get(name, {}), **task.defaults.get(f"{name} {'cpu' if on_cpu else 'gpu'}", {})}
        expected |= dict(contact=preset.contact, substeps=preset.substeps, implicit=preset.implicit)
        assert {name: getattr(args, name) for name in expected} == expected


def test_contacts_begin_softly_where_that_was_better():
    args = parse(rpo.Args, "--env half_cheetah --contact mujoco --device cuda".split())
    assert (args.onset, args.horizon, args.adjoint_clip, args.mix) == ((0.02, 0.002), 32, 8.0, 0.3)
    assert args.num_envs == 256  # as on penalty contact
    args = parse(rpo.Args, "--env half_cheetah --contact mujoco --onset 0 0 --horizon 8 --device cpu".split())
    assert (args.onset, args.horizon) == ((0.0, 0.0), 8)
    for words in ("--env half_cheetah", "--env ant --contact mujoco"):
        assert parse(rpo.Args, words.split()).onset == (0.0, 0.0)


NEAR = {"adjoint_clip": 5.0, "symmetric": True}  # its standing pose, which is symmetric
SMALL_CRITIC, LARGE_CRITIC = ({"critic_hidden": hidden, "critic_lr": 1e-3} for hidden in ((256, 128), (512, 256)))


@pytest.mark.parametrize(
    ("learner", "env", "cpu", "gpu"),
    [
        (
            shac,
            "go2",
            NEAR | SMALL_CRITIC | dict(num_envs=256, horizon=8, iterations=600, initial_log_std=-2.0, target_alpha=0.9),
            dict(num_envs=1024, iterations=1000),
        ),
        (shac, "g1", NEAR | SMALL_CRITIC | dict(num_envs=256, horizon=16, iterations=1500, initial_log_std=-2.0), {}),
        (shac, "g1_track", LARGE_CRITIC | dict(num_envs=1024, horizon=16, iterations=1500, adjoint_clip=5.0), {}),
        (
            rpo,
            "go1",
            NEAR | SMALL_CRITIC | dict(num_envs=64, horizon=16, iterations=400, critic_iterations=4, trust=0.5),
            dict(num_envs=1024, epochs=4, initial_log_std=-2.0),
        ),
        (rpo, "g1", NEAR | SMALL_CRITIC | dict(num_envs=64, iterations=600, initial_log_std=-3.0), {"num_envs": 1024}),
        (
            rpo,
            "g1_track:friction=0.8:1.2",
            LARGE_CRITIC | dict(num_envs=256, horizon=16, critic_iterations=8, epochs=4, trust=0.5, iterations=400),
            dict(num_envs=1024, initial_log_std=-3.0, adjoint_clip=5.0, symmetric=False),
        ),
        (
            sapo,
            "g1",
            NEAR | SMALL_CRITIC | dict(num_envs=256, horizon=16, iterations=700, critic_iterations=4, population=1),
            dict(num_envs=1024, iterations=1200, target_entropy=(-1.0, -1.0), target_alpha=0.9, initial_log_std=-2.0),
        ),
        (
            sapo,
            "g1_track",
            SMALL_CRITIC | dict(num_envs=256, horizon=16, iterations=1300, critic_iterations=4, adjoint_clip=0.0),
            LARGE_CRITIC | dict(num_envs=1024, iterations=700, critic_iterations=8, target_entropy=(-1.0, -2.0)),
        ),
        (sapo, "go2", dict(num_envs=256, horizon=8, initial_log_std=-1.0, critic_hidden=(128, 128)), {"num_envs": 64}),
        (
            ppo_baseline,
            "g1_track",
            dict(hidden=(512, 256, 128), num_envs=256, minibatch_size=2048, horizon=24, initial_log_std=-1.0),
            dict(num_envs=4096, minibatch_size=24576, epochs=5, iterations=5000),
        ),
        (shac, "humanoid_imitation", dict(actor_hidden=(256, 128), target_alpha=0.995, num_envs=64, substeps=48), {}),
    ],
)
def test_what_a_robot_sets_itself(learner, env, cpu, gpu):
    """On a CPU, and what else it sets on a GPU."""
    for device, expected in (("cpu", cpu), ("cuda:1", cpu | gpu)):
        args = vars(parse(learner.Args, ["--env", env, "--device", device]))
        assert {name: args[name] for name in expected} == expected


MINE = """
from diffsim.tasks.cartpole import CartPole

class Mine(CartPole):
    like = "ant"
    defaults = {"shac": {"horizon": 5, "num_envs": 7, "symmetric": True}, "shac gpu": {"num_envs": 9, "gamma": 0.9}}

class Misspelt(Mine):
    defaults = {"shac": {"horizons": 5}}

class Flat(Mine):
    defaults = {"horizon": 5}

class Lost(Mine):
    like = "ants"
"""


def test_a_task_of_a_users_own_sets_defaults(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(MINE)
    words = ["--env", "mine.py:Mine", "--contact", "mujoco", "--no-symmetric"]
    cpu, gpu = (parse(shac.Args, [*words, "--device", device]) for device in ("cpu", "cuda"))
    ant = parse(shac.Args, ["--env", "ant", "--device", "cpu"])
    assert (cpu.horizon, cpu.num_envs, cpu.gamma, cpu.symmetric) == (5, 7, 0.99, False)
    assert (gpu.horizon, gpu.num_envs, gpu.gamma, cpu.actor_hidden) == (5, 9, 0.9, ant.actor_hidden)
    assert parse(shac.Args, [*words, "--horizon", "6"]).horizon == 6
    assert parse(rpo.Args, [*words, "--device", "cpu"]).horizon == 8
    for name, message in (
        ("Misspelt", "task 'mine.py:Misspelt' has defaults of flags that shac.py lacks: --horizons"),
        ("Flat", "task 'mine.py:Flat': defaults are by script, such as {'shac': {'horizon': 16}}, not 'horizon'"),
        ("Lost", "unknown task 'ants': choose from cartpole, hopper"),
    ):
        line = refusal(lambda name=name: parse(shac.Args, ["--env", f"mine.py:{name}"]), capsys)
        assert line.startswith(f"script.py: {message}")


@pytest.mark.parametrize(
    "script", [importlib.import_module(name) for name in sorted({*find_learners()} - {"gps", "pods"})]
)
def test_options_leave_the_defaults_of_the_task(script):
    """Gps and pods, which plan, refuse options."""
    for env in ("walker", "ant", "go2", "g1_track"):
        plain, rough = (parse(script.Args, ["--env", name, "--device", "cpu"]) for name in (env, f"{env}:rough=20"))
        assert dataclasses.replace(rough, env=env) == plain


def test_the_command_line_is_before_the_task_is_before_the_class():
    args = parse(shac.Args, "--env-id cartpole --actor-lr 3e-3 --substeps 7".split())
    assert (args.env, args.actor_lr, args.critic_lr, args.gamma) == ("cartpole", 3e-3, 1e-3, 0.99)
    assert (args.implicit, args.substeps) == (False, 7)
    fast = diffsim.TASKS["humanoid"].integration("fast")
    args = parse(shac.Args, "--env humanoid --accuracy fast --no-implicit".split())
    assert (args.implicit, args.substeps) == (False, fast.substeps) and fast.implicit
    args = parse(shac.Args, ["--env", "cartpole", "--general-hyperparameters", "--num-envs", "3"])
    assert (args.iterations, args.num_envs, args.actor_hidden, args.target_alpha) == (500, 3, (256, 128), 0.995)


def test_the_command_line_is_before_the_checkpoint_is_before_the_task():
    arguments = "--env cartpole --device cpu --num-envs 5 --gamma 0.9 --run-dir there --accuracy fast"
    path = save(parse(shac.Args, arguments.split()))
    args = parse(shac.Args, ["--resume", str(path), "--td-lambda", "0.5", "--iterations", "7"])
    assert (args.num_envs, args.gamma, args.td_lambda, args.actor_lr, args.iterations) == (5, 0.9, 0.5, 1e-2, 7)
    assert (args.run_dir, args.resume, args.evaluate, args.device) == (path.parent, path, None, "cpu")
    assert parse(shac.Args, ["--evaluate", str(path)]).run_dir == path.parent
    assert parse(shac.Args, ["--evaluate", str(path), "--run-dir", "here"]).run_dir == Path("here")
    assert parse(shac.Args, ["--resume", str(path), "--device", "auto"]).device == "cpu"


def test_accuracy_is_stored_and_can_be_replaced():
    fast, accurate = (diffsim.TASKS["cartpole"].integration(name) for name in ("fast", "accurate"))
    path = save(parse(shac.Args, "--env cartpole --accuracy fast".split()))

    def integration(*arguments: str) -> diffsim.Integration:
        args = parse(shac.Args, ["--evaluate", str(path), *arguments])
        assert (how := make_env(args, 1).sim.integration).substeps == args.substeps
        return how

    assert integration() == fast
    for words in (["--accuracy", "accurate"], ["--accuracy=accurate"]):
        assert integration(*words) == accurate
    assert integration("--accuracy", "accurate", "--substeps", "2") == accurate._replace(substeps=2)
    assert integration("--substeps", "16", "--no-implicit") == diffsim.Integration("soft", 16)


def test_rough_ground_is_as_steep_as_the_option():
    args = parse(shac.Args, "--env hopper:rough=12 --device cpu".split())
    np.testing.assert_array_equal(make_env(args, 3, seed=5).scene.terrain, uneven(12.0, 3, 5))


def test_what_a_checkpoint_decides(capsys):
    path = save(parse(shac.Args, "--env cartpole --num-envs 3 --device cpu".split()))
    for argument, saved in (
        ("--env ant", "--env cartpole, which cannot change to ant"),
        ("--num-envs 4", "--num-envs 3, which cannot change to 4"),
        ("--seed 2", "--seed 1, which cannot change to 2"),
    ):
        for mode, more in ("--resume", ""), ("--evaluate", "; --evaluate takes --accuracy, --contact, "):
            command = [mode, str(path), *argument.split()]
            line = refusal(lambda command=command: parse(shac.Args, command), capsys)
            assert line.startswith(f"script.py: {path} has {saved}{more}") and bool(more) == ("--eval-episodes" in line)
    assert parse(shac.Args, ["--evaluate", str(path), *"--eval-episodes 9 --substeps 8 --quiet".split()]).substeps == 8


def test_a_policy_can_be_evaluated_whose_training_would_be_refused_today(capsys):
    path = save(dataclasses.replace(parse(shac.Args, "--env cartpole --device cpu".split()), critic_minibatches=9999))
    assert parse(shac.Args, ["--evaluate", str(path)]).critic_minibatches == 9999
    line = refusal(lambda: parse(shac.Args, ["--resume", str(path), "--iterations", "9999"]), capsys)
    assert "--critic-minibatches 9999 are more than the" in line


def test_networks_keep_their_sizes_and_other_flags_may_change(tiny_run, tmp_path, capsys):
    words = ["--resume", str(tiny_run / "checkpoint.pt"), "--run-dir", str(tmp_path / "run"), "--iterations", "3"]
    line = refusal(lambda: shac.main([*words, "--actor-hidden", "5"]), capsys)
    assert line.endswith("the script as it is now: actor.mean.0.weight has shape (64, 5), not (5, 5)")
    assert not (tmp_path / "run").exists()
    shac.main([*words, "--gamma", "0.9", "--eval-episodes", "2", "--quiet"])
    assert checkpoint.load(tmp_path / "run" / "checkpoint.pt")["args"]["gamma"] == 0.9


def test_a_checkpoint_of_flags_that_the_script_lacks_is_only_evaluated(capsys):
    """And of choices that it lacks; what does not count is told."""
    path = save(parse(shac.Args, ["--env", "cartpole", "--gamma", "0.9"]), old_flag=3, accuracy="exact")
    line = refusal(lambda: parse(shac.Args, ["--resume", str(path)]), capsys)
    expected = f"script.py: {path} was written by a shac.py with other flags: --accuracy exact, --old-flag 3"
    assert line == expected
    args = parse(shac.Args, ["--evaluate", str(path)])
    assert (args.gamma, args.accuracy) == (0.9, "default")
    assert capsys.readouterr().err == f"{expected}; they are ignored\n"


def test_a_checkpoint_older_than_a_flag_has_its_default():
    args = parse(shac.Args, ["--env", "cartpole", "--gamma", "0.9"])
    path = save(args)
    state = torch.load(path)
    del state["args"]["td_lambda"]
    torch.save(state, path)
    older = parse(shac.Args, ["--evaluate", str(path)])
    assert (older.td_lambda, older.gamma) == (0.95, 0.9)


# Help -----------------------------------------------------------------------------------------------------------------


def help_of(script: ModuleType, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Without boxes and line breaks."""
    with pytest.raises(SystemExit) as exit:
        script.main([*arguments, "--help"])
    assert exit.value.code == 0
    return re.sub(r"[│╭╮╰╯─\s]+", " ", capsys.readouterr().out)


def default(text: str, name: str) -> str:
    """What help says that a flag is by default."""
    match = re.search(rf"{name} [A-Z{{[].*?\(default: ([^)]*)\)", text)
    assert match, name
    return match.group(1)


def test_help_shows_the_defaults_of_the_task_and_the_preset(capsys):
    text = help_of(shac, capsys, "--env", "humanoid")
    assert (default(text, "--substeps"), default(text, "--target-alpha")) == ("48", "0.995")
    assert (default(text, "--actor-hidden"), default(text, "--critic-hidden")) == ("256 128", "128 128")
    text = help_of(shac, capsys, "--env", "humanoid", "--accuracy", "fast")
    assert (default(text, "--substeps"), "--implicit, --no-implicit" in text) == ("24", True)
    text = help_of(bptt, capsys, "--env", "cartpole")
    assert (default(text, "--horizon"), default(text, "--hidden")) == ("64", "64 64")
    text = help_of(ppo_baseline, capsys, "--device", "cpu")
    assert (default(text, "--num-envs"), default(text, "--minibatch-size")) == ("256", "2048")
    path = save(parse(shac.Args, ["--env", "cartpole", "--gamma", "0.9"]))
    assert default(help_of(shac, capsys, "--resume", str(path)), "--gamma") == "0.9"


@pytest.mark.parametrize("script", find_learners())
def test_help_fits_on_a_screen(script: str) -> None:
    shared, every = (dataclasses.fields(kind) for kind in (flags.Flags, importlib.import_module(script).Args))
    assert len(shared) <= 18 and len(every) - len(shared) <= (15 if script == "shac" else 20)
