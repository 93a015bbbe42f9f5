"""The examples run, in small, and show what they say; those with another library where it is installed."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from learners import refusal

import diffsim
from diffsim.training import load_policy
from diffsim.view import render

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Some examples write runs/; SHAC's classes and CleanRL's script draw from torch's generator."""
    monkeypatch.chdir(tmp_path)
    state = torch.get_rng_state()
    yield
    torch.set_rng_state(state)


# The simulator on its own ---------------------------------------------------------------------------------------------


def test_trajectory_optimisation() -> None:
    path, costs = load("trajectory_optimisation").optimise(guesses=16, iterations=25)
    assert path.shape == (90, 2) and costs.shape == (25, 16)
    assert costs[-1].median() < 0.6 * costs[0].median()


def test_learned_controller() -> None:
    distances = load("learned_controller").train(num_envs=16, iterations=35)
    assert np.mean(distances[-5:]) < 0.3 * np.mean(distances[:5])


def test_system_identification(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a robot that MuJoCo simulates; and recordings that do not fit the task are refused."""
    module = load("system_identification")
    small, path = {"segments": 128, "iterations": 8}, tmp_path / "walk.npz"
    motion = module.record(diffsim.make("hopper", 20, contact="mujoco"))
    good = dict(zip(("qpos", "qvel", "ctrl"), (x.numpy() for x in motion), strict=True))
    np.savez(path, **good)
    args = module.Args(recording=path, **small)
    for name, factor in zip(args.fit, module.main(args).tolist(), strict=True):
        assert factor == pytest.approx(module.TRUTH[name], rel=0.05), name
    torch.testing.assert_close(module.main(args), module.main(module.Args(**small)), rtol=1e-3, atol=0)

    for bad, message in (
        ({k: good[k] for k in ("qpos", "ctrl")}, "is no .npz of qpos, qvel and ctrl"),
        (good | {"qpos": np.zeros((20, 61, 15))}, "qpos has shape (20, 61, 15), must be (20, 61, 6)"),
        (good | {"qvel": good["qvel"][:, :-1]}, "qvel has shape (20, 60, 6), must be (20, 61, 6)"),
        (good | {"ctrl": good["ctrl"] * np.nan}, "ctrl holds numbers that are not finite"),
        ({k: x[:, : 6 - (k == "ctrl")] for k, x in good.items()}, "with at least 6 control steps"),
    ):
        np.savez(path, **bad)
        assert message in refusal(lambda: module.main(args), capsys)
    path.write_text("hello")
    assert "is no .npz of qpos, qvel and ctrl" in refusal(lambda: module.main(args), capsys)
    none = module.Args(recording=tmp_path / "none.npz", **small)
    assert "is no .npz of qpos, qvel and ctrl: [Errno 2]" in refusal(lambda: module.main(none), capsys)


NOTEBOOK = json.loads((EXAMPLES / "first_steps.ipynb").read_text())
CODES = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


def execute(cells: list[dict[str, Any]], system: Callable[[str], object], **parameters: object) -> dict[str, Any]:
    """The names that cells leave. What follows ! or % goes to `system`; parameters come after the cell of this tag."""
    names: dict[str, Any] = {"system": system}
    for cell in cells:
        exec(re.sub(r"^( *)[!%](.+)$", r"\1system(f'\2')", "".join(cell["source"]), flags=re.MULTILINE), names)
        names |= parameters if "parameters" in cell["metadata"].get("tags", ()) else {}
    return names


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The videos that a notebook shows."""
    videos = list[bytes]()
    display = SimpleNamespace(Video=lambda path, embed: videos.append(Path(path).read_bytes() if embed else b""))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(display=display))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    return videos


def test_first_steps(shown: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """All cells in order, with a policy instead of a training; the notebook holds no outputs."""
    commands = list[str]()

    def system(command: str) -> None:
        commands.append(command)
        Path("runs/ant").mkdir(parents=True, exist_ok=True)
        shutil.copy(EXAMPLES.parent / "diffsim" / "policies" / "ant.pt", "runs/ant/checkpoint.pt")
        Path("ant.mp4").write_bytes(b"video")

    assert len(CODES) >= 4 and not any(cell["outputs"] or cell["execution_count"] for cell in CODES)
    names = execute(CODES, system, iterations=7)
    torch.testing.assert_close(names["gradient"][:, 0], names["difference"], rtol=1e-5, atol=0)
    assert [command.split()[:5] for command in commands] == [
        ["python", "-m", "diffsim", "train", "shac"],
        ["python", "-m", "diffsim", "view", "runs/ant"],
    ]
    assert "--iterations 7" in commands[0] and shown == [b"video"] and os.environ["MUJOCO_GL"] == "egl"

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)  # as on a fresh runtime
    execute(CODES[:2], system)
    project = (EXAMPLES.parent / "pyproject.toml").read_text()
    assert commands[2].startswith("pip install ") and f'name = "{commands[2].split()[-1]}"' in project


@pytest.mark.slow
def test_first_steps_train_and_film(shown: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    try:
        render.check_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))
    path = os.pathsep.join([str(EXAMPLES.parent), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])

    def system(command: str) -> None:
        words = [sys.executable, *command.split()[1:]]
        subprocess.run(words, env=os.environ | {"PYTHONPATH": path, "CUDA_VISIBLE_DEVICES": ""}, check=True)

    names = execute(CODES, system, iterations=2)
    assert load_policy(Path("runs/ant/checkpoint.pt")).iteration == 2
    assert names["policy"](torch.zeros(1, 37)).shape == (1, 8)
    (video,) = shown
    assert len(video) > 10_000 and video[4:8] == b"ftyp"


# Other libraries ------------------------------------------------------------------------------------------------------


def test_stable_baselines3() -> None:
    pytest.importorskip("stable_baselines3")
    sb3_ppo = load("sb3_ppo")
    env, plain = (gymnasium.make_vec("diffsim/Hopper-numpy-v0", num_envs=3, max_episode_steps=30) for _ in range(2))
    venv = sb3_ppo.DiffVecEnv(env)
    venv.seed(5)
    np.testing.assert_array_equal(venv.reset(), plain.reset(seed=5)[0])
    for _ in range(30):
        obs, reward, done, infos = venv.step(np.zeros((3, 3)))
        expected = plain.step(np.zeros((3, 3)))
        np.testing.assert_array_equal(obs, expected[0])
        np.testing.assert_array_equal(reward, expected[1])
        np.testing.assert_array_equal(done, expected[2] | expected[3])
    assert done.all() and all(info["TimeLimit.truncated"] for info in infos)
    np.testing.assert_array_equal(infos[1]["terminal_observation"], expected[4]["final_obs"][1])
    ppo = sb3_ppo.train("diffsim/Hopper-numpy-v0", num_envs=4, timesteps=300)
    assert ppo.num_timesteps >= 300 and ppo.predict(np.zeros(11))[0].shape == (3,)


@pytest.mark.filterwarnings("ignore")
def test_skrl() -> None:
    pytest.importorskip("skrl")
    agent = load("skrl_ppo").train("diffsim/Hopper-numpy-v0", num_envs=4, timesteps=40)
    assert all(parameter.isfinite().all() for parameter in agent.policy.parameters())


def test_rsl_rl() -> None:
    pytest.importorskip("rsl_rl")
    runner = load("rsl_rl_ppo").train("hopper", num_envs=4, iterations=2)
    policy = runner.get_inference_policy()
    assert policy(runner.env.get_observations()).shape == (4, 3)
    assert [*Path("runs").glob("hopper__rsl_rl__1/model_*.pt")]


CLEANRL = """
import argparse, numpy as np, gymnasium as gym
flags = argparse.ArgumentParser()
for name, kind in (("--env-id", str), ("--num-envs", int), ("--gamma", float), ("--steps", int)):
    flags.add_argument(name, type=kind)
args = flags.parse_args()

def make_env(env_id):
    def thunk():
        raise AssertionError("made one by one")
    return thunk

if __name__ == "__main__":
    envs = gym.vector.SyncVectorEnv([make_env(args.env_id) for i in range(args.num_envs)])
    assert isinstance(envs.single_action_space, gym.spaces.Box)
    obs, _ = envs.reset(seed=1)
    returns, seen = [], [obs]
    for step in range(args.steps):
        obs, reward, terminations, truncations, infos = envs.step(np.ones((args.num_envs, 3), np.float32))
        seen.append(obs)
        if "final_info" in infos:
            for info in infos["final_info"]:
                if info and "episode" in info:
                    returns.append((info["episode"]["r"], info["episode"]["l"]))
"""


def test_cleanrl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A script that uses what CleanRL's use, as they do."""
    monkeypatch.setattr(gymnasium.vector, "SyncVectorEnv", gymnasium.vector.SyncVectorEnv)
    monkeypatch.setattr("sys.argv", ["pytest"])
    (tmp_path / "script.py").write_text(CLEANRL)
    arguments = ["--env-id", "diffsim/Hopper-numpy-v0", "--num-envs", "3", "--steps", "150"]
    script = load("cleanrl_ppo").main([str(tmp_path / "script.py"), *arguments])
    assert script["args"].gamma == 0.99 and len(script["returns"]) >= 3
    assert all(10 < length < 150 for _, length in script["returns"])
    seen = np.stack(script["seen"])
    assert seen.shape == (151, 3, 11) and seen.dtype == np.float32 and np.abs(seen).max() <= 10
