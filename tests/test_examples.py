"""The examples run, in small, and show what they say; those with another library where it is installed."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import common
import gymnasium
import identification
import mujoco
import numpy as np
import pytest
import tables
import torch
import worlds
from learners import PATH, ROOT
from scenes import with_motors

import diffsim
from diffsim import load_scene
from diffsim.parameters import ParametricSimulator
from diffsim.tasks.base import ASSETS
from diffsim.training import load_policy
from diffsim_cli.commands import POLICIES, main

EXAMPLES = ROOT / "examples"


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


def test_own_learner() -> None:
    """The page shows the loop of the file; the pole swings up."""
    page, file = (ROOT / "docs" / "own_learner.md").read_text(), (EXAMPLES / "own_learner.py").read_text()
    listing, critic = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert listing in file
    returns = load("own_learner").train()
    assert np.mean(returns[:3]) < -1500 and np.mean(returns[-3:]) > -800
    env = diffsim.make("hopper", 4, horizon=8)
    env.reset(seed=1)
    policy, value = (torch.nn.Linear(11, width) for width in (3, 1))
    exec(critic, {"torch": torch, "env": env, "policy": policy, "critic": value})
    assert all(part.grad.norm() > 0 for part in policy.parameters())


def test_push() -> None:
    """The box does not depend on an action that does not reach it; pushed hard enough it moves, with a gradient."""
    env = diffsim.make(load("push").Push, 2, horizon=16, stochastic_init=False, dtype=torch.float64)
    env.reset(seed=1)
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    for gap, force, moves in ((0.2, 0.5, False), (0.0, 0.0625, False), (0.0, 0.5, True)):  # m, 20 N; it sticks to 2.5 N
        start = qpos.clone()
        start[:, 0] = qpos[:, 2] - 0.08 - 0.05 + 1e-4 - gap
        env.set_state(start, qvel)
        env.detach()
        action = torch.zeros(2, 2, dtype=torch.float64)
        action[:, 0] = force
        action.requires_grad_()
        for _ in range(4):
            obs, *_ = env.step(action)
        (gradient,) = torch.autograd.grad(obs[:, 0].sum(), action)
        moved = float((env.qpos[0, 2] - start[0, 2]).detach())
        assert (moved > 2e-3) == moves and (float(gradient[0, 0]) > 2e-3) == moves, (gap, force, moved, gradient)


@pytest.mark.parametrize("names, only", [(("mass", "damping", "armature"), ()), (("friction",), ("floor",))])
def test_identify(
    names: tuple[str, ...], only: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a hopper that MuJoCo moves. Of two geoms the larger friction counts, so a smaller one would not be found."""
    module, log = load("identify"), tmp_path / "log.csv"
    sim = ParametricSimulator(load_scene(ASSETS / "hopper.xml"), 1, diffsim.Integration("mujoco", 1))
    unknowns = module.Unknowns(sim, names, only)
    true = 0.5 * torch.randn(len(unknowns.labels), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    true = true if "mass" in names else true.abs()
    sim.parameters = unknowns.values(true)
    identification.write_log(log, sim)
    module.main(ASSETS / "hopper.xml", log, names, only)
    rows, printed = tables.read_csv(tmp_path / "log.fit.csv"), capsys.readouterr().out
    assert len(rows) == (16 if "mass" in names else 1) and f"of {len(rows)} combinations of these numbers" in printed
    truths = unknowns.numbers(true)
    before, after = (
        [abs(math.log(float(row[column]) / truth)) for row, truth in zip(rows, truths, strict=True)]
        for column in ("file", "fitted")
    )
    assert np.median(before) > 0.2 and max(after) < 0.03
    assert max(float(row["deviation"]) for row in rows) < 0.02


def test_identify_finds_a_friction_below_that_of_floor_and_feet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both have the same in the file, as most files do; a contact has the larger one, so lowering one has no effect."""
    module, robot, log = load("identify"), tmp_path / "hopper.xml", tmp_path / "log.csv"
    spec = mujoco.MjSpec.from_file(str(ASSETS / "hopper.xml"))
    for geom in spec.geoms:
        geom.friction[0] = 0.9
    spec.compile()
    robot.write_text(spec.to_xml())
    sim = ParametricSimulator(load_scene(robot), 1, diffsim.Integration("mujoco", 1))
    sim.parameters = {"friction": torch.full_like(sim.parameters["friction"], 0.3)}
    identification.write_log(log, sim)
    module.main(robot, log, ("mass", "friction"))
    fitted = {(row["parameter"], row["element"]): row for row in tables.read_csv(tmp_path / "log.fit.csv")}
    assert float(fitted["friction", "foot"]["fitted"]) == pytest.approx(0.3, rel=0.05)
    assert all(
        float(row["fitted"]) == pytest.approx(float(row["file"]), rel=0.02)
        for key, row in fitted.items()
        if key[0] == "mass"
    )
    assert ("friction", "floor") not in fitted and "Not converged" not in capsys.readouterr().out
    monkeypatch.setattr(module, "ITERATIONS", 1)
    module.main(robot, log, ("mass", "friction"))
    assert "Not converged" in capsys.readouterr().out


def test_identify_tells_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,qpos0\n0,1\n1,2\n")
    for flags, message in (
        ([], "log.csv: must have columns of numbers: time and (6, 6, 3) of qpos, qvel and ctrl"),
        (["--fit", "weight"], "unknown parameter 'weight'; choose from mass, com"),
        (["--fit", "mass", "--only", "arm"], "there is no mass that moves the robot"),
    ):
        if flags:
            log.write_text("\n".join(["time", *(",".join([str(k), *["0"] * 15]) for k in range(9))]))
        command = [sys.executable, str(EXAMPLES / "identify.py"), str(ASSETS / "hopper.xml"), str(log), *flags]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | PATH)
        assert done.returncode == 1 and message in done.stderr and done.stderr.count("\n") == 1


def test_landscape(tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Losses of the policy as it is do not depend on how many other values of the weight are tried."""
    module = load("landscape")
    monkeypatch.setattr(module, "STEPS", 20)
    few, many = (
        module.measure(module.Args(points=points, trajectories=3), tiny_run / "checkpoint.pt") for points in (3, 5)
    )
    assert few == many[::2] and [row["change"] for row in few] == [-1.0, 0.0, 1.0]
    assert all(len({row[loss] for row in many}) == 5 for loss in ("long", "rollout"))
    assert module.lowest([3.0, 1.0, 2.0, 0.0, 5.0]) == [0, 1, 0, 1, 0]
    module.main(module.Args(checkpoints=(tiny_run,), points=3, trajectories=3, output=tmp_path))
    assert len(tables.read_csv(tmp_path / "landscape.csv")) == 3 and (tmp_path / "landscape.png").is_file()


def test_particles_begin_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = load("particles")
    monkeypatch.setattr(module, "EVERY", 1)
    monkeypatch.setattr(module, "SETTING", "--num-envs 4 --horizon 8 --minibatch-size 32 --epochs 1")
    module.main(module.Args(iterations=1, output=tmp_path))
    first, _, second, last = tables.read_csv(tmp_path / "particles.csv")
    assert (first["control steps"], second["control steps"]) == ("0", "32")
    assert (first["lowest"], first["highest"], first["moved"]) == ("-1", "1", "0")
    assert second["median deviation"] != first["median deviation"] and last["joint"] == module.JOINTS[1]
    assert (tmp_path / "particles.png").is_file()


def test_bandit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Particles begin evenly; what they learn is tested in tests/test_pfpn.py."""
    module = load("bandit")
    monkeypatch.setattr(module, "ITERATIONS", (0, 2))
    module.main(module.Args(seeds=(1, 2), output=tmp_path))
    rows = tables.read_csv(tmp_path / "bandit.csv")
    assert [(row["policy"], row["seed"]) for row in rows] == [(p, s) for p in module.POLICIES for s in ("1", "2")]
    assert all(row["both"] == "1" for row in rows if row["policy"] != "gaussian")
    assert (tmp_path / "bandit.png").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_pictures(tmp_path: Path) -> None:
    """Those of docs/gymnasium.md."""
    load("trajectory_optimisation").optimise(guesses=2, iterations=1, video=tmp_path / "swing_up.gif")
    assert (tmp_path / "swing_up.gif").stat().st_size > 10_000
    with pytest.raises(ValueError, match="a video ends in"):
        load("trajectory_optimisation").optimise(video=tmp_path / "swing_up.avi")


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [([], "without one, give --video go2.mp4 and set MUJOCO_GL=egl"), (["--video", "a.mp4"], "set MUJOCO_GL=egl or")],
)
def test_onnx_without_a_display_is_one_line(arguments: list[str], hint: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    main(["export", str(POLICIES / "go2.pt"), str(output := tmp_path / "policy.onnx")])
    blind = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, ROOT / "examples" / "run_onnx.py", output, *arguments]
    blind |= PATH | {"MUJOCO_GL": "glfw"}
    found = subprocess.run(command, env=blind, cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 2 and hint in found.stderr.splitlines()[-1] and not list(tmp_path.glob("*.mp4"))


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("", "no such file: policy.onnx; write one by python -m diffsim export CHECKPOINT policy.onnx"),
        (
            "hopper",
            "a policy of hopper, which follows no commands as those of go1, go2 and g1; examples/own_quadruped.py",
        ),
    ],
)
def test_onnx_that_cannot_be_walked_is_one_line(policy: str, message: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    if policy:
        main(["export", str(POLICIES / f"{policy}.pt"), str(tmp_path / "policy.onnx")])
    command = [sys.executable, ROOT / "examples" / "run_onnx.py", "policy.onnx"]
    found = subprocess.run(command, env=os.environ | PATH, cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 2 and message in found.stderr.splitlines()[-1]


@pytest.mark.parametrize("name, file", [("go2", "go2.xml"), ("go2", "motors.xml"), ("g1", "g1.xml")])
def test_onnx_acts_and_walks_as_the_policy_is_judged(name: str, file: str, tmp_path: Path) -> None:
    """Beside benchmarks/joystick.py's world for 2 s; with motors in another order, too."""
    ort = pytest.importorskip("onnxruntime")
    policy, output, command = POLICIES / f"{name}.pt", tmp_path / "policy.onnx", (0.5, 0.2, -0.3)
    main(["export", str(policy), str(output)])
    case = common.load_case(policy, 1, "cpu")
    path, task, n = Path(case.env.scene.path), worlds.in_double(case.env), case.env.scene.nu
    if file == "motors.xml":
        spec, path = with_motors(path), tmp_path / file
        path.write_text(spec.to_xml())
    rest = torch.tensor(task.start)[None].double()
    memory = task.begin(rest.new_full((1, task.num_random), 0.5))
    memory[:, :4] = torch.tensor([*command, 0.0])  # and the clock
    start = worlds.State(rest[:, : n + 7], rest.new_zeros(1, n + 6), rest.new_zeros(1, n), memory)
    world = worlds.OtherFile(case.env, 1, path, 1.0)
    steps = [*worlds.rollout(world, task, case.saved.network, start, 100)]
    assert not steps[-1].fallen.any() and steps[-1].state.qpos[0, 0] > 0.5
    low, high = case.env.scene.mj_model.actuator_ctrlrange.T
    walk = load("run_onnx").walk(ort.InferenceSession(output), mujoco.MjModel.from_xml_path(str(path)), command, 2.0)
    for step, data in zip(steps, walk, strict=True):
        np.testing.assert_allclose(data.qpos, step.state.qpos[0], atol=1e-4)
        np.testing.assert_allclose(data.qvel, step.state.qvel[0], atol=1e-2)
        if file != "motors.xml":
            np.testing.assert_allclose(
                data.ctrl, low + (high - low) * (step.state.action[0].numpy() + 1) / 2, atol=1e-4
            )


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
        shutil.copy(POLICIES / "ant.pt", "runs/ant/checkpoint.pt")
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
    assert commands[2].startswith("pip install ") and (EXAMPLES / commands[2].split()[-1] / "pyproject.toml").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_first_steps_train_and_film(shown: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")

    def system(command: str) -> None:
        words = [sys.executable, *command.split()[1:]]
        subprocess.run(words, env=os.environ | PATH | {"CUDA_VISIBLE_DEVICES": ""}, check=True)

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
