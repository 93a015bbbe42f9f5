"""Blocks of environments: on a CPU one thread steps 8 or 16 of them at once, each number a vector.

Warp has no such type. So in these kernels the numbers that differ between environments (T) are float64 to Warp, and the
C++ below, which Warp puts between its headers and the kernel, makes `float64` a vector of floats: clang maps it to the
machine's registers, however wide they are. A scene's numbers (U) stay float32. The same source with T = U is the kernel
of one environment, for float64 and for GPUs.

A kernel must not branch on an environment's numbers: `pick` selects one of two values per environment. Code behind
`any_of` runs for the whole block, and must not change the environments for which the condition is false.

Warp's own templates do not find functions that are declared after them, so those that call one are overloaded here.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec

PREAMBLE = """
namespace wp {
typedef float wide __attribute__((ext_vector_type(BLOCK)));
typedef int wide_int __attribute__((ext_vector_type(BLOCK)));
inline wide_int numbers()
{
    wide_int n;
    for (int k = 0; k < BLOCK; ++k)
        n[k] = k;
    return n;
}
inline wide mul(wide a, wide b) { return a * b; }
inline wide add(wide a, wide b) { return a + b; }
inline wide sub(wide a, wide b) { return a - b; }
inline wide div(wide a, wide b) { return a / b; }
inline wide neg(wide a) { return -a; }
inline wide abs(wide a) { return __builtin_elementwise_abs(a); }
inline wide sqrt(wide a) { return __builtin_elementwise_sqrt(a); }
inline wide min(wide a, wide b) { return a < b ? a : b; }
inline wide max(wide a, wide b) { return a > b ? a : b; }
inline wide atan2(wide y, wide x)
{
    for (int k = 0; k < BLOCK; ++k)
        y[k] = atan2(y[k], x[k]);
    return y;
}
inline wide pow(wide x, wide y)
{
    for (int k = 0; k < BLOCK; ++k)
        x[k] = pow(x[k], y[k]);
    return x;
}
template <> inline wide muladd<wide>(wide a, wide b, wide c) { return c + a * b; }
inline vec_t<3, wide> abs(vec_t<3, wide> a) { return vec_t<3, wide>(abs(a.c[0]), abs(a.c[1]), abs(a.c[2])); }
template <unsigned N> inline wide length(vec_t<N, wide> a) { return sqrt(dot(a, a)); }
inline wide length(vec_t<3, wide> a) { return sqrt(a.c[0] * a.c[0] + a.c[1] * a.c[1] + a.c[2] * a.c[2]); }
inline wide length(const quat_t<wide>& q) { return sqrt(dot(q, q)); }
inline quat_t<wide> normalize(const quat_t<wide>& q)
{
    wide l = length(q), zero = 0.0f, one = 1.0f, i = l > zero ? one / l : zero;
    return quat_t<wide>(q.x * i, q.y * i, q.z * i, l > zero ? q.w * i : one);
}
// The sine of x plus `quarters` right angles: reduction by Cody and Waite, polynomials of Cephes. Error below 1e-7 for
// |x| < 8192, where one more step of the reduction would be needed.
inline wide turned_sin(wide x, int quarters)
{
    wide k = __builtin_elementwise_rint(x * 0.636619772367581343f);
    wide_int n = __builtin_convertvector(k, wide_int) + quarters;
    wide r = x - k * 1.5703125f;
    r = r - k * 4.837512969970703125e-4f;
    r = r - k * 7.54978995489188216e-8f;
    wide z = r * r;
    wide s = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * r + r;
    wide c = ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z;
    c = c - 0.5f * z + 1.0f;
    wide f = (n & 1) != 0 ? c : s;
    return (n & 2) != 0 ? -f : f;
}
inline wide sin(wide x) { return turned_sin(x, 0); }
inline wide cos(wide x) { return turned_sin(x, 1); }
inline wide tan(wide x) { return sin(x) / cos(x); }
}
#define float64 wide
"""


def module_options(spec: KernelSpec) -> dict[str, Any]:
    """Return Warp's options of a kernel's module."""
    # On the CPU unrolling buys no speed and costs a second of compilation; a GPU keeps small matrices in registers.
    options: dict[str, Any] = {"enable_backward": False, "max_unroll": 6 if spec.env_last else 1}
    if spec.env_last and spec.constrained and spec.dtype is wp.float32:
        # A fifth of a GPU's time. Newton's method corrects what fast divisions and square roots round: states of a G1
        # err as much as without. Those of an ant on soft contact would err ten times as much.
        options["fast_math"] = True
    if not spec.env_last:
        options["block_dim"] = 1  # as Warp launches on a CPU: for its default of 256 it would hash the module once more
    if spec.block > 1:
        preamble = PREAMBLE.replace("BLOCK", str(spec.block))
        options["extra_build_options"] = wp.ModuleBuildOptions(extra_cpu_preamble=preamble)
        # A product and a sum become one instruction where there is one, as on a GPU. How functions pass vectors differs
        # between processors, of which clang warns; nobody but the module calls its functions.
        target = "-march=native" if wp.config.cpu_compiler_flags is None else wp.config.cpu_compiler_flags
        options["cpu_compiler_flags"] = f"{target} -ffp-contract=fast -Wno-psabi"
    return options


@cache
def blocks(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a block: selection, and access to its environments' rows."""
    t, BLOCK = types(spec), spec.block
    T, U, array2, flags, counts = t.T, t.U, t.array2, wp.array(dtype=wp.bool), wp.array(dtype=int)
    wide = BLOCK > 1

    @wp.func_native("return a < b ? x : y;")
    def pick(a: T, b: T, x: T, y: T) -> T:
        """Return x where a < b, else y."""
        ...

    @wp.func_native("return __builtin_reduce_or(x > 0.0f);" if wide else "return x > 0.0;")
    def any_of(x: T) -> bool:
        """Tell whether x > 0 in any environment of the block."""
        ...

    @wp.func_native(
        "return __builtin_elementwise_abs(x) < __builtin_inff() ? wp::wide(0.0f) : wp::wide(1.0f);"
        if wide
        else "return isfinite(x) ? 0.0 : 1.0;"
    )
    def is_nonfinite(x: T) -> T:
        """Return 1 where x is not finite, else 0."""
        ...

    @wp.func_native("return x[k];" if wide else "return x;")
    def element(x: T, k: int) -> U:
        """Return the number of the block's environment k."""
        ...

    @wp.func_native("return wp::numbers() == k ? wp::wide(value) : x;" if wide else "return value;")
    def with_element(x: T, k: int, value: U) -> T: ...

    @wp.func
    def env_of(b: int, k: int, envs: int):
        """Return the index of block b's environment k; the last block is filled up with the last environment."""
        return wp.min(BLOCK * b + k, envs - 1)

    @wp.func
    def read(a: array2, b: int, column: int):
        x = T(0.0)
        for k in range(BLOCK):
            x = with_element(x, k, a[env_of(b, k, a.shape[0]), column])
        return x

    @wp.func
    def write(a: array2, b: int, column: int, x: T):
        for k in range(BLOCK):
            if BLOCK * b + k < a.shape[0]:
                a[BLOCK * b + k, column] = element(x, k)

    @wp.func
    def read_flags(a: flags, b: int):
        x = T(0.0)
        for k in range(BLOCK):
            if a[env_of(b, k, a.shape[0])]:
                x = with_element(x, k, U(1.0))
        return x

    @wp.func
    def write_flags(a: flags, b: int, x: T):
        for k in range(BLOCK):
            if BLOCK * b + k < a.shape[0]:
                a[BLOCK * b + k] = element(x, k) > U(0.0)

    @wp.func
    def count(a: counts, b: int, x: T):
        """Increment the count where x > 0."""
        for k in range(BLOCK):
            if BLOCK * b + k < a.shape[0] and element(x, k) > U(0.0):
                a[BLOCK * b + k] = a[BLOCK * b + k] + 1

    return functions(locals())
