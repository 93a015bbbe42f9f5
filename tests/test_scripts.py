"""What every script does alike: files, resuming, evaluation, errors; and that each stands alone."""

from __future__ import annotations

import dataclasses
import json
import signal
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import ROOT, SCRIPTS, SMALL, assert_same, read_progress, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils._python_dispatch import TorchDispatchMode

from diffsim.training import Run, graph
from diffsim.training.log import COLUMNS, column

NOT_COMPARED = {"seconds"}
PPO_LOSSES = " ".join(  # by CleanRL's names
    f"losses/{name}" for name in "policy_loss value_loss entropy approx_kl clipfrac explained_variance".split()
)
SCALARS = {
    "shac": "losses/actor losses/critic charts/actor_lr charts/critic_lr",
    "rpo": "losses/actor losses/critic losses/approx_kl losses/clipfrac charts/std charts/actor_lr",
    "sapo": (
        "losses/actor losses/critic charts/actor_lr charts/critic_lr charts/reward charts/entropy charts/temperature"
    ),
    "bptt": "losses/actor charts/learning_rate",
    "ppo_baseline": f"{PPO_LOSSES} charts/learning_rate charts/std",
    "pfpn": (
        f"{PPO_LOSSES} charts/learning_rate "
        "particles/dead_mean particles/dead_max particles/moved particles/active particles/std"
    ),
}
COMMON_SCALARS = (
    "charts/episodic_return charts/episodic_length charts/SPS eval/return eval/length grad/norm grad/skipped "
    "sim/nonfinite sim/nonfinite_gradients time/evaluation time/iterate time/total"
)


@pytest.fixture(scope="module", params=SCRIPTS)
def script(request):
    return SCRIPTS[request.param]


@pytest.fixture(scope="module")
def small(script):
    return SMALL[script.__name__]


@pytest.fixture(scope="module")
def trained(script, small, tmp_path_factory):
    directory = tmp_path_factory.mktemp("trained")
    run(script, directory, *small)
    return directory


@pytest.fixture(scope="module")
def checkpoint(trained):
    return torch.load(trained / "checkpoint.pt", weights_only=True)


# A run ----------------------------------------------------------------------------------------------------------------


def test_another_seed_has_other_weights(script, small, checkpoint, tmp_path):
    other = run(script, tmp_path, *small, "--seed", 2, stop_after=1)
    for name, weight in other["policy"]["weights"].items():
        if name.endswith("weight") and weight.ndim == 2:
            assert not torch.equal(weight, checkpoint["policy"]["weights"][name])


def test_saving_and_evaluating_change_no_numbers(script, small, tmp_path):
    often = run(script, tmp_path / "often", *small, "--save-every", 1, "--eval-every", 1, stop_after=3)
    never = run(script, tmp_path / "never", *small, "--save-every", 0, "--eval-every", 0, stop_after=3)
    for name in ("modules", "ranks", "control_steps"):
        assert_same(often[name], never[name])


def test_the_same_seed_interrupted_and_resumed_ends_bitwise_alike(script, small, checkpoint, tmp_path, monkeypatch):
    path, evaluate, before = tmp_path / "checkpoint.pt", Run.evaluate, signal.getsignal(signal.SIGTERM)

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGTERM)
        return evaluate(*arguments)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit:
        patch.setattr(Run, "evaluate", interrupted)
        run(script, tmp_path, *small, "--threads", 1)
    assert exit.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) == before  # a bound method is made anew each time
    assert torch.load(path, weights_only=True)["iteration"] == 5
    with (tmp_path / "progress.csv").open("a") as file:  # of iterations after the checkpoint, as a crash leaves them
        file.write("9,999,9.9\n")
    script.main(["--resume", str(path)])
    resumed = torch.load(path, weights_only=True)
    resumed["args"]["threads"] = 0
    for name in checkpoint.keys() - NOT_COMPARED:
        assert_same(resumed[name], checkpoint[name])
    assert [int(row["iteration"]) for row in read_progress(tmp_path)] == list(range(1, 11))


def test_files_of_a_run(script, trained, checkpoint):
    assert {path.name for path in trained.iterdir() if "tfevents" not in path.name} == {
        "args.json",
        "checkpoint.pt",
        "evaluation.json",
        "lock",
        "progress.csv",
    }
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["num_envs"] == 3 and arguments["substeps"] == 4
    hidden, lr = ("actor_hidden", "actor_lr") if "actor_lr" in arguments else ("hidden", "lr")
    rates = {"ppo_baseline": 3e-4, "pfpn": 3e-4, "rpo": 2e-3}
    assert arguments[hidden] == [64, 64] and arguments[lr] == rates.get(script.__name__, 1e-2)
    assert list(arguments) == [field.name for field in dataclasses.fields(script.Args)]
    assert arguments == json.loads(json.dumps(checkpoint["args"])) | {"run_dir": str(trained)}

    rows, samples = read_progress(trained), [3 * 32 * k for k in range(1, 11)]
    assert [int(row["control_steps"]) for row in rows] == samples
    assert [bool(row["eval_return"]) for row in rows] == [k in (4, 8, 10) for k in range(1, 11)]
    assert [row["length"] for row in rows] == [""] * 7 + ["240.0"] * 3
    assert all(float(row["grad_skipped"]) == float(row["sim_nonfinite"]) == 0 for row in rows)
    if final := getattr(script, "FINAL_LR", None):  # from the first rate to the last one, linearly
        for name in {"charts_actor_lr", "charts_critic_lr", "charts_learning_rate"} & rows[0].keys():
            first = arguments[{"charts_learning_rate": "lr"}.get(name, name.removeprefix("charts_"))]
            rates = [first + (final - first) * k / 10 for k in range(10)]
            assert [float(row[name]) for row in rows] == pytest.approx(rates, rel=1e-5)
    assert [bool(row["time_evaluation"]) for row in rows] == [bool(row["eval_return"]) for row in rows]
    late = {name for name in rows[0] if name.startswith("eval")} | {"return", "length", "time_evaluation"}
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
            ours = [frame for frame in traceback.extract_stack()[:-1] if self.is_ours(Path(frame.filename))]
            self.places.append(f"{Path(ours[-1].filename).name}: {ours[-1].line}")
        return function(*args, **(kwargs or {}))

    @staticmethod
    def is_ours(path: Path) -> bool:
        return path.is_relative_to(ROOT) and "site-packages" not in path.parts  # an environment may lie in the clone


def test_nothing_captured_waits_for_the_device(script, small, tmp_path, monkeypatch):
    captured, places = [], list[str]()

    def capture(function: Callable[[], Any], device: torch.device, env: Any = None) -> Callable[[], Any]:
        captured.append(function.__name__)

        def call() -> Any:
            with Waits(places):
                return function()

        return call

    monkeypatch.setattr(graph, "capture", capture)
    run(script, tmp_path, *small, stop_after=3)
    assert captured == ["iterate"]
    only_on_the_cpu = 'if self.device.type == "cpu" and bool(torch.isnan(action).any()):'
    assert set(places) == {f"env.py: {only_on_the_cpu}"}  # seen, so the rest would be seen


@pytest.mark.gpu
@pytest.mark.parametrize("graphs", [True, False])
def test_same_seed_same_weights_on_a_gpu(script, tmp_path, monkeypatch, graphs):
    monkeypatch.setattr(Run, "graphs", graphs)
    checkpoints = []
    for name in ("a", "b"):
        arguments = "--env cartpole --num-envs 8 --iterations 12 --eval-every 5 --eval-episodes 2 --quiet".split()
        script.main([*arguments, "--device", "cuda", "--run-dir", str(tmp_path / name)])
        checkpoints.append(torch.load(tmp_path / name / "checkpoint.pt", weights_only=True, map_location="cpu"))
    assert_same(checkpoints[0]["modules"], checkpoints[1]["modules"])


# A saved policy -------------------------------------------------------------------------------------------------------
