"""What is read off the curves of runs, and that a stopped call goes on."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import cells
import numpy as np
import paper
import tables

from diffsim.training import checkpoint


def points(learner: str, seed: int, slope: float, count: int, task: str = "ant") -> list[tables.Row]:
    """A curve whose k-th iteration ends after 100 k control steps and k / 2 seconds with the return slope * k."""
    about = {"learner": learner, "task": task, "seed": seed}
    lines = ({"iteration": k, "control_steps": 100 * k, "return": slope * k, "seconds": k / 2} for k in range(count))
    return [about | line for line in lines]


def test_policies_are_compared_within_the_control_steps_that_all_made(tmp_path, monkeypatch):
    """At 3,000 steps, where a Gaussian run ends: 30 and 60 of the first learner, 15 and 30 of the second."""
    group = cells.Group("h200", ("a", "b"), ("ant", "hopper"), 2, timed=False, ratios=True)
    monkeypatch.setitem(paper.GROUPS, "both", group)
    rows = [*points("a", 1, 1.0, 50), *points("a", 2, 2.0, 50), *points("b", 1, 0.5, 50), *points("b", 2, 1.0, 31)]
    rows += [*points("a", 1, 9.0, 50, "hopper"), *points("a", 2, 9.0, 50, "hopper"), *points("b", 1, 9.0, 50, "hopper")]
    rows += points("a", 3, 9.0, 10)  # a third seed is not of the group
    tables.replace_csv(tmp_path / "h200" / "curves.csv", rows, paper.KEY)
    args = paper.Args(output=tmp_path / "cpu")
    found = paper.curves(args, "both")
    assert all(np.isnan(run["seconds"]).all() for runs in found.values() for run in runs)  # the group is not timed
    (row,) = paper.ratios(args, "both")  # on the hopper a seed is missing
    assert row == {"task": "ant", "control steps": "0.003 M", "a": "45 ± 15", "b": "22 ± 8", "ratio": "2.00"}


def test_curves_begin_with_the_first_episode_and_tell_where_they_pass():
    rows = [{"iteration": f"{k}", "control_steps": f"{8 * k}", "seconds": f"{k}", "return": f"{k}"} for k in range(9)]
    one = cells.curve([rows[0] | {"return": ""}, *rows[1:]])
    assert len(one["return"]) == 8 and cells.passing(one, 5.0, "control_steps") == 40.0
    assert cells.passing(one, 50.0, "seconds") == np.inf


def test_a_picture_has_steps_for_all_and_seconds_for_those_alone():
    rows = [{"control_steps": f"{8 * k}", "seconds": f"{k}", "return": f"{k}"} for k in range(1, 9)]
    found = {("shac", "hopper"): [cells.curve(rows)] * 2}
    found["sapo", "hopper"] = [cells.curve([row | {"seconds": ""} for row in rows])]
    group = cells.Group("cpu", ("shac", "sapo"), ("hopper",), 2)
    steps, seconds = (paper.panel(group, found, "hopper", x) for x in ("control_steps", "seconds"))
    assert [line.label for line in steps.lines] == ["", "", "SHAC", "", "SAPO", "SHAC, published"]
    assert [line.label for line in seconds.lines] == ["", "", "SHAC", "SHAC, published"]


def test_a_script_may_be_several_processes(tmp_path_factory, monkeypatch):
    """Of torchrun, to which --monitor would be a flag of its own without the dashes before the script."""
    called, folder = list[list[str]](), tmp_path_factory.getbasetemp()
    monkeypatch.setattr(cells.subprocess, "Popen", lambda command, **_: called.append(command) or Ended())
    for script in ("shac", "shac@2"):
        assert cells.Runner(cells.ScriptFlags(device="cpu")).train(cells.Case(folder, "ant", 1, script))
    alone, both = called
    at = both.index("--")
    assert both[1:3] == ["-m", "torch.distributed.run"] and "--nproc-per-node=2" in both[:at]
    assert both[at + 1 :] == alone[1:] and Path(alone[1]).is_file()


class Ended:
    returncode = 0

    def wait(self, _: float | None) -> int:
        return 0


def test_a_stopped_call_goes_on_where_it_was(tmp_path, monkeypatch):
    flags = "--num-envs", "2", "--horizon", "8", "--eval-every", "0", "--eval-episodes", "1", "--iterations"
    folder = tmp_path / "bptt" / "cartpole__1"
    case = cells.Case(folder, "cartpole", 1, "bptt")

    class Begun(subprocess.Popen[bytes]):
        """Its time counts from its first iterations: how long a script takes to start is the machine's business."""

        def wait(self, timeout: float | None = None) -> int:
            progress = folder / "progress.csv"
            while timeout is not None and self.poll() is None and not (progress.is_file() and progress.read_text()):
                time.sleep(0.05)
            return super().wait(timeout)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", Begun)
        args = cells.ScriptFlags(device="cpu", time_limit=1.0, arguments=(*flags, "100000"))
        assert not cells.Runner(args).train(case)
    done = checkpoint.load(folder / "checkpoint.pt")["iteration"]
    assert 0 < done < 100000 and not (folder / "evaluation.json").exists()
    runner = cells.Runner(cells.ScriptFlags(device="cpu", arguments=(*flags, str(done + 30))))
    assert runner.train(case) and runner.evaluate(case)
    rows = tables.read_csv(folder / "progress.csv")
    assert [int(row["iteration"]) for row in rows] == list(range(1, done + 31))
    assert cells.evaluation(folder)["return"] < 0
    assert cells.evaluation(folder)["finer"]["substeps"] == 16
    assert not cells.evaluation(folder, done)  # of another iteration
