"""Lane: a thread's part of an environment, and the environment's constants: the scene's times its own factors.

Row e of the array `factors` holds environment e's, in the order of FACTORS. The array has no columns if none vary.
"""

from functools import cache

import warp as wp

from diffsim.kernels.thread.model import types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.robot.scene import FACTORS

K_N, K_D, K_T, MU, K_LIMIT, D_LIMIT, MASS, MOTOR = range(len(FACTORS))


@cache
def lane_of(spec: KernelSpec) -> wp.Function:
    """Make the function that finds what a thread computes."""
    t = types(spec)
    T, Model, Lane, read = t.T, t.Model, t.Lane, blocks(spec).read
    CONTACT, VARIED, CONSTRAINED = "contact" in spec.features or spec.pairs > 0, spec.varied, spec.constrained
    THREADS_PER_ENV, SLOTS = spec.threads_per_env, spec.slots

    @wp.func
    def lane_of(m: Model, first: int, thread: int, h: T, factors: t.array2):
        """Make the Lane of a thread, in a launch from environment, or block, `first` on."""
        here = Lane()
        here.e = first + thread / THREADS_PER_ENV
        here.lane = thread % THREADS_PER_ENV
        here.at = here.lane * SLOTS
        here.n = int(SLOTS)  # a variable: Warp unrolls loops over constants, and they would outgrow a GPU's cache
        if wp.static(THREADS_PER_ENV > 1):
            here.n = m.count[here.lane]
        e = here.e
        here.h = h
        if wp.static(CONTACT and CONSTRAINED and VARIED):
            here.k_n = read(factors, e, K_N)  # factor of k, the inverse square of the time constant
            here.k_d = read(factors, e, K_D)  # factor of D, and so of a contact's force at the same motion
            here.mu = read(factors, e, MU)
        if wp.static(CONTACT and not CONSTRAINED):
            here.k_n = T(m.k_n)
            here.k_d = T(m.k_d)
            here.k_t = T(m.k_t)
            here.mu = T(m.mu)
            if wp.static(VARIED):
                here.k_n = here.k_n * read(factors, e, K_N)
                here.k_d = here.k_d * read(factors, e, K_D)
                here.k_t = here.k_t * read(factors, e, K_T)
                here.mu = here.mu * read(factors, e, MU)
        if wp.static(VARIED):
            here.k_limit = read(factors, e, K_LIMIT)
            here.d_limit = read(factors, e, D_LIMIT)
            here.mass = read(factors, e, MASS)
            here.motor = read(factors, e, MOTOR)
        return here

    return lane_of
