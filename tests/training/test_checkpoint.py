"""Checkpoints: written whole or not at all, refused in one line, loaded for any script."""

from __future__ import annotations

import functools
import math
import operator
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import SCRIPTS, refusal
from torch import nn

import diffsim
import shac
from diffsim import __main__ as command
from diffsim.tasks import Go1
from diffsim.tasks.base import ASSETS
from diffsim.training import Likeliest, ObsNormalizer, load_policy, parse
from diffsim.training.checkpoint import FORMAT, load, restore, save

STATE: dict[str, Any] = {
    "args": {"env": "cartpole"},
    "iteration": 1,
    "control_steps": 5,
    "seconds": 0.5,
    "totals": {"sim/nonfinite": 0},
    "episodes": [(2.0, 3.0, 4.0)],
    "ranks": [{"env": None, "rng": torch.get_rng_state()}],
}


class Tiny:
    """The least that a learner is."""

    def __init__(self) -> None:
        self.policy = nn.Sequential(nn.Linear(2, 1))
        self.layer = nn.Linear(2, 1)


def test_a_crash_while_saving_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.pt"
    save(path, "shac", Tiny(), STATE)
    whole = path.read_bytes()

    def crash(file: Path, data: bytes) -> None:
        file.open("wb").write(data[:100])
        raise OSError("no space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        patch.setattr(Path, "write_bytes", crash)
        save(path, "shac", Tiny(), STATE | {"iteration": 2})
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == whole and load(path, "shac")["iteration"] == 1
    assert load(path)["format"] == FORMAT and load(path)["script"] == "shac"
    save(path, "shac", Tiny(), STATE | {"iteration": 3})
    assert load(path)["iteration"] == 3
    assert list(tmp_path.iterdir()) == [path]


def test_anything_else_is_refused_in_one_line(tmp_path, capsys):
    path = tmp_path / "checkpoint.pt"
    assert refusal(lambda: load(path), capsys).endswith(f": no such checkpoint: {path}")
    assert refusal(lambda: load(tmp_path), capsys).endswith(f": no such checkpoint: {path}")  # of a folder
    save(path, "shac", Tiny(), STATE)
    assert refusal(lambda: load(path, "bptt"), capsys).endswith(f": {path} is a checkpoint of 'shac', not of bptt.py")
    whole = path.read_bytes()
    middle = len(whole) // 2
    inverted = whole[:middle] + bytes(255 - byte for byte in whole[middle : middle + 400]) + whole[middle + 400 :]
    for broken in (b"", b"hello", whole[:100], whole[:-10], inverted):
        path.write_bytes(broken)
        assert f": {path} is not a complete checkpoint of bptt.py" in refusal(lambda: load(path, "bptt"), capsys)
        assert f": {path} is not a complete checkpoint" in refusal(lambda: load(path), capsys)
    for older in ("shac-1", 1):
        torch.save({"format": older, "actor": {}}, path)
        message = f": {path} is a checkpoint of format {older!r}, and this version reads format {FORMAT}"
        assert refusal(lambda: load(path, "shac"), capsys).endswith(message)
    for foreign in ({"weights": torch.zeros(3)}, [1, 2], {"format": FORMAT}):
        torch.save(foreign, path)
        assert f": {path} is not a complete checkpoint" in refusal(lambda: load(path), capsys)


def test_weights_are_compared_before_layers_are_built(tmp_path, capsys):
    path = tmp_path / "checkpoint.pt"
    save(path, "shac", Tiny(), STATE)
    state = torch.load(path)
    for layers in ([["Linear", 10**9, 10**9]], [["Linear", "2", 1]], [["Linear"]], [["LayerNorm", -1]]):
        torch.save(state | {"policy": state["policy"] | {"layers": layers}}, path)
        assert "its policy's weights do not fit its layers" in refusal(lambda: load_policy(path), capsys)


@pytest.mark.parametrize(
    ("places", "value"),
    [
        ("args critic_hidden", (b"x",)),
        ("args substeps", torch.Size([3])),
        ("args target_alpha", None),
        ("args integrator", "explicit"),
        ("args check", 1),
        ("ranks 0 env", None),
        ("ranks 0 env qpos", math.nan),
        ("ranks 0 env qvel", torch.zeros(0)),
        ("ranks 0 env task", "ant"),
        ("ranks 0 env generator", math.inf),
        ("modules critic_optimizer adam 0", []),
        ("modules critic_optimizer adam 0 exp_avg", None),
        ("modules critic_optimizer adam 0 exp_avg_sq", torch.zeros(3)),
        ("modules critic_optimizer skipped", torch.tensor(math.inf)),
        ("modules critic_optimizer", None),
    ],
)
def test_what_a_run_cannot_resume_is_one_line(places, value, tiny_run, tmp_path, capsys):
    state = torch.load(tiny_run / "checkpoint.pt")
    *path, last = (int(place) if place.isdigit() else place for place in places.split())
    functools.reduce(operator.getitem, path, state)[last] = value
    torch.save(state, damaged := tmp_path / "checkpoint.pt")
    refusal(lambda: shac.main(["--resume", str(damaged), "--iterations", "3", "--quiet"]), capsys)


def test_the_policy_of_another_robot_is_one_line(tiny_run, tmp_path, capsys):
    state, path = torch.load(tiny_run / "checkpoint.pt"), tmp_path / "checkpoint.pt"
    torch.save(state | {"args": state["args"] | {"env": "hopper"}}, path)
    for call in (lambda: load_policy(path), lambda: shac.main(["--evaluate", str(path)])):
        assert "its policy's weights do not fit its layers or its task" in refusal(call, capsys)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_loaded_policy_acts_as_the_saved_one(name, tmp_path):
    """Without the script, whatever its name, and with the statistics of the observations."""
    torch.manual_seed(0)
    args = parse(SCRIPTS[name].Args, "--env cartpole --device cpu --num-envs 2 --horizon 4".split())
    env = diffsim.make("cartpole", num_envs=2, horizon=4)
    learner = getattr(SCRIPTS[name], {"ppo_baseline": "PPO", "pfpn": "PPO"}.get(name, name.upper()))(args, env)
    with torch.no_grad():
        for parameter in learner.policy.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    learner.policy[0].update(3.0 + 2.0 * torch.randn(100, env.task.obs_dim))
    path = tmp_path / "checkpoint.pt"
    save(path, f"my_{name}", learner, STATE | {"iteration": 7})
    loaded, obs = load_policy(path), 3.0 + 2.0 * torch.randn(7, 5, env.task.obs_dim)
    assert (loaded.script, loaded.args, loaded.iteration) == (f"my_{name}", {"env": "cartpole"}, 7)
    assert loaded.simulator == "diffsim"  # unless it says otherwise
    torch.testing.assert_close(loaded.network(obs), learner.policy(obs), rtol=0, atol=0)
    state = load(path, f"my_{name}")
    assert {"actor", "actor_critic"} & state["modules"].keys() and not {"env", "policy"} & state["modules"].keys()
    for parameter in learner.policy.parameters():
        parameter.data.zero_()
    assert loaded.network(obs).abs().max() > 1e-3  # its weights are its own
    restore(learner, state)
    torch.testing.assert_close(loaded.network(obs), learner.policy(obs), rtol=0, atol=0)


def test_a_layer_that_cannot_be_saved_is_named(tmp_path):
    learner = Tiny()
    learner.policy.append(nn.Dropout())
    with pytest.raises(TypeError, match="layer Dropout; .* has Both, ELU, First, Fold, LayerNorm, Likeliest"):
        save(tmp_path / "checkpoint.pt", "shac", learner, STATE)
    assert not list(tmp_path.iterdir())


def test_weights_of_other_sizes_are_one_line(capsys):
    learner = Tiny()
    for other in ({"layer": nn.Linear(3, 1).state_dict()}, {}, {"layer": 3}):
        error = refusal(lambda other=other: restore(learner, {"modules": other}), capsys)  # type: ignore[misc]
        assert "the checkpoint does not fit the flags, or the script as it is now: " in error


# ONNX -----------------------------------------------------------------------------------------------------------------


class Alone:
    """A learner that is its policy."""

    def __init__(self, policy: nn.Sequential) -> None:
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
        self.policy = policy


def export(checkpoint: Path, output: Path) -> tuple[Any, dict[str, str]]:
    """What `python -m diffsim export` writes, and its metadata."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxscript")
    command.main(["export", str(checkpoint), str(output)])
    model = onnx.load(output)
    onnx.checker.check_model(model, full_check=True)
    assert str(Path(diffsim.__file__).parent).encode() not in output.read_bytes()  # nothing of this machine
    return model, {entry.key: entry.value for entry in model.metadata_props}


def assert_acts_alike(model: Any, network: nn.Module, obs: torch.Tensor, columns: int) -> None:
    """On the first columns of obs, for a batch of any size; some actions are clipped."""
    from onnx.reference import ReferenceEvaluator

    evaluator = ReferenceEvaluator(model)
    (given,), (found,) = model.graph.input, model.graph.output
    assert (given.name, found.name) == ("observation", "action")
    assert [dim.dim_value for dim in given.type.tensor_type.shape.dim] == [0, columns]  # 0: any batch
    wanted = network(obs).clamp(-1, 1).detach()
    assert wanted.std(0).min() > 1e-2  # it depends on the observation
    for rows in (1, len(obs)):
        (action,) = evaluator.run(["action"], {"observation": obs[:rows, :columns].numpy()})
        torch.testing.assert_close(torch.from_numpy(action), wanted[:rows], rtol=0, atol=1e-5)


def test_a_policy_that_tracks_takes_the_clip_as_an_input(tmp_path: Path) -> None:
    """At the start of an episode, where nothing is off, and somewhat later."""
    torch.manual_seed(0)
    env = diffsim.make("g1_track", 3, seed=0, clip="g1_jazz_walk")
    args = parse(shac.Args, "--env g1_track --device cpu --actor-hidden 16 --clip g1_jazz_walk".split())
    policy = shac.Actor(args, env, None).deterministic()
    kept = {name: value for name, value in vars(args).items() if not isinstance(value, Path)}
    save(path := tmp_path / "checkpoint.pt", "my_shac", Alone(policy), STATE | {"args": kept, "iteration": 7})
    model, told = export(path, tmp_path / "policy.onnx")
    assert [each.name for each in model.graph.output] == ["action", "joint_targets"]
    assert told["clip_name"] == "g1_jazz_walk" and told["reference_frames"] == "0,1,2,3"
    assert "action_scale" not in told and "observation_names" not in told and "joint_stiffness" in told
    from onnx.reference import ReferenceEvaluator

    evaluator, names = ReferenceEvaluator(model), [each.name for each in model.graph.input]
    low, high = torch.from_numpy(env.scene.mj_model.actuator_ctrlrange).float().T
    for _ in range(3):
        qpos, qvel, memory = env.qpos, env.qvel, env.memory
        frames = torch.stack([env.task.reference(memory, k)[0] for k in range(4)], 1)  # type: ignore[attr-defined]
        last, before, speed = memory[:, 1:30], memory[:, 30:59], env.task.reference(memory)[1]  # type: ignore[attr-defined]
        parts = dict(zip(names, (qpos, qvel, last, before, frames, speed), strict=True))
        action, targets = evaluator.run(None, {name: part.numpy() for name, part in parts.items()})
        with torch.no_grad():
            wanted = policy(env.observe(qpos, qvel, last)).clamp(-1, 1)
        torch.testing.assert_close(torch.from_numpy(action), wanted, rtol=0, atol=1e-5)
        told_servos = (low + high + (high - low) * env.task.disturb(qvel, wanted, memory)[1]) / 2
        torch.testing.assert_close(torch.from_numpy(targets), told_servos, rtol=0, atol=1e-5)
        env.step(wanted)


@pytest.mark.parametrize("name", ["g1_jazz_walk", "a copy", "another"])
def test_an_exported_policy_names_a_shipped_clip_and_may_have_16_bits(name: str, tmp_path: Path) -> None:
    clip = diffsim.read_clip("g1_jazz_walk")
    if name != "g1_jazz_walk":
        clip = diffsim.Clip(name, clip.qpos, False)
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(224, 29))
    args = {"env": "g1_track", "clip": clip}
    save(path := tmp_path / "checkpoint.pt", "my_shac", Alone(policy), STATE | {"args": args, "iteration": 7})
    sizes = []
    for half in ([], ["--half"]):
        command.main(["export", str(path), str(output := tmp_path / "policy.pt"), *half])
        sizes.append(output.stat().st_size)
        saved = load_policy(output)
        assert saved.args["clip"] == clip
        assert (output.stat().st_size < 50_000) == (name == "g1_jazz_walk")
        wanted = policy[0].weight.half().float() if half else policy[0].weight
        assert torch.equal(saved.network[0].weight, wanted)
    assert sizes[0] - sizes[1] == pytest.approx(2 * (224 + 1) * 29, abs=200)


@pytest.mark.parametrize("symmetric", [False, True])
def test_onnx_takes_only_what_the_actor_sees(symmetric, tmp_path):
    torch.manual_seed(0)
    env = diffsim.make("go1", 1)
    seen, whole = Go1.actor_dim, Go1.obs_dim
    args = parse(shac.Args, "--env go1 --device cpu --actor-hidden 16".split())
    actor = shac.Actor(args, env, env.task.mirror if symmetric else None)
    actor.normalizer.update(3.0 + 2.0 * torch.randn(100, whole) * torch.rand(whole))
    kept = {name: value for name, value in vars(args).items() if not isinstance(value, Path)}
    policy = actor.deterministic()[:-1]  # without tanh: actions leave [-1, 1]
    save(path := tmp_path / "checkpoint.pt", "my_shac", Alone(policy), STATE | {"args": kept, "iteration": 7})
    model, told = export(path, tmp_path / "policy.onnx")
    obs = 3.0 + 3.0 * torch.randn(20, whole)
    assert policy(obs).abs().max() > 1.5
    assert_acts_alike(model, policy, obs, seen)
    assert [told[name] for name in ("task", "script", "iteration", "control_dt")] == ["go1", "my_shac", "7", "0.02"]
    assert told["observation_names"] == (
        "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel_x0.1,actions,command,clock_sin,clock_cos"
    )
    assert told["observation_sizes"] == "3,3,3,12,12,12,3,1,1"
    assert [told[name] for name in ("command_names", "command_range", "gait_frequency", "root_height")] == (
        ["twist", "1,0.6,1", "2", "0.27"]
    )
    scene = diffsim.load_scene(ASSETS / "go1.xml").mj_model
    low, high = scene.actuator_ctrlrange.T
    lists = "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale"
    wanted = scene.actuator_gainprm[:, 0], -scene.actuator_biasprm[:, 2], scene.key_qpos[0, 7:], (high - low) / 2
    for name, numbers in zip(lists, wanted, strict=True):
        assert list(map(float, told[name].split(","))) == pytest.approx(numbers)
    assert told["joint_names"].split(",") == [scene.joint(1 + j).name for j in range(12)]
    for text, a in zip(told["actuators"].split(","), range(12), strict=True):
        name, _, limits = text.rstrip("]").partition("[")
        assert name == scene.actuator(a).name
        assert list(map(float, limits.split(":"))) == pytest.approx(scene.actuator(a).ctrlrange)


@pytest.mark.parametrize("shared", [True, False])
def test_every_layer_as_onnx(shared, tmp_path):
    torch.manual_seed(1)
    smooth = nn.ELU(), nn.LayerNorm(16), nn.SiLU(), nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 16), nn.Softplus()
    last = nn.Linear(16, 3 if shared else 6), Likeliest(1, 3, shared), nn.Tanh()
    learner = Alone(nn.Sequential(ObsNormalizer(5), nn.Linear(5, 16), *smooth, *last))
    save(path := tmp_path / "checkpoint.pt", "pfpn", learner, STATE)
    model, told = export(path, tmp_path / "policy.onnx")
    assert_acts_alike(model, learner.policy, 3 * torch.randn(50, 5), 5)
    assert told["actuators"] == "slider[-1:1]" and "joint_stiffness" not in told  # a motor


def test_what_cannot_be_onnx_is_one_line(tiny_run, tmp_path, monkeypatch, capsys):
    def refused(name: str) -> str:
        return refusal(lambda: command.main(["export", str(tiny_run / "checkpoint.pt"), str(tmp_path / name)]), capsys)

    assert refused("policy.xml").endswith("policy.xml: its name must end in .pt or .onnx")
    for package in ("onnx", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            assert refused("policy.onnx").endswith(
                ': ONNX needs packages that are not installed: pip install -e ".[onnx]"'
            )
    assert not list(tmp_path.iterdir())
