"""benchmarks/gps_humanoid.py: when robots fall, on a small run, and the table."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import gps_humanoid
import pytest
import torch
from common import DOCS, RESULTS, CheckpointFlags
from learners import run
from tables import markdown, read_csv

import diffsim
import gps
from diffsim.planning import System

SMALL = (
    "--env hopper --horizon 6 --restarts 1 --screening 1 --ilqr-iterations 1 --pretraining 5 --hidden 8 --samples 2 "
    "--guiding-samples 4 --active 8 --stored 8 --iterations 1 --lbfgs-iterations 2 --eval-every 0 --eval-episodes 1"
).split()
system = cache(lambda: System(diffsim.make("hopper", 1)))


def test_until_fall() -> None:
    """A hopper falls where its torso sinks; a state that is not finite is the end too; the way after it is not run."""
    x = system().start().repeat(3, 5, 1)
    x[:, :, 0] += torch.tensor([0.0, 0.1, 0.2, 0.3, 9.0]).double()
    x[1, 3, 1] -= 1.0  # stands up again afterwards
    finite = torch.ones(3, 4, dtype=torch.bool)
    finite[2, 1:] = False
    steps, speed = gps_humanoid.until_fall(system(), x, finite)
    assert steps.tolist() == [4, 2, 1]
    expected = torch.tensor([9.0 / 4, 0.1, 0.1]).double() / system().control_dt
    torch.testing.assert_close(speed, expected)


def test_noise_is_of_its_own_step() -> None:
    noise = torch.arange(6.0).view(1, 3, 2)
    act = gps_humanoid.noisy(lambda t, x: 10 * t + x, noise)
    assert act(2, torch.ones(1, 2)).tolist() == [[25.0, 26.0]]


def test_a_run_on_every_ground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No hopper falls within a tenth of a second, unless it starts in the ground; perturbed starts differ from none."""
    directory, output = tmp_path / "hopper__feedback__1", tmp_path / "results"
    run(gps, directory, *SMALL, "--quiet")
    monkeypatch.setattr(gps_humanoid, "SIZES", {"policy's noise": (1.0,), "perturbed start": (0.0, 99.0)})
    monkeypatch.setattr(gps_humanoid, "COUNT", 4)
    gps_humanoid.main(CheckpointFlags(checkpoints=(directory,), output=output))
    rows = {(row["case"], row["size"], row["controller"]): row for row in read_csv(output / "gps_humanoid.csv")}
    assert len(rows) == 9 and all(
        float(rows["policy's noise", "1", name]["seconds"]) == 0.1 for name in ("ddp", "tbdp")
    )
    still, far = rows["perturbed start", "0", "ddp"], rows["perturbed start", "99", "ddp"]
    assert float(still["whole"]) == 1.0 > float(far["whole"]) and still["trajectories"] == "4"
    assert float(still["speed"]) != float(rows["policy's noise", "1", "ddp"]["speed"])
    before = (output / "gps_humanoid.csv").read_bytes()
    gps_humanoid.main(CheckpointFlags(draw_only=True, output=output))
    assert before == (output / "gps_humanoid.csv").read_bytes()


def test_table() -> None:
    """Means over seeds, a column a kind of run."""
    rows = [
        dict(env="humanoid", variant=variant, seed=str(seed), case="rough", size="3", controller=name)
        | dict(whole=str(share + seed / 4), seconds=str(4 * share))
        for variant in ("feedback", "other")
        for name, share in (("policy", 0.25), ("ddp", 0.5), ("tbdp", 0.0))
        for seed in (0, 2)
    ]
    (row,) = gps_humanoid.table(rows)
    assert row == {"": "rough", "size": "3"} | dict.fromkeys(("feedback", "other"), "1.0 / 2.0 / 0.0")


def test_the_page_has_the_table_of_the_csv_file() -> None:
    rows = read_csv(RESULTS / "cpu" / "gps_humanoid.csv")
    assert markdown(gps_humanoid.table(rows)) in (DOCS / "gps_terrain.md").read_text()
