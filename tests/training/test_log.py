"""progress.csv and tensorboard."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from learners import read_progress
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from diffsim.training.log import COLUMNS, ProgressFile, ProgressLog, say


def row(iteration: int, **values: float) -> dict[str, float]:
    return {"iteration": iteration, "control_steps": 10 * iteration, "seconds": 0.5} | values


def test_columns_join_when_they_first_have_a_value(tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    file = ProgressFile(path, 0)
    assert path.read_text().split() == [",".join(COLUMNS)]
    file.write(row(1, loss=0.25))
    file.write(row(2, loss=0.5))
    assert [r["loss"] for r in read_progress(tmp_path)] == ["0.25", "0.5"]
    file.write(row(3, eval=7.0, loss=0.75))
    file.write(row(4, loss=1.0))
    file.write(row(5, eval=8.0))
    assert list(read_progress(tmp_path)[0]) == [*COLUMNS, "loss", "eval"]
    assert [r["loss"] for r in read_progress(tmp_path)] == ["0.25", "0.5", "0.75", "1.0", ""]
    assert [r["eval"] for r in read_progress(tmp_path)] == ["", "", "7.0", "", "8.0"]
    assert [r["control_steps"] for r in read_progress(tmp_path)] == ["10", "20", "30", "40", "50"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_resumed_run_goes_on_after_its_checkpoint(tmp_path: Path) -> None:
    """Without what a crash left behind: later rows, and half of a line."""
    path = tmp_path / "progress.csv"
    file = ProgressFile(path, 0)
    for k in range(1, 11):
        file.write(row(k, loss=float(k)) | ({"eval": 1.0} if k == 9 else {}))
    with path.open("a") as text:
        text.write("1")  # of 11,110,...
    file = ProgressFile(path, 6)
    file.write(row(7, loss=-7.0))
    file.write(row(8, loss=-8.0, speed=2.0))
    rows = read_progress(tmp_path)
    assert [r["iteration"] for r in rows] == [str(k) for k in range(1, 9)]
    assert [r["loss"] for r in rows] == [f"{k}.0" for k in range(1, 7)] + ["-7.0", "-8.0"]
    assert [r["speed"] for r in rows] == [""] * 7 + ["2.0"] and not any(r["eval"] for r in rows)
    ProgressFile(path, 0)  # another run, from the start
    assert read_progress(tmp_path) == []
    path.unlink()
    ProgressFile(path, 6)  # resumed where only the checkpoint was kept
    assert read_progress(tmp_path) == []


def test_a_crash_while_columns_join_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "progress.csv"
    file = ProgressFile(path, 0)
    file.write(row(1, loss=0.25))
    before = path.read_text()

    def crash(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        patch.setattr("os.replace", crash)
        file.write(row(2, eval=1.0))
    assert path.read_text() == before


def test_log(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    log = ProgressLog(tmp_path, 0, 0, {"gamma": 0.99, "hidden": (64, 64)}, total=4, quiet=False)
    for k in range(1, 4):
        log.write(k, 10 * k, 0.12345 * k, {"losses/actor": 1 / 3, "charts/episodic_return": 12.34})
    say("a line")
    log.close()
    rows = read_progress(tmp_path)
    assert [r["control_steps"] for r in rows] == ["10", "20", "30"]
    filled = dict(iteration="2", control_steps="20", seconds="0.247", losses_actor="0.3333333") | {"return": "12.34"}
    assert rows[1] == dict.fromkeys(COLUMNS, "") | filled
    out = capsys.readouterr().out
    assert "a line\n" in out and "3/4" in out and "it/s" in out and "return 12.3" in out

    later = time.time() + 10  # files of one second would be read in the order of a counter's text, 10 before 9
    monkeypatch.setattr(time, "time", lambda: later)
    resumed = ProgressLog(tmp_path, 2, 20, {}, total=4, quiet=True)
    resumed.write(3, 30, 1.0, {"losses/actor": 0.5})
    resumed.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("losses/actor")] == [
        (10, pytest.approx(1 / 3)),
        (20, pytest.approx(1 / 3)),
        (30, 0.5),
    ]
    (text,) = events.Tensors("hyperparameters/text_summary")[:1]
    assert text.tensor_proto.string_val[0].decode() == "|name|value|\n|-|-|\n|gamma|0.99|\n|hidden|(64, 64)|"
