"""What the generated code of the kernels depends on; the numbers that it does not depend on are in model.py."""

import dataclasses
from typing import Any

from diffsim.kernels.lanes import Division
from diffsim.robot.scene import Scene

FAR = 256.0  # m and rad, where rounding of a substep's motion to float32 begins to matter
MAX_PLACE = 1e5  # m and rad; farther, float32 has no hundredth of either
MAX_SPEED = 1e5  # m/s and rad/s; what is faster has blown up, and its squares would soon leave float32


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelSpec:
    """Everything the generated code depends on. Scenes of equal specification share their compiled kernels."""

    nlink: int
    nu: int
    carrier: int
    nball: int
    features: frozenset[str]
    dtype: type  # of the scene's numbers
    block: int = 1  # environments that one thread steps at once (wide.py)
    implicit: bool
    varied: bool = False  # constants are multiplied by factors of each environment (factors.py)
    forced: int  # number of bodies that external forces act on (force.py), 0 without
    env_last: bool  # checkpoints as [row, component, environment] (coalesced on a GPU) or [row, block, component]
    # how threads share an environment (lanes.py); slots: the most links that one of them has
    threads_per_env: int
    sharers: int
    trunk: int
    slots: int
    inert: int  # slots after the fixed base whose links carry nothing, so that their own inertia need not be computed
    constrained: bool = False  # MuJoCo's constraints (constraint.py) in place of the laws of springs and dampers
    spheres: int = 0  # with constraints, the most contact spheres of a lane

    def has(self, names: str) -> list[bool]:
        """Whether the scene has each of these features."""
        return [name in self.features for name in names.split()]

    @property
    def floating(self) -> bool:
        return "floating" in self.features

    @property
    def dof0(self) -> int:
        """Degrees of freedom of the base: joint i is dof0 + i - 1 in qvel."""
        return 6 if self.floating else 0

    @property
    def nv(self) -> int:
        return self.dof0 + self.nlink - 1

    @property
    def nq(self) -> int:
        return self.nv + int(self.floating) + self.nball

    @property
    def solves(self) -> int:
        """Linear systems of a substep that its adjoint needs: MuJoCo's damping is one more, after the constraints'."""
        return 2 if self.damped else 1

    @property
    def damped(self) -> bool:
        """Whether damping follows the constraints."""
        return self.constrained and bool(self.features & {"damping", "base_damping"})

    @property
    def nfactor(self) -> int:
        """Numbers of the cached factorisation: U and 1/d of each joint, the base's packed Cholesky factor."""
        return 7 * (self.nlink - 1) + (21 if self.floating else 0)


def kernel_spec(scene: Scene, division: Division, dtype: type, forced: bool = False, **asked: Any) -> KernelSpec:
    """Of a scene whose environments are divided so; asked: fields that neither decides."""
    limbs = division.threads_per_env > division.sharers  # which differ, so that only the trunk's links are everyone's
    return KernelSpec(
        **{name: getattr(scene, name) for name in ("nlink", "nu", "carrier", "nball", "features")},
        **{name: getattr(division, name) for name in ("threads_per_env", "sharers", "trunk", "slots")},
        dtype=dtype,
        forced=scene.nbody if forced else 0,
        inert=min(scene.inert, division.trunk) if limbs else scene.inert,
        spheres=max(map(len, division.spheres)) if asked.get("constrained") else 0,
        **asked,
    )
