"""What an MJCF file asks for and the simulator does not do: rows of (kind, which, why), which become lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.contact import POINTS, declared_pairs, ground_pairs, pair_law
from diffsim.robot.elements import (
    at_rest,
    disabled_flags,
    enabled_flags,
    floating,
    label,
    listed,
    mass_matrix,
    motors,
    numeric,
    servos,
)
from diffsim.robot.scene import PENALTY_CONSTANTS, Array, Scene

Kind, Joint = mujoco.mjtObj, mujoco.mjtJoint
Mask = NDArray[np.bool_]
# The kind of an element, a mask of those elements or their names, and what is not simulated of them
Row = tuple[mujoco.mjtObj | str, ArrayLike, str]

# Flags that the reader obeys, and flags that choose between MuJoCo's own numerical methods.
OBEYED = {"constraint", "contact", "damper", "equality", "frictionloss", "gravity", "limit", "passive", "spring"}
METHODS = {"autoreset", "clampctrl", "eulerdamp", "filterparent", "island", "midphase", "multiccd", "nativeccd"}
METHODS |= {"refsafe", "sensor", "warmstart"}
EXTRAS = {"diagexact", "energy", "fwdinv", "invdiscrete", "island", "multiccd", "nativeccd", "sleep"}
# Fields of a scene that may be infinite, and that are NaN where the file does not name them
UNLIMITED, UNNAMED = {"lower", "upper", "force_low", "force_high"}, PENALTY_CONSTANTS


def obstacles(m: mujoco.MjModel) -> list[str]:
    """One line per reason, with the names of all elements that it holds for; empty if the file can be simulated."""
    lines = []
    for rows in (_file, _bodies, _joints, _inertia, _tendons, _actuators, _contacts):
        for kind, which, why in rows(m):
            if isinstance(kind, str):
                names = list(map(str, np.atleast_1d(which)))
            else:
                names = [label(m, kind, index) for index in np.flatnonzero(which).tolist()]
                kind = str(kind).rsplit("mjOBJ_", 1)[-1].lower()
            if names:
                lines.append(f"{kind} {listed(names)}: {why}")
    return lines


def beyond(scene: Scene) -> list[str]:
    """Likewise of arrays whose numbers are none, or too large for the kernels' single precision."""
    names = []
    for name, values in ((field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)):
        if isinstance(values, float | np.ndarray) and np.asarray(values).dtype == np.float64:
            within = np.abs(values) <= np.finfo(np.float32).max
            within |= (name in UNLIMITED) & np.isinf(values) | (name in UNNAMED) & np.isnan(values)
            names += [name] * (not np.all(within))
    return [f"{', '.join(names)}: not finite in single precision"] if names else []


def _any(m: mujoco.MjModel, fields: str) -> Mask:
    """(n,) of which elements one of these arrays is not 0; some of them only newer versions of MuJoCo have."""
    there = [np.asarray(getattr(m, field)) for field in fields.split() if hasattr(m, field)]
    masks = [values.any(tuple(range(1, values.ndim))) for values in there]
    return np.logical_or.reduce(masks) if masks else np.zeros(1, bool)


def _file(m: mujoco.MjModel) -> Iterator[Row]:
    group = np.array(m.actuator_group)
    off = (group >= 0) & (group < 31) & ((m.opt.disableactuator >> group.clip(0, 30)) & 1 == 1)
    constants = {name: numeric(m, name) for name in (*PENALTY_CONSTANTS, "muscle_strength")}
    wrong = [name for name, values in constants.items() if len(values) > 1 or (values < 0).any()]
    yield "option flag", sorted(disabled_flags(m) - OBEYED - METHODS), "cannot be disabled here"
    yield "option flag", sorted(enabled_flags(m) - EXTRAS), "cannot be enabled here"
    yield "option", ["wind"] * bool(np.any(m.opt.wind)), "only a fluid at rest is simulated"
    fluid = [name for name in ("density", "viscosity") if getattr(m.opt, name) < 0]
    yield "option", fluid, "must not be negative"
    yield "numeric", wrong, "must be one number, not negative"
    yield "file", ["without a joint"] * (not m.njnt), "there is nothing to simulate"
    yield Kind.mjOBJ_EQUALITY, m.eq_active0, "equality constraints are not simulated"
    yield Kind.mjOBJ_FLEX, np.ones(m.nflex), "deformable bodies are not simulated"
    yield Kind.mjOBJ_PLUGIN, np.ones(m.nplugin), "plugins are not simulated"
    yield Kind.mjOBJ_ACTUATOR, off, "its group is in actuatorgroupdisable; remove the actuator"


def _bodies(m: mujoco.MjModel) -> Iterator[Row]:
    second = np.zeros(m.nbody, bool)
    if (m.jnt_type == Joint.mjJNT_FREE)[:1].any():
        others = m.jnt_bodyid[m.jnt_type != Joint.mjJNT_FREE]
        second[others] = m.body_rootid[others] != m.body_rootid[m.jnt_bodyid[0]]
    fluid = m.opt.density > 0 or m.opt.viscosity > 0
    welded = (m.body_mass > 0) & (m.body_jntnum == 0) & (m.body_weldid > 0)
    yield Kind.mjOBJ_BODY, m.body_mocapid >= 0, "mocap is not simulated"
    yield Kind.mjOBJ_BODY, second, "a second base beside a floating one"
    yield Kind.mjOBJ_BODY, welded & fluid, "in a fluid each body needs a joint; merge its geoms"
    yield Kind.mjOBJ_GEOM, m.geom_fluid[:, 0] * fluid, "fluidshape ellipsoid is not simulated"
    yield Kind.mjOBJ_GEOM, _any(m, "geom_adhesion"), "adhesion is not simulated"
    yield Kind.mjOBJ_GEOM, _any(m, "geom_surfacevel"), "surfacevel is not simulated"


def _joints(m: mujoco.MjModel) -> Iterator[Row]:
    kind, dof, limited = Kind.mjOBJ_JOINT, m.jnt_dofadr, m.jnt_limited != 0
    free, ball = m.jnt_type == Joint.mjJNT_FREE, m.jnt_type == Joint.mjJNT_BALL
    armature, damping, loss = (getattr(m, f"dof_{name}")[dof] for name in ("armature", "damping", "frictionloss"))
    fluid = m.opt.density + m.opt.viscosity > 0
    first = (np.arange(m.njnt) == 0) & (m.body_parentid[m.jnt_bodyid] == 0)
    plastic = np.asarray(getattr(m, "jnt_plasticadr", -1)) >= 0
    tendons = (m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON).any()
    curved = np.isin(range(m.njnt), m.dof_jntid[np.flatnonzero(_any(m, "dof_dampingpoly"))])
    negative = np.minimum.reduce((m.jnt_stiffness, armature, damping, loss)) < 0
    bounded = m.jnt_actfrclimited != 0
    yield kind, negative, "armature, damping, stiffness and frictionloss must not be negative"
    yield kind, curved | _any(m, "jnt_stiffnesspoly"), "damping and stiffness are linear here, one number each"
    yield kind, _any(m, "jnt_springyield") | plastic, "springs that yield are not simulated"
    yield kind, ball & limited, "the limit of a ball joint is not simulated"
    yield kind, limited & _mixed(m.jnt_solref), "solreflimit mixes a positive with another number"
    yield kind, bounded & tendons, "actuatorfrcrange beside muscles is not simulated"
    yield kind, bounded & (m.jnt_actgravcomp != 0), "actuatorgravcomp within actuatorfrcrange is not simulated"
    yield kind, free & ((m.jnt_stiffness != 0) | (loss != 0)), "a free joint has no stiffness or frictionloss here"
    yield kind, free & (armature != 0) & fluid, "armature of a free joint in a fluid is not simulated"
    yield kind, free & ~first, "one free joint, of the first moving body, is simulated"


def _inertia(m: mujoco.MjModel) -> Iterator[Row]:
    matrix = mass_matrix(m) if m.nv else np.eye(0)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0))
    shared = np.zeros(m.nv, bool)
    if np.isfinite(matrix).all() and scale.all() and m.nv:
        values, shapes = np.linalg.eigh(matrix / np.outer(scale, scale))
        shared[:] = (abs(shapes[:, 0]) > 0.1) & (values[0] < 1e-7)
    joints = np.arange(m.njnt)
    yield Kind.mjOBJ_JOINT, np.isin(joints, m.dof_jntid[scale == 0]), "it moves no inertia"
    yield Kind.mjOBJ_JOINT, np.isin(joints, m.dof_jntid[shared]), "these joints together have a motion without inertia"


def _tendons(m: mujoco.MjModel) -> Iterator[Row]:
    """One without force of its own and without actuator has no effect, whatever its path."""
    for name in ("stiffness", "damping", "limited", "frictionloss", "armature", "actfrclimited", "springyield"):
        yield Kind.mjOBJ_TENDON, _any(m, f"tendon_{name}"), f"{name} of a tendon is not simulated"
    spatial, held = np.ones(m.ntendon, bool), np.zeros(m.nsite, bool)
    for tendon in np.unique(m.actuator_trnid[m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]).tolist():
        path = slice(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        spatial[tendon] = (m.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE).all()
        if spatial[tendon]:
            held[m.wrap_objid[path]] = True
    world = (m.body_weldid[m.site_bodyid] == 0) & floating(m)
    yield Kind.mjOBJ_TENDON, ~spatial, "only spatial tendons through sites, without pulleys or wrapping geoms"
    yield Kind.mjOBJ_SITE, held & world, "a muscle of a floating robot cannot hold on to the world"


ON_JOINT = "motors on a hinge, a slide or one axis of a ball joint, position and velocity servos on a hinge or a slide"
ON_TENDON = "<muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push, on a tendon"


def _actuators(m: mujoco.MjModel) -> Iterator[Row]:
    kind, count = Kind.mjOBJ_ACTUATOR, len(m.actuator_trntype)  # a PID has several of nu controls
    tendon, motor = m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, motors(m)
    pulls, turns = _pulls(m, count), _turns(m)
    negative = servos(m) & (m.actuator_biasprm[:count, 1:3] > 0).any(1)
    bounded, joint = m.actuator_forcelimited[:count] != 0, np.where(tendon, -1, m.actuator_trnid[:count, 0])
    shared = (joint[:, None] == joint).sum(1) > 1
    idle = tendon & ~motor & (m.actuator_gainprm[:count, 2] < 0) & (m.actuator_acc0[:count] <= 0)
    for name, fields in {"damping": "damping actuator_dampingpoly", "armature": "armature", "delay": "delay"}.items():
        yield kind, _any(m, f"actuator_{fields}"), f"{name} is not simulated"
    yield kind, tendon & ~pulls, f"only {ON_TENDON}"
    yield kind, ~tendon & ~turns, f"only {ON_JOINT}, without activation dynamics, or muscles on tendons"
    yield kind, turns & negative, "stiffness and damping of a servo must not be negative"
    yield kind, tendon & bounded, "forcerange of what pulls a tendon is not simulated"
    yield kind, turns & bounded & shared, "forcerange is simulated of a joint's only actuator"
    yield kind, pulls & idle, "its force follows from what it moves, and it moves nothing; give force"


def _turns(m: mujoco.MjModel) -> Mask:
    """Motors and servos of a hinge or of a slide, and motors of one axis of a ball joint."""
    turns = (motors(m) | servos(m)) & (m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    found = np.flatnonzero(turns)
    kind, axes = m.jnt_type[m.actuator_trnid[found, 0]], np.count_nonzero(m.actuator_gear[found, :3], axis=1)
    turns[found] = np.where(kind == Joint.mjJNT_BALL, motors(m)[found] & (axes <= 1), kind != Joint.mjJNT_FREE)
    return turns


def _pulls(m: mujoco.MjModel, count: int) -> Mask:
    """A <muscle>, or a motor that can only shorten its tendon."""
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
    data, pairs, only_drawn = at_rest(m), ground_pairs(m), "; set contype and conaffinity to 0 if only drawn"
    touching, shaped, mixed = np.zeros(m.ngeom, bool), np.ones(m.ngeom, bool), np.zeros(m.ngeom, bool)
    touching[[ground for ground, _ in pairs]] = True
    other = (m.geom_type != mujoco.mjtGeom.mjGEOM_PLANE) | (touching.sum() > 1)
    tilted = ~np.isclose(data.geom_xmat[:, 2::3], [0.0, 0.0, 1.0]).all(1)
    for ground, geom in pairs:
        shaped[geom] = m.geom_type[geom] in POINTS
        mixed[geom] = _mixed(pair_law(m, ground, geom).solref)
    negative = (m.geom_friction.min(1) < 0) | (m.geom_solmix < 0)
    ends = {tuple(sorted(pair)) for pair in pairs}
    declared = np.isin(range(m.npair), [k for pair, k in declared_pairs(m).items() if pair in ends])
    yield Kind.mjOBJ_GEOM, negative, "friction and solmix must not be negative"
    yield Kind.mjOBJ_GEOM, touching & other, f"contact is simulated with one ground plane only{only_drawn}"
    yield Kind.mjOBJ_GEOM, touching & ~other & tilted, "the ground plane must be horizontal"
    yield Kind.mjOBJ_GEOM, ~shaped, f"its shape cannot touch the ground here{only_drawn}"
    yield Kind.mjOBJ_GEOM, mixed, "solref mixes a positive with another number"
    first, second = m.pair_friction[:, :2].T
    yield Kind.mjOBJ_PAIR, declared & (m.pair_friction.min(1) < 0), "friction must not be negative"
    yield Kind.mjOBJ_PAIR, declared & (first != second), "friction differs by direction; it is isotropic here"
    yield Kind.mjOBJ_PAIR, declared & m.pair_solreffriction.any(1), "solreffriction is not simulated"


def _mixed(solref: Array) -> Mask:
    return (solref[..., 0] > 0) != (solref[..., 1] > 0)
