"""The constants of the laws in one environment: the scene's, times the environment's own factors where they vary.

Row e of the array `factors` has environment e's, in the order of FACTORS; the array has no columns where none vary.
"""

from functools import cache

import warp as wp

from diffsim.kernels.model import types
from diffsim.kernels.spec import KernelSpec
from diffsim.kernels.wide import blocks
from diffsim.robot.scene import FACTORS

K_N, K_D, K_T, MU, K_LIMIT, D_LIMIT, MASS, MOTOR = range(len(FACTORS))


@cache
def environment_law(spec: KernelSpec) -> wp.Function:
    t = types(spec)
    T, Model, Law, read = t.T, t.Model, t.Law, blocks(spec).read
    CONTACT, VARIED, TERRAIN = "contact" in spec.features, spec.varied, "terrain" in spec.features
    CONSTRAINED = spec.constrained

    @wp.func
    def law_of(m: Model, h: T, theta: T, factors: t.array2, e: int):
        law = Law()
        law.h = h
        law.theta = theta
        if wp.static(CONTACT and CONSTRAINED and VARIED):
            law.k_n = read(factors, e, K_N)  # of the time constant's inverse square
            law.k_d = read(factors, e, K_D)  # of D, and so of all of a contact's force for one motion
            law.mu = read(factors, e, MU)
        if wp.static(CONTACT and not CONSTRAINED):
            law.k_n = T(m.k_n)
            law.k_d = T(m.k_d)
            law.k_t = T(m.k_t)
            law.mu = T(m.mu)
            if wp.static(VARIED):
                law.k_n = law.k_n * read(factors, e, K_N)
                law.k_d = law.k_d * read(factors, e, K_D)
                law.k_t = law.k_t * read(factors, e, K_T)
                law.mu = law.mu * read(factors, e, MU)
        if wp.static(VARIED):
            law.k_limit = read(factors, e, K_LIMIT)
            law.d_limit = read(factors, e, D_LIMIT)
            law.mass = read(factors, e, MASS)
            law.motor = read(factors, e, MOTOR)
        if wp.static(TERRAIN):
            law.block = e
        return law

    return law_of
