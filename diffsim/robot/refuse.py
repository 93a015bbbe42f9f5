"""What an MJCF file asks for and the simulator does not do, and numbers that no robot has, by their elements' names.

Each check lists reasons with a mask of the elements that they hold for.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.constants import (
    POINTS,
    asked,
    at_rest,
    declared_pairs,
    disabled_flags,
    enabled_flags,
    floating,
    ground_pairs,
    label,
    listed,
    mass_matrix,
    motors,
    numeric,
    pair_law,
    servos,
    text,
)
from diffsim.robot.scene import PENALTY_CONSTANTS, Array, Scene

Kind, Joint = mujoco.mjtObj, mujoco.mjtJoint
Mask = NDArray[np.bool_]
NUMERICS = (*PENALTY_CONSTANTS, "muscle_strength")
TEXTS = ("muscle_model",)

# Flags that the reader obeys, and flags that choose between MuJoCo's own numerical methods.
OBEYED = {"constraint", "contact", "damper", "equality", "frictionloss", "gravity", "limit", "passive", "spring"}
METHODS = {"autoreset", "clampctrl", "eulerdamp", "filterparent", "island", "midphase", "multiccd", "nativeccd"}
METHODS |= {"refsafe", "sensor", "warmstart"}
EXTRAS = {"diagexact", "energy", "fwdinv", "invdiscrete", "island", "multiccd", "nativeccd", "sleep"}

# Attributes of elements that are not simulated, and the arrays that are not 0 where one is set.
UNSIMULATED = {
    Kind.mjOBJ_TENDON: {
        f"{field} of a tendon": f"tendon_{field}"
        for field in ("stiffness", "damping", "limited", "frictionloss", "armature", "actfrclimited", "springyield")
    },
    Kind.mjOBJ_ACTUATOR: {
        "damping": "actuator_damping actuator_dampingpoly",
        "armature": "actuator_armature",
        "delay": "actuator_delay actuator_history",
    },
    Kind.mjOBJ_GEOM: {"adhesion": "geom_adhesion", "surfacevel": "geom_surfacevel"},
}

MASSES = (1e-4, 1e6)  # kg, of a whole robot
MOST_POINTS = 10_000  # of contact; 20 s to read
GREATEST = float(np.finfo(np.float32).max)


class Obstacle(NamedTuple):
    """Why an element keeps a file from being simulated."""

    kind: str
    name: str
    why: str


def obstacles(m: mujoco.MjModel) -> list[str]:
    """One line per reason, with the names of all elements that it holds for; empty if the file can be simulated."""
    for names in (m.names, m.text_data):
        try:
            names.decode()
        except UnicodeDecodeError as error:
            name = names[: error.end].rpartition(b"\0")[2] + names[error.end :].partition(b"\0")[0]
            return [f"names must be in UTF-8, and {name.decode('latin-1')!r} is not; save the file in that encoding"]
    return _lines(obstacle for check in (*NUMBERS, *ELEMENTS) for obstacle in check(m))


def overflows(scene: Scene) -> list[str]:
    """Likewise of actuators whose forces, products of the file's numbers, single precision does not hold."""
    names = "stiffness", "damping", "spring_ref", "servo_stiffness", "servo_damping", "servo_ref"
    springs = np.array([getattr(scene, name) for name in names])[:, scene.motor_link]
    numbers = np.column_stack((scene.gear, scene.motor_bias, *springs))
    why = f"its force is beyond single precision, {GREATEST:.2g} N at most"
    return _lines(_where(scene.mj_model, Kind.mjOBJ_ACTUATOR, {why: ~_finite(numbers).all(1)}))


def _lines(found: Iterable[Obstacle]) -> list[str]:
    lines: dict[tuple[str, str], dict[str, None]] = {}
    for kind, name, why in found:
        lines.setdefault((kind, why), {})[name] = None
    return [f"{kind} {listed(names)}: {why}" for (kind, why), names in lines.items()]


def _where(
    m: mujoco.MjModel, kind: mujoco.mjtObj, rules: Mapping[str, ArrayLike], **values: NDArray[Any]
) -> Iterator[Obstacle]:
    """The elements of a kind for which a mask of the rules is true; values fill their fields in the reasons."""
    for why, mask in rules.items():
        for index in np.flatnonzero(np.asarray(mask)).tolist():
            filled = why.format(**{key: column[index] for key, column in values.items()})
            yield Obstacle(_name(kind), label(m, kind, index), filled)


def _name(kind: mujoco.mjtObj) -> str:
    return str(kind).rsplit("mjOBJ_", 1)[-1].lower()


def _any(m: mujoco.MjModel, fields: str) -> Mask:
    """(n,) of which elements one of these arrays is not 0; some of them only newer versions of MuJoCo have."""
    there = [np.asarray(getattr(m, field)) for field in fields.split() if hasattr(m, field)]
    masks = [values.any(tuple(range(1, values.ndim))) for values in there]
    return np.logical_or.reduce(masks) if masks else np.zeros(1, bool)


# Numbers --------------------------------------------------------------------------------------------------------------


def _finite(values: ArrayLike) -> Mask:
    """Elementwise, in the single precision of the kernels."""
    return np.abs(values) <= GREATEST


def _numbers(m: mujoco.MjModel) -> dict[mujoco.mjtObj, dict[str, Array]]:
    """What must be finite, by kind and attribute; (n,) or (n, ...) each."""
    fields = {
        Kind.mjOBJ_BODY: ("body", "pos quat mass inertia ipos iquat gravcomp"),
        Kind.mjOBJ_GEOM: ("geom", "pos quat size friction solref solimp solmix margin gap"),
        Kind.mjOBJ_PAIR: ("pair", "friction solref solimp margin gap"),
        Kind.mjOBJ_SITE: ("site", "pos"),
        Kind.mjOBJ_JOINT: ("jnt", "pos axis range actfrcrange stiffness solref solimp margin"),
        Kind.mjOBJ_ACTUATOR: ("actuator", "gear ctrlrange forcerange gainprm biasprm lengthrange"),
    }
    table = {k: {f: getattr(m, f"{prefix}_{f}") for f in names.split()} for k, (prefix, names) in fields.items()}
    table[Kind.mjOBJ_JOINT] |= {"ref": m.qpos0[m.jnt_qposadr], "springref": m.qpos_spring[m.jnt_qposadr]}
    for field in ("armature", "damping", "frictionloss"):
        table[Kind.mjOBJ_JOINT][field] = getattr(m, f"dof_{field}")[m.jnt_dofadr]
    return table


def _not_finite(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for kind, fields in _numbers(m).items():
        wrong = {field: (~_finite(values)).any(tuple(range(1, values.ndim))) for field, values in fields.items()}
        yield from _where(m, kind, {f"{field} is not finite": mask for field, mask in wrong.items()})
    for field in ("gravity", "density", "viscosity"):
        if not _finite(getattr(m.opt, field)).all():
            yield Obstacle("option", field, "not finite")


def _negative(m: mujoco.MjModel) -> Iterator[Obstacle]:
    signed = {Kind.mjOBJ_JOINT: ("armature", "damping", "stiffness"), Kind.mjOBJ_GEOM: ("friction", "solmix")}
    signed |= {Kind.mjOBJ_PAIR: ("friction",), Kind.mjOBJ_BODY: ("gravcomp",)}
    for kind, field in ((kind, field) for kind, fields in signed.items() for field in fields):
        values = _numbers(m)[kind][field]
        least = values.min(tuple(range(1, values.ndim)))
        yield from _where(m, kind, {field + " is {least:g}, must not be negative": least < 0}, least=least)
    for field in ("density", "viscosity"):
        if getattr(m.opt, field) < 0:
            yield Obstacle("option", field, f"{getattr(m.opt, field):g}, must not be negative")


def _masses(m: mujoco.MjModel) -> Iterator[Obstacle]:
    moving = np.where(m.body_weldid != 0, m.body_mass, 0.0)
    if moving.any() and not MASSES[0] <= moving.sum() <= MASSES[1]:
        least, most = MASSES
        why = f"the robot weighs {moving.sum():.3g} kg, most of it here; must be {least:g} to {most:g} kg"
        yield from _where(m, Kind.mjOBJ_BODY, {why: np.arange(m.nbody) == moving.argmax()})
    if not m.nv or any(_not_finite(m)) or (m.dof_armature < 0).any():
        return
    matrix = mass_matrix(m)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0))
    shared = np.zeros(m.nv, bool)
    if np.isfinite(matrix).all() and scale.all():
        values, shapes = np.linalg.eigh(matrix / np.outer(scale, scale))
        shared = (abs(shapes[:, 0]) > 0.1) & (values[0] < 1e-7)
    for body in range(m.nbody):  # MuJoCo's matrix takes the slides of a body for independent
        slides = np.flatnonzero((m.jnt_bodyid == body) & (m.jnt_type == Joint.mjJNT_SLIDE))
        dofs = m.jnt_dofadr[slides]
        if len(slides) > np.linalg.matrix_rank(m.jnt_axis[slides], tol=1e-6) and not m.dof_armature[dofs].all():
            shared[dofs] = True
    rules = {"it moves no inertia": scale == 0, "these joints together have a motion without inertia": shared}
    joints = {why: np.isin(range(m.njnt), m.dof_jntid[mask]) for why, mask in rules.items()}
    yield from _where(m, Kind.mjOBJ_JOINT, joints)


def _names(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for kind, ours, count in ((Kind.mjOBJ_NUMERIC, NUMERICS, m.nnumeric), (Kind.mjOBJ_TEXT, TEXTS, m.ntext)):
        for index in range(count):
            name = mujoco.mj_id2name(m, kind, index)
            if name not in ours and (near := difflib.get_close_matches(name.lower(), ours, 1, 0.65)):
                why = f"not one of {', '.join(ours)}; did you mean {near[0]!r}? Else rename it"
                yield Obstacle(_name(kind), repr(name), why)
    for name in NUMERICS:
        values = numeric(m, name)
        if len(values) > 1 or not all(0 <= value <= GREATEST for value in values):
            why = f"{' '.join(f'{v:g}' for v in values)}, must be one number, finite and not negative"
            yield Obstacle("numeric", repr(name), why)
    if (model := text(m, "muscle_model", "linear")) != "linear":
        yield Obstacle("text", "'muscle_model'", f"{model!r} is not simulated; a muscle's force is linear here")


# Elements -------------------------------------------------------------------------------------------------------------


def _options(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for flag in sorted(disabled_flags(m) - OBEYED - METHODS):
        yield Obstacle("option flag", flag, "cannot be disabled here")
    for flag in sorted(enabled_flags(m) - EXTRAS):
        yield Obstacle("option flag", flag, "cannot be enabled here")
    if np.any(m.opt.wind):
        yield Obstacle("option", "wind", "only a fluid at rest is simulated")
    group = np.array(m.actuator_group)
    off = (group >= 0) & (group < 31) & ((m.opt.disableactuator >> group.clip(0, 30)) & 1 == 1)
    yield from _where(m, Kind.mjOBJ_ACTUATOR, {"its group is in actuatorgroupdisable; remove the actuator": off})


def _unsimulated(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for kind, present, what in (
        (Kind.mjOBJ_EQUALITY, m.eq_active0, "equality constraints"),
        (Kind.mjOBJ_FLEX, np.ones(m.nflex), "deformable bodies"),
        (Kind.mjOBJ_PLUGIN, np.ones(m.nplugin), "plugins"),
    ):
        yield from _where(m, kind, {f"{what} are not simulated": present})
    for kind, attributes in UNSIMULATED.items():
        rules = {f"{attribute} is not simulated": _any(m, fields) for attribute, fields in attributes.items()}
        yield from _where(m, kind, rules)


def _bodies(m: mujoco.MjModel) -> Iterator[Obstacle]:
    if not m.njnt:
        yield Obstacle("file", "without a joint", "there is nothing to simulate")
    second = np.zeros(m.nbody, bool)
    if (m.jnt_type == Joint.mjJNT_FREE)[:1].any():
        others = m.jnt_bodyid[m.jnt_type != Joint.mjJNT_FREE]
        second[others] = m.body_rootid[others] != m.body_rootid[m.jnt_bodyid[0]]
    fluid = m.opt.density > 0 or m.opt.viscosity > 0
    welded = (m.body_mass > 0) & (m.body_jntnum == 0) & (m.body_weldid > 0)
    rules = {
        "mocap is not simulated": m.body_mocapid >= 0,
        "a second base beside a floating one": second,
        "in a fluid each body needs a joint; merge its geoms": welded & fluid,
    }
    yield from _where(m, Kind.mjOBJ_BODY, rules)
    yield from _where(m, Kind.mjOBJ_GEOM, {"fluidshape ellipsoid is not simulated": m.geom_fluid[:, 0] * fluid})


def _joints(m: mujoco.MjModel) -> Iterator[Obstacle]:
    dof, limited, (low, high) = m.jnt_dofadr, m.jnt_limited != 0, m.jnt_range.T
    free, ball = m.jnt_type == Joint.mjJNT_FREE, m.jnt_type == Joint.mjJNT_BALL
    loss = m.dof_frictionloss[dof]
    inertial = (m.dof_armature[dof] != 0) & (m.opt.density + m.opt.viscosity > 0)
    compensated = m.jnt_actgravcomp & m.jnt_actfrclimited
    first = (np.arange(m.njnt) == 0) & (m.body_parentid[m.jnt_bodyid] == 0)
    plastic = np.asarray(getattr(m, "jnt_plasticadr", -1)) >= 0
    tendons = (m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON).any()
    curved = np.isin(range(m.njnt), m.dof_jntid[np.flatnonzero(_any(m, "dof_dampingpoly"))])
    rules = {
        "damping and stiffness are linear here, one number each": curved | _any(m, "jnt_stiffnesspoly"),
        "springs that yield are not simulated": _any(m, "jnt_springyield") | plastic,
        "frictionloss {loss:g} is negative": loss < 0,
        "the limit of a ball joint is not simulated": ball & limited,
        "actuatorfrcrange beside muscles is not simulated": (m.jnt_actfrclimited != 0) & tendons,
        "a free joint has no stiffness or frictionloss here": free & ((m.jnt_stiffness != 0) | (loss != 0)),
        "armature of a free joint in a fluid is not simulated": free & inertial,
        "actuatorgravcomp within actuatorfrcrange is not simulated": compensated,
        "one free joint, of the first moving body, is simulated": free & ~first,
        "range {low:g} {high:g} is empty": (low >= high) & ((low != 0) | (high != 0)),
    }
    yield from _where(m, Kind.mjOBJ_JOINT, rules, low=low, high=high, loss=loss)
    wrong = np.array([_wrong(solref) for solref in m.jnt_solref], str)
    yield from _where(m, Kind.mjOBJ_JOINT, {"solreflimit {wrong}": limited & (wrong != "")}, wrong=wrong)


def _tendons(m: mujoco.MjModel) -> Iterator[Obstacle]:
    """One without force of its own and without actuator has no effect, whatever its path."""
    spatial, held = np.ones(m.ntendon, bool), np.zeros(m.nsite, bool)
    for tendon in np.unique(m.actuator_trnid[m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]).tolist():
        path = slice(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        spatial[tendon] = (m.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE).all()
        if spatial[tendon]:
            held[m.wrap_objid[path]] = True
    world = (m.body_weldid[m.site_bodyid] == 0) & floating(m)
    why = "only spatial tendons through sites, without pulleys or wrapping geoms"
    yield from _where(m, Kind.mjOBJ_TENDON, {why: ~spatial})
    yield from _where(m, Kind.mjOBJ_SITE, {"a muscle of a floating robot cannot hold on to the world": held & world})


ON_JOINT = "motors on a hinge, a slide or one axis of a ball joint, position and velocity servos on a hinge or a slide"
ON_TENDON = "<muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push, on a tendon"


def _actuators(m: mujoco.MjModel) -> Iterator[Obstacle]:
    count = len(m.actuator_trntype)  # a PID has several of nu controls
    tendon, motor = m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, motors(m)
    pulls, turns = _pulls(m, count), _turns(m)
    low, high = m.actuator_ctrlrange[:count].T
    stiffness, damping = np.where(servos(m), -m.actuator_biasprm[:count, 1:3].T, 0.0)
    bounded, joint = m.actuator_forcelimited[:count] != 0, np.where(tendon, -1, m.actuator_trnid[:count, 0])
    shared = (joint[:, None] == joint).sum(1) > 1
    idle = tendon & ~motor & (m.actuator_gainprm[:count, 2] < 0) & (m.actuator_acc0[:count] <= 0)
    rules = {
        f"only {ON_TENDON}": tendon & ~pulls,
        f"only {ON_JOINT}, without activation dynamics, or muscles on tendons": ~tendon & ~turns,
        "its stiffness (minus biasprm's second number) is {stiffness:g}, must not be negative": turns & (stiffness < 0),
        "its damping (minus biasprm's third number) is {damping:g}, must not be negative": turns & (damping < 0),
        "forcerange of what pulls a tendon is not simulated": tendon & bounded,
        "forcerange is simulated of a joint's only actuator": turns & bounded & shared,
        "its force follows from what it moves, and it moves nothing; give force": pulls & idle,
        "ctrlrange {low:g} {high:g} is empty": (low >= high) & ((low != 0) | (high != 0)),
    }
    yield from _where(m, Kind.mjOBJ_ACTUATOR, rules, low=low, high=high, stiffness=stiffness, damping=damping)


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


def _contacts(m: mujoco.MjModel) -> Iterator[Obstacle]:
    data, pairs = at_rest(m), ground_pairs(m)
    touching = np.zeros(m.ngeom, bool)
    touching[[ground for ground, _ in pairs]] = True
    plane, only_drawn = m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, "; set contype and conaffinity to 0 if only drawn"
    other = ~plane | (touching.sum() > 1)
    tilted = ~np.isclose(data.geom_xmat[:, 2::3], [0.0, 0.0, 1.0]).all(1)
    one_plane = f"contact is simulated with one ground plane only{only_drawn}"
    rules = {one_plane: touching & other, "the ground plane must be horizontal": touching & ~other & tilted}
    yield from _where(m, Kind.mjOBJ_GEOM, rules)
    points = sum(len(POINTS.get(m.geom_type[geom], ())) for _, geom in pairs)
    if points > MOST_POINTS:
        yield Obstacle("contact", f"{points} points", f"at most {MOST_POINTS} are simulated{only_drawn}")
        return
    laws = {geom: pair_law(m, ground, geom) for ground, geom in pairs}
    geoms = list(laws)
    wrong, shaped = np.full(m.ngeom, "", "U80"), np.ones(m.ngeom, bool)
    wrong[geoms] = [_wrong(law.solref) for law in laws.values()]
    shaped[geoms] = np.isin(m.geom_type[geoms], list(POINTS))
    rules = {f"its shape cannot touch the ground here{only_drawn}": ~shaped, "solref {wrong}": wrong != ""}
    yield from _where(m, Kind.mjOBJ_GEOM, rules, wrong=wrong)
    ends = {tuple(sorted(pair)) for pair in pairs}
    on_ground = np.array([k for pair, k in declared_pairs(m).items() if pair in ends], int)
    first, second = m.pair_friction[:, :2].T
    rules = {
        "friction {first:g} {second:g} differs by direction; it is isotropic here": first != second,
        "solreffriction is not simulated": m.pair_solreffriction.any(1),
    }
    rules = {why: mask & np.isin(range(m.npair), on_ground) for why, mask in rules.items()}
    yield from _where(m, Kind.mjOBJ_PAIR, rules, first=first, second=second)


def _wrong(solref: ArrayLike) -> str:
    """What is wrong with a solref, if anything."""
    first, second = np.asarray(solref).tolist()
    if (first > 0) != (second > 0):
        return "mixes a positive with another number"
    return "" if _finite(asked((first, second))).all() else "is beyond single precision; MuJoCo's default is 0.02 1"


NUMBERS = _not_finite, _negative, _masses, _names
ELEMENTS = _options, _unsimulated, _bodies, _joints, _tendons, _actuators, _contacts
