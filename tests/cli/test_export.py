"""Exported policies: as ONNX they act as the network does; as a checkpoint they are small."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import refusal
from torch import nn

import diffsim
import shac
from diffsim import tasks
from diffsim.learning.likeliest import Likeliest
from diffsim.tasks.base import ASSETS
from diffsim.training import ObsNormalizer, load_policy, parse
from diffsim.training.checkpoint import save
from diffsim_cli import commands as command
from diffsim_robots.imitation import task as imitation
from diffsim_robots.imitation.clip import Clip, read_clip
from diffsim_robots.imitation.tracking import G1Track
from diffsim_robots.unitree import Go1

STATE: dict[str, Any] = {"args": {"env": "cartpole"}, "iteration": 1}


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
    env = diffsim.make("g1_track:g1_jazz_walk", 3, seed=0)
    args = parse(shac.Args, "--env g1_track:g1_jazz_walk --device cpu --actor-hidden 16".split())
    policy = shac.Actor(args, env).deterministic()
    kept = {name: value for name, value in dataclasses.asdict(args).items() if not isinstance(value, Path)}
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
def test_an_exported_policy_holds_a_clip_that_is_not_shipped_and_may_have_16_bits(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = read_clip("g1_jazz_walk")
    if name != "g1_jazz_walk":
        clip = Clip(name, clip.qpos, False)
    torch.manual_seed(0)
    policy, task = nn.Sequential(nn.Linear(224, 29)), G1Track.with_clip(clip)
    state = STATE | {"args": {"env": f"g1_track:{name}"}, "iteration": 7, "task": task.stored()}
    save(path := tmp_path / "checkpoint.pt", "my_shac", Alone(policy), state)
    sizes = []
    for half in ([], ["--half"]):
        command.main(["export", str(path), str(output := tmp_path / "policy.pt"), *half])
        sizes.append(output.stat().st_size)
        monkeypatch.setattr(imitation, "RESTORED", {})
        saved = load_policy(output)
        assert tasks.find_task(saved.args["env"])().clip == clip  # type: ignore[attr-defined]
        assert (output.stat().st_size < 50_000) == (name == "g1_jazz_walk")
        wanted = policy[0].weight.half().float() if half else policy[0].weight
        assert torch.equal(saved.network[0].weight, wanted)
    assert sizes[0] - sizes[1] == pytest.approx(2 * (224 + 1) * 29, abs=200)


def test_weights_that_16_bits_cannot_hold_are_refused(tiny_run: Path, tmp_path: Path, capsys) -> None:
    state = torch.load(tiny_run / "checkpoint.pt")
    state["policy"]["weights"]["1.bias"][0] = 1e5
    torch.save(state, path := tmp_path / "checkpoint.pt")
    words = ["export", str(path), str(tmp_path / "policy.pt")]
    error = refusal(lambda: command.main([*words, "--half"]), capsys)
    assert error.endswith("weight 1.bias of the policy is too large for 16 bits") and [*tmp_path.iterdir()] == [path]
    command.main(words)


@pytest.mark.parametrize("symmetric", [False, True])
def test_onnx_takes_only_what_the_actor_sees(symmetric, tmp_path):
    torch.manual_seed(0)
    env = diffsim.make("go1", 1)
    seen, whole = Go1.actor_dim, Go1.obs_dim
    args = parse(shac.Args, "--env go1 --device cpu --actor-hidden 16".split())
    args.symmetric = symmetric
    actor = shac.SHAC(args, env).actor
    actor.normalizer.update(3.0 + 2.0 * torch.randn(100, whole) * torch.rand(whole))
    kept = {name: value for name, value in dataclasses.asdict(args).items() if not isinstance(value, Path)}
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
