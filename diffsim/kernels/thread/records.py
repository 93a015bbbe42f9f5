"""Structs of MuJoCo's constraints: what the kernels keep of contacts, of Newton's method and of rows between bodies."""

from collections.abc import Callable
from typing import Any

import numpy as np

from diffsim.kernels.thread.spec import KernelSpec

# Fields of Model with rows between bodies (robot/pairs.py), as FIELDS of model.py; those of ends have two elements of a
# block, its first and its second end
PAIR_FIELDS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    f"row_{name}": (kind, lambda n, name=name: getattr(n.scene.pairs, name))
    for name, kind in (
        ("kind", "ints"),  # of each block
        ("touch", "ints"),  # kind of two geoms
        ("partner", "ints"),  # the block that shares its violation, or itself
        ("params", "vec11s"),  # as rows of robot.types.Constraints
        ("polycoef", "vec5s"),  # of a joint
        ("torquescale", "reals"),  # of a turn
        ("reach_sq", "reals"),  # m^2, square of the distance of two geoms' centres within which they may touch
    )
}
PAIR_FIELDS["row_link"] = "ints", lambda n: slots_of(n, n.scene.pairs.link).flat  # slot of each end's link
PAIR_FIELDS["row_ref"] = "reals", lambda n: n.scene.pairs.ref.flat  # q_0 of its joint
PAIR_FIELDS["row_point"] = "vec3s", lambda n: n.scene.pairs.point.reshape(-1, 3)  # m, in its link's frame
PAIR_FIELDS["row_frame"] = "mat3s", lambda n: n.scene.pairs.frame.reshape(-1, 3, 3)  # orientation, in that frame
PAIR_FIELDS["row_size"] = "vec3s", lambda n: n.scene.pairs.size.reshape(-1, 3)  # m, of a geom as MuJoCo's
PAIR_FIELDS["row_place"] = "ints", lambda n: n.scene.pairs.places[1].flat  # of each end, in the following two
PAIR_FIELDS["place_link"] = "ints", lambda n: slots_of(n, n.scene.pairs.places[0][:, 0])
PAIR_FIELDS["place_point"] = "vec3s", lambda n: n.scene.pairs.places[0][:, 1:]  # m, in the link's frame
# Fields of Model with actuators on fixed tendons or at sites (robot/actuator.py); such scenes have one lane
TRANSMISSION_FIELDS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    name: (kind, lambda n, field=field: getattr(n.scene.transmissions, field))
    for name, kind, field in (
        ("tendon_actuator", "ints", "tendon"),
        ("tendon_law", "vec4s", "law"),  # stiffness, damping, and bounds of the force
        ("tendon_begin", "ints", "begin"),  # of each tendon, in the next two
        ("tendon_slot", "ints", "link"),
        ("tendon_coef", "reals", "coef"),
        ("tendon_chain", "ints", "chain"),
        ("site_actuator", "ints", "site"),
        ("site_slot", "ints", "site_link"),
        ("site_torque", "vec3s", "torque"),  # in the link's frame, about its origin, per force of the actuator
        ("site_force", "vec3s", "force"),
    )
}
OPTIONAL_FIELDS = {"pairs": PAIR_FIELDS, "transmissions": TRANSMISSION_FIELDS}  # by the part of Scene that has them


def parts_of(spec: KernelSpec) -> tuple[str, ...]:
    """Name the parts in OPTIONAL_FIELDS of a specification's scenes."""
    used = spec.pairs > 0, bool(spec.features & {"tendon", "site"})
    return tuple(part for part, there in zip(OPTIONAL_FIELDS, used, strict=True) if there)


def slots_of(entries: Any, link: np.ndarray) -> np.ndarray:
    """Return the slots of links; beside a floating base the world, -1, has one of its own."""
    return np.where(link < 0, entries.scene.nlink, link)


def add_constraints(
    structs: dict[str, dict[str, Any]],
    spec: KernelSpec,
    T: type,
    vec3: type,
    vec4: type,
    vec6: type,
    mat3: type,
    mat6: type,
) -> None:
    """Add the constraints' own structs, and the members that other ones have with them, by their names and types."""
    structs |= {
        # Newton's method of an environment
        "Newton": {
            "tolerance": T,  # of the residual
            "active": T,  # 1 until the environment has converged, then 0
            "residual_sq": T,  # square of the residual
            "accel_sq": T,  # 1 plus the square of the acceleration
            "passes": int,  # so far
        },
        # Constraints after a trial step alpha s, whose forces f are linearised to f - H s: sums over their rows
        "Trial": {
            "slope": T,  # s . (f - alpha H s - f(alpha s)), the part of the cost's slope that is not linear
            "linear": T,  # s . H s
            "curvature": T,  # s . H(alpha s) s
            "error_sq": T,  # square of that difference of forces as an acceleration
            "stiffness": T,  # ratio of contact stiffness to inertia
        },
        # A contact with MuJoCo's law
        "Contact": {
            "p": vec3,  # the contact point, about the carrier
            "jar": vec3,  # J a - aref of the iterate
            "f": vec3,  # force of the iterate
            "trial_jar": vec3,  # jar after the trial step
            "trial_force": vec3,  # force after the trial step
            "Hs": vec3,  # H of the iterate times the step
            "H": mat3,  # minus the force's derivatives in jar, of the last trial step
            "D": T,  # inverse of the regularised inertia
            "active": T,  # 1 within the margin
            "sphere": int,  # of the ground's contacts, which are listed in the order of the spheres
            # The same element of the last substep's list
            "last_sphere": int,
            "last_active": T,
            "last_jar": vec3,
        },
    }
    structs["Lane"] |= {"contacts": int}  # number of contacts with the ground, also of those without room
    if "tendon_damping" in spec.features:
        for name in ("Motion", "Node"):
            structs[name] |= {"tendon_damping": T}  # of the joint, implicit, by tendons; the base's of a whole chain
    if spec.framed or spec.pairs:
        structs["Contact"] |= {"E": mat3}  # the frame of jar, forces and H
    if spec.constrained:
        structs["Node"] |= {
            "B": vec6,  # sum of S qacc, the twist that gives J a (mujoco/impedance.py)
            "qacc": T,  # the joint's acceleration before damping
        }
        structs["Adjoint"] |= {"b": vec6}  # B
        structs["Motion"] |= {
            "accel_link": vec6,  # acceleration of the link, of Newton's iterate
            "contacts_begin": int,  # of the link's contacts in their list
            "contacts_end": int,
            "limit": vec3,  # the limit's row, see limits.limit_state
            "accel_joint": T,  # acceleration of the joint, of Newton's iterate
            "free_force": T,  # force of the joint without constraints
            "con_force": T,  # force of its constraints
            "con_slope": T,  # minus the derivative of con_force
            "trial_force": T,  # con_force after the trial step
            "trial_slope": T,  # con_slope after the trial step
        }
    if spec.damped:
        structs["Node"] |= {
            "D": vec6,  # what damping adds to B
            "W1": vec6,  # twist under lambda of the damped solve
        }
        structs["Adjoint"] |= {
            "d": vec6,  # D
            "w1": vec6,  # W1
        }
    if spec.pairs:
        # A block of rows between two bodies, see rows.py; p is its point on the second one
        structs["Contact"] |= {
            "row": int,  # its index in Model's rows
            "q": vec3,  # its point on the first one
            "r": T,  # of two geoms, their distance less the margin
            "slope": T,  # of a joint's row, the ratio of the two joints' velocities
            "residual": vec3,  # of the conjugate gradients, as forces of the rows
            "direction": vec3,  # of their search, as such forces
            "rate": vec3,  # acceleration of the rows by the direction
            "change": vec3,  # of the forces, by the step
        }
        structs["Lane"] |= {
            "begin": int,  # the first block's element of contacts
            "end": int,  # the element after the last block that acts in the substep
        }
        if "geoms_rows" in spec.features:
            structs["Contact"] |= {"how": vec4}  # of two geoms, as Touch, here and below
        if spec.pair_sizes.most > 1:
            structs["Contact"] |= {"z": vec3, "a": vec3, "b": vec3}
    if spec.branched:
        work = {
            "twist": vec6,  # of the link, by the forces of rows between bodies; in the inward sweep the bias force
            "rate": T,  # of its joint
        }
        structs["Motion"] |= work
        structs["Node"] |= {"U": vec6, "dinv": T} | work  # the factor as in Motion
        structs["Root"] |= {"L": mat6}  # Cholesky factor of the base's articulated inertia
