"""Refuse what an MJCF file has and the simulator does not support: rows of (kind, which, why) become lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from diffsim.robot.actuator import Mask, at_site, driven, on_joint, on_tendon, refused, turning
from diffsim.robot.contacts import POINTS, declared_pairs, ground_pairs, pair_law
from diffsim.robot.elements import (
    at_rest,
    disabled_flags,
    enabled_flags,
    floating,
    label,
    listed,
    mass_matrix,
    motors,
    muscles,
    numeric,
    servos,
)
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene
from diffsim.robot.types import Array

Joint = mujoco.mjtJoint
# The kind of an element, a mask of those elements or their names, and what is not simulated of them
Row = tuple[str, ArrayLike | list[str], str]

# Flags that the reader obeys, and flags that choose between MuJoCo's own numerical methods.
OBEYED = {"constraint", "contact", "damper", "equality", "frictionloss", "gravity", "limit", "passive", "spring"}
METHODS = {"autoreset", "clampctrl", "filterparent", "island", "midphase", "multiccd", "nativeccd", "refsafe", "sensor"}
METHODS |= {"eulerdamp", "warmstart"}
EXTRAS = {"diagexact", "energy", "fwdinv", "invdiscrete", "island", "multiccd", "nativeccd", "sleep"}
# Fields of a scene that may be infinite, and that are NaN where the file does not name them
UNLIMITED, UNNAMED = {"lower", "upper", "force_low", "force_high"}, PENALTY_CONSTANTS

# Arrays of MuJoCo's model that must be 0, of which only newer versions have some, finite, and not negative
ZERO = """geom_adhesion geom_surfacevel jnt_springyield jnt_stiffnesspoly dof_dampingpoly pair_adhesion
    pair_solreffriction tendon_stiffness tendon_stiffnesspoly tendon_damping tendon_dampingpoly tendon_limited
    tendon_frictionloss tendon_armature tendon_actfrclimited tendon_springyield actuator_damping actuator_dampingpoly
    actuator_armature actuator_delay""".split()
FINITE = """body_pos body_quat geom_friction geom_margin geom_gap geom_solmix geom_solref geom_solimp pair_friction
    pair_margin pair_gap pair_solref pair_solimp jnt_margin jnt_solref jnt_solimp dof_solref dof_solimp
    dof_frictionloss eq_data eq_solref eq_solimp key_qpos key_qvel key_ctrl""".split()
POSITIVE = "jnt_stiffness dof_armature dof_damping dof_frictionloss geom_friction geom_solmix pair_friction".split()
# Least pivot of the mass matrix, as a part of its diagonal, with at most so many joints from a leaf on
IDLE, SHORT = 1e-7, 8
# What a file calls them, where that is another word
WORDS = {"limited": "range", "actfrclimited": "actuatorfrcrange"}
WORDS |= {"stiffnesspoly": "a second number of stiffness", "dampingpoly": "a second number of damping"}
ELEMENTS = {"jnt": "joint", "dof": "joint", "eq": "equality"}
ON_JOINT = "motors on a hinge, a slide or one axis of a ball joint, position and velocity servos on a hinge or a slide"
ON_TENDON = "<muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push, on a tendon"
EQUALITIES = "connect", "weld", "joint"
WITHOUT_EQUALITY = 'remove it, or all of them by <flag equality="disable"/>'
ONLY_DRAWN = "; set contype and conaffinity to 0 if only drawn"


def obstacles(m: mujoco.MjModel) -> list[str]:
    """Return a line per reason with the names of all its elements; none if the file can be simulated."""
    lines = []
    for rows in (_file, _numbers, _bodies, _joints, _inertia, _tendons, _actuators, _contacts):
        for kind, which, why in rows(m):
            if not isinstance(which, list):
                element = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
                which = [label(m, element, index) for index in np.flatnonzero(which).tolist()]
            if which:
                lines.append(f"{kind} {listed(which)}: {why}")
    return lines


def strays(m: mujoco.MjModel) -> list[str]:
    """Name bodies beside the robot that touch nothing, if the file has no tendon or equality that could tie them."""
    alone = np.flatnonzero(_others(m) & ~_touching(m)).tolist()
    return [name for body in alone if (name := m.body(body).name) and not m.neq and not m.ntendon]


def beyond(scene: Scene) -> list[str]:
    """Return such a line for arrays that are not finite in the kernels' single precision."""
    names = []
    for name, values in ((field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)):
        if isinstance(values, float | np.ndarray) and np.asarray(values).dtype == np.float64:
            within = np.abs(values) <= np.finfo(np.float32).max
            within |= (name in UNLIMITED) & np.isinf(values) | (name in UNNAMED) & np.isnan(values)
            names += [name] * (not np.all(within))
    return [f"{', '.join(names)}: not finite in single precision"] if names else []


def _file(m: mujoco.MjModel) -> Iterator[Row]:
    constants = {name: numeric(m, name) for name in (*PENALTY_CONSTANTS, "muscle_strength")}
    yield "option flag", sorted(disabled_flags(m) - OBEYED - METHODS), "cannot be disabled here"
    yield "option flag", sorted(enabled_flags(m) - EXTRAS), "cannot be enabled here"
    yield "option", ["wind"] * bool(np.any(m.opt.wind)), "only a fluid at rest is simulated"
    yield "option", ["impratio"] * (not 0 < m.opt.impratio < np.inf), "must be positive and finite"
    yield "option", [name for name in ("density", "viscosity") if getattr(m.opt, name) < 0], "must not be negative"
    wrong = [name for name, values in constants.items() if len(values) > 1 or (values < 0).any()]
    yield "numeric", wrong, "must be one number, not negative"
    yield "file", ["without a joint"] * (not m.njnt), "there is nothing to simulate"
    yield "flex", np.ones(m.nflex), "deformable bodies are not simulated"
    active = m.eq_active0 != 0
    for name, kind in mujoco.mjtEq.__members__.items():
        if (word := name.removeprefix("mjEQ_").lower()) not in EQUALITIES:
            yield "equality", active & (m.eq_type == kind), f"{word} is not simulated; {WITHOUT_EQUALITY}"
    yield "equality", active & _mixed(m.eq_solref), "solref mixes a positive with another number"
    yield "plugin", np.ones(m.nplugin), "plugins are not simulated"


def _numbers(m: mujoco.MjModel) -> Iterator[Row]:
    for fields, is_wrong, why in (
        (ZERO, np.any, "is not simulated"),
        (POSITIVE, lambda each: np.any(each < 0), "must not be negative"),
        (FINITE, lambda each: not np.isfinite(each).all(), "must be finite"),
    ):
        for field in fields:
            prefix, _, name = field.partition("_")
            wrong = np.array([is_wrong(each) for each in getattr(m, field, ())], bool)
            if prefix == "dof":
                wrong = np.isin(range(m.njnt), m.dof_jntid[np.flatnonzero(wrong)])
            yield ELEMENTS.get(prefix, prefix), wrong, f"{WORDS.get(name, name)} {why}"


def _bodies(m: mujoco.MjModel) -> Iterator[Row]:
    fluid = m.opt.density > 0 or m.opt.viscosity > 0
    welded = (m.body_mass > 0) & (m.body_jntnum == 0) & (m.body_weldid > 0)
    yield "body", (m.body_mocapid >= 0) & _touching(m), f"contact of a mocap body is not simulated{ONLY_DRAWN}"
    yield "body", welded & fluid, "in a fluid each body needs a joint; merge its geoms"
    yield "geom", m.geom_fluid[:, 0] * fluid, "fluidshape ellipsoid is not simulated"


def _others(m: mujoco.MjModel) -> Mask:
    """Mark bodies below the world that have joints, beside a floating robot, or a free joint, beside any."""
    root, free = m.body_rootid[m.jnt_bodyid], m.jnt_type == Joint.mjJNT_FREE
    return np.isin(range(m.nbody), root[(root != root[:1]) & (free | free[:1])])


def _touching(m: mujoco.MjModel) -> Mask:
    """Mark bodies below the world that have, or carry, a geom that may touch another one."""
    geoms = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    geoms[[*m.pair_geom1, *m.pair_geom2]] = True
    return np.isin(range(m.nbody), m.body_rootid[m.geom_bodyid[geoms]])


def _joints(m: mujoco.MjModel) -> Iterator[Row]:
    limited, bounded = m.jnt_limited != 0, m.jnt_actfrclimited != 0
    free, ball = m.jnt_type == Joint.mjJNT_FREE, m.jnt_type == Joint.mjJNT_BALL
    armature = m.dof_armature[m.jnt_dofadr] != 0
    fluid = m.opt.density + m.opt.viscosity > 0
    pushed = (muscles(m) | at_site(m)).any()
    yield "joint", ball & limited, "the limit of a ball joint is not simulated"
    yield "joint", limited & _mixed(m.jnt_solref), "solreflimit mixes a positive with another number"
    yield "joint", bounded & pushed, "actuatorfrcrange together with muscles or actuators at sites is not simulated"
    yield "joint", bounded & (m.jnt_actgravcomp != 0), "actuatorgravcomp within actuatorfrcrange is not simulated"
    yield "joint", free & (m.jnt_stiffness != 0), "a free joint has no stiffness here; write <freejoint/>"
    yield "joint", free & armature & fluid, "armature of a free joint in a fluid is not simulated"


def _inertia(m: mujoco.MjModel) -> Iterator[Row]:
    """Find motions without inertia: pivots of the mass matrix, from the leaves on, that are as good as zero.

    In a chain of n equal links a pivot is about M_ii / n^3, so the bound follows the number of joints beyond.
    """
    matrix, idle, beyond = mass_matrix(m), np.zeros(m.nv, bool), np.ones(m.nv)
    pivots, ways = matrix.copy(), list[list[int]]()  # from each to the world
    for dof, parent in enumerate(m.dof_parentid.tolist()):
        ways.append([dof, *ways[parent]] if parent >= 0 else [dof])
    for dof in reversed(range(m.nv)):
        pivot, above = pivots[dof, dof], ways[dof][1:]
        if pivot <= IDLE * min(1.0, (SHORT / beyond[dof]) ** 3) * matrix[dof, dof]:
            near = [k for k, way in enumerate(ways) if dof in way[:SHORT]]  # of which some move against others
            scale = np.sqrt(np.maximum(matrix[near, near], 1e-300))
            shape = np.linalg.eigh(matrix[np.ix_(near, near)] / np.outer(scale, scale))[1][:, 0]
            idle[np.array(near)[np.abs(shape) > 0.1]] = True
        elif above:
            beyond[above[0]] = max(beyond[above[0]], beyond[dof] + 1)
            pivots[np.ix_(above, above)] -= np.outer(pivots[above, dof], pivots[dof, above]) / pivot
    yield "joint", np.isin(range(m.njnt), m.dof_jntid[idle]), "they have a motion without inertia"


def _tendons(m: mujoco.MjModel) -> Iterator[Row]:
    """Check tendons with actuators; a tendon without actuator and without a force of its own has no effect."""
    spatial, held = np.ones(m.ntendon, bool), np.zeros(m.nsite, bool)
    for tendon in np.unique(m.actuator_trnid[muscles(m), 0]).tolist():
        path = slice(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        spatial[tendon] = (m.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE).all()
        if spatial[tendon]:
            held[m.wrap_objid[path]] = True
    world = (m.body_weldid[m.site_bodyid] == 0) & floating(m)
    yield "tendon", ~spatial, "only fixed tendons, or spatial ones through sites, without pulleys or wrapping geoms"
    yield "site", held & world, "a muscle of a floating robot cannot hold on to the world"


def _actuators(m: mujoco.MjModel) -> Iterator[Row]:
    count = len(m.actuator_trntype)  # a PID has several of nu controls
    tendon, joint, fixed, group = muscles(m), on_joint(m), on_tendon(m), np.array(m.actuator_group)
    off = (group >= 0) & (group < 31) & ((m.opt.disableactuator >> group.clip(0, 30)) & 1 == 1)
    pulls, turns = _pulls(m, count), turning(m)
    negative = servos(m) & (m.actuator_biasprm[:count, 1:3] > 0).any(1)
    bounded, others = m.actuator_forcelimited[:count] != 0, ~tendon & ~turns & ~fixed & ~at_site(m)
    shared = joint & (np.bincount(driven(m), minlength=1)[np.where(joint, m.actuator_trnid[:count, 0], 0)] > 1)
    idle = tendon & ~motors(m) & (m.actuator_gainprm[:count, 2] < 0) & (m.actuator_acc0[:count] <= 0)
    yield "actuator", off, "its group is in actuatorgroupdisable; remove the actuator"
    yield "actuator", tendon & ~pulls, f"only {ON_TENDON}"
    found = np.array([_unlike_a_motor(m, a) for a in range(count)])
    for words in dict.fromkeys(found[others].tolist()):
        yield "actuator", others & (found == words), f"only {ON_JOINT}, or muscles on tendons, not {words}"
    yield from (("actuator", which, why) for which, why in refused(m))
    yield "actuator", (turns | fixed) & negative, "stiffness and damping of a servo must not be negative"
    yield "actuator", pulls & idle, "its force follows from what it moves, and it moves nothing; give force"
    yield "actuator", bounded & (tendon | shared), "forcerange is simulated of a joint's only actuator"


def _unlike_a_motor(m: mujoco.MjModel, a: int) -> str:
    """Name what distinguishes an actuator from a motor or servo on a hinge, in the file's words."""
    kinds = {"transmission": mujoco.mjtTrn, "dyntype": mujoco.mjtDyn, "gaintype": mujoco.mjtGain}
    numbers = m.actuator_trntype[a], m.actuator_dyntype[a], m.actuator_gaintype[a]
    for (name, kind), number, usual in zip(kinds.items(), numbers, ("joint", "none", "fixed"), strict=True):
        if (word := kind(number).name.partition("_")[2].lower()) != usual:
            return f"{name} {word}"
    return "on this joint"


def _pulls(m: mujoco.MjModel, count: int) -> Mask:
    """Mark <muscle>s, and motors that can only shorten their tendon."""
    gain, gear = m.actuator_gainprm[:count, :9], m.actuator_gear[:count, 0]
    limited = m.actuator_ctrllimited[:count, None] != 0
    low, high = np.where(limited, m.actuator_ctrlrange[:count], (0.0, 1.0)).T
    shortens = (-gear * gain[:, 0] * low >= 0) & (-gear * gain[:, 0] * high >= 0)
    muscle = (
        (m.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE)
        & (m.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE)
        & (m.actuator_biastype == mujoco.mjtBias.mjBIAS_MUSCLE)
        & (gain == m.actuator_biasprm[:count, :9]).all(1)
    )
    return np.where(motors(m), shortens, muscle & (gear == 1) & (0 <= low) & (low < high) & (high <= 1))


def _contacts(m: mujoco.MjModel) -> Iterator[Row]:
    pairs = ground_pairs(m)
    touching, shaped, mixed = np.zeros(m.ngeom, bool), np.ones(m.ngeom, bool), np.zeros(m.ngeom, bool)
    touching[[ground for ground, _ in pairs]] = True
    other = (m.geom_type != mujoco.mjtGeom.mjGEOM_PLANE) | (touching.sum() > 1)
    tilted = ~np.isclose(at_rest(m).geom_xmat[:, 2::3], [0.0, 0.0, 1.0]).all(1)
    for ground, geom in pairs:
        shaped[geom] = m.geom_type[geom] in POINTS
        mixed[geom] = _mixed(pair_law(m, ground, geom).solref)
    first, second = m.pair_friction[:, :2].T
    ends = {tuple(sorted(pair)) for pair in pairs}
    declared = np.isin(range(m.npair), [k for pair, k in declared_pairs(m).items() if pair in ends])
    yield "geom", touching & other, f"contact is simulated with one ground plane only{ONLY_DRAWN}"
    yield "geom", touching & ~other & tilted, "the ground plane must be horizontal"
    yield "geom", ~shaped, f"its shape cannot touch the ground here{ONLY_DRAWN}"
    yield "geom", mixed, "solref mixes a positive with another number"
    yield "pair", declared & (first != second), "friction differs by direction; it is isotropic here"


def _mixed(solref: Array) -> Mask:
    return (solref[..., 0] > 0) != (solref[..., 1] > 0)
