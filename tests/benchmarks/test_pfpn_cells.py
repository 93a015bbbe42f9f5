"""benchmarks/pfpn_cells.py: what it reads off runs."""

from __future__ import annotations

import csv
from pathlib import Path

import pfpn_cells
import pytest
from common import DOCS, RESULTS, ROOT
from learners import refusal
from tables import markdown, read_csv

import pfpn
import pfpn_sac
from diffsim.training import parse


@pytest.mark.parametrize(
    ("figure", "cell"), [(name, cell) for name, figure in pfpn_cells.FIGURES.items() for cell in figure.cells]
)
def test_each_cell_is_a_command(figure: str, cell: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same iterations and samples as the others of its figure."""
    monkeypatch.chdir(ROOT)
    case = pfpn_cells.FIGURES[figure]
    flags = ["--env", case.env, "--device", "cpu", *case.flags.split()]
    kind = (pfpn if case.script == "pfpn" else pfpn_sac).Args
    base, args = parse(kind, flags), parse(kind, [*flags, *case.cells[cell].split()])
    for name in ("iterations", "num_envs", "horizon", "epochs", "minibatch_size", "gamma", "hidden"):
        assert getattr(args, name) == getattr(base, name)


def test_an_unknown_figure_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: pfpn_cells.main(pfpn_cells.Args(only=("figure 3",))), capsys)
    assert error.endswith(f"--only: there is no 'figure 3'; choose from {', '.join(pfpn_cells.FIGURES)}")


def write(folder: Path, returns: list[float], dead: float | None) -> None:
    folder.mkdir(parents=True)
    rows = []
    for k, value in enumerate(returns, start=1):
        row = {"iteration": k, "control_steps": 1000.0 * k, "return": "" if k == 1 else value, "eval_return": ""}
        if dead is not None:
            row |= {"particles_dead_mean": dead if k == 2 else 0, "particles_dead_max": 0, "particles_moved": 10.0 * k}
            row |= {"particles_active": 7}
        rows.append(row)
    rows[-1]["eval_return"] = 2 * returns[-1]
    with (folder / "progress.csv").open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_a_cell_is_a_line_over_its_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figure = pfpn_cells.Figure("ant", "", {"a": "", "b": "--policy gaussian", "c": ""})
    monkeypatch.setattr(pfpn_cells, "FIGURES", {"one": figure})
    for number, last in ((1, 100.0), (2, 120.0)):
        write(tmp_path / "pfpn" / "one" / f"a__{number}", [0.0, 50.0, last], 0.25)
    write(tmp_path / "pfpn" / "one" / "b__1", [0.0, 10.0, 30.0], None)
    args = pfpn_cells.Args(runs=tmp_path, output=tmp_path / "out", draw_only=True, only=("one",))
    pfpn_cells.main(args)
    rows = read_csv(tmp_path / "out" / "pfpn_cells.csv")
    assert sorted((row["cell"], row["seed"]) for row in rows) == [("a", "1"), ("a", "2"), ("b", "1")]
    first, second = pfpn_cells.table(rows)
    assert first == {"case": "a", "return": "220 ± 20", "in training": "80", "dead": "25%/0%", "moved": "30"}
    assert second == {"case": "b", "return": "60", "in training": "20", "dead": "", "moved": ""}


def test_the_page_has_the_tables_of_the_csv_file() -> None:
    rows = read_csv(RESULTS / "cpu" / "pfpn_cells.csv")
    for name in pfpn_cells.FIGURES:
        own = [row for row in rows if row["figure"] == name]
        assert own and markdown(pfpn_cells.table(own)) in (DOCS / "pfpn.md").read_text()
