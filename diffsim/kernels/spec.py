"""What the generated code of the kernels depends on; the numbers that it does not depend on are in model.py."""

import dataclasses

from diffsim.kernels.lanes import Division
from diffsim.robot.scene import FACTORS, Scene

MAX_SPEED = 1e5  # m/s and rad/s; what is faster has blown up, and its squares would soon leave float32


@dataclasses.dataclass(frozen=True)
class KernelSpec:
    """Everything the generated code depends on. Scenes of equal specification share their compiled kernels."""

    nlink: int
    nu: int
    carrier: int
    nball: int
    features: frozenset[str]
    dtype: type  # of the scene's numbers
    block: int  # environments that one thread steps at once (wide.py)
    implicit: bool
    varied: bool  # constants are multiplied by factors of each environment (factors.py)
    forced: int  # number of bodies that external forces act on (force.py), 0 without
    env_last: bool  # checkpoints as [row, component, environment] (coalesced on a GPU) or [row, block, component]
    # how threads share an environment (lanes.py); slots: the most links that one of them has
    threads_per_env: int
    sharers: int
    trunk: int
    slots: int
    inert: int  # slots after the fixed base whose links carry nothing, so that their own inertia need not be computed
    constrained: bool  # MuJoCo's constraints (constraint.py) in place of the laws of springs and dampers
    touchdown: bool  # see Integration

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
        return self.constrained and "damping" in self.features

    @property
    def nfactors(self) -> int:
        """Columns of the array `factors`."""
        return len(FACTORS) if self.varied else 0

    @property
    def nfactor(self) -> int:
        """Numbers of the cached factorisation: U and 1/d of each joint, the base's packed Cholesky factor."""
        return 7 * (self.nlink - 1) + (21 if self.floating else 0)


def kernel_spec(
    scene: Scene,
    division: Division,
    dtype: type,
    implicit: bool,
    env_last: bool,
    varied: bool = False,
    forced: bool = False,
    block: int = 1,
    constrained: bool = False,
    touchdown: bool = True,
) -> KernelSpec:
    limbs = division.threads_per_env > division.sharers  # which differ, so that only the trunk's links are everyone's
    return KernelSpec(
        nlink=scene.nlink,
        nu=scene.nu,
        carrier=scene.carrier,
        nball=scene.nball,
        features=scene.features,
        dtype=dtype,
        block=block,
        implicit=implicit,
        varied=varied,
        forced=scene.nbody if forced else 0,
        env_last=env_last,
        threads_per_env=division.threads_per_env,
        sharers=division.sharers,
        trunk=division.trunk,
        slots=division.slots,
        inert=min(scene.inert, division.trunk) if limbs else scene.inert,
        constrained=constrained,
        touchdown=touchdown and constrained,
    )
