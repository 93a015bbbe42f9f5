"""What every learner does alike: files, resuming, evaluation, errors; and that each stands alone."""

from __future__ import annotations

import ast
import csv
import importlib
import json
import signal
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from learners import ROOT, assert_refuses, assert_refuses_a_missing_gpu, assert_same, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils._python_dispatch import TorchDispatchMode

# Windows of cartpole with a time-out on the way (240 steps), an evaluation before the end and one at it.
SMALL = "--env cartpole --num-envs 3 --horizon 32 --iterations 10 --eval-every 4 --eval-episodes 3 --quiet".split()
SPECIFIC = {"bptt": [], "ppo_baseline": ["--minibatch-size", "40", "--epochs", "2"]}
NOT_COMPARED = {"seconds"}


@pytest.fixture(scope="module", params=list(SPECIFIC))
def learner(request: pytest.FixtureRequest) -> ModuleType:
    return importlib.import_module(request.param)


@pytest.fixture(autouse=True)
def named(learner: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [f"{learner.__name__}.py"])


@pytest.fixture(scope="module")
def small(learner: ModuleType) -> list[str]:
    return SMALL + SPECIFIC[learner.__name__]


@pytest.fixture(scope="module")
def trained(learner: ModuleType, small: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("trained")
    run(learner, directory, *small)
    return directory


@pytest.fixture(scope="module")
def checkpoint(trained: Path) -> dict[str, Any]:
    return torch.load(trained / "checkpoint.pt", weights_only=True)


def test_no_script_imports_another() -> None:
    scripts = {path.stem: path for path in ROOT.glob("*.py")}
    assert {"shac", "bptt", "ppo_baseline", "gps"} <= scripts.keys()
    for path in scripts.values():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {(node.module or "").split(".")[0]}
            else:
                continue
            assert not names & scripts.keys(), f"{path.name} imports {names}"


def test_same_seed_same_weights_other_seed_others(
    learner: ModuleType, small: list[str], checkpoint: dict[str, Any], tmp_path: Path
) -> None:
    same = run(learner, tmp_path / "same", *small)
    other = run(learner, tmp_path / "other", *small, "--seed", 2, "--stop-after", 1)
    for name in checkpoint.keys() - NOT_COMPARED:
        assert_same(same[name], checkpoint[name])
    part = "policy" if "policy" in checkpoint else "actor"
    for name, weight in other[part].items():
        if name.endswith("weight") and weight.ndim == 2:
            assert not torch.equal(weight, checkpoint[part][name])


@pytest.mark.parametrize("how", ["stop-after", "signal"])
def test_resume_continues_bitwise(
    learner: ModuleType,
    small: list[str],
    checkpoint: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    how: str,
) -> None:
    path = tmp_path / "checkpoint.pt"
    if how == "stop-after":
        run(learner, tmp_path, *small, "--stop-after", 5)
    else:
        evaluate = learner.evaluate

        def interrupted(*arguments: Any) -> Any:
            signal.raise_signal(signal.SIGTERM)
            return evaluate(*arguments)

        monkeypatch.setattr(learner, "evaluate", interrupted)
        with pytest.raises(SystemExit) as exit:
            run(learner, tmp_path, *small)
        monkeypatch.undo()
        assert exit.value.code == 128 + signal.SIGTERM
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert torch.load(path, weights_only=True)["iteration"] == 5
    with (tmp_path / "progress.csv").open("a") as file:  # of iterations after the checkpoint, as a crash leaves them
        file.write("9,999,9.9\n")
    learner.main(["--resume", str(path)])
    resumed = torch.load(path, weights_only=True)
    for name in checkpoint.keys() - NOT_COMPARED:
        assert_same(resumed[name], checkpoint[name])
    with (tmp_path / "progress.csv").open() as file:
        assert [int(row["iteration"]) for row in csv.DictReader(file)] == list(range(1, 11))


def test_files_of_a_run(learner: ModuleType, trained: Path) -> None:
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["num_envs"] == 3 and arguments["substeps"] == 4 and arguments["hidden"] == [64, 64]
    with (trained / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["control_steps"]) for row in rows] == [3 * 32 * k for k in range(1, 11)]
    assert [bool(row["eval_return"]) for row in rows] == [k in (4, 8, 10) for k in range(1, 11)]
    assert [row["length"] for row in rows] == [""] * 7 + ["240.0"] * 3
    assert all(float(row["skipped"]) == float(row["nonfinite"]) == 0 for row in rows)
    assert all(
        row[column]
        for row in rows
        for column in row
        if not column.startswith("eval") and column not in ("return", "length")
    )
    events = EventAccumulator(str(trained))
    events.Reload()
    expected = set(learner.PROGRESS) - {"eval/speed"} | {"charts/SPS", "time/sim_forward", "time/total"}
    assert expected <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("grad/norm")] == [3 * 32 * k for k in range(1, 11)]
    assert not list(trained.glob("*.tmp"))


class Waits(TorchDispatchMode):
    """Notes where in the project a value is asked for on the host: a GPU would be waited for, a capture would fail."""

    asking = {torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero, torch.ops.aten.equal}

    def __init__(self, places: list[str]) -> None:
        super().__init__()
        self.places = places

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function.overloadpacket in self.asking:
            stack = [frame for frame in traceback.extract_stack()[:-1] if frame.filename.startswith(str(ROOT))]
            self.places.append(f"{Path(stack[-1].filename).name}: {stack[-1].line}")
        return function(*args, **(kwargs or {}))


def test_nothing_captured_waits_for_the_device(
    learner: ModuleType, small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captured, places = [], []

    def capture(function: Any, device: Any, env: Any = None) -> Any:
        captured.append(function)

        def call() -> Any:
            with Waits(places):
                return function()

        return call

    monkeypatch.setattr(learner.graph, "capture", capture)
    run(learner, tmp_path, *small, "--stop-after", 3)
    assert len(captured) == {"bptt": 1, "ppo_baseline": 2}[learner.__name__]
    only_on_the_cpu = 'if self.device.type == "cpu" and bool(torch.isnan(action.detach()).any()):'
    assert set(places) == {f"env.py: {only_on_the_cpu}"}  # seen, so the rest would be seen


def test_evaluate(learner: ModuleType, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (trained / "checkpoint.pt").read_bytes()
    evaluate = ["--evaluate", str(trained / "checkpoint.pt")]
    learner.main(evaluate)
    same = capsys.readouterr().out
    with (trained / "progress.csv").open() as file:
        final = float(list(csv.DictReader(file))[-1]["eval_return"])
    assert same.startswith(f"cartpole, 3 episodes: return median {final:.1f}, mean ")
    learner.main([*evaluate, "--substeps", "16", "--eval-episodes", "4"])
    assert capsys.readouterr().out.startswith("cartpole, 4 episodes: return median ")
    assert (trained / "checkpoint.pt").read_bytes() == before


def test_help_names_every_flag(learner: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        learner.main(["--help"])
    assert exit.value.code == 0
    out = capsys.readouterr().out
    for name in learner.Args.__dataclass_fields__:
        assert learner.flag(name) in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env anty", "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant, humanoid"),
        ("--num-envs 0", "num_envs"),
        ("--horizon 0", "horizon"),
        ("--substeps 0", "substeps"),
        ("--iterations 0", "--iterations must be at least 1, not 0"),
        ("--device nonsense", "nonsense"),
        ("--run-dir {file}", "cannot write to run directory {file}: Not a directory"),
        ("--run-dir {trained}", "{trained} holds another run's checkpoint.pt"),
        ("--resume {file}.pt", "no such checkpoint: {file}.pt"),
        ("--evaluate {truncated}", "{truncated} is not a whole checkpoint of {name}.py"),
        ("--evaluate {foreign}", "{foreign} is not a whole checkpoint of {name}.py"),
        (
            "--resume {elsewhere} --device cpu --iterations 20",
            "{elsewhere} was trained on cuda:0, which cpu cannot continue",
        ),
        ("--evaluate {trained}/checkpoint.pt --env ant", "has --env cartpole, not ant"),
        ("--resume {trained}/checkpoint.pt --num-envs 4", "has --num-envs 3, not 4"),
        ("--resume {trained}/checkpoint.pt", "is at iteration 10 already"),
        ("--resume {file} --evaluate {file}", "--resume and --evaluate exclude each other"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    learner: ModuleType,
    arguments: str,
    message: str,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert_refuses(learner, arguments, message, trained, tmp_path, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none(learner: ModuleType) -> None:
    assert_refuses_a_missing_gpu(learner)
