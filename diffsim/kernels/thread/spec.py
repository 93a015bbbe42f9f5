"""KernelSpec: all that the kernels' generated code depends on. A scene's numbers are in model.py."""

import dataclasses
from typing import Any

from diffsim.kernels.thread.columns import Columns
from diffsim.kernels.thread.division import Division
from diffsim.robot.scene import Scene
from diffsim.robot.types import PairSizes

FAR = 256.0  # m and rad, beyond which rounding a substep's motion to float32 matters
MAX_POSITION = 1e5  # m and rad; beyond, float32 does not resolve a hundredth
MAX_SPEED = 1e5  # m/s and rad/s; beyond, the simulation has diverged, and squares would soon overflow float32


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
    varied: bool = False  # constants are multiplied by factors of each environment (lane.py)
    parameters: int = 0  # number of the scene's constants with gradients (parameters.py)
    forced: int  # number of bodies that external forces act on (force.py), 0 without
    env_last: bool  # checkpoints as [row, component, environment] (coalesced on a GPU) or [row, block, component]
    # how threads share an environment (division.py); slots: the most links that one of them has
    threads_per_env: int
    sharers: int
    trunk: int
    slots: int
    inert: int  # slots after the fixed base whose links carry nothing, so that their own inertia need not be computed
    constrained: bool = False  # MuJoCo's constraints (mujoco/) in place of the laws of springs and dampers
    spheres: int = 0  # with constraints, the most contact spheres of a lane
    pairs: int = 0  # number of blocks of rows between two bodies (pairs/), and
    pair_sizes: PairSizes = PairSizes()

    def has(self, names: str) -> list[bool]:
        """Return for each of these features whether the scene has it."""
        return [name in self.features for name in names.split()]

    @property
    def floating(self) -> bool:
        return "floating" in self.features

    @property
    def framed(self) -> bool:
        """Tell whether contacts have frames of their own: on a terrain, and in pyramidal cones."""
        return bool(self.features & {"terrain", "pyramid"})

    @property
    def branched(self) -> bool:
        """Tell whether a matrix leaves the tree's shape (tree/branches.py)."""
        return self.pairs > 0 or "tendon_chain" in self.features

    @property
    def room(self) -> int:
        """Return the number of links in local arrays: the last one is the world, where tree/branches.py needs it."""
        return self.slots + int(self.branched)

    @property
    def dof0(self) -> int:
        """Return the base's number of degrees of freedom: joint i is dof0 + i - 1 in qvel."""
        return 6 if self.floating else 0

    @property
    def nv(self) -> int:
        return self.dof0 + self.nlink - 1

    @property
    def nq(self) -> int:
        return self.nv + int(self.floating) + self.nball

    @property
    def solves(self) -> int:
        """Return the number of solves in a substep's adjoint: MuJoCo's damping adds one to that of the constraints."""
        return 2 if self.damped else 1

    @property
    def damped(self) -> bool:
        """Tell whether damping, or what free bodies have of that kind (gyroscope.py), follows the constraints."""
        *dampers, explicit = self.has("damping base_damping tendon_damping explicit_damping")
        return self.constrained and any(dampers) and not explicit or "gyroscopic" in self.features

    @property
    def columns(self) -> Columns:
        """Return where the gradients by the scene's constants are, if it has parameters."""
        return Columns.of(self.nlink, self.nu, self.spheres, self.pairs)

    @property
    def nfactor(self) -> int:
        """Return the size of the stored factorisation: U and 1/d of each joint, the base's packed Cholesky factor."""
        return 7 * (self.nlink - 1) + (21 if self.floating else 0)


def kernel_spec(scene: Scene, division: Division, dtype: type, forced: bool = False, **options: Any) -> KernelSpec:
    """Make the spec of a scene and a division of its environments; options are the fields that neither decides."""
    limbs = division.threads_per_env > division.sharers  # lanes then have only the trunk's links in common
    return KernelSpec(
        **{name: getattr(scene, name) for name in ("nlink", "nu", "carrier", "nball", "features", "parameters")},
        **{name: getattr(division, name) for name in ("threads_per_env", "sharers", "trunk", "slots")},
        dtype=dtype,
        forced=scene.nbody if forced else 0,
        inert=min(scene.inert, division.trunk) if limbs else scene.inert,
        spheres=max(map(len, division.spheres)) if options.get("constrained") else 0,
        pairs=len(scene.pairs.kind) if scene.pairs else 0,
        pair_sizes=scene.constraints.pair_sizes if scene.constraints else PairSizes(),
        **options,
    )
