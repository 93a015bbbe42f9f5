"""A new user's way, as docs/own_robot.md describes it: each of its commands and snippets runs, in small."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from learners import ROOT, refusal

import diffsim
import ppo_baseline
import shac
from diffsim.tasks.base import ASSETS
from diffsim.training import checkpoint, load_policy, parse
from diffsim_cli import view
from diffsim_cli.commands import main as diffsim_main

pytestmark = pytest.mark.unoptimized
PAGE = (ROOT / "docs" / "own_robot.md").read_text()
(LISTING,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
(MADE,) = re.findall(r"`(diffsim\.make\(.*?\))`", PAGE)
COMMANDS = [
    line.split()[1:] for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.M | re.S) for line in block.splitlines()
]
LEARNER = "ppo_baseline.py"
TINY = "--num-envs 4 --horizon 8 --minibatch-size 16 --epochs 1".split()
FEW = "--eval-episodes 2 --eval-every 0 --device cpu".split()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the example and a trained run."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "examples").mkdir()
    for suffix in ("py", "xml"):
        shutil.copy(ROOT / "examples" / f"own_robot.{suffix}", folder / "examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        words = next(words for words in COMMANDS if words[:3] == [LEARNER, "--env", "examples/own_robot.py"])
        ppo_baseline.main([*small(words), *TINY])
    return folder


def small(words: Sequence[str], run: Path | None = None, iterations: int = 2) -> list[str]:
    text = re.sub(r"--iterations \w+", f"--iterations {iterations}", " ".join(words[1:]))
    return [*text.replace("runs/<run>", str(run)).split(), *(FEW if words[0] == LEARNER else ())]


def test_the_page_lists_the_example() -> None:
    assert LISTING in (ROOT / "examples" / "own_robot.py").read_text()
    assert LISTING.count("\n") <= 30 and "class RunForward(Task):" in LISTING
    first = "-m", "ppo_baseline.py", "view", "ppo_baseline.py", "ppo_baseline.py"
    assert [words[0] for words in COMMANDS] == [
        *first,
        "clone",
        "shac.py",
        "install",
        "-m",
        "examples/own_quadruped.py",
        "ppo_baseline.py",  # the task with an object
    ]


@pytest.mark.slow
def test_the_commands_run(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(home)
    (run,) = (home / "runs").iterdir()
    assert re.fullmatch(r"run_forward__ppo_baseline__1__\d+", run.name)
    saved = checkpoint.load(run / "checkpoint.pt")
    assert saved["args"]["env"] == "examples/own_robot.py" and saved["iteration"] == 2
    assert saved["args"]["contact"] == "mujoco"
    check, _, watch, judge, resume = COMMANDS[:5]
    diffsim_main(check[2:])
    assert "own_robot: can be simulated" in capsys.readouterr().out
    view.main(small(watch, run))
    assert "run_forward, ppo_baseline.py, iteration 2" in capsys.readouterr().out and (home / "run.mp4").is_file()
    ppo_baseline.main(small(judge, run))
    written = json.loads((run / "evaluation.json").read_text())
    assert len(written["returns"]) == 2 and written["speed"] is not None
    ppo_baseline.main(small(resume, run, 3))
    assert checkpoint.load(run / "checkpoint.pt")["iteration"] == 3


def test_the_snippet_runs(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the class itself makes the same environment."""
    monkeypatch.chdir(home)
    names: dict[str, object] = {}
    exec(f"import diffsim\nenv = {MADE}", names)
    env = names["env"]
    assert isinstance(env, diffsim.DiffEnv) and (env.num_envs, env.task.obs_dim) == (16, 9)
    envs = [diffsim.make(task, 3, seed=1) for task in ("examples/own_robot.py:RunForward", type(env.task))]
    for one in envs:
        assert one.sim.integration == diffsim.Integration("mujoco", 4) and one.task.name == "run_forward"
    assert torch.equal(*(one.reset(seed=1)[0] for one in envs))
    steps = [one.step(torch.full((3, 2), 0.5)) for one in envs]
    assert torch.equal(steps[0][0], steps[1][0]) and torch.equal(steps[0][1], steps[1][1])


@pytest.mark.slow
def test_from_another_directory(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (run,), there = (home / "runs").iterdir(), str(home / "examples" / "own_robot.py")
    path = run / "checkpoint.pt"
    missing = f"no such file: examples/own_robot.py in {tmp_path}; give its path, in scripts --env path/to/own_robot.py"
    for words in (["--evaluate", path], ["--resume", path, "--iterations", "9"]):
        assert (
            refusal(lambda words=words: ppo_baseline.main([*map(str, words), *FEW]), capsys) == f"script.py: {missing}"
        )
    film = [str(run), "--video", "a.mp4", "--seconds", "0.1", "--env"]
    assert refusal(lambda: view.main([*film, "examples/own_robot.py"]), capsys) == f"script.py: {missing}"
    ppo_baseline.main(["--evaluate", str(path), "--env", there, "--run-dir", str(tmp_path), *FEW])
    assert json.loads((tmp_path / "evaluation.json").read_text())["settings"]["env"] == there
    view.main([*film, there])
    assert (tmp_path / "a.mp4").is_file()
    line = refusal(lambda: ppo_baseline.main(["--evaluate", str(path), "--env", "ant"]), capsys)
    assert "has --env examples/own_robot.py, which cannot change to ant" in line


def test_flags_of_an_own_task(home: Path) -> None:
    env = ["--env", str(home / "examples" / "own_robot.py")]
    args = parse(shac.Args, env)
    assert (args.contact, args.substeps, args.horizon) == ("mujoco", 4, 8)
    args = parse(shac.Args, [*env, "--contact", "soft"])
    assert (args.contact, args.substeps, args.horizon) == ("soft", 16, 32)
    args = parse(shac.Args, ["--env", "hopper"])
    assert (args.contact, args.implicit) == ("soft", False)


def test_a_robot_of_menagerie_and_its_onnx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In MuJoCo, with its time step, the exported policy moves the robot as it does here."""
    pytest.importorskip("onnxruntime")
    (folder := tmp_path / "mujoco_menagerie" / "unitree_a1").mkdir(parents=True)
    shutil.copy(ASSETS / "go2.xml", folder / "scene.xml")  # has the A1's joints, too
    shutil.copy(ASSETS / "stage.xml", folder)
    monkeypatch.chdir(tmp_path)
    file = str(ROOT / "examples" / "own_quadruped.py")
    _, train, _, export, play = COMMANDS[5:10]
    assert train[2] == export[-1] == f"{Path(file).parent.name}/{Path(file).name}" == play[0]
    tiny = "--iterations 1 --num-envs 4 --horizon 4 --run-dir run".split()
    shac.main(["--env", file, *tiny, *FEW])
    diffsim_main(["export", "run/checkpoint.pt", "a1.onnx", "--env", file])
    env = diffsim.make(file, 1, substeps=10, stochastic_init=False)
    policy, (obs, _) = load_policy("run/checkpoint.pt").network, env.reset()
    with torch.no_grad():
        for _ in range(15):
            obs, *_ = env.step(policy(obs))
    distance = sys.modules[type(env.task).__module__].play("a1.onnx", env.task, 0.3)
    assert distance == pytest.approx(env.qpos[0, 0].item(), abs=1e-3)
