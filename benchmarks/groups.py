"""Rows of csv files by the values of their columns, and what a table shows of a group."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median

Cells = dict[str, str]


def grouped(rows: Iterable[Cells], *columns: str) -> dict[tuple[str, ...], list[Cells]]:
    """The rows that agree in these columns, by their values there, in the order of each group's first row."""
    groups: dict[tuple[str, ...], list[Cells]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in columns), []).append(row)
    return groups


def pivot(rows: Iterable[Cells], columns: Sequence[str], name: str, value: str) -> list[Mapping[str, object]]:
    """A line for each group; its columns have the names in the column `name`, and the values beside them."""
    groups = grouped(rows, *columns).items()
    return [dict(zip(columns, key, strict=True)) | {row[name]: row[value] for row in own} for key, own in groups]


def numbers(rows: Iterable[Cells], column: str) -> list[float]:
    """Those that a column has."""
    return [float(row[column]) for row in rows if row.get(column)]


def middle(rows: Sequence[Cells], column: str, form: str) -> str:
    """The median of a column's numbers, or nothing."""
    values = numbers(rows, column)
    return format(median(values), form) if values else ""
