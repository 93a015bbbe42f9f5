"""What the benchmarks write: rows that say where they come from, and the marked parts of pages."""

from __future__ import annotations

import sys
from pathlib import Path

import common
import tables
from learners import refusal


def test_rows_replace_those_of_their_key_and_origins_those_of_their_command(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    for flags, rows in (
        (["--first"], [{"task": "ant", "us": 1.0, "error": 0.5}, {"task": "hopper", "us": 2.0, "error": 0.25}]),
        (["--second", "one two"], [{"task": "ant", "us": 1234.56}]),
        (["--second", "one two"], [{"task": "ant", "us": 3.0}]),
    ):
        monkeypatch.setattr(sys, "argv", ["speed.py", *flags])
        tables.origin.cache_clear()
        tables.replace_csv(path, rows, ("task",))
    tables.origin.cache_clear()
    assert tables.read_csv(path) == [
        {"task": "ant", "us": "3", "error": ""},  # of which the second command measures none
        {"task": "hopper", "us": "2", "error": "0.25"},
    ]
    first, second = tables.origins(path)
    assert first.endswith("speed.py --first\n") and second.endswith("speed.py --second 'one two'\n")
    assert first.startswith("# ") and "; python 3." in first and "torch " in first and "; revision " in first
    tables.replace_csv(path, [{"task": "ant", "us": "7"}, {"task": "ant", "us": "8"}], ("task",))
    assert [(row["task"], row["us"], row["error"]) for row in tables.read_csv(path)] == [
        ("ant", "7", ""),
        ("ant", "8", ""),
        ("hopper", "2", "0.25"),
    ]
    assert tables.origins(path) == [first, second]


def test_only_its_own_part_of_a_page_is_filled(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- a -->\nold\n<!-- /a -->\nbetween\n<!-- b -->\n<!-- /b -->\nafter\n")
    for name, text in (("a", "new\n"), ("b", "b\n"), ("a", "newer\n")):
        tables.fill(page, name, text)
    parts = "before\n<!-- a -->\nnewer\n<!-- /a -->\nbetween\n<!-- b -->\nb\n<!-- /b -->\nafter\n"
    assert page.read_text() == parts


def test_results_of_a_gpu_have_places_of_their_own(monkeypatch):
    monkeypatch.setattr("torch.cuda.get_device_name", lambda _: "NVIDIA H100 80GB HBM3")
    gpu, cpu, elsewhere = (
        common.CommonFlags(device="cuda:0", update_results=True),
        common.CommonFlags(update_results=True),
        common.CommonFlags(output=Path("/elsewhere")),
    )
    figures = common.DOCS / "figures"
    assert gpu.csv("speed") == common.RESULTS / "h100" / "speed.csv" and gpu.picture("speed").parent == figures / "h100"
    assert cpu.csv("speed") == common.RESULTS / "cpu" / "speed.csv" and cpu.picture("speed").parent == figures
    assert elsewhere.picture("speed") == Path("/elsewhere/speed.png")


def test_the_repository_is_changed_on_demand_alone(tmp_path, monkeypatch, capsys):
    for name in ("RESULTS", "DOCS", "OUTPUT"):
        monkeypatch.setattr(common, name, tmp_path / name)
    monkeypatch.setattr(tables, "unknown", lambda _: "")
    (tmp_path / "DOCS").mkdir()
    page = tmp_path / "DOCS" / "page.md"
    page.write_text("<!-- a -->\n<!-- /a -->\n")
    for flags, tree in (([], "OUTPUT"), (["--update-results"], "RESULTS")):
        args = common.parse(common.CommonFlags, None, flags)
        args.replace("a", [{"task": "ant"}], ("task",))
        args.publish("a", "table\n", "page.md")
        assert list(tmp_path.glob("*/cpu/a.csv")) == [tmp_path / tree / "cpu" / "a.csv"]
        assert (
            ("table" in page.read_text()) == (tree == "RESULTS") == (args.picture("a").parents[1] == tmp_path / "DOCS")
        )
        (tmp_path / tree / "cpu" / "a.csv").unlink()
    argv = ["--update-results", "--output", str(tmp_path)]
    error = refusal(lambda: common.parse(common.CommonFlags, None, argv), capsys)
    assert error.endswith("--output and --update-results exclude each other")


def test_a_command_has_no_path_of_its_machine(monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(tables.ROOT / "benchmarks" / "speed.py"), "--runs", "/home/me/runs", "--env"])
    assert tables.origin.__wrapped__().endswith("; python benchmarks/speed.py --runs runs --env\n")


def test_results_of_unknown_origin_are_refused(monkeypatch, capsys):
    known = "# 2 cores of a CPU; python 3.11, torch 2.13; revision 1dd159e; python speed.py --runs unknown-dirty\n"
    assert tables.unknown(known) == ""
    for old, new, found in (
        ("a CPU", "unknown", "2 cores of unknown"),
        ("torch 2.13", "torch unknown", "python 3.11, torch unknown"),
        ("1dd159e", "1dd159e-dirty", "revision 1dd159e-dirty"),
    ):
        line = known.replace(old, new)
        monkeypatch.setattr(tables, "origin", lambda _, line=line: line)
        error = refusal(lambda: common.parse(common.CommonFlags, None, ["--update-results"]), capsys)
        assert "--update-results needs a known machine, known versions and a committed" in error
        assert error.endswith(f"not {found}")
        common.parse(common.CommonFlags, None, [])  # elsewhere any will do
