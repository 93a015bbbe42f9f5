"""The pages: their figures are in the csv files that they name; links, files and flags that they mention exist."""

from __future__ import annotations

import ast
import contextlib
import csv
import dataclasses
import functools
import importlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean, median, pstdev
from typing import NamedTuple

import pytest

from diffsim import TASKS
from diffsim_cli import view
from tools import api

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
LOG = ROOT / "results" / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", LOG, *sorted((ROOT / "docs").glob("*.md"))]
LEARNERS = [*ROOT.glob("*.py"), *ROOT.glob("baselines/*.py")]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CASES = json.loads((ROOT / "benchmarks" / "cases.json").read_text())
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


# Figures --------------------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    header: list[str]
    rows: list[list[str]]
    source: Path | None  # the csv file named between the table and the next table or heading


def tables(page: Path) -> Iterator[Table]:
    parts = re.split(r"((?:^\|.*\n)+)", page.read_text(), flags=re.MULTILINE)
    for block, text in zip(parts[1::2], parts[2::2], strict=True):
        header, _, *rows = ([plain(cell) for cell in line.strip()[1:-1].split("|")] for line in block.splitlines())
        below = re.split(r"^#", text, flags=re.MULTILINE)[0]
        source = re.search(r"results/\w+/\w+\.csv", below)
        yield Table(header, rows, ROOT / source[0] if source else None)


def plain(cell: str) -> str:
    """A cell without markup and thousands separators."""
    cell = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", cell)
    return re.sub(r"(?<=\d),(?=\d{3})", "", cell.replace("`", "").replace("*", "")).strip()


def read_csv(path: Path) -> list[dict[str, str]]:
    lines = path.read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("# ")))  # without where it comes from


def same(shown: str, measured: str) -> bool:
    try:
        return float(shown) == float(measured)
    except ValueError:
        return shown == measured


ORIGIN = re.compile(r"# [^;]+; python .*torch .*warp .*; revision [^;]+; python \w+")


def test_every_csv_file_is_of_a_commit() -> None:
    def git(*words: str) -> list[str]:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.split()

    if git("rev-parse", "--is-shallow-repository") != ["false"]:
        pytest.skip("the history is not here")
    commits = git("log", "--format=%H")
    for path in sorted((ROOT / "results").rglob("*.csv")):
        for line in path.read_text().splitlines():
            revisions = re.findall(r"\b[0-9a-f]{7}\b", line.split("; ", 3)[2]) if line.startswith("# ") else ()
            for short in revisions:
                assert any(commit.startswith(short) for commit in commits), f"{path} is of {short}, not in this history"


def test_every_csv_file_says_where_it_comes_from() -> None:
    paths = sorted((ROOT / "results").rglob("*.csv"))
    files = {path for path in (ROOT / "results").rglob("*") if path.is_file()}
    assert paths and files == {*paths, LOG}
    for path in paths:
        origins = [line for line in path.read_text().splitlines() if line.startswith("# ")]
        assert origins and all(ORIGIN.match(line) for line in origins), path
        assert not any(re.search("unknown|dirty", line) for line in origins), path


def test_every_csv_file_is_shown_or_needed() -> None:
    """A page or the log names it, or a picture has its name."""
    text = "".join(page.read_text() for page in PAGES)
    pictures = {path.stem for path in (ROOT / "docs" / "figures").rglob("*.png")}
    for path in sorted((ROOT / "results").rglob("*.csv")):
        assert path.name in text or path.stem in pictures, f"no page shows {path}"


def test_tables_that_no_benchmark_fills_agree_with_their_files() -> None:
    """In the columns that the csv file has, too. What benchmarks fill: tests/benchmarks/test_pages.py."""
    checked = set()
    for table in tables(ROOT / "docs" / "performance.md"):
        if table.source and table.source.stem in ("speed_physics", "speed_scaling"):
            measured = read_csv(table.source)
            own = [name for name in table.header if name in measured[0]]
            for row in table.rows:
                shown = dict(zip(table.header, row, strict=True))
                found = [line for line in measured if all(same(shown[name], line[name]) for name in own)]
                assert len(own) > 2 and found, f"{table.source.name} lacks {shown}"
                checked.add(table.source.stem)
    assert checked == {"speed_physics", "speed_scaling"}


def test_the_page_of_tasks_has_their_sizes() -> None:
    shown: dict[str, list[str]] = {}
    for table in tables(ROOT / "docs" / "tasks.md"):
        if "observations" in table.header:
            shown |= {name: cells for first, *cells in table.rows for name in first.split(", ")}
    assert shown == {
        name: [
            *(str(task.obs_dim), str(task.load_robot().nu), f"{1 / task.control_dt:.0f}"),
            *(str(task.substeps), task.contact, str(task.episode_length)),
        ]
        for name, task in TASKS.items()
    }


def test_the_page_of_the_api_is_that_of_the_docstrings() -> None:
    assert api.PAGE.read_text() == api.page(), "python tools/api.py writes it"


def test_every_logged_metric_is_explained() -> None:
    text = (ROOT / "docs" / "running.md").read_text()
    for script in [*LEARNERS, *(ROOT / "diffsim" / "training").glob("*.py")]:
        groups = "losses|charts|eval|grad|sim|gps|pods|models|particles"
        for name in re.findall(rf'"((?:{groups})/\w*[a-z])"', script.read_text()):
            names = name, name.partition("/")[2]
            assert any(f"`{each}`" in text for each in names), f"{script.name} logs {name}"


@each_page
def test_tables_have_at_most_seven_columns(page: Path) -> None:
    for line in re.findall(r"^\|(?: ?:?-+:? ?\|)+$", page.read_text(), re.MULTILINE):
        assert line.count("|") <= 8, f"{page.name}: {line}"


@each_page
def test_no_spread_of_a_single_seed(page: Path) -> None:
    assert not re.search(r"±\s*0(?![.\d])", page.read_text()), "the spread of one run is not 0: print the seed count"


# Where numbers of a page come from. In the text, after them: <!-- =FILE:COLUMN:KEY=VALUE&KEY=VALUE:RULES -->. Or in a
# list at the page's end, which leaves the text readable: <!-- numbers, lines of "PHRASE | FILE:COLUMN:...:RULES" with
# phrases that the page has once, and -->. RULES are as many as the last numbers before the mark or of the phrase,
# joined by commas. VALUE|VALUE takes rows of both, " / " divides two such sources, "; " joins them. FILE is in
# results/, or begins with diffsim/.
MARK = re.compile(r"(.*?)<!-- =(.+?) -->")
LIST = re.compile(r"^<!-- numbers\n(.*?)^-->$", re.MULTILINE | re.DOTALL)
RULES: dict[str, Callable[[list[float]], float]] = {
    **{"median": median, "mean": mean, "min": min, "max": max, "sum": sum, "count": len},
    "std": pstdev,
    "percent": lambda values: 100 * median(values),
    "mean percent": lambda values: 100 * mean(values),
    "worst": lambda values: 100 * min(values),
    "best": lambda values: 100 * max(values),
    "milli": lambda values: 1000 * median(values),
    "millions": lambda values: median(values) / 1e6,
}


def sources(page: Path) -> Iterator[tuple[str, str]]:
    """The text before each mark, or a phrase of the list at the page's end, and where its last numbers come from."""
    text = page.read_text()
    yield from MARK.findall(text)
    body = " ".join(LIST.sub("", text).split())
    for line in "".join(LIST.findall(text)).splitlines():
        phrase, _, source = line.rpartition(" | ")
        assert body.count(phrase) == 1, f"{page.name} has {phrase!r} {body.count(phrase)} times"
        yield phrase, source


def recompute(source: str) -> list[float]:
    """What a mark asks for."""
    if "; " in source:
        return [value for each in source.split("; ") for value in recompute(each)]
    if " / " in source:
        above, below = map(recompute, source.split(" / "))
        return [one / other for one, other in zip(above, below, strict=True)]
    file, column, where, rules = source.split(":")
    rows = read_csv(ROOT / file if file.startswith("diffsim/") else ROOT / "results" / file)
    wanted = [part.split("=") for part in where.split("&") if part]
    found = [row for row in rows if all(any(same(row[key], v) for v in value.split("|")) for key, value in wanted)]
    values = [0.0 if rules == "count" else float(row[column].rstrip("%")) for row in found if row[column]]
    assert values, f"{source}: no such rows"
    return [RULES[rule](values) for rule in rules.split(",")]


@each_page
def test_marked_numbers_are_those_of_their_files(page: Path) -> None:
    for before, source in sources(page):
        expected, shown = recompute(source), re.findall(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?", before)
        assert len(shown) >= len(expected), f"{page.name}: no number before {source}"
        for number, value in zip(shown[-len(expected) :], expected, strict=True):
            unit = 10.0 ** -len(number.partition(".")[2])
            off = abs(float(number.replace(",", "")) - value)
            assert off <= 0.501 * unit, f"{page.name}: {number} is {value:.6g}, by {source}"


def test_a_list_of_numbers_finds_a_wrong_one(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    source = "h200/cells.csv:return:learner=rpo&task=ant:median,max"
    for phrase, error in (("7,929 (8,430)", ""), ("7,928 (8,430)", "7,928 is 7929"), ("7,929", "no number")):
        path.write_text(f"It returns {phrase}.\n\n<!-- numbers\n{phrase} | {source}\n-->\n")
        with pytest.raises(AssertionError, match=error) if error else contextlib.nullcontext():
            test_marked_numbers_are_those_of_their_files(path)
    path.write_text(f"Twice 7,929, once 7,929.\n<!-- numbers\n7,929 | {source}\n-->\n")
    with pytest.raises(AssertionError, match="2 times"):
        test_marked_numbers_are_those_of_their_files(path)


# Links and files ------------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """GitHub's names of a page's headings."""
    names: list[str] = []
    for heading in re.findall(r"^#+ +(.+)$", FENCE.sub("", page.read_text()), re.MULTILINE):
        name = re.sub(r"[^\w\- ]", "", plain(heading).lower()).replace(" ", "-")
        names.append(f"{name}-{names.count(name)}" if name in names else name)
    return {*names}


@each_page
def test_relative_links_and_pictures_exist(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text()))
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"""\b(?:src|href)=["']([^"']+)""", text)
    for link in links:
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name} links to {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link} has no such heading"


def test_readme_begins_with_the_commands_of_a_fresh_machine() -> None:
    """In the folder that the reader has."""
    commands = [line.split("  ")[0] for _, code in FENCE.findall(README.read_text())[:1] for line in code.splitlines()]
    assert commands[:3] == ["pip install -e .", "diffsim demo humanoid", "python shac.py --env ant --seed 1"]


def test_what_is_where_names_all_scripts_and_packages_once() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (section,) = re.findall(r"^## What is where\n\n```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    first = [line.split()[0] for line in section.splitlines() if re.match(r" *[\w./]+ {2}", line)]
    packages = [f"{path.parent.name}/" for path in ROOT.glob("diffsim*/*/__init__.py")]
    folders = "diffsim/ diffsim_robots/ diffsim_cli/ baselines/ benchmarks/ tests/ examples/ tools/".split()
    assert sorted(first) == sorted([*(path.name for path in LEARNERS), *packages, *folders])


def test_readme_links_the_page_of_every_learner() -> None:
    links = dict(re.findall(r"\[(\w+)\]\(docs/(\w+)\.md\)", README.read_text()))
    assert all(path.stem.startswith(links[path.stem]) for path in LEARNERS)


@each_page
def test_formulas_are_safe_from_markdown(page: Path) -> None:
    """GitHub drops a backslash before punctuation, except in $`...`$ and in blocks."""
    text = re.sub(r"\$`[^`\n]*`\$|`[^`\n]*`", "", FENCE.sub("", page.read_text()))
    assert not [each for each in re.findall(r"\$([^$\n]+)\$", text) if re.search(r"\\[^\w\s]", each)]
    assert "$$" not in text


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason='pip install -e ".[docs]"')
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "<math" in (tmp_path / "physics" / "index.html").read_text()


def test_the_site_has_all_pages() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    assert {path.name for path in (ROOT / "docs").glob("*.md")} <= {*re.findall(r"\w+\.md", text)}
    assert all(
        f"]({path.name})" in (ROOT / "docs" / "index.md").read_text() for path in PAGES[3:] if path.stem != "index"
    )


# Flags ----------------------------------------------------------------------------------------------------------------


SCRIPTS = [*LEARNERS, *ROOT.glob("benchmarks/*.py"), *ROOT.glob("tools/*.py")]


@functools.cache
def flags(script: Path) -> set[str]:
    """The flags that a script takes: the fields of its dataclass ...Args."""
    kinds = [kind for name, kind in vars(importlib.import_module(script.stem)).items() if name.endswith("Args")]
    fields = [field for kind in kinds if kind.__module__ == script.stem for field in dataclasses.fields(kind)]
    names = {field.name.replace("_", "-"): str(field.type) for field in fields}
    switches = {f"--no-{name}" for name, kind in names.items() if kind == "bool"}
    aliases = {word for kind in names.values() for word in re.findall(r"--[\w-]+", kind)}
    return {"--help", *(f"--{name}" for name in names)} | switches | aliases if names else set()


def of_commands(path: Path) -> set[str]:
    """The flags of the commands that a module defines: the parameters of its functions."""
    functions = (node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef))
    return {f"--{each.arg.replace('_', '-')}" for node in functions for each in node.args.args}


def of_argparse(script: Path) -> set[str]:
    """The flags of a script without this package, which has argparse alone."""
    return set(re.findall(r'add_argument\("(--[a-z-]+)"', script.read_text()))


ANY = {flag for script in SCRIPTS for flag in flags(script)}
ANY |= {flag for path in ("commands.py", "tune/__init__.py") for flag in of_commands(ROOT / "diffsim_cli" / path)}
ANY |= of_commands(ROOT / "examples" / "identify.py")
ANY |= {f"--{field.name}" for field in dataclasses.fields(view.Args)}


def commands(page: Path) -> Iterator[list[str]]:
    """The words of every shell command and of every piece of inline code, without comments."""
    text = page.read_text()
    shell = "".join(code for kind, code in FENCE.findall(text) if kind == "sh").replace("\\\n", " ")
    for code in shell.splitlines() + re.findall(r"`([^`\n]+)`", FENCE.sub("", text)):
        for command in re.split(r"&&|;|\|", re.sub(r"(^|\s)#.*", "", code)):
            yield command.split()


@each_page
def test_flags_exist(page: Path) -> None:
    for words in commands(page):
        scripts = [k for k, word in enumerate(words) if re.fullmatch(r"[\w./-]+\.py", word)]
        if not scripts and not (words and words[0].startswith("--")):
            continue  # another program's
        own = words[scripts[0] + 1 :] if scripts else words
        own = own[: own.index("--")] if "--" in own else own  # what follows "--" goes to another script
        mentioned = {word.partition("=")[0] for word in own if re.match(r"--[a-z]", word)}
        known, name = ANY, "no script"  # of a flag without its script
        if mentioned and scripts:
            script, name = ROOT / words[scripts[0]], words[scripts[0]]
            assert script.is_file(), f"{page.name} mentions {name}, which does not exist"
            known = (script in SCRIPTS and flags(script)) or of_argparse(script) or of_commands(script) or ANY
        assert mentioned <= known, f"{page.name}: {name} has no {sorted(mentioned - known)}"


def test_commands_of_results_run_today() -> None:
    """Their scripts and flags exist."""
    older = set[str]()
    for path in sorted((ROOT / "results").rglob("*.csv")):
        for line in path.read_text().splitlines():
            if not line.startswith("# "):
                break
            command = re.sub(r"\([^)]*\)", "", line.split("; ", 3)[3])
            for words in (part.split() for part in re.split(r", (?:then )?(?=python )", command)):
                script = ROOT / words[1]
                own = words[: words.index("--")] if "--" in words else words
                mentioned = {word.partition("=")[0] for word in own if re.match(r"--[a-z]", word)}
                if not script.is_file() or not mentioned <= (flags(script) or ANY):
                    older.add(f"{path.parent.name}/{path.stem}")
    assert not older


@functools.cache
def choices(script: Path, flag: str) -> set[str]:
    """The values that a benchmark's flag takes: names of cases.json, or the words of its Literal PartName."""
    if script.name == "paper.py":
        return {"--only": {*CASES["paper"]["groups"]}, "--learners": {*CASES["learners"]}}[flag]
    assigned = (node for node in ast.parse(script.read_text()).body if isinstance(node, ast.Assign))
    parts = [node.value for node in assigned if ast.unparse(node.targets[0]) == "PartName"]
    return {word.value for node in parts for word in ast.walk(node) if isinstance(word, ast.Constant)}


@each_page
def test_parts_groups_and_learners_exist(page: Path) -> None:
    for words in commands(page):
        scripts = [word for word in words if re.fullmatch(r"benchmarks/\w+\.py", word)]
        own, flag = words[: words.index("--")] if "--" in words else words, ""
        for word in own if scripts else ():
            flag = word if word.startswith("--") else flag
            script = ROOT / scripts[0]
            of_paper = script.name == "paper.py" and flag in ("--only", "--learners")
            if (flag == "--parts" or of_paper) and word != flag:
                assert word in choices(script, flag), f"{page.name}: {script.name} has no {flag} {word}"


@each_page
def test_csv_files_that_a_page_names_exist(page: Path) -> None:
    for name in re.findall(r"`(?:results/)?((?:cpu|h100|h200)/[^`<]+\.csv)`", page.read_text()):
        assert [*(ROOT / "results").glob(name)], f"{page.name} names {name}, which does not exist"
