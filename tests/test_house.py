"""How large the rooms of the package are, which CONTRIBUTING.md draws."""

from __future__ import annotations

import re
from pathlib import Path

import diffsim

PACKAGE = Path(diffsim.__file__).parent
CONTRIBUTING = PACKAGE.parent / "CONTRIBUTING.md"
# Laws that the core has as features of a KernelSpec, and that the paper's six tasks do without
OPTIONAL = """kernels/mujoco/constraint kernels/newton kernels/laws/drag kernels/laws/force kernels/laws/terrain
kernels/thread/division kernels/thread/exchange kernels/mujoco/cone kernels/thread/records kernels/pairs/rows
kernels/pairs/adjoint kernels/pairs/geometry kernels/pairs/solver kernels/pairs/listing kernels/pairs/capsules
kernels/pairs/boxes kernels/parameters kernels/laws/clamp kernels/transmission robot/actuator robot/pairs
robot/constraint robot/terrain robot/drag sim/tangent sim/adjoint sim/elevation sim/onset
kernels/tree/branches""".split()


def lines(*patterns: str) -> int:
    return sum(len(path.read_text().splitlines()) for pattern in patterns for path in PACKAGE.glob(pattern))


def test_the_core_is_small() -> None:
    """The simulator with the paper's six tasks, the harness of training, and both as they are drawn."""
    optional, harness, extra = (
        lines(*(f"{name}.py" for name in OPTIONAL)),
        lines("training/*.py"),
        lines("extra/**/*.py"),
    )
    simulator = lines("*.py", "robot/*.py", "kernels/**/*.py", "sim/*.py", "tasks/*.py") - optional
    print(f"simulator {simulator}, harness {harness}, optional laws {optional}, extra {extra}")
    assert simulator <= 5795 and harness <= 1830
    (drawing,) = re.findall(r"^An import goes down.*?```\n(.*?)^```$", CONTRIBUTING.read_text(), re.M | re.S)
    drawn = {int(number.replace(",", "")) for number in re.findall(r"\d,\d{3}", drawing)}
    assert drawn == {round(part, -2) for part in (simulator, harness, optional, extra)}
