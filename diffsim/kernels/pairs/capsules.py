"""Contacts of a capsule with a parallel one, and with a box, as MuJoCo's (pair_list.py).

Capsules that are all but parallel touch at both ends of the stretch along which they lie beside each other.

A capsule touches a box as two spheres on its axis would: one at the axis' point nearest to the box, the other where the
axis leaves the face or the edge there, or ends. If y + s h, |s| <= 1, is the axis in the frame of the box, s of either
depends on y and h: a contact keeps ds/dy and ds/dh for its adjoint. An s at an end of the capsule does not move.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.geometry import TINY, pair_geometry
from diffsim.kernels.thread.model import functions, types
from diffsim.kernels.thread.spatial import spatial
from diffsim.kernels.thread.spec import KernelSpec
from diffsim.kernels.thread.wide import blocks

# In float64, as MuJoCo's, and in float32
PARALLEL_SQ = 1e-8, 1e-6  # square of the sine between two parallel capsules
SAME_SQ = 1e-15, 1e-9  # m^2, by which an edge must be nearer to a capsule than what was found before
SKEW_SQ = 0.0, 1e-6  # square of the least sine between a capsule and an edge
SURFACE = 1e-12, 1e-6  # m, of a sphere's centre from a box
FAR = 1e10  # m


@cache
def capsule_contacts(spec: KernelSpec) -> SimpleNamespace:
    """Make the functions of a capsule's contacts."""
    t, sp, geometry, single = types(spec), spatial(spec), pair_geometry(spec), int(types(spec).U == wp.float32)
    T, vec3, vec4, block, force_at, join = t.T, t.vec3, t.vec4, blocks(spec), sp.force_at, sp.join
    Model, Links, Contacts, pick = t.Model, t.Links, t.Contacts, block.pick
    less, sign, signs, shifted, blend = (getattr(geometry, name) for name in "less sign signs shifted blend".split())
    parallel_sq, same_sq, skew_sq, surface = (each[single] for each in (PARALLEL_SQ, SAME_SQ, SKEW_SQ, SURFACE))

    @wp.func
    def place_parallel(m: Model, s: int, end: int, links: Links, contacts: Contacts):
        """Place the two contacts of parallel capsules, or one where they are not."""
        touch = geometry.nearest_points(m, s, links)
        x1, a1, x2, a2, s1, s2 = touch.x1, touch.a1, touch.x2, touch.a2, touch.s1, touch.s2
        ma = wp.dot(a1, a1)
        mb = wp.dot(a1, a2)
        mc = wp.dot(a2, a2)
        parallel = less(ma * mc - mb * mb, T(parallel_sq) * ma * mc)
        for k in range(2):
            e = T(2.0 * float(k) - 1.0)  # the end of the first capsule, or that of the second one which lies before it
            f = e * sign(mb)
            at = (wp.dot(a1, x2 - x1) + f * mb) / ma
            own = (wp.dot(a2, x1 - x2) + e * mb) / mc
            inner = less(e * at, T(1.0))
            touch.s1 = pick(T(0.5), parallel, pick(T(0.5), inner, geometry.clamped(at), e), s1)
            touch.s2 = pick(T(0.5), parallel, pick(T(0.5), inner, f, geometry.clamped(own)), s2)
            touch.d = (x2 + touch.s2 * a2) - (x1 + touch.s1 * a1)
            contacts[end + k].how = vec4(touch.s1, touch.s2, T(0.0), T(0.0))
            geometry.place_touch(m, s, end + k, touch, contacts)
        contacts[end + 1].active = parallel * contacts[end + 1].active

    @wp.func
    def parallel_adjoint(m: Model, c: int, links: Links, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of a contact, see pair_list.contact_adjoint."""
        s = contacts[c].row
        touch = geometry.segments(m, s, links)
        touch.s1 = contacts[c].how[0]
        touch.s2 = contacts[c].how[1]
        touch.d = (touch.x2 + touch.s2 * touch.a2) - (touch.x1 + touch.s1 * touch.a1)
        return geometry.touch_adjoint(m, s, links, touch, n, g_p, g_r, g_n)

    @wp.func
    def nearest_to_box(y: vec3, h: vec3, b: vec3):
        """Find the point of a capsule's axis that is nearest to a box with half lengths b.

        Returns:
            s; marks of the box's axes along which an end is outside, if that is nearest to a face or inside; 1 if it is
            nearest to an edge, else 0; a mark of the edge's axis; the edge's point; 1 between its ends, else 0; the
            signs of its corner.
        """
        best = T(FAR)
        s = T(0.0)
        outside = vec3()
        for k in range(2):
            e = T(2.0 * float(k) - 1.0)
            beyond = wp.abs(y + e * h) - b
            out = vec3()
            for i in range(3):
                out[i] = less(T(0.0), beyond[i])
                beyond[i] = wp.max(beyond[i], T(0.0))
            square = wp.dot(beyond, beyond)
            nearer = less(square, best) * less(out[0] + out[1] + out[2], T(1.5))
            best = pick(T(0.5), nearer, square, best)
            s = pick(T(0.5), nearer, e, s)
            outside = blend(nearer, out, outside)
        on_edge = T(0.0)
        along = vec3()
        corner = vec3()
        inner = T(0.0)
        sigma = vec3()
        hh = wp.dot(h, h)
        for k in range(12):
            j = k // 4
            e_j = vec3()
            e_j[j] = T(1.0)
            centre = b - b[j] * e_j
            centre[(j + 1) % 3] = b[(j + 1) % 3] * T(1.0 - 2.0 * float(k % 2))
            centre[(j + 2) % 3] = b[(j + 2) % 3] * T(1.0 - 2.0 * float(k // 2 % 2))
            at, on_axis, d = geometry.nearest(centre, b[j] * e_j, y, h)
            square = wp.dot(d, d)
            det = b[j] * b[j] * (hh - h[j] * h[j])
            skew = less(wp.max(T(TINY), T(skew_sq) * b[j] * b[j] * hh), det)
            nearer = less(square, best - T(same_sq)) * skew
            best = pick(T(0.5), nearer, square, best)
            s = pick(T(0.5), nearer, on_axis, s)
            on_edge = wp.max(on_edge, nearer)
            along = blend(nearer, e_j, along)
            corner = blend(nearer, centre + (at * b[j]) * e_j, corner)
            # MuJoCo counts the point as a corner, too, if the nearest points of both lines are beyond it
            line = b[j] * (hh * (y[j] - centre[j]) - h[j] * wp.dot(h, y - centre))
            inside = less(wp.abs(at), T(1.0))
            inner = pick(T(0.5), nearer, inside * less(wp.abs(line), det), inner)
            centre[j] = pick(T(0.5), inside, line, at)
            sigma = blend(nearer, signs(centre), sigma)
        return s, outside, on_edge, along, corner, inner, sigma

    @wp.func
    def way_over_box(h: vec3, s: T, outside: vec3, on_edge: T, along: vec3, inner: T, sigma: vec3):
        """Choose the way along a capsule's axis from the point nearest to a box to the other contact.

        Returns:
            its direction, or 0 if there is none; marks of the box's axes along which it ends at a side of the box, and
            of those along which it is at most as long as the box.
        """
        ones = vec3(T(1.0), T(1.0), T(1.0))
        differs = vec3()  # axes along which the capsule's direction and the corner differ in sign
        for i in range(3):
            differs[i] = less(-sign(-h[i]) * sigma[i], T(0.0))
        # from a corner along the edge whose axis is the odd one out, or over the face of the other two
        count = wp.dot(differs, ones)
        two = less(T(1.5), count)
        odd = blend(two, ones - differs, differs)
        slant = wp.dot(odd, h)
        over_edge = less(T(0.5) * wp.dot(h, h), slant * slant)
        from_corner = on_edge * (T(1.0) - inner) * less(T(0.5), count) * less(count, T(2.5))
        corner_way = (T(1.0) - T(2.0) * two) * (T(2.0) * over_edge - T(1.0))
        # from an edge over the face that is less steep
        third = shifted(along)
        main = shifted(third)
        main = blend(less(wp.abs(wp.dot(main, h)), wp.abs(wp.dot(third, h))), third, main)
        count = wp.dot(differs, ones - along)
        from_edge = on_edge * inner * less(T(0.5), count) * less(count, T(1.5))
        edge_way = T(2.0) * wp.dot(differs, main) - T(1.0)
        # from an end over a face
        way = -s * wp.max(outside[0], wp.max(outside[1], outside[2]))
        way = pick(T(0.5), on_edge, from_corner * corner_way + from_edge * edge_way, way)
        sides = blend(on_edge, from_edge * along, ones - outside)
        return way, sides, from_corner * blend(over_edge, odd, ones - odd) + from_edge * main

    @wp.func
    def end_of_way(y: vec3, h: vec3, b: vec3, s: T, g_y: vec3, g_h: vec3, way: T, sides: vec3, steps: vec3):
        """Return s, ds/dy and ds/dh at the end of the way over the box, of those at its beginning."""
        length = T(1.0) - way * s
        end_y = vec3()
        end_h = vec3()
        q = y + s * h
        for i in range(3):
            e_i = vec3()
            e_i[i] = T(1.0)
            inv_h = sign(h[i]) / wp.max(wp.abs(h[i]), T(TINY))
            step = pick(T(0.5), steps[i], T(2.0) * b[i] * wp.abs(inv_h), T(FAR))
            step = pick(T(0.5), sides[i], (b[i] - way * sign(h[i]) * q[i]) * wp.abs(inv_h), step)
            shorter = less(step, length)
            length = wp.min(length, step)
            end_y = blend(shorter, steps[i] * g_y - (sides[i] * inv_h) * e_i, end_y)
            end_h = blend(shorter, steps[i] * g_h - ((sides[i] * s + way * step) * inv_h) * e_i, end_h)
        return s + way * length, end_y, end_h

    @wp.func
    def place_capsule_box(m: Model, s: int, end: int, links: Links, contacts: Contacts):
        """Place the contacts of a capsule and a box; returns how many blocks have one in some environment."""
        capsule = geometry.segments(m, s, links)
        box = geometry.second_box(m, s, links)
        reach = wp.length(capsule.a1) + T(m.row_shape[s][1]) + T(m.row_params[s][10])
        if not block.any_of(geometry.reaches(capsule.x1, reach, box)):
            return 0
        y = wp.transpose(box.R) * (capsule.x1 - box.x)
        h = wp.transpose(box.R) * capsule.a1
        at, outside, on_edge, along, corner, inner, sigma = nearest_to_box(y, h, box.h)
        way, sides, steps = way_over_box(h, at, outside, on_edge, along, inner, sigma)
        across = vec3(T(1.0), T(1.0), T(1.0)) - inner * along
        h_across = wp.cw_mul(across, h)
        scale = on_edge * less(wp.abs(at), T(1.0)) / wp.max(wp.dot(h_across, h_across), T(TINY))
        g_y = -scale * h_across
        g_h = at * g_y + scale * wp.cw_mul(across, corner - y - at * h)
        for k in range(2):
            c = end + k
            if k == 1:
                at, g_y, g_h = end_of_way(y, h, box.h, at, g_y, g_h, way, sides, steps)
            centre = capsule.x1 + at * capsule.a1
            contacts[c].vertex = centre
            contacts[c].a = box.R * g_y
            contacts[c].b = box.R * g_h
            touch = geometry.to_box(m, s, links, centre, box.x)
            geometry.place_touch(m, s, c, touch, contacts)
            # where the way begins to be over the box it may be on its surface: normal to the nearest face
            q = y + at * h
            face = geometry.largest(-wp.abs(box.h - wp.abs(q)))
            n = -(box.R * wp.cw_mul(face, signs(q)))
            on_surface = less(wp.length(touch.d), T(surface))
            geometry.set_normal(c, n, on_surface, contacts)
            contacts[c].how[0] = on_surface
            contacts[c].p = blend(on_surface, centre + T(0.5) * T(m.row_shape[s][1]) * n, contacts[c].p)
            contacts[c].q = contacts[c].p
        contacts[end + 1].active = contacts[end + 1].active * wp.abs(way)
        return 2

    @wp.func
    def capsule_box_adjoint(m: Model, c: int, links: Links, contacts: Contacts, n: vec3, g_p: vec3, g_r: T, g_n: vec3):
        """Return the wrench of a contact, see pair_list.contact_adjoint."""
        s = contacts[c].row
        z = contacts[c].vertex
        capsule = geometry.segments(m, s, links)
        wrench = geometry.touch_adjoint(m, s, links, geometry.to_box(m, s, links, z, capsule.x2), n, g_p, g_r, g_n)
        # on the surface
        g_z = g_r + T(0.5) * wp.dot(n, g_p)
        turn = wp.cross(n, g_n + T(0.5) * T(m.row_shape[s][1]) * g_p)
        wrench = geometry.blend_wrenches(contacts[c].how[0], force_at(z, g_z * n) + join(turn, vec3()), wrench)
        # as s moves
        g_s = wp.dot(g_p - wp.spatial_bottom(wrench), capsule.a1)
        wrench = wrench - force_at(capsule.x1, g_s * contacts[c].a)
        return wrench - join(g_s * wp.cross(capsule.a1, contacts[c].b), vec3())

    return functions(locals())
