"""What an MJCF file asks for and the simulator does not do, and numbers that no robot has, by their elements' names."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.constants import mass_matrix
from diffsim.robot.ground import disabled_flags, enabled_flags, ground_pairs, pair_law
from diffsim.robot.scene import MUSCLE_MODELS, PENALTY_CONSTANTS

Kind = mujoco.mjtObj
NUMERICS = (*PENALTY_CONSTANTS, "muscle_strength")
TEXTS = ("muscle_model",)

# Flags that the reader obeys, and flags that choose between MuJoCo's own numerical methods.
OBEYED = {"constraint", "contact", "damper", "equality", "frictionloss", "gravity", "limit", "passive", "spring"}
METHODS = {"autoreset", "clampctrl", "eulerdamp", "filterparent", "island", "midphase", "multiccd", "nativeccd"}
METHODS |= {"refsafe", "sensor", "warmstart"}
EXTRAS = {"diagexact", "energy", "fwdinv", "invdiscrete", "island", "multiccd", "nativeccd", "sleep"}

MASSES = (1e-4, 1e6)  # kg, of a whole robot


class Obstacle(NamedTuple):
    """Why an element keeps a file from being simulated."""

    kind: str
    name: str
    why: str


def obstacles(m: mujoco.MjModel) -> list[str]:
    """One line per reason, with the names of all elements that it holds for; empty if the file can be simulated."""
    lines: dict[tuple[str, str], dict[str, None]] = {}
    for check in CHECKS:
        for kind, name, why in check(m):
            lines.setdefault((kind, why), {})[name] = None
    return [f"{kind} {', '.join(names)}: {why}" for (kind, why), names in lines.items()]


def label(m: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    """The quoted name of an element, or its number and its body's name."""
    if name := mujoco.mj_id2name(m, kind, index):
        return repr(name)
    bodies = {Kind.mjOBJ_GEOM: m.geom_bodyid, Kind.mjOBJ_JOINT: m.jnt_bodyid, Kind.mjOBJ_SITE: m.site_bodyid}
    body = mujoco.mj_id2name(m, Kind.mjOBJ_BODY, bodies[kind][index]) if kind in bodies else ""
    return f"number {index}" + (f" of body {body!r}" if body else "")


def is_motor(m: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator's force is its control times a constant."""
    return bool(
        m.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE
        and m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
        and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    )


def text(m: mujoco.MjModel, name: str, default: str) -> str:
    """The <custom><text> of that name."""
    index = mujoco.mj_name2id(m, Kind.mjOBJ_TEXT, name)
    return m.text_data[m.text_adr[index] :].partition(b"\0")[0].decode() if index >= 0 else default


def _of(m: mujoco.MjModel, kind: mujoco.mjtObj, index: int, why: str) -> Obstacle:
    return Obstacle(str(kind).rsplit("mjOBJ_", 1)[-1].lower(), label(m, kind, index), why)


def _any(m: mujoco.MjModel, field: str, index: int) -> bool:
    """Whether a field that only newer versions of MuJoCo have is set."""
    return bool(np.any(getattr(m, field)[index])) if hasattr(m, field) else False


# Numbers


FINITE = {
    Kind.mjOBJ_BODY: ("body", ("pos", "quat", "mass", "inertia", "ipos", "iquat")),
    Kind.mjOBJ_GEOM: ("geom", ("pos", "quat", "size", "friction", "solref", "margin")),
    Kind.mjOBJ_SITE: ("site", ("pos",)),
    Kind.mjOBJ_JOINT: ("jnt", ("pos", "axis", "range", "stiffness", "solref", "margin")),
    Kind.mjOBJ_ACTUATOR: ("actuator", ("gear", "ctrlrange", "gainprm", "biasprm", "lengthrange")),
}


def _finite(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Elementwise, in the single precision of the kernels."""
    within: NDArray[np.bool_] = np.abs(values) <= np.finfo(np.float32).max
    return within


def _not_finite(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for kind, (prefix, fields) in FINITE.items():
        for field in fields:
            values = np.asarray(getattr(m, f"{prefix}_{field}"))
            for index in np.flatnonzero(~_finite(values.reshape(len(values), values[:1].size)).all(1)).tolist():
                yield _of(m, kind, index, f"{field} is not finite")
    for joint in range(m.njnt):
        dof, adr = m.jnt_dofadr[joint], m.jnt_qposadr[joint]
        for what, value in (("ref", m.qpos0[adr]), ("springref", m.qpos_spring[adr])):
            if not _finite(value):
                yield _of(m, Kind.mjOBJ_JOINT, joint, f"{what} is not finite")
        for field in ("armature", "damping", "frictionloss"):
            if not _finite(getattr(m, f"dof_{field}")[dof]):
                yield _of(m, Kind.mjOBJ_JOINT, joint, f"{field} is not finite")
    for field in ("gravity", "density", "viscosity"):
        if not _finite(getattr(m.opt, field)).all():
            yield Obstacle("option", field, "not finite")


def _negative(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for joint in range(m.njnt):
        dof = m.jnt_dofadr[joint]
        for field, value in (
            ("armature", m.dof_armature[dof]),
            ("damping", m.dof_damping[dof]),
            ("stiffness", m.jnt_stiffness[joint]),
        ):
            if value < 0:
                yield _of(m, Kind.mjOBJ_JOINT, joint, f"{field} is {value:g}, must not be negative")
    for geom in np.flatnonzero((m.geom_friction < 0).any(1)).tolist():
        yield _of(m, Kind.mjOBJ_GEOM, geom, f"friction is {m.geom_friction[geom].min():g}, must not be negative")
    for field in ("density", "viscosity"):
        if getattr(m.opt, field) < 0:
            yield Obstacle("option", field, f"{getattr(m.opt, field):g}, must not be negative")


def _masses(m: mujoco.MjModel) -> Iterator[Obstacle]:
    moving = np.where(m.body_weldid != 0, m.body_mass, 0.0)
    if moving.any() and not MASSES[0] <= moving.sum() <= MASSES[1]:
        least, most = MASSES
        why = f"the robot weighs {moving.sum():.3g} kg, most of it here; must be {least:g} to {most:g} kg"
        yield _of(m, Kind.mjOBJ_BODY, int(moving.argmax()), why)
    if not m.nv or any(_not_finite(m)) or (m.dof_armature < 0).any():
        return
    matrix = mass_matrix(m)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0))
    for dof in np.flatnonzero(scale == 0).tolist():
        yield _of(m, Kind.mjOBJ_JOINT, m.dof_jntid[dof], "it moves no inertia")
    if scale.all():
        least, shape = (x.T[0] for x in np.linalg.eigh(matrix / np.outer(scale, scale)))
        for dof in np.flatnonzero(abs(shape) > 0.1).tolist() if least < 1e-9 else ():
            yield _of(m, Kind.mjOBJ_JOINT, m.dof_jntid[dof], "these joints together have a motion without inertia")


def _names(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for kind, ours, count in ((Kind.mjOBJ_NUMERIC, NUMERICS, m.nnumeric), (Kind.mjOBJ_TEXT, TEXTS, m.ntext)):
        for index in range(count):
            name = mujoco.mj_id2name(m, kind, index)
            if name not in ours and (near := difflib.get_close_matches(name.lower(), ours, 1, 0.65)):
                yield _of(m, kind, index, f"not one of {', '.join(ours)}; did you mean {near[0]!r}? Else rename it")
    for name in NUMERICS:
        index = mujoco.mj_name2id(m, Kind.mjOBJ_NUMERIC, name)
        if index >= 0:
            values = m.numeric_data[m.numeric_adr[index] :][: m.numeric_size[index]]
            if len(values) != 1 or not 0 <= values[0] < np.inf:
                why = f"{' '.join(f'{v:g}' for v in values)}, must be one number, finite and not negative"
                yield _of(m, Kind.mjOBJ_NUMERIC, index, why)


# Elements


def _options(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for flag in sorted(disabled_flags(m) - OBEYED - METHODS):
        yield Obstacle("option flag", flag, "cannot be disabled here")
    for flag in sorted(enabled_flags(m) - EXTRAS):
        yield Obstacle("option flag", flag, "cannot be enabled here")
    if np.any(m.opt.wind):
        yield Obstacle("option", "wind", "only a fluid at rest is simulated")
    for actuator in range(len(m.actuator_group)):
        group = m.actuator_group[actuator]
        if 0 <= group < 31 and m.opt.disableactuator & (1 << int(group)):
            why = "its group is in actuatorgroupdisable; remove the actuator"
            yield _of(m, Kind.mjOBJ_ACTUATOR, actuator, why)


def _whole_elements(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for equality in np.flatnonzero(m.eq_active0).tolist():
        yield _of(m, Kind.mjOBJ_EQUALITY, equality, "equality constraints are not simulated")
    touch = not disabled_flags(m) & {"constraint", "contact"}
    for kind, count, what in (
        (Kind.mjOBJ_PAIR, m.npair * touch, "contact pairs"),
        (Kind.mjOBJ_FLEX, m.nflex, "deformable bodies"),
        (Kind.mjOBJ_PLUGIN, m.nplugin, "plugins"),
    ):
        for index in range(count):
            yield _of(m, kind, index, f"{what} are not simulated")


def _bodies(m: mujoco.MjModel) -> Iterator[Obstacle]:
    if not m.njnt:
        yield Obstacle("file", "without a joint", "there is nothing to simulate")
    for body in range(m.nbody):
        if m.body_gravcomp[body] and np.any(m.opt.gravity):
            yield _of(m, Kind.mjOBJ_BODY, body, "gravcomp is not simulated")
        if m.body_mocapid[body] >= 0:
            yield _of(m, Kind.mjOBJ_BODY, body, "mocap is not simulated")
    free = m.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    if free[:1].any():
        for joint in np.flatnonzero(~free & (m.body_rootid[m.jnt_bodyid] != m.body_rootid[m.jnt_bodyid[0]])):
            yield _of(m, Kind.mjOBJ_BODY, int(m.jnt_bodyid[joint]), "a second base beside a floating one")
    if m.opt.density or m.opt.viscosity:
        for body in range(1, m.nbody):
            if m.body_mass[body] > 0 and not m.body_jntnum[body] and m.body_weldid[body]:
                yield _of(m, Kind.mjOBJ_BODY, body, "in a fluid each body needs a joint; merge its geoms")
        for geom in np.flatnonzero(m.geom_fluid[:, 0]).tolist():
            yield _of(m, Kind.mjOBJ_GEOM, geom, "fluidshape ellipsoid is not simulated")


def _joints(m: mujoco.MjModel) -> Iterator[Obstacle]:
    for joint in range(m.njnt):
        dof, (low, high) = m.jnt_dofadr[joint], m.jnt_range[joint]
        is_free, is_ball = (
            m.jnt_type[joint] == kind for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
        )
        later = joint > 0 or m.body_parentid[m.jnt_bodyid[joint]] > 0
        passive = m.dof_armature[dof] or m.dof_damping[dof] or m.jnt_stiffness[joint]
        curved = any(_any(m, f"{what}poly", at) for what, at in (("dof_damping", dof), ("jnt_stiffness", joint)))
        plastic = _any(m, "jnt_springyield", joint) or ("jnt_plasticadr" in dir(m) and m.jnt_plasticadr[joint] >= 0)
        for wrong, why in (
            (m.jnt_actfrclimited[joint], "actuatorfrcrange is not simulated"),
            (curved, "damping and stiffness are linear here, one number each"),
            (plastic, "springs that yield are not simulated"),
            (m.dof_frictionloss[dof], "frictionloss is not simulated"),
            (is_ball and m.jnt_limited[joint], "the limit of a ball joint is not simulated"),
            (is_free and passive, "a free joint has no armature, damping or stiffness here"),
            (is_free and later, "one free joint, of the first moving body, is simulated"),
            (low >= high and (low or high), f"range {low:g} {high:g} is empty"),
            (m.jnt_limited[joint] and _mixed(m.jnt_solref[joint]), "solreflimit mixes a positive with another number"),
        ):
            if wrong:
                yield _of(m, Kind.mjOBJ_JOINT, joint, why)


def _tendons(m: mujoco.MjModel) -> Iterator[Obstacle]:
    """One without force of its own and without actuator has no effect, whatever its path."""
    pulled = m.actuator_trnid[m.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]
    for tendon in range(m.ntendon):
        path = slice(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        if tendon in pulled and (m.wrap_type[path] != mujoco.mjtWrap.mjWRAP_SITE).any():
            why = "only spatial tendons through sites, without pulleys or wrapping geoms"
            yield _of(m, Kind.mjOBJ_TENDON, tendon, why)
        elif tendon in pulled and floating(m):
            for site in m.wrap_objid[path]:
                if m.body_weldid[m.site_bodyid[site]] == 0:
                    why = "a muscle of a floating robot cannot hold on to the world"
                    yield _of(m, Kind.mjOBJ_SITE, site, why)
        for field in ("stiffness", "damping", "limited", "frictionloss", "armature", "actfrclimited", "springyield"):
            if _any(m, f"tendon_{field}", tendon):
                yield _of(m, Kind.mjOBJ_TENDON, tendon, f"{field} of a tendon is not simulated")


def _actuators(m: mujoco.MjModel) -> Iterator[Obstacle]:
    model = text(m, "muscle_model", "linear")
    if model not in MUSCLE_MODELS:
        yield Obstacle("text", "'muscle_model'", f"{model!r}; choose from {', '.join(MUSCLE_MODELS)}")
    for a in range(len(m.actuator_trntype)):  # a PID has several of nu controls
        on_tendon = m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON
        low, high = m.actuator_ctrlrange[a]
        for wrong, why in (
            (on_tendon and not _pulls(m, a), f"only {ON_TENDON}"),
            (not on_tendon and not _turns(m, a), f"only {ON_JOINT}, or muscles on tendons"),
            (on_tendon and model == "hill" and is_motor(m, a), "muscle_model 'hill' needs a <muscle>"),
            (m.actuator_forcelimited[a], "forcerange is not simulated"),
            (low >= high and (low or high), f"ctrlrange {low:g} {high:g} is empty"),
            (_any(m, "actuator_damping", a) or _any(m, "actuator_dampingpoly", a), "damping is not simulated"),
            (_any(m, "actuator_armature", a), "armature is not simulated"),
            (_any(m, "actuator_delay", a) or _any(m, "actuator_history", a), "delay is not simulated"),
        ):
            if wrong:
                yield _of(m, Kind.mjOBJ_ACTUATOR, a, why)


ON_JOINT = "motors with a gear and a ctrlrange on a hinge, a slide or one axis of a ball joint"
ON_TENDON = "<muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push, on a tendon"


def _turns(m: mujoco.MjModel, a: int) -> bool:
    """A motor of a hinge, of a slide or of one axis of a ball joint."""
    if m.actuator_trntype[a] != mujoco.mjtTrn.mjTRN_JOINT or not is_motor(m, a):
        return False
    kind = m.jnt_type[m.actuator_trnid[a, 0]]
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return bool(np.count_nonzero(m.actuator_gear[a, :3]) <= 1)
    return bool(kind != mujoco.mjtJoint.mjJNT_FREE)


def _pulls(m: mujoco.MjModel, a: int) -> bool:
    """A <muscle>, or a motor that can only shorten its tendon."""
    low, high = m.actuator_ctrlrange[a] if m.actuator_ctrllimited[a] else (0.0, 1.0)
    if is_motor(m, a):
        scale = -m.actuator_gear[a, 0] * m.actuator_gainprm[a, 0]
        return bool(min(scale * low, scale * high) >= 0)
    return bool(
        m.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_MUSCLE
        and m.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE
        and m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_MUSCLE
        and np.array_equal(m.actuator_gainprm[a, :9], m.actuator_biasprm[a, :9])
        and m.actuator_gear[a, 0] == 1
        and 0 <= low < high <= 1
    )


def _contacts(m: mujoco.MjModel) -> Iterator[Obstacle]:
    shapes = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape}")) for shape in ("SPHERE", "CAPSULE", "BOX")]
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    pairs = ground_pairs(m)
    grounds = sorted({ground for ground, _ in pairs})
    smooth = {pair: pair_law(m, *pair).condim == 1 for pair in pairs}
    has_mu = mujoco.mj_name2id(m, Kind.mjOBJ_NUMERIC, "mu") >= 0
    for ground in grounds:
        if m.geom_type[ground] != mujoco.mjtGeom.mjGEOM_PLANE or len(grounds) > 1:
            why = "contact is simulated with one ground plane only; set contype and conaffinity to 0 if only drawn"
            yield _of(m, Kind.mjOBJ_GEOM, ground, why)
        elif not np.allclose(data.geom_xmat[ground].reshape(3, 3)[:, 2], [0.0, 0.0, 1.0]):
            yield _of(m, Kind.mjOBJ_GEOM, ground, "the ground plane must be horizontal")
    for ground, geom in pairs:
        condim, _, solref = pair_law(m, ground, geom)
        for wrong, why in (
            (
                m.geom_type[geom] not in shapes,
                "only spheres, capsules and boxes may touch the ground; set contype and conaffinity to 0 if only drawn",
            ),
            (condim > 3, f"condim {condim}: torsional and rolling friction are not simulated; condim 3 is"),
            (
                smooth[ground, geom] and not has_mu and not all(smooth.values()),
                "condim 1: frictionless beside geoms with friction is not simulated; <numeric> 'mu' is for all",
            ),
            (_mixed(solref), "solref mixes a positive with another number"),
        ):
            if wrong:
                yield _of(m, Kind.mjOBJ_GEOM, geom, why)
    for geom in range(m.ngeom):
        for field in ("adhesion", "surfacevel"):
            if _any(m, f"geom_{field}", geom):
                yield _of(m, Kind.mjOBJ_GEOM, geom, f"{field} is not simulated")


def _mixed(solref: Sequence[float] | NDArray[np.float64]) -> bool:
    return (solref[0] > 0) != (solref[1] > 0)


def floating(m: mujoco.MjModel) -> bool:
    """Whether the robot has a free joint."""
    return bool(m.njnt and (m.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())


CHECKS = (
    _not_finite,
    _negative,
    _masses,
    _names,
    _options,
    _whole_elements,
    _bodies,
    _joints,
    _tendons,
    _actuators,
    _contacts,
)
