"""Geoms and their contacts in one environment, the values that the functions of geometry take and return.

These functions know neither Model nor blocks of environments: geoms.py calls them for each environment of a block.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from diffsim.kernels.thread.model import struct


@cache
def geom_types(U: type) -> SimpleNamespace:
    """Make the structs of geoms and of their contacts in one environment, with numbers of this type."""
    vec2, vec3, vec4 = (wp.types.vector(n, U) for n in (2, 3, 4))
    mat3 = wp.types.matrix((3, 3), U)
    structs = {
        # A sphere, capsule or box
        "Geom": {
            "x": vec3,  # m, centre
            "R": mat3,  # orientation
            "size": vec3,  # m, as MuJoCo's: radius, half the length and 0, or half lengths of a box
        },
        # A contact of two geoms, and what its adjoint needs (touch_adjoint.py)
        "Touch": {
            "p": vec3,  # m, the contact point
            "n": vec3,  # the normal, from the first geom to the second
            "dist": U,  # m, distance of the surfaces, less than 0 if they overlap
            "z": vec3,  # m, of two boxes the corner of a clipped face, or the point on the first one's edge
            "a": vec3,  # of a corner; half the edge of the first box; ds/dy of a capsule on a box
            "b": vec3,  # of a corner; half the edge of the second box; ds/dh
            "how": vec4,  # see the functions that return it
        },
    }
    kinds = {name: struct(name, members) for name, members in structs.items()}
    return SimpleNamespace(**kinds, Touches=wp.array(dtype=kinds["Touch"]), vec2=vec2, vec3=vec3, vec4=vec4, mat3=mat3)
