"""Checkpoints: written whole or not at all, refused in one line, loaded for any script."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from learners import SCRIPTS, refusal
from torch import nn

import diffsim
from diffsim.training import Stateful, load_policy, parse
from diffsim.training.checkpoint import FORMAT, load, restore, save


class Tiny:
    """The least that a learner is."""

    def __init__(self) -> None:
        self.policy = nn.Sequential(nn.Linear(2, 1))
        self.modules: dict[str, Stateful] = {}


def test_a_crash_while_saving_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint.pt"
    save(path, "shac", Tiny(), {"iteration": 1})
    whole = path.read_bytes()

    def crash(file: Path, data: bytes) -> None:
        file.open("wb").write(data[:100])
        raise OSError("no space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        patch.setattr(Path, "write_bytes", crash)
        save(path, "shac", Tiny(), {"iteration": 2})
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == whole and load(path, "shac")["iteration"] == 1
    assert load(path)["format"] == FORMAT and load(path)["script"] == "shac"
    save(path, "shac", Tiny(), {"iteration": 3})
    assert load(path)["iteration"] == 3
    assert list(tmp_path.iterdir()) == [path]


def test_anything_else_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "checkpoint.pt"
    assert refusal(lambda: load(path), capsys).endswith(f": no such checkpoint: {path}")
    assert refusal(lambda: load(tmp_path), capsys).endswith(f": no such checkpoint: {tmp_path}")
    save(path, "shac", Tiny(), {})
    assert refusal(lambda: load(path, "bptt"), capsys).endswith(f": {path} is a checkpoint of shac.py, not of bptt.py")
    whole = path.read_bytes()
    middle = len(whole) // 2
    inverted = whole[:middle] + bytes(255 - byte for byte in whole[middle : middle + 400]) + whole[middle + 400 :]
    for broken in (b"", b"hello", whole[:100], whole[:-10], inverted):
        path.write_bytes(broken)
        assert refusal(lambda: load(path, "bptt"), capsys).endswith(f": {path} is not a whole checkpoint of bptt.py")
        assert refusal(lambda: load(path), capsys).endswith(f": {path} is not a whole checkpoint")
    for older in ("shac-1", 1):
        torch.save({"format": older, "actor": {}}, path)
        message = f": {path} is a checkpoint of format {older}, and this version reads format {FORMAT}"
        assert refusal(lambda: load(path, "shac"), capsys).endswith(message)
    for foreign in ({"weights": torch.zeros(3)}, [1, 2], {"format": FORMAT}):
        torch.save(foreign, path)
        assert refusal(lambda: load(path), capsys).endswith(f": {path} is not a whole checkpoint")


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_loaded_policy_acts_as_the_saved_one(name: str, tmp_path: Path) -> None:
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
    save(path, f"my-{name}", learner, {"args": {"env": "cartpole"}, "iteration": 7})
    loaded, obs = load_policy(path), 3.0 + 2.0 * torch.randn(7, 5, env.task.obs_dim)
    assert (loaded.script, loaded.args, loaded.iteration) == (f"my-{name}", {"env": "cartpole"}, 7)
    torch.testing.assert_close(loaded.network(obs), learner.policy(obs), rtol=0, atol=0)
    state = load(path, f"my-{name}")
    assert state["modules"].keys() == learner.modules.keys()
    for parameter in learner.policy.parameters():
        parameter.data.zero_()
    assert loaded.network(obs).abs().max() > 1e-3  # its weights are its own
    restore(learner, state)
    torch.testing.assert_close(loaded.network(obs), learner.policy(obs), rtol=0, atol=0)


def test_a_layer_that_cannot_be_saved_is_named(tmp_path: Path) -> None:
    learner = Tiny()
    learner.policy.append(nn.Dropout())
    with pytest.raises(TypeError, match="layer Dropout; .* has ELU, LayerNorm, Likeliest, Linear"):
        save(tmp_path / "checkpoint.pt", "shac", learner, {})
    assert not list(tmp_path.iterdir())


def test_weights_of_other_sizes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    learner = Tiny()
    learner.modules = {"policy": learner.policy}
    for other in ({"policy": nn.Sequential(nn.Linear(3, 1)).state_dict()}, {}):
        error = refusal(lambda other=other: restore(learner, {"modules": other}), capsys)  # type: ignore[misc]
        assert "the checkpoint does not fit the script as it is now: " in error


def test_a_policy_that_is_not_whole_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "checkpoint.pt"
    save(path, "shac", Tiny(), {"args": {}, "iteration": 1})
    state = load(path)
    assert load_policy(path).iteration == 1
    for policy in ({}, state["policy"] | {"weights": {}}):
        torch.save(state | {"policy": policy}, path)
        assert refusal(lambda: load_policy(path), capsys).endswith(f"{path} is not a whole checkpoint")
