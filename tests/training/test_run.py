"""A run: when it evaluates, saves and stops, what it counts, prints and logs."""

from __future__ import annotations

import errno
import importlib
import json
import math
import os
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import PATH, ROOT, SMALL, assert_same, read_progress, refusal, run, stopped
from torch import Tensor, nn

import bptt
import diffsim
import shac
from diffsim.env import DiffEnv
from diffsim.tasks import REGISTERED
from diffsim.tasks.cartpole import CartPole
from diffsim.training import ClippedAdam, Run, checkpoint, evaluate, fail, load_policy, parse
from diffsim.training.log import COLUMNS

# Iterations of a few milliseconds.
TINY = "--env cartpole --num-envs 2 --horizon 8 --eval-episodes 1 --device cpu".split()


# When it evaluates, saves and stops -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "stop_after", "evaluated", "saved"),
    [
        ("--iterations 7 --eval-every 3 --save-every 2", 0, [3, 6, 7], [2, 4, 6, 7]),
        ("--iterations 4 --eval-every 2 --save-every 4", 0, [2, 4], [4]),
        ("--iterations 5 --eval-every 0 --save-every 0", 0, [5], [5]),
        ("--iterations 5 --eval-every 2 --save-every 0", 3, [2], [3]),
        ("--iterations 5 --eval-every 0 --save-every 2", 9, [5], [2, 4, 5]),
    ],
)
def test_schedule(arguments, stop_after, evaluated, saved, tmp_path, monkeypatch, capsys):
    iterations, save = list[int](), checkpoint.save

    def record(path: Path, script: str, learner: checkpoint.Learner, state: Mapping[str, Any]) -> None:
        iterations.append(state["iteration"])
        save(path, script, learner, state)

    monkeypatch.setattr(checkpoint, "save", record)
    run(bptt, tmp_path, *TINY, *arguments.split(), "--quiet", stop_after=stop_after)
    assert iterations == saved
    rows = read_progress(tmp_path)
    assert [int(row["iteration"]) for row in rows if row.get("eval_return")] == evaluated
    out, finished = capsys.readouterr().out, stop_after != 3
    assert ("stopped early: python bptt.py --resume" in out) != finished
    assert (tmp_path / "evaluation.json").exists() == finished
    assert f"evaluation of iteration {evaluated[-1]}, 1 episodes: return median" in out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)])
def test_signals(number, tmp_path, monkeypatch, capsys, request):
    """The first one lets the iteration end, saved; the same a second time ends it at once. nohup's ignores SIGHUP."""
    request.addfinalizer(partial(signal.signal, number, signal.getsignal(number)))
    before, raised = signal.default_int_handler, []  # also where pytest itself runs in the background and ignores it
    signal.signal(number, before)

    def interrupted(count: int) -> Any:
        def loss(*arguments: Any) -> Tensor:
            for _ in range(count if not raised else 0):
                raised.append(number)
                signal.raise_signal(number)
            return original(*arguments)

        return loss

    original = bptt.bptt_loss
    arguments = *TINY, "--iterations", 5, "--quiet"
    monkeypatch.setattr(bptt, "bptt_loss", interrupted(1))
    with pytest.raises(SystemExit) as exit:
        run(bptt, tmp_path / "once", *arguments)
    assert exit.value.code == 128 + number and signal.getsignal(number) is before
    assert checkpoint.load(tmp_path / "once" / "checkpoint.pt")["iteration"] == 1
    assert len(read_progress(tmp_path / "once")) == 1
    assert "stopped early" in capsys.readouterr().out

    raised.clear()
    monkeypatch.setattr(bptt, "bptt_loss", interrupted(2))
    with pytest.raises(SystemExit) as exit:
        run(bptt, tmp_path / "twice", *arguments)
    assert exit.value.code == 130 and capsys.readouterr().err == "script.py: interrupted\n"
    assert not (tmp_path / "twice" / "checkpoint.pt").exists()


# When it cannot go on -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "arguments"),
    [(math.nan, "--save-every 1"), (math.inf, "--save-every 1"), (math.nan, "--save-every 2 --eval-every 3")],
)
def test_weights_that_are_not_finite_are_named_and_not_saved(value, arguments, tmp_path, monkeypatch, capsys):
    step, calls = ClippedAdam.step, []

    def diverge(optimizer: ClippedAdam, loss: Tensor) -> Tensor:
        norm = step(optimizer, loss)
        calls.append(1)
        if len(calls) == 3:
            optimizer.vector[-1] = value
        return norm

    monkeypatch.setattr(ClippedAdam, "step", diverge)
    argv = [*TINY, "--iterations", "5", "--quiet", *arguments.split(), "--run-dir", str(tmp_path)]
    error, path = refusal(lambda: bptt.main(argv), capsys), tmp_path / "checkpoint.pt"
    assert error.startswith("script.py: iteration 3: weight actor.mean.")
    assert error.endswith(f"{path} is of iteration 2")
    assert checkpoint.load(path)["iteration"] == 2 and not list(tmp_path.glob("*.tmp"))


def test_weights_that_make_actions_nan_are_named(tmp_path, monkeypatch, capsys):
    """On a CPU the environment refuses them, an iteration after the weights went wrong."""
    monkeypatch.setattr(ClippedAdam, "step", lambda optimizer, _: optimizer.vector.fill_(math.nan)[0])
    argv = [*TINY, "--iterations", "5", "--quiet", "--run-dir", str(tmp_path)]
    error = refusal(lambda: bptt.main(argv), capsys)
    assert error == "script.py: iteration 2: weight actor.log_std is not finite; no checkpoint was saved"


class Gone:
    """A stdout that nobody reads any more."""

    def write(self, _: str) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    def isatty(self) -> bool:
        return False

    flush = fileno = write


@pytest.mark.parametrize("stdout", [None, Gone()], ids=["closed", "broken"])
def test_a_training_goes_on_without_its_reader(stdout, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stdout)
        train = shac.script(bptt.Args, bptt.train).__wrapped__  # type: ignore[attr-defined]
        train([*TINY, "--iterations", "3", "--eval-every", "1", "--run-dir", str(tmp_path)])
    assert checkpoint.load(tmp_path / "checkpoint.pt")["iteration"] == 3
    assert json.loads((tmp_path / "evaluation.json").read_text())["settings"]["iteration"] == 3


def test_a_directory_that_is_moved_is_made_again(tmp_path, monkeypatch):
    def moved(*arguments: Any) -> Any:
        if not (tmp_path / "moved").exists() and read_progress(tmp_path / "run"):
            (tmp_path / "run").rename(tmp_path / "moved")
        return original(*arguments)

    original = bptt.bptt_loss
    monkeypatch.setattr(bptt, "bptt_loss", moved)
    assert run(bptt, tmp_path / "run", *TINY, "--iterations", 3, "--eval-every", 1, "--quiet")["iteration"] == 3
    assert [row["iteration"] for row in read_progress(tmp_path / "moved")] == ["1"]
    assert [row["iteration"] for row in read_progress(tmp_path / "run")] == ["2", "3"]


@pytest.mark.parametrize("part", ["reward", "observation 2"])
def test_the_first_number_of_a_task_that_is_none_is_named(part, tmp_path, monkeypatch, capsys):
    class Faulty(CartPole):
        """Its numbers are NaN where the cart is fast."""

        name = "faulty"

        def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
            obs = super().observe(qpos, qvel, action)
            column = obs[..., 2].where(qvel[..., 0] < 2.0, math.nan) if part != "reward" else obs[..., 2]
            return torch.cat((obs[..., :2], column.unsqueeze(-1), obs[..., 3:]), -1)

        def reward(self, obs: Tensor, action: Tensor) -> Tensor:
            return super().reward(obs, action).where((obs[..., 1] < 2.0) | (part != "reward"), math.nan)

    monkeypatch.setattr(sys.modules[__name__], "Faulty", Faulty, raising=False)
    monkeypatch.setitem(REGISTERED, "faulty", f"{__name__}:Faulty")
    argv = [*TINY, "--env", "faulty", "--iterations", "60", "--quiet", "--run-dir", str(tmp_path)]
    error = refusal(lambda: bptt.main(argv), capsys)
    first = len(read_progress(tmp_path)) + 1
    name = "a reward" if part == "reward" else part
    assert error == f"script.py: iteration {first}: {name} of faulty is not finite; no checkpoint was saved"


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit")
@pytest.mark.parametrize(
    ("limit", "arguments", "message"),
    [
        (30_000, "--save-every 1", "to {}: File too large; {}/checkpoint.pt is of iteration 2"),
        (1_000, "--save-every 0", "to {}: File too large; {}/checkpoint.pt is of iteration 2"),
        (10, "--save-every 0", "to run directory {}: File too large"),
    ],
)
def test_a_full_disk_leaves_the_last_checkpoint(limit, arguments, message, tmp_path, capsys):
    """What does not fit is the checkpoint, or the progress, or anything at all."""
    import resource

    run(bptt, tmp_path, *TINY, "--iterations", 50, "--quiet", stop_after=2)
    path = tmp_path / "checkpoint.pt"
    whole, (soft, hard) = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)

    def resume() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            bptt.main(["--resume", str(path), *arguments.split()])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    error = refusal(resume, capsys)
    assert error == f"script.py: cannot write {message.format(tmp_path, tmp_path)}"
    assert path.read_bytes() == whole and not list(tmp_path.glob("*.tmp"))


def process(script: str, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, ROOT / f"{script}.py", *map(str, arguments)]
    return subprocess.Popen(command, text=True, stderr=subprocess.PIPE, env=os.environ | PATH)


def rows_of(directory: Path) -> int:
    return len(read_progress(directory)) if (directory / "progress.csv").exists() else 0


def is_free(directory: Path) -> bool:
    """Whether another process could lock a run's directory."""
    program = "import fcntl, sys; fcntl.lockf(open(sys.argv[1], 'a'), fcntl.LOCK_EX | fcntl.LOCK_NB)"
    return subprocess.run([sys.executable, "-c", program, directory / "lock"], capture_output=True).returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
@pytest.mark.parametrize("case", ["start", "start and save each iteration", "resume"])
def test_two_processes_in_one_directory(case, tmp_path, capsys):
    """The second is refused and leaves everything to the first; a killed one leaves the directory free."""
    save = 0 if case == "start" else 1
    arguments = *TINY, "--iterations", 10**6, "--eval-every", 0, "--save-every", save, "--quiet"
    commands = [(*arguments, "--run-dir", tmp_path, "--seed", seed) for seed in (1, 2)]
    if case == "resume":
        run(bptt, tmp_path, *arguments, stop_after=1)
        commands = 2 * [("--resume", tmp_path)]
    both = [process("bptt", *command) for command in commands]
    try:
        while all(each.poll() is None for each in both) or rows_of(tmp_path) < 3:
            assert any(each.poll() is None for each in both)
            time.sleep(0.05)
        second, first = sorted(both, key=lambda each: each.poll() is None)
        *_, error = second.stderr.read().splitlines()
        holder = f"{tmp_path} is in use by process {first.pid} on {socket.gethostname()}: wait for its end, or choose"
        late = f"{tmp_path} holds another run's checkpoint.pt: --resume it, or choose"  # it starts after the first save
        assert second.wait() == 2 and error in [f"bptt.py: {why} another --run-dir" for why in (holder, late)]
        for resumed in (tmp_path, tmp_path / "checkpoint.pt"):
            if save:
                assert holder in refusal(lambda path=resumed: bptt.main(["--resume", str(path)]), capsys)
        assert first.poll() is None and not is_free(tmp_path)
    finally:
        for each in both:
            each.kill()
            each.wait()
            each.stderr.close()
    rows = [int(row["iteration"]) for row in read_progress(tmp_path)]
    assert is_free(tmp_path) and rows == [*range(1, len(rows) + 1)]  # of one run, and none is missing
    if save:
        saved = checkpoint.load(tmp_path)["iteration"]
        assert 0 <= len(rows) - saved <= 1
        run(bptt, tmp_path, "--resume", tmp_path / "checkpoint.pt", stop_after=saved + 2)
        assert checkpoint.load(tmp_path)["iteration"] == saved + 2 == len(read_progress(tmp_path))


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
@pytest.mark.parametrize("end", ["last", "signal", "error", "start"])
def test_a_directory_is_free_when_its_run_has_ended(end, tmp_path, monkeypatch, capsys):
    original, held = bptt.bptt_loss, []

    def loss(*arguments: Any) -> Tensor:
        held.append(not is_free(tmp_path))
        if end == "signal":
            signal.raise_signal(signal.SIGTERM)
        if end == "error":
            raise FloatingPointError("a mistake")
        return original(*arguments)

    arguments = *TINY, "--iterations", 2, "--quiet"
    run(bptt, tmp_path, *arguments, stop_after=1)
    monkeypatch.setattr(bptt, "bptt_loss", loss)
    if end == "start":
        monkeypatch.setattr(bptt, "BPTT", lambda *_: fail("a mistake"))
    with pytest.raises(SystemExit) if end != "last" else nullcontext():
        bptt.main(["--resume", str(tmp_path)])
    assert all(held) and len(held) == (0 if end == "start" else 1)
    assert is_free(tmp_path)


def test_a_lock_that_cannot_be_written_is_one_line(tmp_path, capsys):
    (tmp_path / "lock").mkdir()
    error = refusal(lambda: bptt.main([*TINY, "--iterations", "2", "--run-dir", str(tmp_path)]), capsys)
    assert error == f"script.py: cannot write to run directory {tmp_path}: Is a directory"


REWARDS = {
    "detached": lambda obs, action: obs[..., 0].detach() - 0.1 * action.square().sum(-1),
    "jumps": lambda obs, action: (obs[..., 0] > 0).float() - 0.1 * action.square().sum(-1),
    "rounded": lambda obs, action: (10 * obs[..., 0]).round(),
    "integer": lambda obs, action: (obs[..., 0] > 0).long(),
    "smooth": lambda obs, action: -obs[..., 0].square(),
    "smooth in one place": lambda obs, action: obs[..., 1].clamp(min=0.02),
}


@pytest.mark.parametrize("kind", REWARDS)
def test_a_reward_without_a_gradient_is_told_to_learners_that_need_one(kind, monkeypatch, capsys):
    monkeypatch.setattr(CartPole, "reward", lambda self, obs, action: REWARDS[kind](obs, action))
    for name in ("shac", "rpo", "bptt", "sapo", "ppo_baseline"):
        args = parse(importlib.import_module(name).Args, [*TINY, "--num-envs", "8"])
        Run(args).make_env(8, args.horizon)
        told, needs = "".join(capsys.readouterr()), name != "ppo_baseline" and not kind.startswith("smooth")
        assert ("the reward of cartpole has no gradient in the robot's state" in told) == needs, (name, told)
        assert told.count("\n") == needs


# What it counts -------------------------------------------------------------------------------------------------------


def test_bad_gradients_and_states_are_counted_across_a_resume(tmp_path, monkeypatch, capsys):
    """In the second iteration the loss is too large and an environment leaves the finite numbers; adjoints in each."""
    loss, collect, calls = shac.actor_loss, shac.collect, []

    def sometimes_large(*arguments: Any) -> Tensor:
        return loss(*arguments) * (1e12 if len(calls) == 2 else 1.0)

    def sometimes_thrown(env: DiffEnv, *arguments: Any) -> shac.Rollout:
        calls.append(1)
        env.sim.nonfinite_gradients[1:] += len(calls)  # in each of two environments
        if len(calls) == 2:
            env.qvel = env.qvel.clone()
            env.qvel[1] = torch.inf
        return collect(env, *arguments)

    monkeypatch.setattr(shac, "actor_loss", sometimes_large)
    monkeypatch.setattr(shac, "collect", sometimes_thrown)
    saved = run(shac, tmp_path, *SMALL["shac"], stop_after=3)
    optimizer = saved["modules"]["actor_optimizer"]
    assert optimizer["skipped"] == 1 and optimizer["adam"][0]["step"] == 2
    assert saved["totals"] == {"sim/nonfinite": 1, "sim/nonfinite_gradients": 12}
    summary = "skipped 1 updates, contained 1 non-finite states and {} gradients"
    assert summary.format(12) in capsys.readouterr().out
    run(shac, tmp_path, "--resume", tmp_path / "checkpoint.pt", stop_after=5)
    assert summary.format(30) in capsys.readouterr().out
    for name in ("grad_skipped", "sim_nonfinite"):
        assert [float(row[name]) for row in read_progress(tmp_path)] == [0, 1, 1, 1, 1]
    assert [float(row["sim_nonfinite_gradients"]) for row in read_progress(tmp_path)] == [2, 6, 12, 20, 30]


def test_other_hyperparameters_hold_from_a_resume_on(tmp_path):
    ends = list[Tensor]()
    run(bptt, tmp_path / "start", *TINY, "--iterations", 4, "--quiet", stop_after=2)
    for arguments in ([], ["--lr", "1e-6"], ["--gamma", "0.5"]):
        path = shutil.copytree(tmp_path / "start", tmp_path / str(len(ends))) / "checkpoint.pt"
        bptt.main(["--resume", str(path), *arguments])
        ends.append(checkpoint.load(path)["modules"]["actor"]["mean.0.weight"])
    assert all(not torch.equal(end, ends[0]) for end in ends[1:])


# What it shows --------------------------------------------------------------------------------------------------------


def test_a_run_goes_on_by_new_episodes_on_other_ground(tmp_path, monkeypatch):
    monkeypatch.setattr(diffsim.Simulator, "advance", lambda _, qpos, qvel, ctrl: (qpos, qvel + 0.01 * ctrl.sum()))
    words = "--num-envs 4 --horizon 4 --critic-iterations 1 --eval-episodes 1 --eval-every 0 --quiet"
    flags = [*words.split(), *"--device cpu --env hopper:rough=20 --iterations 2".split()]
    run(shac, first := tmp_path / "first", *flags, stop_after=1)
    for rough, length in (("20", 8), ("10", 4)):
        shutil.copytree(first, path := tmp_path / rough)
        shac.main(["--resume", str(path), "--env", f"hopper:rough={rough}", "--quiet"])
        (rank,) = checkpoint.load(path / "checkpoint.pt")["ranks"]
        assert (rank["env"]["episode_step"] == length).all()


def test_a_file_that_is_named_from_another_directory_continues_its_episodes(tmp_path, monkeypatch):
    text = "from diffsim.tasks.cartpole import CartPole\nclass Mine(CartPole):\n    name = 'mine'\n"
    (file := tmp_path / "mine.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    run(bptt, tmp_path / "run", *TINY, "--env", "mine.py", "--iterations", 2, "--quiet", stop_after=1)
    monkeypatch.chdir("/")
    state = run(bptt, tmp_path / "run", "--resume", tmp_path / "run", "--env", file, "--quiet")
    assert (state["ranks"][0]["env"]["episode_step"] == 16).all()


def test_progress_and_messages(tmp_path, capsys):
    arguments = *TINY, "--iterations", 3, "--eval-every", 2
    run(bptt, tmp_path / "loud", *arguments)
    out = capsys.readouterr().out
    assert "3/3" in out and "it/s" in out and "iteration 2: return median" in out
    summary = out[out.index("cartpole: 3 iterations, 48 control steps, ") :]
    assert "evaluation of iteration 3, 1 episodes: return median" in summary
    assert f"written to {tmp_path / 'loud'}" in summary
    run(bptt, tmp_path / "quiet", *arguments, "--quiet")
    out = capsys.readouterr().out
    assert out.startswith("cartpole: 3 iterations, ") and "it/s" not in out


def test_skipped_updates_and_steps_that_do_not_converge_are_told_when_they_have_doubled(tmp_path, monkeypatch, capsys):
    """The simulator counts the latter; a line tells the sum over all environments and iterations."""
    collect = bptt.collect

    def counted(env: DiffEnv, *arguments: Any) -> bptt.Rollout:
        env.sim.unconverged += 1  # in each of two environments
        return collect(env, *arguments)

    monkeypatch.setattr(bptt, "collect", counted)
    monkeypatch.setattr(diffsim.Simulator, "advance", lambda _, qpos, qvel, ctrl: (qpos, qvel + ctrl))  # no kernel
    monkeypatch.setattr(bptt, "ClippedAdam", lambda *given, **named: ClippedAdam(*given, **named | {"skip_norm": 0.0}))
    run(bptt, tmp_path, *TINY, "--contact", "mujoco", "--iterations", 8)
    updates, steps = "updates skipped so far because of their gradients", "control steps so far in which Newton's"
    out = capsys.readouterr().out
    for words, count in ((updates, 1), (f"{steps} method did not converge", 2)):
        told = re.findall(rf"iteration (\d): {words}: (\d+)", out)
        assert told == [(f"{k}", f"{count * k}") for k in (1, 3, 7)]
    assert [float(row["sim_unconverged"]) for row in read_progress(tmp_path)] == [2, 4, 6, 8, 10, 12, 14, 16]


def test_runs_without_a_directory_have_one_of_their_own(tmp_path, monkeypatch):
    """Also those that begin in the same second."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.time", lambda: 1700000000.5)
    for _ in range(3):
        bptt.main([*TINY, "--iterations", "1", "--quiet"])
    name = "cartpole__bptt__1__1700000000"
    assert {path.name for path in Path("runs").iterdir()} == {name, f"{name}.2", f"{name}.3"}
    assert all(json.loads((path / "args.json").read_text())["run_dir"] == str(path) for path in Path("runs").iterdir())


def test_a_renamed_copy_trains_resumes_and_evaluates(tmp_path, monkeypatch):
    """What users do, under a name that is no identifier; the first time as a process of its own."""
    copy = tmp_path / "my-bptt.py"
    copy.write_text((ROOT / "bptt.py").read_text())
    monkeypatch.chdir(tmp_path)
    first = [*TINY, "--iterations", "2", "--quiet"]
    result = subprocess.run([sys.executable, copy.name, *first], capture_output=True, text=True, check=True)
    assert "2 iterations, 32 control steps" in result.stdout and "16 substeps: return median" in result.stdout
    (directory,) = Path("runs").glob("cartpole__my-bptt__1__*")
    path = directory / "checkpoint.pt"
    for arguments in (["--resume", str(path), "--iterations", "3", "--quiet"], ["--evaluate", str(path)]):
        monkeypatch.setattr(sys, "argv", [copy.name, *arguments])
        runpy.run_path(copy.name, run_name="__main__")
    state = torch.load(path, weights_only=True)
    assert (state["script"], state["iteration"], len(read_progress(directory))) == (copy.stem, 3, 3)
    assert json.loads((directory / "evaluation.json").read_text())["settings"]["script"] == copy.stem
    assert_same(dict(load_policy(path).network.state_dict()), dict(state["policy"]["weights"]))


# By itself ------------------------------------------------------------------------------------------------------------


class Counter:
    """A learner that needs no environment: it counts."""

    def __init__(self) -> None:
        self.layer = nn.Linear(5, 1)
        self.policy = nn.Sequential(self.layer)

    @property
    def bias(self) -> Tensor:
        return self.layer.bias

    def update(self) -> dict[str, Tensor]:
        with torch.no_grad():
            self.bias.add_(1)
        return {"losses/bias": self.bias[0]}


def count(args: bptt.Args) -> Counter:
    """Control steps are counted by the learner, numbers of the host are logged beside those of the device."""
    run = Run(args)
    counter = run.restore(Counter())
    update = run.capture(counter.update)
    for iteration in run:
        run.log(update() | {"charts/square": iteration**2}, control_steps=100)
        if run.evaluation_due:
            evaluation = evaluate(run.eval_env, counter.policy)
            evaluation.others["further"] = 3.5
            run.log_evaluation(evaluation)
    return counter


def test_a_learner_without_training_environments(tmp_path, capsys):
    arguments = [*TINY, "--iterations", "4", "--eval-every", "3", "--run-dir", str(tmp_path)]
    with stopped(2):
        count(parse(bptt.Args, [*arguments, "--quiet"]))
    drawn = torch.rand(1)
    counter = count(parse(bptt.Args, ["--resume", str(tmp_path / "checkpoint.pt")]))
    assert torch.equal(drawn, torch.rand(1))  # random numbers go on too
    rows = read_progress(tmp_path)
    assert [row["control_steps"] for row in rows] == ["100", "200", "300", "400"]
    assert [float(row["charts_square"]) for row in rows] == [1, 4, 9, 16]
    losses = [float(row["losses_bias"]) for row in rows]
    assert losses == pytest.approx([losses[0] + k for k in range(4)]) and losses[3] == pytest.approx(
        counter.bias.item()
    )
    assert [row["eval_further"] for row in rows] == ["", "", "3.5", "3.5"]
    assert all(float(row["time_update"]) > 0 for row in rows)
    own = {"charts_square", "charts_SPS", "losses_bias", "time_update", "time_total", "eval_further"}
    assert rows[0].keys() == own | {*COLUMNS}
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)
    total = sum(float(row["time_total"]) for row in rows)
    assert seconds[-1] == pytest.approx(total, abs=1e-3)
    assert "skipped" not in capsys.readouterr().out


def test_control_steps_accumulate_when_a_resume_changes_the_window(tmp_path):
    run(bptt, tmp_path, *TINY, "--iterations", 4, "--quiet", stop_after=2)
    bptt.main(["--resume", str(tmp_path / "checkpoint.pt"), "--horizon", "3"])
    rows = read_progress(tmp_path)
    assert [row["control_steps"] for row in rows] == ["16", "32", "38", "44"]
    assert all(float(row["charts_SPS"]) > 0 for row in rows)
    assert checkpoint.load(tmp_path / "checkpoint.pt")["control_steps"] == 44
