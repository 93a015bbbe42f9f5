"""How large the rooms of the house are, which CONTRIBUTING.md draws, and what they may import."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ROOT / "diffsim" / "kernels"
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
FLOORS = "thread", "laws", "tree", "mujoco", "pairs", "kernels"  # the last one has the files beside the rooms
LONGEST = 200  # lines of a factory of kernels


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


def imports(path: Path) -> Iterator[str]:
    """The modules that a file imports, also those that only its types need."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def test_rooms_of_kernels_import_from_the_same_floor_and_below() -> None:
    """So laws and the tree know neither MuJoCo's constraints nor rows between bodies."""
    rooms = {path: path.parent.name for path in KERNELS.rglob("*.py")}
    assert set(rooms.values()) == set(FLOORS)
    for path, room in rooms.items():
        for module in imports(path):
            if module.startswith("diffsim.kernels"):
                other = module.split(".")[2] if module.count(".") > 2 else "kernels"
                assert FLOORS.index(other) <= FLOORS.index(room), f"{path.relative_to(ROOT)} imports {module}"


@pytest.mark.parametrize("room", FLOORS)
def test_factories_of_kernels_are_short(room: str) -> None:
    for path in KERNELS.rglob("*.py"):
        for node in ast.parse(path.read_text()).body if path.parent.name == room else ():
            if isinstance(node, ast.FunctionDef) and node.end_lineno:
                length = node.end_lineno - node.lineno + 1
                assert length <= LONGEST, f"{path.relative_to(ROOT)}: {node.name} has {length} lines"


def test_files_of_robots_and_of_kernels_have_different_names() -> None:
    kernels = {path.name for path in KERNELS.rglob("*.py")} - {"__init__.py"}
    assert not kernels & {path.name for path in (ROOT / "diffsim/robot").glob("*.py")}


def test_files_of_robots_import_each_other_in_no_circle() -> None:
    """Not for their types either."""
    files = {f"diffsim.robot.{path.stem}": set(imports(path)) for path in (ROOT / "diffsim/robot").glob("*.py")}
    while free := [name for name, needed in files.items() if not needed & files.keys()]:
        for name in free:
            del files[name]
    assert not files
