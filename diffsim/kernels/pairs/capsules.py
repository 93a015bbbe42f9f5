"""Contacts of a capsule and a box of one environment, as MuJoCo's.

A capsule touches a box as two spheres on its axis would: one at the axis' point nearest to the box, the other where the
axis leaves the face or the edge there, or ends. If y + s h, |s| <= 1, is the axis in the frame of the box, s of either
depends on y and h: a contact keeps ds/dy and ds/dh for its adjoint. An s at an end of the capsule does not move.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.pairs.spheres import TINY, sphere_contacts
from diffsim.kernels.pairs.touch import geom_types
from diffsim.kernels.thread.model import functions, struct

# In float64, as MuJoCo's, and in float32
SAME_SQ = 1e-15, 1e-9  # m^2, by which an edge must be nearer to a capsule than what was found before
SKEW_SQ = 0.0, 1e-6  # square of the least sine between a capsule and an edge
FAR = 1e10  # m
INSIDE, FACE, EDGE, CORNER = range(4)  # what of a box is nearest to a capsule's axis
WHOLE, SIDE = 1, 2  # a way along an axis of the box is at most as long as the box, or ends at its side


@cache
def box_features(U: type) -> SimpleNamespace:
    """Make the function that finds what of a box is nearest to a capsule, and its result, for numbers of this type."""
    vec3 = geom_types(U).vec3
    same_sq, skew_sq = (each[int(U == wp.float32)] for each in (SAME_SQ, SKEW_SQ))
    Feature = struct(
        "Feature",
        {
            "kind": int,  # INSIDE, FACE, EDGE or CORNER
            "axis": int,  # normal to the face, or along the edge
            "s": U,  # of the point on the capsule's axis
            "point": vec3,  # on the box, of an edge or a corner
            "corner": vec3,  # whose signs are those of the nearest corner
        },
    )

    @wp.func
    def nearest_feature(y: vec3, h: vec3, b: vec3):
        """Find what of a box with the half lengths b is nearest to a capsule's axis."""
        feature = Feature()
        best = U(FAR)
        same, edge = U(same_sq), int(EDGE)  # here, as Warp reads a named constant only where it first appears
        for k in range(2):
            end = U(2.0 * float(k) - 1.0)
            square = U(0.0)
            outside, axis = int(0), int(0)
            for i in range(3):
                beyond = wp.abs(y[i] + end * h[i]) - b[i]
                if beyond > U(0.0):
                    square = square + beyond * beyond
                    outside = outside + 1
                    axis = i
            if outside < 2 and square < best:
                best = square
                feature.kind = outside  # INSIDE or FACE
                feature.axis = axis
                feature.s = end
        hh = wp.dot(h, h)
        for j in range(3):
            low = wp.where(j == 0, 1, 0)  # the first of the other axes: of equally near edges MuJoCo has the first
            along = vec3()
            along[j] = b[j]
            det = b[j] * b[j] * hh - b[j] * h[j] * (b[j] * h[j])
            skew = det > wp.max(U(TINY), U(skew_sq) * b[j] * b[j] * hh)
            for k in range(4):
                middle = b - along
                if k % 2 == 0:
                    middle[low] = -b[low]
                if k < 2:
                    middle[3 - j - low] = -b[3 - j - low]
                # the axis is at least as far from this edge as the box around it
                gap = middle - y
                bound = U(0.0)
                for i in range(3):
                    beyond = wp.max(wp.abs(gap[i]) - wp.abs(h[i]) - along[i], U(0.0))
                    bound = bound + beyond * beyond
                if skew and bound < best - same:
                    # nearest points middle + at along and y + s h; it is a corner, too, if both lines' are beyond it
                    u, v = -b[j] * gap[j], wp.dot(h, gap)
                    at = (hh * u + b[j] * h[j] * v) / det
                    s = (b[j] * b[j] * v + b[j] * h[j] * u) / det
                    corner = int(0)
                    side = at
                    if wp.abs(at) > U(1.0):
                        corner = 1
                        at = wp.sign(at)
                        s = (v + at * b[j] * h[j]) / hh
                    if wp.abs(s) > U(1.0):
                        s = wp.sign(s)
                        at = (u + s * b[j] * h[j]) / (b[j] * b[j])
                        if wp.abs(at) > U(1.0):
                            corner = 1
                            side = at
                            at = wp.sign(at)
                    d = gap + at * along - s * h
                    if wp.dot(d, d) < best - same:
                        best = wp.dot(d, d)
                        feature.kind = edge + corner
                        feature.axis = j
                        feature.s = s
                        feature.point = middle + at * along
                        feature.corner = middle
                        feature.corner[j] = side
        return feature

    return SimpleNamespace(Feature=Feature, nearest=nearest_feature)


@cache
def capsule_contacts(U: type) -> SimpleNamespace:
    """Make the functions for numbers of this type."""
    t, spheres, features = geom_types(U), sphere_contacts(U), box_features(U)
    vec3, Geom, Touches, Feature, nearest_feature = t.vec3, t.Geom, t.Touches, features.Feature, features.nearest
    # A point s on the capsule's axis, and how it moves
    Place = struct("Place", {"s": U, "by_y": vec3, "by_h": vec3})

    @wp.func
    def first_place(feature: Feature, y: vec3, h: vec3):
        """Return the point of a capsule's axis that is nearest to the box."""
        place = Place()
        place.s = feature.s
        if feature.kind >= EDGE and wp.abs(feature.s) < U(1.0):
            across = h
            gap = feature.point - y - feature.s * h
            if feature.kind == EDGE:
                across[feature.axis] = U(0.0)
                gap[feature.axis] = U(0.0)
            scale = U(1.0) / wp.max(wp.dot(across, across), U(TINY))
            place.by_y = -scale * across
            place.by_h = feature.s * place.by_y + scale * gap
        return place

    @wp.func
    def way_over_box(feature: Feature, h: vec3):
        """Choose the way along a capsule's axis from the point nearest to a box to the other contact.

        Returns:
            its direction, 1 or -1, or 0 if there is none; and for each axis of the box what ends it: WHOLE, SIDE or 0.
        """
        whole, side = int(WHOLE), int(SIDE)  # here, as Warp reads a named constant only where it first appears
        way = U(0.0)
        ends = wp.vec3i(0, 0, 0)
        if feature.kind == FACE:
            way = -feature.s
            ends = wp.vec3i(side, side, side)
            ends[feature.axis] = 0
        if feature.kind < EDGE:
            return way, ends
        differs = wp.vec3i(0, 0, 0)  # 1 of axes along which the capsule's direction and the corner differ in sign
        for i in range(3):
            if (h[i] > U(0.0)) != (feature.corner[i] >= U(0.0)):
                differs[i] = 1
        if feature.kind == EDGE:  # over the face that is less steep
            differs[feature.axis] = 0
            main = (feature.axis + 2) % 3
            if wp.abs(h[main]) < wp.abs(h[(feature.axis + 1) % 3]):
                main = (feature.axis + 1) % 3
            if differs[0] + differs[1] + differs[2] == 1:
                way = U(2.0 * float(differs[main]) - 1.0)
                ends[main] = whole
                ends[feature.axis] = side
            return way, ends
        # from a corner along the edge whose axis is the odd one out, or over the face of the other two
        count = differs[0] + differs[1] + differs[2]
        if count == 1 or count == 2:
            odd = int(0)
            for i in range(1, 3):
                if (differs[i] == 1) == (count == 1):
                    odd = i
            way = U(3.0 - 2.0 * float(count))
            if h[odd] * h[odd] > U(0.5) * wp.dot(h, h):
                ends[odd] = whole
            else:
                way = -way
                ends = wp.vec3i(whole, whole, whole)
                ends[odd] = 0
        return way, ends

    @wp.func
    def second_place(first: Place, y: vec3, h: vec3, b: vec3, way: U, ends: wp.vec3i):
        """Return the point of a capsule's axis where the way over the box ends that begins at the first place."""
        place = Place()
        length = U(1.0) - way * first.s
        q = y + first.s * h
        for i in range(3):
            inv_h = wp.sign(h[i]) / wp.max(wp.abs(h[i]), U(TINY))
            if ends[i] == WHOLE:
                step = U(2.0) * b[i] * wp.abs(inv_h)
                if step < length:
                    length = step
                    place.by_y = first.by_y
                    place.by_h = first.by_h
                    place.by_h[i] = place.by_h[i] - way * step * inv_h
            if ends[i] == SIDE:
                step = (b[i] - way * wp.sign(h[i]) * q[i]) * wp.abs(inv_h)
                if step > U(0.0) and step < length:  # a capsule that begins at the side goes on along it
                    length = step
                    place.by_y = vec3()
                    place.by_y[i] = -inv_h
                    place.by_h = (first.s + way * step) * place.by_y
        place.s = first.s + way * length
        return place

    @wp.func
    def touch_at(place: Place, capsule: Geom, box: Geom):
        """Return the contact of the sphere at a place on the capsule's axis, with ds/dy and ds/dh in the world."""
        centre = capsule.x + place.s * spheres.half_axis(capsule)
        touch = spheres.sphere_box(centre, capsule.size[0], box)
        touch.a = box.R * place.by_y
        touch.b = box.R * place.by_h
        return touch

    @wp.func
    def capsule_box(capsule: Geom, box: Geom, margin: U, found: Touches):
        """Find the contacts of a capsule and a box, none if they are clearly apart; returns their number."""
        y = wp.transpose(box.R) * (capsule.x - box.x)
        h = capsule.size[1] * (wp.transpose(box.R) * spheres.column(capsule.R, 2))
        reach = capsule.size[0] + margin
        for i in range(3):
            if wp.abs(y[i]) - wp.abs(h[i]) - box.size[i] > reach:
                return 0
        feature = nearest_feature(y, h, box.size)
        first = first_place(feature, y, h)
        found[0] = touch_at(first, capsule, box)
        way, ends = way_over_box(feature, h)
        if way == U(0.0):
            return 1
        found[1] = touch_at(second_place(first, y, h, box.size, way, ends), capsule, box)
        return 2

    return functions(locals())
