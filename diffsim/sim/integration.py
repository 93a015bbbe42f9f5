"""Integration of a control step: the contact model, the number of its substeps and how they are taken."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Literal, NamedTuple, TypeGuard, get_args

Contact = Literal["soft", "mujoco"]
MOST_SUBSTEPS = 1_000_000
TOLERANCE = 1e-4  # as measured in docs/physics.md


class Integration(NamedTuple):
    """Options of the integrator; docs/physics.md has the equations.

    Example:
        diffsim.Integration("mujoco", substeps=8, tolerance=1e-6)

    Attributes:
        contact: "soft" (the SHAC paper's springs and dampers) or "mujoco" (MuJoCo's own steps, with constraints for
            contact, limits and dry friction).
        substeps: integration steps per control step.
        implicit: only "soft": damping and friction act at the end of a substep. Otherwise it is semi-implicit Euler.
        tolerance: only "mujoco": residual that ends Newton's method, see Simulator.residual.
        onset: only "mujoco": length [m] over which a contact begins, see robot.constants.soften; 0: as in the file.

    Raises:
        ValueError: by the simulator that gets it, of an option that it cannot have.
    """

    contact: str = "soft"
    substeps: int = 16
    implicit: bool = False
    tolerance: float = TOLERANCE
    onset: float = 0.0

    def check(self) -> Integration:
        """Itself, with plain ints; raises ValueError, with what is allowed, if it cannot be integrated so."""
        check_contact(self.contact)
        if not isinstance(self.implicit, bool):
            raise ValueError(f"implicit is {self.implicit!r}, must be True or False")
        if self.implicit and self.contact == "mujoco":
            raise ValueError("implicit is True, but only soft contact has an implicit integrator")
        if not is_real(self.tolerance) or not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance is {self.tolerance!r}, must lie between 0 and 1")
        if not is_real(self.onset) or not 0 <= self.onset <= (self.contact == "mujoco"):
            raise ValueError(f"onset is {self.onset!r}, must be 0 to 1 m on MuJoCo's contact, and 0 on soft contact")
        return self._replace(substeps=check_count("substeps", self.substeps, MOST_SUBSTEPS))


def check_contact(contact: str) -> None:
    """Raise ValueError unless there is such a contact model."""
    if contact not in get_args(Contact):
        raise ValueError(f"unknown contact {contact!r}; choose from {', '.join(get_args(Contact))}")


def is_real(value: object) -> TypeGuard[float]:
    """Tell whether it is a real number, of Python or NumPy; True is not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_count(name: str, value: int, most: int = 2**63 - 1) -> int:
    """Return the value as an int; raises ValueError unless it is an integer from 1 to `most`, which True is not."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} is {value!r}, must be an integer of at least 1")
    if value > most:
        raise ValueError(f"{name} is {value}, must be at most {most}")
    return int(value)
