"""Newton's matrix with rows between two bodies: conjugate gradients, preconditioned by the tree.

A row between links i and j acts on both, so it adds a block to no single link's inertia, and Newton's matrix leaves
the tree:

    H = T + U' C U.

T is the tree's matrix with the ground's contacts and the limits, whose inverse is one articulated-body pass. U has the
rows between bodies, and C the slopes of their forces. Conjugate gradients preconditioned by T^-1 (Saad, Iterative
Methods for Sparse Linear Systems, 2003, algorithm 9.1) solve H s = b, starting from s_0 = T^-1 b. Their first
residual, b - H s_0 = -U' C U s_0, is the image of forces of the rows, and so are all others. With such forces, r = U' p
and T d = U' q of the search direction d, only numbers of rows are kept, and d itself is never needed:

    z = U T^-1 U' p,   beta = p.z / (p.z)_last,   q = p + beta q,   v = U d = z + beta v,
    alpha = p.z / v.(q + C v),   y += alpha q,   p -= alpha (q + C v).

At the end s = s_0 + T^-1 U' y. In exact arithmetic this takes at most rank(U) steps, each a tree solve with the
factor that the pass has already. The adjoint solves with the same symmetric H.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.jacobian import pair_jacobian
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks
from diffsim.kernels.tree.branches import branch_solver
from diffsim.robot.types import JOINT

# The search ends where p.z, the square of the residual in the norm of T^-1, is small in comparison with that of b, or
# without another solve where the residual is as good as 0: this multiple of that goal in the rows' accelerations
ROUND_OFF = 1e-6


@cache
def row_solver(spec: KernelSpec, array: str) -> SimpleNamespace:
    """Make the conjugate gradients on branches, the array of structs ("Motions" or "Nodes") that has T's factor."""
    t, block, J, tree = types(spec), blocks(spec), pair_jacobian(spec), branch_solver(spec, array)
    T, vec3, mat6, pick, clear, solve_tree = t.T, t.vec3, t.mat6, block.pick, tree.clear, tree.solve_tree
    Model, Lane, Links, Contacts, Branches = t.Model, t.Lane, t.Links, t.Contacts, getattr(t, array)
    STEPS = 2 * min(3 * spec.pairs, spec.nv) + 4  # at most: twice the rank of the rows, as rounding costs steps

    @wp.func
    def spread(m: Model, c: int, contacts: Contacts, f: vec3, branches: Branches):
        """Add the rows' forces f to the right-hand side: to the links' bias forces, and to the joints' forces."""
        s = contacts[c].row
        i, j = J.ends(m, s)
        first, second = J.wrenches(m, c, contacts, f)
        branches[i].twist = branches[i].twist + first
        branches[j].twist = branches[j].twist - second
        if m.row_kind[s] == JOINT:
            branches[i].rate = branches[i].rate - contacts[c].slope * f[0]
            branches[j].rate = branches[j].rate + f[0]

    @wp.func
    def rates_of(m: Model, c: int, contacts: Contacts, branches: Branches):
        s = contacts[c].row
        i, j = J.ends(m, s)
        a, b = branches[i].twist, branches[j].twist
        return J.rates(m, c, contacts, a, b, branches[i].rate, branches[j].rate)

    @wp.func
    def solve(
        m: Model, here: Lane, links: Links, contacts: Contacts, branches: Branches, L: mat6, active: T, accuracy: T
    ):
        """Solve H s = b where active is 1, given U s_0 as the blocks' rates: branches get s - s_0, blocks their y."""
        goal = T(0.0)
        for c in range(here.begin, here.end):
            p = contacts[c].H * contacts[c].rate
            for r in range(3):
                p[r] = pick(T(0.0), active, -p[r], T(0.0))
            contacts[c].residual = p
            contacts[c].change = vec3()
            contacts[c].direction = vec3()
            contacts[c].rate = vec3()
            goal = goal + T(m.row_params[contacts[c].row][4]) * wp.dot(p, p)
        goal = T(ROUND_OFF) * accuracy * accuracy * goal
        running = pick(T(0.0), goal, T(1.0), T(0.0))
        enough = T(0.0)
        last = T(0.0)
        step = int(0)
        while step < STEPS and block.any_of(running):
            clear(branches)
            for c in range(here.begin, here.end):
                spread(m, c, contacts, contacts[c].residual, branches)
            solve_tree(m, here, links, branches, L)
            pz = T(0.0)
            for c in range(here.begin, here.end):
                pz = pz + wp.dot(contacts[c].residual, rates_of(m, c, contacts, branches))
            running = pick(enough, pz, running, T(0.0))
            beta = pick(T(0.0), last, pz / last, T(0.0))
            last = pz
            curvature = T(0.0)
            for c in range(here.begin, here.end):
                q = contacts[c].residual + beta * contacts[c].direction
                v = rates_of(m, c, contacts, branches) + beta * contacts[c].rate
                contacts[c].direction = q
                contacts[c].rate = v
                curvature = curvature + wp.dot(v, q + contacts[c].H * v)
            alpha = pick(T(0.0), running, pick(T(0.0), curvature, pz / curvature, T(0.0)), T(0.0))
            if step == 0:  # 1 / alpha is about the factor by which s_0's residual exceeds b
                enough = accuracy * accuracy * alpha * alpha * pz
            left = T(0.0)
            for c in range(here.begin, here.end):
                q = contacts[c].direction
                contacts[c].change = contacts[c].change + alpha * q
                contacts[c].residual = contacts[c].residual - alpha * (q + contacts[c].H * contacts[c].rate)
                p = contacts[c].residual
                left = left + T(m.row_params[contacts[c].row][4]) * wp.dot(p, p)
            running = pick(goal, left, running, T(0.0))
            step = step + 1
        clear(branches)
        for c in range(here.begin, here.end):
            spread(m, c, contacts, contacts[c].change, branches)
        solve_tree(m, here, links, branches, L)

    return functions(locals())
