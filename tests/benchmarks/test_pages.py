"""Of all benchmarks: pages have their tables of today's csv files, and what one cannot measure is one line."""

from __future__ import annotations

import importlib
import re
from typing import Any

import common
import pytest
import torch
from learners import refusal

from diffsim.training.checkpoint import POLICIES

MADE = "gradients", "joystick", "numerics", "overview", "suites", "tracking", "transfer", "guided_policy_search"
CASES = [
    *((name, {}) for name in MADE),
    *((name, {"race": True}) for name in ("joystick", "tracking")),
    ("pairs", {}),
    *(("trade", {"output": common.RESULTS / machine}) for machine in ("cpu", "h200")),
    ("speed", {"parts": ("iteration",), "output": common.RESULTS / "h100"}),
]


@pytest.mark.parametrize(("name", "flags"), CASES)
def test_a_page_has_the_tables_of_the_csv_files(
    name: str, flags: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    script, filled = importlib.import_module(name), list[str]()
    flags = {"output": common.RESULTS / "cpu"} | flags

    def publish(args: common.CommonFlags, table: str, text: str, page: str, everywhere: bool = False) -> None:
        if page:
            table += "" if args.directory.name == "cpu" else f"_{args.directory.name}"
            (found,) = re.findall(
                rf"<!-- {table} -->\n(.*?)<!-- /{table} -->", (common.DOCS / page).read_text(), re.DOTALL
            )
            assert found == text and "(none yet)" not in text
            filled.append(table)

    monkeypatch.setattr(common.CommonFlags, "publish", publish)
    monkeypatch.setattr(f"{name}.plot", lambda *_: None, raising=False)
    kind = getattr(script, "Args", common.CheckpointFlags)
    main = script.draw if name == "guided_policy_search" else script.main  # which trains
    main(kind(draw_only=True, **flags))
    assert filled


@pytest.mark.parametrize(
    ("name", "checkpoint", "message"),
    [
        ("transfer", "", "of what? give a checkpoint"),
        ("transfer", "none", "no such checkpoint: "),
        ("transfer", "juggler", "was trained elsewhere: unknown task 'juggler': choose from cartpole, hopper"),
        ("transfer", "humanoid_mtu", "humanoid_mtu, whose muscles are not simulated in MuJoCo here"),
        ("robustness", "cartpole", "was trained on cartpole, whose episodes do not end with a fall"),
        ("joystick", "hopper", "was trained on hopper, which follows no command"),
        ("tracking", "hopper", "was trained on hopper, which is not judged by its clip's root"),
    ],
)
def test_a_policy_that_cannot_be_measured_is_one_line(
    name: str,
    checkpoint: str,
    message: str,
    tmp_path_factory: pytest.TempPathFactory,
    capsys: pytest.CaptureFixture[str],
) -> None:
    script, path = importlib.import_module(name), POLICIES / f"{checkpoint}.pt"
    if checkpoint == "juggler":
        state, path = torch.load(POLICIES / "cartpole.pt", weights_only=True), tmp_path_factory.mktemp("other") / "a.pt"
        torch.save(state | {"args": state["args"] | {"env": "juggler"}}, path)
    args = common.parse(script.Args, None, [str(path)] if checkpoint else [])
    assert message in refusal(lambda: script.main(args), capsys)
