"""What the benchmarks write: csv files, markdown tables, and the marked parts of pages."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any


def digits(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows; none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Nothing if there are no rows."""
    if not rows:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def merge_csv(path: Path, rows: list[dict[str, Any]], key: tuple[str, ...]) -> list[dict[str, str]]:
    """Write the rows' cells over those of rows that agree in all of `key`; returns all rows of the file."""
    new = [{name: digits(value) for name, value in row.items()} for row in rows]
    merged: dict[tuple[str, ...], dict[str, str]] = {}
    for row in [*read_csv(path), *new]:
        merged.setdefault(tuple(row.get(k, "") for k in key), {}).update(row)
    write_csv(path, list(merged.values()))
    return list(merged.values())


def markdown(rows: list[dict[str, Any]], columns: list[str] | None = None) -> str:
    if not rows:
        return "(none yet)\n"
    columns = columns or list(rows[0])
    lines = [columns, ["---"] * len(columns), *([digits(row.get(c, "")) for c in columns] for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def fill(page: Path, name: str, text: str) -> None:
    """Put text between the page's comments <!-- name --> and <!-- /name -->, at its end if it does not have them."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->\n"
    before = page.read_text() if page.is_file() else ""
    if begin not in before:
        before += begin + end
    head, _, tail = before.partition(begin)
    page.write_text(f"{head}{begin}{text}{end}{tail.partition(end)[2]}")
