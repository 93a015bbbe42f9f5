"""What the benchmarks write: csv files that say where they come from, markdown tables, and the marked parts of pages.

The comment lines at a csv file's top are the origins of its rows, one for each command that wrote some of them:
machine; versions; git revision; command.
"""

from __future__ import annotations

import csv
import functools
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from statistics import median

import torch

from diffsim.sim.launcher import available_cores

ROOT = Path(__file__).resolve().parents[1]
Row = Mapping[str, object]
Cells = dict[str, str]


def script_of(learner: str, checkout: Path = ROOT) -> Path:
    """The learner's script in a checkout; those of revisions before baselines/ all lie at the top."""
    return path if (path := checkout / f"{learner}.py").is_file() else checkout / "baselines" / f"{learner}.py"


def digits(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


@functools.cache
def origin(device: str = "cpu") -> str:
    """The comment line of rows that this process measures on a device."""
    info = Path("/proc/cpuinfo").read_text() if sys.platform == "linux" else ""
    found = re.search("model name.*: (.*)", info)
    cores, own = os.cpu_count(), available_cores()
    share = f"{cores}" if own == cores else f"{own} of {cores}"
    machine = f"{share} cores of {found[1] if found else platform.processor() or 'unknown'}"
    if device.startswith("cuda"):
        machine = torch.cuda.get_device_name(device)
    packages = {"torch": "torch", "warp": "warp-lang", "mujoco": "mujoco"}
    versions = ", ".join(f"{name} {metadata.version(package)}" for name, package in packages.items())
    words = (Path(word).name if os.path.isabs(word) else word for word in sys.argv[1:])  # no paths of this machine
    command = shlex.join(["python", os.path.relpath(sys.argv[0], ROOT), *words])
    return f"# {machine}; python {platform.python_version()}, {versions}; revision {revision()}; {command}\n"


def revision() -> str:
    """The commit, "-dirty" with changes of tracked files. Results do not count: benchmarks write them one by one."""

    def git(*words: str) -> str | None:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else None

    changes = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!results", ":!docs", ":!README.md")
    return f"{git('rev-parse', '--short', 'HEAD') or 'unknown'}{'-dirty' if changes else ''}"


def unknown(line: str) -> str:
    """Which part of an origin does not say where rows come from; empty if all do."""
    machine_versions_revision = line.removeprefix("# ").split("; ")[:3]
    return next((part for part in machine_versions_revision if re.search("unknown|-dirty", part)), "")


def origins(path: Path) -> list[str]:
    lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
    return [line for line in lines if line.startswith("# ")]


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows; none if there is no file."""
    lines = path.read_text().splitlines() if path.is_file() else []
    return list(csv.DictReader(line for line in lines if not line.startswith("# ")))


def replace_csv(path: Path, rows: Sequence[Row], key: Sequence[str], device: str = "cpu") -> list[dict[str, str]]:
    """Write rows, measured on a device, in place of all that agree with one of them in all of `key`.

    Whole rows go, so that no cell which an older benchmark measured stays beside new ones. The lines that say where
    rows come from stay, except one of the same command. Returns all rows of the file.
    """
    new = [{name: digits(value) for name, value in row.items()} for row in rows]
    groups = grouped(read_csv(path), *key) | grouped(new, *key)
    merged = [row for group in groups.values() for row in group]
    if rows:
        own = origin(device)  # before the file, which git would call a change, is touched
        older = [line for line in origins(path) if line.rpartition("; ")[2] != own.rpartition("; ")[2]]
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="") as file:
            file.writelines([*older, own])
            columns = dict.fromkeys(name for row in merged for name in row)
            writer = csv.DictWriter(file, list(columns), restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(merged)
    return merged


def markdown(rows: Sequence[Row], columns: Sequence[str] | None = None) -> str:
    if not rows:
        return "(none yet)\n"
    columns = columns or list(rows[0])
    lines = [columns, ["---"] * len(columns), *([digits(row.get(c, "")) for c in columns] for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def fill(page: Path, name: str, text: str) -> None:
    """Put text between the page's comments <!-- name --> and <!-- /name -->."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->\n"
    head, _, tail = page.read_text().partition(begin)
    page.write_text(f"{head}{begin}{text}{end}{tail.partition(end)[2]}")


# Rows by the values of their columns ---------------------------------------------------------------------------------


def grouped(rows: Iterable[Cells], *columns: str) -> dict[tuple[str, ...], list[Cells]]:
    """The rows that agree in these columns, by their values there, in the order of each group's first row."""
    groups: dict[tuple[str, ...], list[Cells]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in columns), []).append(row)
    return groups


def numbers(rows: Iterable[Cells], column: str) -> list[float]:
    """Those that a column has."""
    return [float(row[column]) for row in rows if row.get(column)]


def middle(rows: Sequence[Cells], column: str, form: str) -> str:
    """The median of a column's numbers, or nothing."""
    values = numbers(rows, column)
    return format(median(values), form) if values else ""


def ranged(values: Sequence[float], form: str) -> str:
    """The median, in brackets the least and the most if they differ; nothing of no values."""
    if not values:
        return ""
    middle, *ends = (tell(value, form) for value in (median(values), min(values), max(values)))
    return middle if ends[0] == ends[1] else f"{middle} ({ends[0]} to {ends[1]})"


def tell(value: float, form: str) -> str:
    return "never" if value == math.inf else f"{value:{form}}"
