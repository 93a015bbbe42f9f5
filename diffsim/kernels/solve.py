"""The linear system M lambda = -h g, with the factor that the forward kernel stored."""

from functools import cache

import warp as wp

from diffsim.kernels.base import base_inertia
from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.model import types
from diffsim.kernels.spec import KernelSpec


@cache
def factor_solve(spec: KernelSpec) -> wp.Function:
    t, kin, base, sums = types(spec), kinematics(spec), base_inertia(spec), lane_sums(spec)
    T, vec6, Model, load, link_of = t.T, t.vec6, t.Model, kin.load, kin.link_of
    vec6s = wp.array(dtype=vec6)
    FLOATING, SLOTS = spec.floating, spec.slots
    THREADS_PER_ENV, SHARERS, TRUNK = spec.threads_per_env, spec.sharers, spec.trunk

    @wp.func
    def solve(
        m: Model,
        at: int,
        n: int,
        ck_f: t.array3,
        row: int,
        e: int,
        S: vec6s,
        h: T,
        g_base: vec6,  # read of a floating base
        g: t.array,  # of the joints
        u: t.array,  # for use here
        W: vec6s,  # out: the twists of the links under lambda
        lam: t.array,  # out
    ):
        """lambda = -M^-1 h g; on the way in, W holds the articulated bias force."""
        slots = int(SLOTS)
        for i in range(n):
            W[i] = vec6()
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_vectors(W)
            if i > 0 and i < n:
                p = m.parent[at + i]
                ui = -h * g[i] - wp.dot(S[i], W[i])
                u[i] = ui
                if wp.static(FLOATING) or p > 0:
                    f0 = 7 * (link_of(m, at + i) - 1)
                    Ui = vec6()
                    for r in range(6):
                        Ui[r] = load(ck_f, row, f0 + r, e)
                    W[p] = W[p] + W[i] + Ui * (ui * load(ck_f, row, f0 + 6, e))
        if wp.static(FLOATING):
            W[0] = base.solve_base(ck_f, row, e, g_base * (-h) - W[0])
        for i in range(1, n):
            p = m.parent[at + i]
            f0 = 7 * (link_of(m, at + i) - 1)
            UW = T(0.0)
            for r in range(6):
                UW = UW + load(ck_f, row, f0 + r, e) * W[p][r]
            lam[i] = (u[i] - UW) * load(ck_f, row, f0 + 6, e)
            W[i] = W[p] + S[i] * lam[i]

    return solve
