"""Evaluations: the first episode of each environment, and what is written of it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import run
from torch import nn

import diffsim
import shac
from diffsim.training import Evaluation, evaluate, evaluation
from diffsim_cli import render
from diffsim_cli.watch import film_median


@pytest.fixture(scope="module")
def policy() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(37, 8), nn.ELU(), nn.Linear(8, 8), nn.Tanh())


@pytest.fixture(scope="module")
def ants() -> diffsim.DiffEnv:
    return diffsim.make("ant", num_envs=4, horizon=1, threads=1)


@pytest.fixture(scope="module")
def result(ants: diffsim.DiffEnv, policy: nn.Module) -> Evaluation:
    return evaluate(ants, policy)


def test_first_episodes_only_are_counted(result: Evaluation, ants: diffsim.DiffEnv, policy: nn.Module) -> None:
    """Against a loop over each environment's own rewards, for ants that fall at different times."""
    obs, _ = ants.reset(seed=evaluation.SEED)
    total, length, ended = [0.0] * 4, [0] * 4, [False] * 4
    path = [[] for _ in range(4)]
    with torch.no_grad():
        while not all(ended):
            before = ants.qpos.clone()
            obs, reward, terminated, truncated, _ = ants.step(policy(obs))
            for i in range(4):
                if not ended[i]:
                    path[i].append(before[i])
                    total[i], length[i] = total[i] + reward[i].item(), length[i] + 1
                    ended[i] = bool(terminated[i] or truncated[i])
    np.testing.assert_allclose(result.returns, total, rtol=1e-4)
    assert result.lengths.tolist() == length and len(set(length)) > 1
    assert result.length == pytest.approx(sum(length) / 4)
    for i in range(4):
        assert torch.equal(result.qpos[: length[i], i], torch.stack(path[i]))
    assert not result.returns.requires_grad and not result.qpos.requires_grad
    distance = sum((states[-1][0] - states[0][0]).item() for states in path)
    assert result.speed == pytest.approx(distance / ((sum(length) - 4) / 60), rel=1e-4)


def test_evaluations_are_alike_whatever_was_before() -> None:
    """As of environments whose state a graph keeps in place, which a reset has to write there."""
    env, policy = diffsim.make("ant", num_envs=4, seed=0), torch.nn.Linear(37, 8)
    player, expected = evaluation.Player(env, policy), evaluate(diffsim.make("ant", num_envs=4), policy)
    player.evaluate(seed=5)
    pinned = env.pin_rollout()
    again = player.evaluate()
    assert torch.equal(again.returns, expected.returns) and torch.equal(again.qpos, expected.qpos)
    env.reset(seed=evaluation.SEED)
    assert env.qpos is pinned[0] and torch.equal(env.qpos, expected.qpos[0])


def test_terms_of_the_reward_sum_up_to_the_return() -> None:
    """Of robots that fall at different times, after which they begin anew."""
    env = diffsim.make("go2", num_envs=4, max_episode_steps=30)
    fixed = torch.rand(12, generator=torch.Generator().manual_seed(0))
    offsets = torch.linspace(0.0, 3.0, 4).unsqueeze(1)
    player = evaluation.Player(env, lambda obs: offsets * (2.0 * fixed - 1.0))
    for _ in range(2):
        found = player.evaluate()
        assert len(found.lengths.unique()) > 1 and found.lengths.max() == 30
        values = {name: value for name, value in found.scalars().items() if name.startswith("eval/reward_")}
        assert values.keys() == {f"eval/reward_{name}" for name in set(env.task.weights) - {"feet_apart"}}
        assert sum(values.values()) == pytest.approx(found.returns.mean().item(), rel=1e-4)
        assert values["eval/reward_alive"] == pytest.approx(4.0 * found.length)
        assert values["eval/reward_action_rate"] < 0 and "reward" not in str(found)


def some(result: Evaluation, **changes: Any) -> Evaluation:
    returns, lengths = torch.tensor([4.0, 1.0, 3.0, 100.0, 2.0]), torch.tensor([5, 2, 7, 10, 1])
    qpos = torch.arange(10.0).reshape(10, 1, 1).expand(10, 5, 15)
    motion = dict(qpos=qpos, action=qpos[..., :8] / 10, scene=result.scene, control_dt=1 / 60)
    return Evaluation(**dict(returns=returns, lengths=lengths, speed=1.25) | motion | changes)


def test_numbers_of_an_evaluation(result: Evaluation, tmp_path: Path) -> None:
    five = some(result)
    assert five.scalars() == {"eval/return": 3.0, "eval/length": 5.0, "eval/speed": 1.25}
    assert str(five) == ("return median 3.0, mean 22.0, std 39.0, min 1.0, length 5.0, forward speed 1.25 m/s")
    args = shac.Args(env="cartpole", device="cpu", run_dir=tmp_path / "new")
    evaluation.write_evaluation(args, dataclasses.replace(five, speed=None), 7, finer=0.5)
    written = json.loads((tmp_path / "new" / "evaluation.json").read_text())
    settings = {"env": "cartpole", "device": "cpu", "substeps": 16, "script": "shac", "iteration": 7}
    assert written.pop("settings").items() > settings.items()
    assert written == {
        "return": 3.0,
        "length": 5.0,
        "speed": None,
        "finer": 0.5,
        "returns": [4.0, 1.0, 3.0, 100.0, 2.0],
        "lengths": [5, 2, 7, 10, 1],
    }


def test_the_video_is_of_the_median_episode(
    result: Evaluation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filmed = []

    def film(path: Path, scene: diffsim.Scene, qpos: np.ndarray, dt: float, ctrl: np.ndarray, ghost: None) -> Path:
        filmed.append((scene, qpos, dt, ctrl))
        return path

    monkeypatch.setattr(render, "film", film)
    assert film_median(some(result), tmp_path / "video.mp4") == tmp_path / "video.mp4"
    ((scene, qpos, dt, ctrl),) = filmed
    assert scene is result.scene and dt == 1 / 60
    np.testing.assert_array_equal(qpos[:, 0], range(7))  # seven steps of the episode of return 3
    np.testing.assert_allclose(ctrl[:, 0], np.arange(7) / 10, rtol=1e-6)
    film_median(some(result, control_dt=2.0), tmp_path / "video.mp4")
    assert len(filmed[1][1]) == 5  # ten seconds


def test_evaluate_a_checkpoint_with_other_substeps(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Returns of cartpole are costs, so the share that is kept is the inverse ratio."""

    def found(folder: str, *flags: str, compared: bool = False) -> dict[str, Any]:
        monkeypatch.setattr(Evaluation, "compared", compared)
        path = tmp_path / "new" / folder
        shac.main(["--evaluate", str(tiny_run / "checkpoint.pt"), "--run-dir", str(path), *flags])
        return json.loads((path / "evaluation.json").read_text())

    own = found("own", compared=True)
    finer, out = own.pop("finer"), capsys.readouterr().out
    assert own == json.loads((tiny_run / "evaluation.json").read_text()) and "gait" not in out
    assert own["speed"] is None and own["lengths"] == [240, 240]  # a robot without ground
    assert out.startswith(f"cartpole, 2 episodes: return median {own['return']:.1f}, mean ")
    assert finer["substeps"] == 16 and finer["kept"] == pytest.approx(own["return"] / finer["return"])
    assert f"\n16 substeps: return median {finer['return']:.1f}, {finer['kept']:.1%} retained" in out
    explicit = found("explicit", *"--no-implicit --substeps 16".split())
    assert explicit["return"] == finer["return"] and "finer" not in explicit
    other = found("other", *"--substeps 16 --eval-episodes 4".split())["settings"]
    assert (other["substeps"], other["eval_episodes"], other["iteration"]) == (16, 4, 2)


def test_a_run_ends_with_the_return_at_finer_substeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As --evaluate says it, unless the run is stopped early."""
    monkeypatch.setattr(Evaluation, "compared", True)
    flags = "--env cartpole --device cpu --num-envs 4 --horizon 4 --iterations 3 --eval-episodes 2 --quiet"
    run(shac, tmp_path, *flags.split(), stop_after=2)
    assert "retained" not in capsys.readouterr().out
    run(shac, tmp_path, "--resume", tmp_path)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "retained" in line]
    written = json.loads((tmp_path / "evaluation.json").read_text())
    shac.main(["--evaluate", str(tmp_path)])
    assert line in capsys.readouterr().out and line.startswith("16 substeps: return median ")
    assert json.loads((tmp_path / "evaluation.json").read_text()) == written and written["finer"]["substeps"] == 16
