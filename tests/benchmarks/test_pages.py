"""Pages have the tables that the benchmarks make of the csv files today."""

from __future__ import annotations

import importlib
import re
from typing import Any

import common
import pytest

MADE = "gradients", "joystick", "numerics", "suites", "tracking", "transfer", "gps_controllers"
CASES = [*((name, "cpu", {}) for name in (*MADE, "gps_stability")), ("joystick", "cpu", {"race": True})]
CASES += [("numerics", "cpu", {"parts": ("promise",)})]


@pytest.mark.parametrize(("name", "machine", "flags"), CASES)
def test_a_page_has_the_tables_of_the_csv_files(
    name: str, machine: str, flags: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    script, filled = importlib.import_module(name), list[str]()

    def publish(args: common.CommonFlags, table: str, text: str, page: str, everywhere: bool = False) -> None:
        table = table if everywhere or machine == "cpu" else f"{table}_{machine}"
        content = (common.DOCS / page).read_text()
        if found := re.search(rf"<!-- {table} -->\n(.*?)<!-- /{table} -->", content, re.DOTALL):
            assert found[1] == text and "(none yet)" not in text
            filled.append(table)

    monkeypatch.setattr(common.CommonFlags, "publish", publish)
    monkeypatch.setattr(f"{name}.plot", lambda *_: None, raising=False)
    kind = getattr(script, "Args", common.CheckpointFlags)
    script.main(kind(draw_only=True, output=common.RESULTS / machine, **flags))
    assert filled
