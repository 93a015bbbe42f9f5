"""The pages: their figures are in the csv files that they name; links, files and flags that they mention exist."""

from __future__ import annotations

import ast
import csv
import dataclasses
import functools
import importlib
import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
LOG = ROOT / "results" / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", LOG, *sorted((ROOT / "docs").glob("*.md"))]
# Tables of these pages use the column names of the csv file that the text below them names.
LEARNERS = ("shac", "sapo", "bptt", "pods", "ppo", "sac", "mbpo", "pfpn", "humanoid_mtu", "experiments")
CHECKED = [README, *(ROOT / "docs" / f"{name}.md" for name in (*LEARNERS, "robustness"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CASES = json.loads((ROOT / "benchmarks" / "cases.json").read_text())
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


# Figures --------------------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    header: list[str]
    rows: list[list[str]]
    source: Path | None  # the csv file named between the table and the next table or heading

    def columns(self) -> list[str]:
        """Those that the csv file has, too."""
        return [name for name in self.header if self.source and name in read_csv(self.source)[0]]


def tables(page: Path) -> Iterator[Table]:
    parts = re.split(r"((?:^\|.*\n)+)", page.read_text(), flags=re.MULTILINE)
    for block, text in zip(parts[1::2], parts[2::2], strict=True):
        header, _, *joined = ([plain(cell) for cell in line.strip()[1:-1].split("|")] for line in block.splitlines())
        rows = [row for cells in joined for row in seeds(header, cells)]
        below = re.split(r"^#", text, flags=re.MULTILINE)[0]
        source = re.search(r"results/\w+/(?!cells|curves)\w+\.csv", below)  # these: tests/benchmarks/test_paper.py
        yield Table(header, rows, ROOT / source[0] if source else None)


def seeds(header: list[str], cells: list[str]) -> list[list[str]]:
    """A row for each seed of one that holds several, "1, 2" with "97, 98" and the like."""
    count = len(cells[header.index("seed")].split(", ")) if "seed" in header else 1
    parts = [each if len(each := cell.split(", ")) == count else [cell] * count for cell in cells]
    return [list(row) for row in zip(*parts, strict=True)]


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


@pytest.mark.parametrize("page", CHECKED, ids=lambda page: page.stem)
def test_tables_agree_with_the_csv_files_that_they_name(page: Path) -> None:
    for table in tables(page):
        if not table.source or len(columns := table.columns()) < 2:
            continue
        measured = read_csv(table.source)
        for row in table.rows:
            shown = dict(zip(table.header, row, strict=False))
            if "machine" in shown:  # whose folder has the file
                measured = read_csv(table.source.parents[1] / shown["machine"] / table.source.name)
            key, *figures = columns
            if all(shown[key] != line[key] for line in measured):  # not measured, so nothing may be claimed
                assert not any(re.search(r"\d", shown[name]) for name in figures), f"{table.source.name} lacks {shown}"
                continue
            assert any(all(same(shown[c], line[c]) for c in columns) for line in measured), f"{table.source}: {shown}"


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


def test_tables_of_the_simulator_agree_with_their_files() -> None:
    """A header is a column of the file, or a value in one: then the cell begins with a number of such a line."""
    checked = 0
    for table in tables(ROOT / "docs" / "performance.md"):
        for row in table.rows if table.source else ():
            shown = dict(zip(table.header, row, strict=True))
            folder = table.source.parents[1] / shown.get("machine", table.source.parent.name)
            measured = read_csv(folder / table.source.name)
            values = {value for line in measured for value in line.values()}
            own = [name for name in shown if name in measured[0]]
            lines = [line for line in measured if all(same(shown[name], line[name]) for name in own)]
            assert own and lines, f"{table.source.name} lacks {shown}"
            for name in (name for name in shown if name in values and name not in own):
                cell, found = shown[name].split(" (")[0], [line for line in lines if name in line.values()]
                assert cell == "-" or any(same(cell, value) for line in found for value in line.values()), shown
            checked += 1
    assert checked


@each_page
def test_no_spread_of_a_single_seed(page: Path) -> None:
    assert not re.search(r"±\s*0(?![.\d])", page.read_text()), "the spread of one run is not 0: print the seed count"


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


def test_readme_is_short_and_begins_with_the_commands_of_a_fresh_machine() -> None:
    text = README.read_text()
    commands = [line.split("  ")[0] for _, code in FENCE.findall(text)[:2] for line in code.splitlines()]
    assert commands == [
        "pip install -e . && diffsim demo humanoid",
        "pip install -e . && python shac.py --env ant --seed 1",
        'pip install -e ".[test]" && pytest',
    ]
    assert len(text.split()) <= 800


def test_what_is_where_names_all_scripts_and_packages_once() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (section,) = re.findall(r"^## What is where\n\n```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    first = [line.split()[0] for line in section.splitlines() if re.match(r" *[\w./]+ {2}", line)]
    packages = [f"{path.parent.name}/" for path in (ROOT / "diffsim").glob("*/__init__.py")]
    folders = [f"{name}/" for name in ("diffsim", "benchmarks", "tests", "examples", "tools")]
    assert sorted(first) == sorted([*(path.name for path in ROOT.glob("*.py")), *packages, *folders])


def test_readme_links_the_page_of_every_learner() -> None:
    rows = re.findall(r"^\| .*\[(\w+)\]\(docs/(\w+)\.md\)", README.read_text(), re.MULTILINE)
    learners = {path.stem for path in ROOT.glob("*.py")} - {"view"}
    assert {name for name, page in rows if name.startswith(page)} == learners


# Flags ----------------------------------------------------------------------------------------------------------------


SCRIPTS = [*ROOT.glob("*.py"), *ROOT.glob("benchmarks/*.py"), *ROOT.glob("tools/*.py")]


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
    """The flags of the commands that a module of the package defines: the parameters of its functions."""
    functions = (node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef))
    return {f"--{each.arg.replace('_', '-')}" for node in functions for each in node.args.args}


def of_argparse(script: Path) -> set[str]:
    """The flags of a script without this package, which has argparse alone."""
    return set(re.findall(r'add_argument\("(--[a-z-]+)"', script.read_text()))


ANY = {flag for script in SCRIPTS for flag in flags(script)}
ANY |= {flag for path in ("__main__.py", "tune/__init__.py") for flag in of_commands(ROOT / "diffsim" / path)}


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
            known = (script in SCRIPTS and flags(script)) or of_argparse(script) or ANY
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
