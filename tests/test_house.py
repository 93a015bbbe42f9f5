"""How large the rooms of the house are, which CONTRIBUTING.md draws."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
ROOMS = {  # as they are drawn
    "diffsim_cli": "diffsim_cli/**/*.py",
    "diffsim_robots": "diffsim_robots/**/*.py",
    "diffsim": "diffsim/**/*.py",
    "learning/": "diffsim/learning/*.py",
    "planning/": "diffsim/planning/*.py",
    "symmetry/": "diffsim/symmetry/*.py",
    "training/": "diffsim/training/*.py",
    "env.py, make": "diffsim/*.py",
    "tasks/": "diffsim/tasks/*.py",
    "sim/": "diffsim/sim/*.py",
    "kernels/": "diffsim/kernels/**/*.py",
    "forward, backward, newton, ...": "diffsim/kernels/*.py",
    "pairs/": "diffsim/kernels/pairs/*.py",
    "mujoco/": "diffsim/kernels/mujoco/*.py",
    "laws/": "diffsim/kernels/laws/*.py",
    "tree/": "diffsim/kernels/tree/*.py",
    "thread/": "diffsim/kernels/thread/*.py",
    "robot/": "diffsim/robot/*.py",
}


def lines(pattern: str) -> int:
    return sum(len(path.read_text().splitlines()) for path in ROOT.glob(pattern))


def test_the_rooms_are_as_large_as_they_are_drawn() -> None:
    (drawing,) = re.findall(r"^An import goes down.*?```\n(.*?)^```$", CONTRIBUTING.read_text(), re.M | re.S)
    drawn = {
        name.strip(): int(number.replace(",", "")) for name, number in re.findall(r"([\w/., ]+?) \(([\d,]+)\)", drawing)
    }
    counted = {name: lines(pattern) for name, pattern in ROOMS.items()}
    print(counted)
    assert drawn == {name: round(size, -2) for name, size in counted.items()}
