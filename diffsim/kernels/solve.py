"""The factorisation of the mass matrix that the forward kernel stores, and M lambda = -h g, solved with it."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.exchange import lane_sums
from diffsim.kernels.kinematics import kinematics
from diffsim.kernels.model import by_name, types
from diffsim.kernels.spatial import spatial
from diffsim.kernels.spec import KernelSpec


@cache
def base_inertia(spec: KernelSpec) -> SimpleNamespace:
    """Of the floating base: the Cholesky factor of its articulated inertia, and its damping."""
    t, kin = types(spec), kinematics(spec)
    T, vec3, vec6, mat3, mat6 = t.T, t.vec3, t.vec6, t.mat3, t.mat6
    load, store, join = kin.load, kin.store, spatial(spec).join
    Model, Law, Link, Load, Root = t.Model, t.Law, t.Link, t.Load, t.Root
    CONSTRAINED, IMPLICIT = spec.constrained, spec.implicit
    BASE = 7 * (spec.nlink - 1)  # where the base's factor begins, packed by rows

    @wp.func
    def factor_base(Ia: mat3, Ib: mat3, Id: mat3, b: vec6):
        """Cholesky factor (reciprocal diagonal) of the base's articulated inertia, and the solution of I a = b."""
        L = mat6()
        for r in range(3):
            for c in range(3):
                L[r, c] = Ia[r, c]
                L[3 + r, c] = Ib[c, r]
                L[3 + r, 3 + c] = Id[r, c]
        a = vec6()
        for r in range(6):
            for c in range(r):
                s = L[r, c]
                for k in range(c):
                    s = s - L[r, k] * L[c, k]
                L[r, c] = s * L[c, c]
            s = L[r, r]
            y = b[r]
            for k in range(r):
                s = s - L[r, k] * L[r, k]
                y = y - L[r, k] * a[k]
            L[r, r] = T(1.0) / wp.sqrt(s)
            a[r] = y * L[r, r]
        for rr in range(6):
            r = 5 - rr
            y = a[r]
            for k in range(r + 1, 6):
                y = y - L[k, r] * a[k]
            a[r] = y * L[r, r]
        return L, a

    @wp.func
    def store_base(ck_f: t.array3, row: int, e: int, L: mat6):
        k = int(BASE)
        for r in range(6):
            for c in range(r + 1):
                store(ck_f, row, k, e, L[r, c])
                k = k + 1

    @wp.func
    def solve_base(ck_f: t.array3, row: int, e: int, b: vec6):
        """I^-1 b with the base's stored Cholesky factor."""
        a = b
        for r in range(6):
            y = a[r]
            for k in range(r):
                y = y - load(ck_f, row, BASE + r * (r + 1) / 2 + k, e) * a[k]
            a[r] = y * load(ck_f, row, BASE + r * (r + 1) / 2 + r, e)
        for rr in range(6):
            r = 5 - rr
            y = a[r]
            for k in range(r + 1, 6):
                y = y - load(ck_f, row, BASE + k * (k + 1) / 2 + r, e) * a[k]
            a[r] = y * load(ck_f, row, BASE + r * (r + 1) / 2 + r, e)
        return a

    @wp.func
    def damp_base(m: Model, law: Law, last: bool, link: Link, load: Load, root: Root):
        """The base's load with its damping, implicit where that of joints is: with constraints in the last solve."""
        b = T(m.base_damping)
        hb = law.h * b
        implicit = int(IMPLICIT)
        if wp.static(CONSTRAINED):
            implicit = wp.where(last, 1, 0)
        if wp.static(CONSTRAINED) and implicit == 1:
            load.f = load.f + hb * join(link.R * root.wdot, root.vdot)
        else:
            load.f = load.f + b * link.V
            if wp.static(IMPLICIT):  # of a spatial acceleration, which lacks w x v and gravity
                load.f = load.f + hb * join(vec3(), wp.cross(wp.spatial_top(link.V), root.v) + vec3(m.gravity))
        if implicit == 1:
            load.a = load.a + wp.diag(vec3(hb, hb, hb))
            load.d = load.d + wp.diag(vec3(hb, hb, hb))
        return load

    return by_name(factor_base, store_base, solve_base, damp_base)


@cache
def factor_solve(spec: KernelSpec) -> wp.Function:
    t, kin, base, sums = types(spec), kinematics(spec), base_inertia(spec), lane_sums(spec)
    T, vec6, load, link_of = t.T, t.vec6, kin.load, kin.link_of
    Model, Law, Lane, Ck, Links, Nodes = t.Model, t.Law, t.Lane, t.Checkpoint, t.Links, t.Nodes
    FLOATING, SLOTS = spec.floating, spec.slots
    THREADS_PER_ENV, SHARERS, TRUNK = spec.threads_per_env, spec.sharers, spec.trunk

    @wp.func
    def solve(m: Model, law: Law, here: Lane, ck: Ck, row: int, links: Links, nodes: Nodes, g_base: vec6):
        """lambda = -M^-1 h g and the twists W under it, into nodes; g_base is a floating base's.

        On the way in, W holds the articulated bias force.
        """
        slots = int(SLOTS)
        h = law.h
        for i in range(here.n):
            nodes[i].W = vec6()
        for j in range(1, slots + 1):
            i = slots - j
            if wp.static(THREADS_PER_ENV > SHARERS):
                if i == TRUNK:
                    sums.limbs.add_twists(nodes)
            if i > 0 and i < here.n:
                p = m.parent[here.at + i]
                W = nodes[i].W
                u = -h * nodes[i].g - wp.dot(links[i].S, W)
                nodes[i].u = u
                if wp.static(FLOATING) or p > 0:
                    f0 = 7 * (link_of(m, here.at + i) - 1)
                    Ui = vec6()
                    for r in range(6):
                        Ui[r] = load(ck.f, row, f0 + r, here.e)
                    nodes[p].W = nodes[p].W + W + Ui * (u * load(ck.f, row, f0 + 6, here.e))
        if wp.static(FLOATING):
            nodes[0].W = base.solve_base(ck.f, row, here.e, g_base * (-h) - nodes[0].W)
        for i in range(1, here.n):
            W = nodes[m.parent[here.at + i]].W
            f0 = 7 * (link_of(m, here.at + i) - 1)
            UW = T(0.0)
            for r in range(6):
                UW = UW + load(ck.f, row, f0 + r, here.e) * W[r]
            lam = (nodes[i].u - UW) * load(ck.f, row, f0 + 6, here.e)
            nodes[i].lam = lam
            nodes[i].W = W + links[i].S * lam

    return solve
