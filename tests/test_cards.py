"""The policies that come with the package do what their cards say, and are the files of which these speak."""

from __future__ import annotations

import re

import pytest
from common import load_case
from tables import ROOT, origins, read_csv, script_of, unknown

from diffsim.training import load_policy
from tools import cards

CARDS, FOLDER = {row["policy"]: row for row in read_csv(cards.CARDS)}, cards.CARDS.parent
HEAVY = [pytest.param(name, marks=pytest.mark.slow) for name in sorted({*CARDS} - {"cartpole", "hopper"})]


def check(name: str, found: dict[str, object], rel: float) -> None:
    card = CARDS[name]
    for column, value in found.items():
        assert bool(card[column]) == (value != ""), column
        if value != "":
            assert float(card[column]) == pytest.approx(value, rel=rel), column


def test_every_policy_has_a_card_that_says_where_it_comes_from() -> None:
    assert {*CARDS} == {path.stem for path in FOLDER.glob("*.pt")}
    assert origins(cards.CARDS) and not any(map(unknown, origins(cards.CARDS)))
    for name, card in CARDS.items():
        saved = load_policy(path := FOLDER / f"{name}.pt")
        command = f"python {script_of(saved.script).relative_to(ROOT)} --env {saved.args['env']} --seed {card['seed']}"
        assert card["sha256"] == cards.fingerprint(path), f"{name}: python tools/cards.py measures it"
        assert card["command"].startswith(command) and card["seed"] == str(saved.args["seed"])
        assert card["iteration"] == f"{saved.iteration} of {saved.args['iterations']}"
        assert card["machine"] in (("H100", "H200") if saved.args["device"] == "cuda" else ("two CPU cores",))
        assert re.fullmatch(r"[0-9a-f]{7}|unknown \(before [0-9a-f]{7}\)", card["revision"])


@pytest.mark.parametrize("name", ["cartpole", "hopper", *HEAVY])
def test_a_policy_returns_what_its_card_says(name: str) -> None:
    found = cards.here(load_case(FOLDER / f"{name}.pt", cards.EPISODES, "cpu"))
    assert found.keys() == {"return", "least return", "speed"}
    check(name, {column: found[column] for column in ("return", "speed")}, rel=0.003)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CARDS))
def test_a_policy_does_in_mujoco_what_its_card_says(name: str) -> None:
    found = cards.in_mujoco(load_case(FOLDER / f"{name}.pt", cards.EPISODES, "cpu"))
    measured = {column for column, cell in CARDS[name].items() if column.endswith("MuJoCo") and cell}
    assert measured == {column for column, value in found.items() if value != ""}
    check(name, found, rel=0.02)
