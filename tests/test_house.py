"""How large the rooms of the package are, which CONTRIBUTING.md draws."""

from __future__ import annotations

import re
from pathlib import Path

import diffsim

PACKAGE = Path(diffsim.__file__).parent
CONTRIBUTING = PACKAGE.parent / "CONTRIBUTING.md"
# Laws that the core has as features of a KernelSpec, and that the paper's six tasks do without
OPTIONAL = """kernels/newton kernels/parameters kernels/transmission kernels/laws/clamp kernels/laws/drag
kernels/laws/force kernels/laws/terrain kernels/mujoco/cone kernels/mujoco/ground kernels/mujoco/impedance
kernels/mujoco/limits kernels/pairs/adjoint kernels/pairs/boxes kernels/pairs/capsules kernels/pairs/geometry
kernels/pairs/listing kernels/pairs/rows kernels/pairs/solver kernels/thread/division kernels/thread/exchange
kernels/thread/records kernels/tree/branches robot/actuator robot/constants robot/fluid robot/pairs robot/profile
sim/adjoint sim/elevation sim/tangent""".split()


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
