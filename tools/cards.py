"""Measure the shipped policies, and write their cards, diffsim/policies/cards.csv.

    python tools/cards.py                              all of them
    python tools/cards.py diffsim/policies/ant.pt      one: write its other cells, command to revision, by hand

Returns are of the first episodes of 64 environments, as --evaluate has them. In MuJoCo the policies meet its own
contact, as in benchmarks/transfer.py; those of joystick tasks follow the commands of benchmarks/joystick.py.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import torch
import tyro
from tyro.conf import Positional

from diffsim.training import command, evaluate
from diffsim_cli.commands import POLICIES
from diffsim_robots.joystick import Joystick

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import joystick  # noqa: E402
import transfer  # noqa: E402
from common import Case, load_case  # noqa: E402
from tables import digits, replace_csv  # noqa: E402

CARDS, EPISODES = Path(str(POLICIES)) / "cards.csv", 64


def fingerprint(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def here(case: Case) -> dict[str, object]:
    found = evaluate(case.env, case.saved.network)
    row = {"return": found.returns.median().item(), "least return": found.returns.min().item()}
    return row | {"speed": "" if found.speed is None else found.speed}


def in_mujoco(case: Case) -> dict[str, object]:
    if isinstance(case.env.task, Joystick):
        (found,) = joystick.measure(joystick.Args(friction=(1.0,)), case.path)
        return {"error in MuJoCo": found["error"]}
    row = transfer.in_mujoco(case)
    return {f"{name} in MuJoCo": row[name] for name in ("return", "speed") if row}


@command
def main(policies: Positional[tuple[Path, ...]] = ()) -> None:
    torch.set_num_threads(1)
    for path in policies or sorted(CARDS.parent.glob("*.pt")):
        case = load_case(path, EPISODES, "cpu")
        row = {"policy": path.stem, "sha256": fingerprint(path)} | here(case) | in_mujoco(case)
        print(", ".join(f"{name} {digits(value)}" for name, value in row.items()), flush=True)
        replace_csv(CARDS, [row], ("policy",))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
