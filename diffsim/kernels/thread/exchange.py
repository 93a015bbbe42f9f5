"""Sum over the lanes that share an environment (division.py); all of them must call these functions together.

A butterfly adds the same numbers in the same tree on every lane. So values that lanes have in common stay equal bit for
bit.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec


@cache
def lane_sums(spec: KernelSpec) -> SimpleNamespace:
    """Make the sums over an environment's lanes."""
    t, threads = types(spec), spec.threads_per_env
    T, vec6, mat3 = t.T, t.vec6, t.mat3
    neighbour = f"""
#if defined(__CUDA_ARCH__)
    const unsigned first = (threadIdx.x & 31u) & ~({threads}u - 1u);
    return __shfl_xor_sync({2**threads - 1}u << first, value, offset);
#else
    return value;
#endif
"""

    @wp.func_native(neighbour)
    def shuffle_xor(value: T, offset: int) -> T: ...

    def sums(offsets: list[int], last: int) -> SimpleNamespace:
        """Make sums of a number, and of the loads, twists and adjoints of the links up to `last`."""
        steps, least, inertial = len(offsets), offsets[0] if offsets else 1, 0 if spec.floating else 1 + spec.inert

        @wp.func
        def add(value: T):
            for k in range(steps):
                value = value + shuffle_xor(value, least << k)
            return value

        @wp.func
        def add_vec6(value: vec6):
            for k in range(6):
                value[k] = add(value[k])
            return value

        @wp.func
        def add_mat3(value: mat3):
            for r in range(3):
                for c in range(3):
                    value[r, c] = add(value[r, c])
            return value

        @wp.func
        def add_loads(loads: t.Loads):
            begin = int(inertial)
            for i in range(begin, last + 1):
                loads[i].a = add_mat3(loads[i].a)
                loads[i].b = add_mat3(loads[i].b)
                loads[i].d = add_mat3(loads[i].d)
                loads[i].f = add_vec6(loads[i].f)

        @wp.func
        def add_twists(nodes: t.Nodes):
            begin = int(0)
            for i in range(begin, last + 1):
                nodes[i].W = add_vec6(nodes[i].W)

        @wp.func
        def add_adjoints(adj: t.Adjoints):
            begin = int(0)
            for i in range(begin, last + 1):
                adj[i].a = add_vec6(adj[i].a)
                adj[i].v = add_vec6(adj[i].v)
                adj[i].w = add_vec6(adj[i].w)
                adj[i].p = add_vec6(adj[i].p)
                if wp.static(spec.constrained):
                    adj[i].b = add_vec6(adj[i].b)
                if wp.static(spec.damped):
                    adj[i].d = add_vec6(adj[i].d)
                    adj[i].w1 = add_vec6(adj[i].w1)

        return functions(locals())

    powers = [2**k for k in range(threads.bit_length() - 1)]
    return SimpleNamespace(
        add=sums(powers, 0).add,
        sharers=sums([p for p in powers if p < spec.sharers], spec.slots - 1),
        limbs=sums([p for p in powers if p >= spec.sharers], spec.trunk),
    )
