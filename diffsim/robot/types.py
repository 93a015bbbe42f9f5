"""Types that the files of a robot share: below Scene, which is made of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int32]


class SceneError(ValueError):
    """Raised for an MJCF file that is missing, broken or not supported; names the element."""


class Transmissions(NamedTuple):
    """Actuators on fixed tendons and at sites, for kernels/transmission.py."""

    tendon: Index  # (nt,) actuators on fixed tendons
    law: Array  # (nt, 4) stiffness [N/m] and damping [N s/m] by the tendon's length, then the bounds of the force [N]
    begin: Index  # (nt + 1,) of each tendon in the two that follow
    link: Index  # (nj,) its joints' links
    coef: Array  # (nj,) the tendon's change of length by each joint's position, times the actuator's gear
    chain: Index  # (1,) the tendon with damping along a chain of joints, -1 if none
    site: Index  # (ns,) actuators at sites
    site_link: Index  # (ns,) the links that they push
    torque: Array  # (ns, 3) m, per force of the actuator, about the link's origin and in the link's frame
    force: Array  # (ns, 3) the same of the force

    def features(self, constrained: bool, explicit: bool) -> frozenset[str]:
        """Return the features of these actuators with MuJoCo's constraints or not, whose damping may be explicit."""
        present = {
            "tendon": len(self.tendon),
            "site": len(self.site),
            "tendon_damping": bool(self.law[:, 1].any()) and not explicit,
            "tendon_chain": self.chain[0] >= 0 and constrained and not explicit,
        }
        return frozenset(name for name, used in present.items() if used)
