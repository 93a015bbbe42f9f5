"""Solves with the factor of the tree's matrix T, which an articulated-body pass leaves on its links."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.tree.kinematics import kinematics
from diffsim.kernels.tree.solve import base_inertia


@cache
def branch_solver(spec: KernelSpec, array: str) -> SimpleNamespace:
    """Make the solves on branches, the array of structs ("Motions" or "Nodes") that has T's factor."""
    t, base = types(spec), base_inertia(spec)
    T, vec6, mat6, Model, Lane, Links, Branches = t.T, t.vec6, t.mat6, t.Model, t.Lane, t.Links, getattr(t, array)
    FLOATING, ROOM, BASE, load = spec.floating, spec.room, 7 * (spec.nlink - 1), kinematics(spec).load

    @wp.func
    def clear(branches: Branches):
        """Set the right-hand sides to zero."""
        room = int(ROOM)
        for i in range(room):
            branches[i].twist = vec6()
            branches[i].rate = T(0.0)

    @wp.func
    def solve_factored(L: mat6, b: vec6):
        """Return I^-1 b by the base's Cholesky factor L."""
        a = b
        for r in range(6):
            y = a[r]
            for k in range(r):
                y = y - L[r, k] * a[k]
            a[r] = y * L[r, r]
        return base.back_substitute(L, a)

    @wp.func
    def solve_tree(m: Model, here: Lane, links: Links, branches: Branches, L: mat6):
        """Solve T x = forces: on entry twist has the links' bias forces and rate the joints' forces, on return x."""
        for k in range(1, here.n):
            i = here.n - k
            p = m.parent[i]
            own = branches[i].twist
            u = branches[i].rate - wp.dot(links[i].S, own)
            branches[i].rate = u
            if wp.static(FLOATING) or p > 0:
                branches[p].twist = branches[p].twist + own + branches[i].U * (u * branches[i].dinv)
        if wp.static(FLOATING):
            branches[0].twist = solve_factored(L, -branches[0].twist)
        else:
            branches[0].twist = vec6()
        for i in range(1, here.n):
            A = branches[m.parent[i]].twist
            accel = (branches[i].rate - wp.dot(branches[i].U, A)) * branches[i].dinv
            branches[i].rate = accel
            branches[i].twist = A + links[i].S * accel
        branches[ROOM - 1].twist = vec6()
        branches[ROOM - 1].rate = T(0.0)

    @wp.func
    def recall_factor(here: Lane, ck: t.Checkpoint, row: int, branches: Branches):
        """Load T's factor of a checkpoint's row; returns the base's."""
        for i in range(1, here.n):
            for r in range(6):
                branches[i].U[r] = load(ck.f, row, 7 * (i - 1) + r, here.e)
            branches[i].dinv = load(ck.f, row, 7 * (i - 1) + 6, here.e)
        L = mat6()
        if wp.static(FLOATING):
            k = int(BASE)
            for r in range(6):
                for c in range(r + 1):
                    L[r, c] = load(ck.f, row, k, here.e)
                    k = k + 1
        return L

    return functions(locals())
