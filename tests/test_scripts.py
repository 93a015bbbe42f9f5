"""What every script does alike: files, resuming, evaluation, errors; and that each stands alone."""

from __future__ import annotations

import ast
import dataclasses
import json
import re
import runpy
import shutil
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from learners import ROOT, SCRIPTS, SMALL, assert_refuses, assert_same, read_progress, refusal, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils._python_dispatch import TorchDispatchMode

from diffsim.training import graph, load_policy
from diffsim.training.directory import COLUMNS, column
from diffsim.training.ranges import flag

NOT_COMPARED = {"seconds"}
SCALARS = {
    "shac": "losses/actor losses/critic time/update_actor time/update_critic",
    "sapo": (
        "losses/actor losses/critic charts/reward charts/entropy charts/temperature "
        "time/update_actor time/update_critic"
    ),
    "bptt": "losses/actor time/update",
    "ppo_baseline": "losses/policy losses/value losses/kl charts/learning_rate charts/std time/collect time/update",
    "pfpn": (
        "losses/policy losses/value losses/kl charts/learning_rate charts/entropy time/interact time/learn "
        "particles/dead_mean particles/dead_max particles/moved particles/active particles/std"
    ),
}
COMMON_SCALARS = (
    "charts/episodic_return charts/episodic_length charts/SPS eval/return eval/length grad/norm grad/skipped "
    "sim/nonfinite sim/nonfinite_gradients time/total"
)


@pytest.fixture(scope="module", params=SCRIPTS)
def script(request: pytest.FixtureRequest) -> ModuleType:
    return SCRIPTS[request.param]


@pytest.fixture(autouse=True)
def named(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [f"{script.__name__}.py"])


@pytest.fixture(scope="module")
def small(script: ModuleType) -> list[str]:
    return SMALL[script.__name__]


@pytest.fixture(scope="module")
def trained(script: ModuleType, small: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("trained")
    run(script, directory, *small)
    return directory


@pytest.fixture(scope="module")
def checkpoint(trained: Path) -> dict[str, Any]:
    return torch.load(trained / "checkpoint.pt", weights_only=True)


# A run ----------------------------------------------------------------------------------------------------------------


def test_another_seed_has_other_weights(
    script: ModuleType, small: list[str], checkpoint: dict[str, Any], tmp_path: Path
) -> None:
    other = run(script, tmp_path, *small, "--seed", 2, "--stop-after", 1)
    for name, weight in other["policy"]["weights"].items():
        if name.endswith("weight") and weight.ndim == 2:
            assert not torch.equal(weight, checkpoint["policy"]["weights"][name])


def test_saving_and_evaluating_change_no_numbers(script: ModuleType, small: list[str], tmp_path: Path) -> None:
    often = run(script, tmp_path / "often", *small, "--stop-after", 3, "--save-every", 1, "--eval-every", 1)
    never = run(script, tmp_path / "never", *small, "--stop-after", 3, "--save-every", 0, "--eval-every", 0)
    for name in ("modules", "ranks", "control_steps"):
        assert_same(often[name], never[name])


def test_the_same_seed_interrupted_and_resumed_ends_bitwise_alike(
    script: ModuleType, small: list[str], checkpoint: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, evaluate = tmp_path / "checkpoint.pt", script.evaluate

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGTERM)
        return evaluate(*arguments)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit:
        patch.setattr(script, "evaluate", interrupted)
        run(script, tmp_path, *small, "--threads", 1)
    assert exit.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert torch.load(path, weights_only=True)["iteration"] == 5
    with (tmp_path / "progress.csv").open("a") as file:  # of iterations after the checkpoint, as a crash leaves them
        file.write("9,999,9.9\n")
    script.main(["--resume", str(path)])
    resumed = torch.load(path, weights_only=True)
    resumed["args"]["threads"] = 0
    for name in checkpoint.keys() - NOT_COMPARED:
        assert_same(resumed[name], checkpoint[name])
    assert [int(row["iteration"]) for row in read_progress(tmp_path)] == list(range(1, 11))


def test_files_of_a_run(script: ModuleType, trained: Path, checkpoint: dict[str, Any]) -> None:
    assert {path.name for path in trained.iterdir() if "tfevents" not in path.name} == {
        "args.json",
        "checkpoint.pt",
        "evaluation.json",
        "progress.csv",
    }
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["num_envs"] == 3 and arguments["substeps"] == 4
    hidden, lr = ("actor_hidden", "actor_lr") if "actor_lr" in arguments else ("hidden", "lr")
    assert arguments[hidden] == [64, 64] and arguments[lr] == (
        3e-4 if script.__name__ in ("ppo_baseline", "pfpn") else 1e-2
    )
    assert list(arguments) == [field.name for field in dataclasses.fields(script.Args)]
    assert arguments == json.loads(json.dumps(checkpoint["args"])) | {"run_dir": str(trained)}

    rows, samples = read_progress(trained), [3 * 32 * k for k in range(1, 11)]
    assert [int(row["control_steps"]) for row in rows] == samples
    assert [bool(row["eval_return"]) for row in rows] == [k in (4, 8, 10) for k in range(1, 11)]
    assert [row["length"] for row in rows] == [""] * 7 + ["240.0"] * 3
    assert all(float(row["grad_skipped"]) == float(row["sim_nonfinite"]) == 0 for row in rows)
    late = {name for name in rows[0] if name.startswith("eval")} | {"return", "length"}
    assert all(row[name] for row in rows for name in row.keys() - late)

    scalars = set(f"{COMMON_SCALARS} {SCALARS[script.__name__]}".split())
    assert rows[0].keys() == {*COLUMNS, *map(column, scalars)}
    events = EventAccumulator(str(trained))
    events.Reload()
    assert set(events.Tags()["scalars"]) == scalars
    assert [event.step for event in events.Scalars("grad/norm")] == samples
    for name in ("grad/norm", "charts/SPS", next(iter(SCALARS[script.__name__].split()))):
        values = [event.value for event in events.Scalars(name)]
        assert values == pytest.approx([float(row[column(name)]) for row in rows], rel=1e-5)
    evaluation = json.loads((trained / "evaluation.json").read_text())
    assert evaluation["return"] == pytest.approx(float(rows[-1]["eval_return"]), rel=1e-6)


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
    script: ModuleType, small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captured, places = [], list[str]()

    def capture(function: Callable[[], Any], device: torch.device, env: Any = None) -> Callable[[], Any]:
        captured.append(function.__name__)

        def call() -> Any:
            with Waits(places):
                return function()

        return call

    monkeypatch.setattr(graph, "capture", capture)
    run(script, tmp_path, *small, "--stop-after", 3)
    names = {"bptt": ["update"], "ppo_baseline": ["collect", "update"], "pfpn": ["interact", "learn"]}
    assert captured == names.get(script.__name__, ["update_actor", "update_critic"])
    only_on_the_cpu = 'if self.device.type == "cpu" and bool(torch.isnan(action.detach()).any()):'
    assert set(places) == {f"env.py: {only_on_the_cpu}"}  # seen, so the rest would be seen


@pytest.mark.gpu
@pytest.mark.parametrize("eager", [[], ["--no-cuda-graph"]])
def test_same_seed_same_weights_on_a_gpu(script: ModuleType, tmp_path: Path, eager: list[str]) -> None:
    checkpoints = []
    for name in ("a", "b"):
        arguments = "--env cartpole --num-envs 8 --iterations 12 --eval-every 5 --eval-episodes 2 --quiet".split()
        script.main([*arguments, "--device", "cuda", "--run-dir", str(tmp_path / name), *eager])
        checkpoints.append(torch.load(tmp_path / name / "checkpoint.pt", weights_only=True, map_location="cpu"))
    assert_same(checkpoints[0]["modules"], checkpoints[1]["modules"])


# A saved policy -------------------------------------------------------------------------------------------------------


def test_evaluate(script: ModuleType, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "checkpoint.pt"
    before = shutil.copy(trained / "checkpoint.pt", path).read_bytes()
    script.main(["--evaluate", str(path), "--device", "cpu"])
    final = float(read_progress(trained)[-1]["eval_return"])
    out = capsys.readouterr().out
    assert out.startswith(f"cartpole, 3 episodes: return median {final:.1f}, mean ") and "gait" not in out
    evaluation = json.loads((tmp_path / "evaluation.json").read_text())  # beside the checkpoint
    finer = evaluation["finer"]
    assert evaluation == json.loads((trained / "evaluation.json").read_text()) | {"finer": finer}
    # Returns of this task are costs, so the share that is kept is the inverse ratio.
    assert finer["substeps"] == 16 and finer["kept"] == pytest.approx(evaluation["return"] / finer["return"])
    assert f"semi_implicit with 16 substeps: return median {finer['return']:.1f}, {finer['kept']:.1%} kept" in out
    settings = dict(script=script.__name__, iteration=10, env="cartpole", substeps=4, eval_episodes=3)
    assert evaluation["settings"].items() >= settings.items()
    assert evaluation["lengths"] == [240] * 3 and evaluation["speed"] is None

    explicit = "--integrator semi_implicit --substeps 16 --no-finer --device cpu --run-dir".split()
    script.main(["--evaluate", str(path), *explicit, str(tmp_path / "explicit")])
    again = json.loads((tmp_path / "explicit" / "evaluation.json").read_text())
    assert again["return"] == finer["return"] and "finer" not in again

    others = "--substeps 16 --eval-episodes 4 --no-finer --run-dir".split()
    script.main(["--evaluate", str(path), *others, str(tmp_path / "new" / "deeper")])
    assert capsys.readouterr().out.count("cartpole, 4 episodes: return median ") == 1
    settings = json.loads((tmp_path / "new" / "deeper" / "evaluation.json").read_text())["settings"]
    assert (settings["substeps"], settings["eval_episodes"], settings["iteration"]) == (16, 4, 10)
    assert evaluation == json.loads((tmp_path / "evaluation.json").read_text())
    assert path.read_bytes() == before


def test_a_renamed_copy_trains_resumes_and_evaluates(
    script: ModuleType, small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What users do, under a name that is no identifier; the first time as a process of its own."""
    copy = tmp_path / f"my-{script.__name__}.py"
    copy.write_text((ROOT / f"{script.__name__}.py").read_text())
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", [copy.name, *arguments])
        runpy.run_path(copy.name, run_name="__main__")

    first = [*small, "--stop-after", "2", "--save-every", "1"]
    if script.__name__ == "shac":
        result = subprocess.run([sys.executable, copy.name, *first], capture_output=True, text=True, check=True)
        assert "2 iterations, 192 control steps" in result.stdout
    else:
        call(*first)
    (directory,) = Path("runs").glob(f"cartpole__my-{script.__name__}__1__*")
    path = directory / "checkpoint.pt"
    call("--resume", str(path), "--iterations", "3", "--quiet")
    assert len(read_progress(directory)) == 3
    state = torch.load(path, weights_only=True)
    assert (state["script"], state["iteration"]) == (copy.stem, 3)
    call("--evaluate", str(path))
    assert json.loads((directory / "evaluation.json").read_text())["settings"]["script"] == copy.stem
    assert_same(dict(load_policy(path).network.state_dict()), dict(state["policy"]["weights"]))


# The command line -----------------------------------------------------------------------------------------------------


def test_help_names_every_flag(script: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        script.main(["--help"])
    assert exit.value.code == 0
    out = capsys.readouterr().out
    for field in dataclasses.fields(script.Args):
        assert re.search(rf"{flag(field.name)}[ ,]", out)
    names = (
        "env env-id seed device iterations num-envs horizon substeps integrator eval-every save-every run-dir resume "
        "evaluate capture-video track quiet deterministic-policy general-hyperparameters threads actor-lr gamma "
        "accuracy penalty no-critic"
    )
    if script.__name__ == "shac":
        assert all(f"--{name}" in out for name in names.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env anty", "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant, humanoid"),
        ("--num-envs 0", "--num-envs must be from 1 to 1,000,000,000, not 0"),
        ("--substeps 5 --integrator extrapolated", "substeps is 5, must be even"),
        ("--penalty k_n", "--penalty takes pairs like k_n=1e5, not 'k_n'"),
        ("--penalty kn=1e5", "unknown penalty constant 'kn'"),
        ("--device nonsense", "nonsense"),
        ("--run-dir {file}", "cannot write to run directory {file}: Not a directory"),
        ("--run-dir {file}/deeper", "cannot write to run directory {file}/deeper: Not a directory"),
        ("--run-dir {trained}", "{trained} holds another run's checkpoint.pt"),
        ("--resume {file}.pt", "no such checkpoint: {file}.pt"),
        ("--resume {file}", "{file} is not a whole checkpoint of {name}.py"),
        ("--evaluate {truncated}", "{truncated} is not a whole checkpoint of {name}.py"),
        ("--evaluate {foreign}", "{foreign} is not a whole checkpoint of {name}.py"),
        ("--resume {older}", "{older} is a checkpoint of format '{name}-1', and this version reads format 2"),
        ("--evaluate {other}", "{other} is a checkpoint of 'other', not of {name}.py"),
        (
            "--resume {elsewhere} --device cpu --iterations 20",
            "{elsewhere} was trained on cuda:0, which cpu cannot continue",
        ),
        ("--evaluate {trained}/checkpoint.pt --env ant", "has --env cartpole, not ant"),
        ("--evaluate {trained}/checkpoint.pt --run-dir {file}", "cannot write to run directory {file}"),
        ("--resume {trained}/checkpoint.pt --num-envs 4", "has --num-envs 3, not 4"),
        ("--resume {trained}/checkpoint.pt", "is at iteration 10 already"),
        ("--resume {trained}/checkpoint.pt --iterations 20 --stop-after 10", "is at iteration 10 already"),
        ("--resume {file} --evaluate {file}", "--resume and --evaluate exclude each other"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    script: ModuleType,
    arguments: str,
    message: str,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert_refuses(script, arguments, message, trained, tmp_path, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: script.main(["--device", "cuda", "--run-dir", str(tmp_path / "run")]), capsys)
    assert error.startswith(f"{script.__name__}.py: ") and "cuda" in error.lower()
    assert not (tmp_path / "run").exists()


def imported(path: Path) -> Sequence[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name.split(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append((node.module or "").split(".")[0])
    return names


def test_no_script_imports_another(script: ModuleType) -> None:
    scripts = {path.stem for path in ROOT.glob("*.py")}
    assert {*SCRIPTS, "gps", "pods"} <= scripts
    for name in scripts:
        assert not scripts & set(imported(ROOT / f"{name}.py")), name
