"""Distance of a sphere from the ground: a plane, or a piecewise-linear z(x).

A sphere of radius r touches if its centre is nearer to the ground than r. Signed distance d, normal n and curvature
k of the centre's distance field are those of the nearest feature:

    a segment         d = (c - a) . n - r                           k = 0
    a ridge           d = |c - v| - r,   n = (c - v) / |c - v|      k = 1 / |c - v|
    a valley          d = -|c - w|,      n = (w - c) / |c - w|      k = -1 / |c - w|

where w is the centre of the sphere that rests in the valley, touching both sides: a centre below it is pushed there
by both. So d and n are continuous, d's gradient is n, and dn = k t (t . dc) with the tangent t. They jump only where
two features are equally near: for a centre that is itself below a ridge, which is a depth of r or more, and in a notch
that the sphere does not fit into.

The law of contact, be it soft_contact.py's or MuJoCo's, acts in the frame E = (t, y, n) of the feature. Its adjoint
includes the rotation of that frame.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks


@cache
def terrain_contact(spec: KernelSpec) -> SimpleNamespace:
    """Make the ground's distance from a sphere, and the frame of what the sphere touches."""
    t, block, BLOCK, TERRAIN = types(spec), blocks(spec), spec.block, "terrain" in spec.features
    FRAMED, TREES = spec.framed, "trees" in spec.features
    T, U, vec3, vec4, mat3, Model, uvec4 = t.T, t.U, t.vec3, t.vec4, t.mat3, t.Model, t.scene.vec4

    @wp.func
    def segment_length(m: Model, row: int, i: int):
        """Return the length of segment i; the first and the last one are infinite."""
        a = m.terrain[row, i]
        b = m.terrain[row, i + 1]
        length = (b[0] - a[0]) * a[2] + (b[1] - a[1]) * a[3]
        if i == 0 or i + 2 == m.terrain.shape[1]:
            length = U(wp.inf)
        return length

    @wp.func
    def segment_below(m: Model, row: int, x: U):
        low = int(0)
        high = m.terrain.shape[1] - 1
        while high - low > 1:
            middle = (low + high) // 2
            if m.terrain[row, middle][0] <= x:
                low = middle
            else:
                high = middle
        return low

    @wp.func
    def in_valley(m: Model, row: int, i: int, x: U, z: U, r: U, otherwise: uvec4):
        """Return (d, n_x, n_z, k) of a centre that both sides of the valley at vertex i push, else `otherwise`."""
        result = otherwise
        if i > 0 and i + 1 < m.terrain.shape[1]:
            a = m.terrain[row, i - 1]
            b = m.terrain[row, i]
            sine = a[2] * b[3] - a[3] * b[2]
            cosine = a[2] * b[2] + a[3] * b[3]
            fits = r * sine <= (U(1.0) + cosine) * wp.min(segment_length(m, row, i - 1), segment_length(m, row, i))
            if sine > U(0.0) and fits:
                scale = r / (U(1.0) + cosine)
                wx = b[0] - scale * (a[3] + b[3]) - x
                wz = b[1] + scale * (a[2] + b[2]) - z
                away = wp.sqrt(wx * wx + wz * wz)
                if wx * a[2] + wz * a[3] < U(0.0) and wx * b[2] + wz * b[3] > U(0.0) and away > U(0.0):
                    result = uvec4(-away, wx / away, wz / away, U(-1.0) / away)
        return result

    @wp.func
    def nearest(m: Model, row: int, x: U, z: U, r: U, reach: U):
        """Return (d, n_x, n_z, k) of the centre (x, z); over the ground exact only for centres nearer than `reach`."""
        last = m.terrain.shape[1] - 1
        below = segment_below(m, row, x)
        a = m.terrain[row, below]
        above = z - a[1] - (x - a[0]) * a[3] / a[2]
        result = uvec4(above - r, U(0.0), U(1.0), U(0.0))
        # The nearest point is at most as far as the one straight below or above, and so is its x.
        bound = wp.abs(above)
        if above > U(0.0):
            bound = wp.min(above, reach)
        i = below
        while i > 0 and m.terrain[row, i][0] > x - bound:
            i = i - 1
        best = bound * bound
        found = int(-1)
        end = int(0)  # -1, 1: the nearest point of the segment is where it begins, where it ends
        while i < last and (i <= below or m.terrain[row, i][0] < x + bound):
            b = m.terrain[row, i]
            dx = x - b[0]
            dz = z - b[1]
            s = dx * b[2] + dz * b[3]
            length = segment_length(m, row, i)
            at = int(0)
            if s < U(0.0) and i > 0:
                s = U(0.0)
                at = -1
            elif s > length:
                s = length
                at = 1
            dx = dx - s * b[2]
            dz = dz - s * b[3]
            if dx * dx + dz * dz <= best:
                best = dx * dx + dz * dz
                found = i
                end = at
            i = i + 1
        if found >= 0:
            b = m.terrain[row, found]
            if end == 0:
                result = uvec4((z - b[1]) * b[2] - (x - b[0]) * b[3] - r, -b[3], b[2], U(0.0))
                result = in_valley(m, row, found, x, z, r, result)
                result = in_valley(m, row, found + 1, x, z, r, result)
            else:
                vertex = found + wp.max(end, 0)
                b = m.terrain[row, vertex]
                away = wp.where(above > U(0.0), wp.sqrt(best), -wp.sqrt(best))
                if best > U(0.0):
                    result = uvec4(away - r, (x - b[0]) / away, (z - b[1]) / away, U(1.0) / away)
                result = in_valley(m, row, vertex, x, z, r, result)
        return result

    @wp.func
    def nearest_of_each(m: Model, b: int, x: T, z: T, r: U, reach: T):
        """Call nearest() for each of the block's environments with its own profile."""
        result = vec4()
        for k in range(BLOCK):
            row = (BLOCK * b + k) % m.terrain.shape[0]
            hit = nearest(m, row, block.element(x, k), block.element(z, k), r, block.element(reach, k))
            for i in range(4):
                result[i] = block.with_element(result[i], k, hit[i])
        return result

    @wp.func
    def frame_of(hit: vec4):
        """Return the frame E of a result of nearest()."""
        return mat3(hit[2], T(0.0), hit[1], T(0.0), T(1.0), T(0.0), -hit[1], T(0.0), hit[2])

    @wp.func
    def distance(m: Model, here: t.Lane, c: int, centre: vec3, carrier: t.CarrierPos, reach: T):
        """Return (d, E, k) of contact sphere c, see nearest(); over a plane E is the world's and k is 0."""
        if wp.static(TERRAIN):
            hit = nearest_of_each(m, here.e, carrier[0] + centre[0], carrier[1] + centre[2], m.contact_radius[c], reach)
            return hit[0], frame_of(hit), hit[3]
        elif wp.static(FRAMED):
            return carrier + centre[2] - T(m.contact_radius[c]), wp.identity(3, dtype=T), T(0.0)
        else:
            return carrier + centre[2] - T(m.contact_radius[c]), T(1.0), T(0.0)

    @wp.func
    def about_carrier(link: t.Link, p: vec3):
        """Return a point of a link, which may be about an origin of its tree's own, about the carrier."""
        if wp.static(TREES):
            return link.origin + p
        return p

    @wp.func
    def in_frame(E: t.Frame, v: vec3):
        """Transform a world vector to a contact's frame, in which the law acts."""
        if wp.static(FRAMED):
            return wp.transpose(E) * v
        return v

    @wp.func
    def in_world(E: t.Frame, v: vec3):
        if wp.static(FRAMED):
            return E * v
        return v

    return functions(locals())
