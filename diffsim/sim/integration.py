"""Integration: the choice of integrator and the number of its steps."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any, NamedTuple, TypeGuard

INTEGRATORS = ("semi_implicit", "implicit", "extrapolated", "mujoco")
MOST_SUBSTEPS, MOST_PASSES = 1_000_000, 1000
PASSES, TOLERANCE = 30, 1e-4  # as measured in docs/physics.md


class Integration(NamedTuple):
    """Options of the integrator; docs/physics.md has the equations.

    Attributes:
        integrator: "semi_implicit" (Euler), "implicit" (linearly implicit in damping, friction and, scaled by theta,
            stiffness), "extrapolated" (Richardson's, from two semi-implicit steps: second order at 1.5 times the cost)
            or "mujoco" (MuJoCo's Euler and its own constraints for contact, limits and dry friction).
        substeps: integration steps per control step; an even number for "extrapolated".
        theta: 0 (velocity-implicit) to 1 (backward-Euler-like stiffness); 0 unless implicit.
        passes: only "mujoco": most passes of Newton's method per substep.
        tolerance: only "mujoco": residual that ends them, see Simulator.residual.
        touchdown: only "mujoco": gradients include the jumps with which contacts begin, see docs/adjoint.md.
    """

    integrator: str = "semi_implicit"
    substeps: int = 16
    theta: float = 0.0
    passes: int = PASSES
    tolerance: float = TOLERANCE
    touchdown: bool = True

    @classmethod
    def explicit(cls, kind: str, substeps: int) -> Integration:
        """Return Euler's method, on MuJoCo's contact if kind, a contact or an integrator, is "mujoco", else on soft."""
        return cls("mujoco" if kind == "mujoco" else "semi_implicit", substeps)

    @property
    def constrained(self) -> bool:
        """Tell whether contact and limits are MuJoCo's constraints instead of springs and dampers."""
        return self.integrator == "mujoco"

    def replaced(self, integrator: str | None = None, **others: Any) -> Integration:
        """Return a copy with the arguments that are not None; an integrator does not inherit another one's theta."""
        same = integrator is None or integrator == self.integrator
        new = self if same else Integration(str(integrator), self.substeps)
        return new._replace(**{name: value for name, value in others.items() if value is not None})

    def check(self) -> Integration:
        """Return itself with plain ints; raises ValueError, with what is allowed, for an invalid field."""
        if self.integrator not in INTEGRATORS:
            raise ValueError(f"unknown integrator {self.integrator!r}; choose from {', '.join(INTEGRATORS)}")
        substeps = check_count("substeps", self.substeps, MOST_SUBSTEPS)
        if self.integrator == "extrapolated" and substeps % 2:
            raise ValueError(f"substeps is {substeps}, must be even for the extrapolated integrator")
        if not is_real(self.theta) or not 0 <= self.theta <= 1:
            raise ValueError(f"theta is {self.theta!r}, must lie in [0, 1]")
        if self.theta and self.integrator != "implicit":
            raise ValueError(f"theta is {self.theta!r}, but only the implicit integrator has a theta")
        if not is_real(self.tolerance) or not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance is {self.tolerance!r}, must lie between 0 and 1")
        if not isinstance(self.touchdown, bool):
            raise ValueError(f"touchdown is {self.touchdown!r}, must be True or False")
        return self._replace(substeps=substeps, passes=check_count("passes", self.passes, MOST_PASSES))


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
