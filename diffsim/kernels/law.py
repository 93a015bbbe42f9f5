"""The constants of the laws in one environment: the scene's, times the environment's own factors where they vary.

Such a kernel finds the factors behind the controls: column nu + K_N of its ctrl is the factor of k_n, and so on. Their
adjoints stand in the same columns of that of ctrl.
"""

from functools import cache

import warp as wp

from diffsim.kernels.model import types
from diffsim.kernels.spec import KernelSpec
from diffsim.robot.scene import FACTORS

K_N, K_D, K_T, MU, K_LIMIT, D_LIMIT, MASS, MOTOR = range(len(FACTORS))


@cache
def environment_law(spec: KernelSpec) -> wp.Function:
    t = types(spec.dtype)
    Model, Law = t.Model, t.Law
    NU, CONTACT, VARIED, TERRAIN = spec.nu, "contact" in spec.features, spec.varied, "terrain" in spec.features

    @wp.func
    def law_of(m: Model, ctrl: t.array2, e: int):
        law = Law()
        if wp.static(CONTACT):
            law.k_n = m.k_n
            law.k_d = m.k_d
            law.k_t = m.k_t
            law.mu = m.mu
            if wp.static(VARIED):
                law.k_n = law.k_n * ctrl[e, NU + K_N]
                law.k_d = law.k_d * ctrl[e, NU + K_D]
                law.k_t = law.k_t * ctrl[e, NU + K_T]
                law.mu = law.mu * ctrl[e, NU + MU]
        if wp.static(VARIED):
            law.k_limit = ctrl[e, NU + K_LIMIT]
            law.d_limit = ctrl[e, NU + D_LIMIT]
            law.mass = ctrl[e, NU + MASS]
            law.motor = ctrl[e, NU + MOTOR]
        if wp.static(TERRAIN):
            law.profile = e % m.terrain.shape[0]
        return law

    return law_of
