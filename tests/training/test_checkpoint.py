"""Checkpoints: written whole or not at all, refused in one line, loaded for any script."""

from __future__ import annotations

import functools
import math
import operator
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import SCRIPTS, refusal
from torch import nn

import diffsim
import shac
from diffsim.training import load_policy, parse
from diffsim.training.checkpoint import FORMAT, load, restore, save
from diffsim_cli import commands

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


def test_an_argument_may_have_any_other_character(tmp_path):
    """Those of a folder of a task of your own, say: a no-break space, and one that is no UTF-8."""
    for name in ("my\xa0task.py", "my\udcfftask.py", "m\u00fc\u200b.py"):
        save(path := tmp_path / "checkpoint.pt", "shac", Tiny(), STATE | {"args": {"env": name}})
        assert load(path)["args"]["env"] == name


def test_weights_are_compared_before_layers_are_built(tmp_path, capsys):
    path = tmp_path / "checkpoint.pt"
    save(path, "shac", Tiny(), STATE)
    state = torch.load(path)
    for layers in ([["Linear", 10**9, 10**9]], [["Linear", "2", 1]], [["Linear"]], [["LayerNorm", -1]]):
        torch.save(state | {"policy": state["policy"] | {"layers": layers}}, path)
        assert "its policy's weights do not fit its layers" in refusal(lambda: load_policy(path), capsys)


@pytest.mark.parametrize(
    ("places", "value", "message"),
    [
        ("args", [1], "is not a complete checkpoint"),
        ("args", {"a": [{}]}, "is not a complete checkpoint"),
        ("args env", None, "is not a complete checkpoint"),
        ("args env", 10**12, "is not a complete checkpoint"),
        ("script", 5, "is not a complete checkpoint"),
        ("script", "evil\x1b[31m", "is not a complete checkpoint"),
        ("iteration", "7\nERROR: fake line", "is not a complete checkpoint"),
        ("simulator", "\r", "is not a complete checkpoint"),
        ("args env", "cartpole:\x1b]0;", "is not a complete checkpoint"),
        ("policy weights 1.bias", torch.zeros(64, dtype=torch.complex64), "weights do not fit its layers"),
        ("policy weights 1.bias", torch.full((64,), math.nan), "weight 1.bias of the policy is not finite"),
        ("policy weights 0.std", torch.full((5,), math.inf), "weight 0.std of the policy is not finite"),
    ],
)
def test_what_was_never_saved_is_one_printable_line(places, value, message, tiny_run, tmp_path, capsys):
    """No argument of another type, no terminal codes, no weight that would command NaN to a robot."""
    state = torch.load(tiny_run / "checkpoint.pt")
    *path, last = places.split()
    functools.reduce(operator.getitem, path, state)[last] = value
    torch.save(state, crafted := tmp_path / "crafted.pt")
    for output in ("policy.pt", "policy.onnx"):
        error = refusal(lambda name=output: commands.main(["export", str(crafted), str(tmp_path / name)]), capsys)
        assert message in error and error.isprintable()
    assert [*tmp_path.iterdir()] == [crafted]


@pytest.mark.parametrize(
    ("places", "value"),
    [
        ("args critic_hidden", (b"x",)),
        ("args substeps", torch.Size([3])),
        ("args target_alpha", None),
        ("args contact", "hard"),
        ("args check", 1),
        ("ranks 0 env", None),
        ("ranks 0 env qpos", math.nan),
        ("ranks 0 env qvel", torch.zeros(0)),
        ("ranks 0 env task", "ant"),
        ("ranks 0 env generator", math.inf),
        ("modules critic_optimizer adam 0", []),
        ("modules critic_optimizer adam 0 exp_avg", None),
        ("modules critic_optimizer adam 0 exp_avg_sq", torch.zeros(3)),
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
    with pytest.raises(TypeError, match="layer Dropout; .* has ELU, First, LayerNorm, Likeliest"):
        save(tmp_path / "checkpoint.pt", "shac", learner, STATE)
    assert not list(tmp_path.iterdir())


def test_weights_of_other_sizes_are_one_line(capsys):
    learner = Tiny()
    for other in ({"layer": nn.Linear(3, 1).state_dict()}, {}, {"layer": 3}):
        error = refusal(lambda other=other: restore(learner, {"modules": other}), capsys)  # type: ignore[misc]
        assert "the checkpoint does not fit the flags, or the script as it is now: " in error
