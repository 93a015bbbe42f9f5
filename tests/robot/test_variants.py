"""170 variants of one MJCF file: a step is as in MuJoCo, or the file is refused, or the report tells what is rough."""

from __future__ import annotations

from typing import TypeAlias

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scenes import free_states, parse, random_tree, robot

from diffsim import Integration, Scene, SceneError, Simulator
from diffsim.robot.constants import constrained
from diffsim.sim import simulator
from diffsim_cli.report import approximations

pytestmark = pytest.mark.unoptimized
States: TypeAlias = list[tuple[NDArray[np.float64], NDArray[np.float64]]]  # qpos and qvel
H = 0.002  # s
BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]
# A sphere in the ground and a driven leg within its limits; a variant fills one of the places.
ROBOT = """
<mujoco>
  <compiler {compiler}/>
  <default> <joint damping="0.05"/> </default>
  <option {option}> <flag {flag}/> </option>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" {floor}/>
    <body name="trunk" pos="0 0 0.099" {body}>
      {root} <geom name="ball" type="{shape}" size="0.1 0.1 0.1" mass="1" {geom}/> <site name="site"/>
      <body name="leg" pos="0.12 0 0">
        <joint name="knee" axis="0 1 0" {joint}/>
        <geom type="capsule" fromto="0 0 0 0.2 0 -0.02" size="0.04" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator> {actuator} </actuator>
  {rest}
</mujoco>"""
DISABLED = """constraint equality frictionloss limit contact spring damper gravity clampctrl warmstart filterparent
    actuation refsafe sensor midphase eulerdamp autoreset nativeccd island""".split()
SERVO = '<{} joint="knee" {}/>'
KNEE = '<joint joint="knee" coef="1"/>'
PLAIN = dict.fromkeys("compiler option flag floor body geom rest".split(), "") | {
    "root": "<freejoint/>",
    "shape": "sphere",
    "joint": 'range="-20 20"',
    "actuator": '<motor joint="knee" gear="5" ctrlrange="-1 1"/>',
}
VARIANTS = {
    "flag": [
        *(f'{name}="disable"' for name in DISABLED),
        *(f'{name}="enable"' for name in "override energy fwdinv invdiscrete multiccd sleep diagexact".split()),
    ],
    "option": [
        *(f'gravity="{g}"' for g in ("3 0 -9", "0 0 0", "0 0 9.81", "0 0 -1e4", "1 2 3")),
        *('density="1000"', 'viscosity="1"', 'wind="1 0 0" density="1.2"', 'impratio="10"', 'magnetic="1 0 0"'),
        *('density="-1"', 'o_solref="0.05 1" o_margin="0.01"', 'actuatorgroupdisable="0"', 'cone="elliptic"'),
        *(f'integrator="{name}"' for name in ("implicitfast", "implicit", "RK4")),
        *('noslip_iterations="10"', 'impratio="0"', 'integrator="implicitfast" density="1000"', 'solver="CG"'),
    ],
    "compiler": [
        *('angle="radian"', 'settotalmass="7"', 'boundmass="2"', 'boundinertia="0.1"', 'inertiafromgeom="true"'),
        *('eulerseq="zyx"', 'coordinate="local"', 'balanceinertia="true"', 'fusestatic="true"', 'alignfree="true"'),
        *('discardvisual="true"', ""),
    ],
    "joint": [
        *("", 'range="-20 20" ref="10"', 'stiffness="3" springref="15"', 'springdamper="0.1 1"', 'armature="0.1"'),
        *('frictionloss="0.2"', 'range="-1 1" solreflimit="0.05 0.5"', 'range="-1 1" solreflimit="-1000 -50"'),
        *('range="-1 1" solimplimit="0.5 0.9 0.01 0.3 3"', 'range="-20 20" margin="0.05"', 'damping="-0.1"'),
        *('frictionloss="0.2" solreffriction="0.1 1"', 'frictionloss="0.2" solimpfriction="0.5 0.6 0.1"'),
        *('actuatorfrcrange="-0.5 0.5"', 'actuatorgravcomp="true"', 'pos="0.05 0.02 0"', 'stiffness="20"'),
        *('group="3" user="1 2"', 'damping="0.1 0.2"', 'range="-1 1" solreflimit="-1 1"', 'springyield="0.1"'),
        *('range="nan 1"', 'type="ball"', 'type="slide" range="-0.01 0.01"'),
    ],
    "geom": [
        *(f'condim="{n}"' for n in (1, 4, 6)),
        *('friction="0.3 0.1 0.1"', 'friction="0 0 0"', 'friction="-1 0 0"', 'solref="0.05 0.7"', 'solref="-1 1"'),
        *('solref="-5000 -100"', 'solref="0.001 1"', 'solimp="0.5 0.8 0.02 0.3 4"', 'solimp="0.9 0.5 0.001"'),
        *('margin="0.02"', 'margin="0.02" gap="0.01"', 'gap="0.01"', 'solmix="5" solref="0.1 1"', 'contype="2"'),
        *('margin="nan"', 'solimp="0.9 0.95 nan"', 'friction="inf"', 'solref="-1e30 -1"'),
        'priority="1" friction="1e-4"',
        *('priority="1" friction="0.1 0 0" solref="0.1 1"', 'fluidshape="ellipsoid"', 'adhesion="1"', 'group="1"'),
    ],
    "shape": ["ellipsoid", "box", "cylinder"],
    "floor": [
        *('condim="1"', 'priority="2" friction="0.2 0 0"', 'solmix="0" solref="0.1 1"', 'margin="0.02"'),
        *('solref="0.1 1"', 'pos="0 0 0.01"', 'friction="2"', 'euler="5 0 0"'),
    ],
    "body": ['gravcomp="0.5"', 'euler="20 0 0"', 'mocap="true"'],
    "root": [
        '<joint type="free" frictionloss="0.5"/>',
        *('<joint type="free" damping="0.5"/>', '<joint type="free" armature="0.5"/>', '<freejoint align="true"/>', ""),
        *(
            '<joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>',
            '<joint type="slide" axis="0 0 1"/><joint type="ball"/>',
        ),
        '<joint type="slide" axis="0 0 1" range="-0.0005 0.5"/>',
    ],
    "actuator": [
        *(SERVO.format("position", words) for words in ('kp="20"', 'kp="20" kv="2"', 'kp="20" dampratio="1"')),
        *(SERVO.format("position", words) for words in ('kp="20" timeconst="0.1"', 'kp="20" ctrlrange="-1 2"')),
        *(SERVO.format("motor", f'gear="5" {words}') for words in ('ctrlrange="-0.2 3"', "", 'forcerange="-0.1 0.1"')),
        *(SERVO.format("motor", f'gear="5" {words}') for words in ('delay="0.01" nsample="5"', 'armature="0.1"')),
        *(SERVO.format("motor", f'gear="5" {words}') for words in ('damping="1"', 'ctrllimited="false"')),
        *(SERVO.format("velocity", 'kv="2"'), SERVO.format("intvelocity", 'kp="2" actrange="-1 1"')),
        *(SERVO.format("damper", 'kv="2" ctrlrange="0 1"'), SERVO.format("cylinder", "")),
        *(SERVO.format("general", words) for words in ('gainprm="3" biastype="affine" biasprm="1 -2 -0.5"',)),
        *(SERVO.format("general", words) for words in ('gaintype="affine" gainprm="3 1 1"', 'dyntype="integrator"')),
        *(2 * SERVO.format("motor", 'gear="2"'), SERVO.format("motor", 'gear="-5"')),
        *('<motor jointinparent="knee" gear="5"/>', '<motor site="site" gear="1 0 0 0 0 0"/>', ""),
        '<adhesion body="leg" gain="1" ctrlrange="0 1"/>',
    ],
    "rest": [
        *(
            f'<contact><pair geom1="ball" geom2="floor" {words}/></contact>'
            for words in ('solref="0.1 1" friction="0.2 0.2 0 0 0"', 'margin="0.02" gap="0.01"', 'condim="1"')
        ),
        '<contact><pair geom1="ball" geom2="floor" solreffriction="0.1 1"/></contact>',
        '<contact><exclude body1="trunk" body2="world"/></contact>',
        *(f"<equality>{each}</equality>" for each in ('<joint joint1="knee"/>', '<weld body1="leg" active="false"/>')),
        '<keyframe><key qpos="0 0 0.2 1 0 0 0 0.1"/></keyframe>',
        *(
            f"<tendon><fixed {words}>{KNEE}</fixed></tendon>"
            for words in ("", *(f'{name}="5"' for name in ("stiffness", "damping", "armature", "frictionloss")))
        ),
        f'<tendon><fixed range="-0.1 0.1">{KNEE}</fixed></tendon>',
    ],
}
CASES = [(place, text) for place, texts in VARIANTS.items() for text in texts]
REFUSED = 38


def scene_of(place: str, text: str) -> Scene:
    scene = parse(ROBOT.format(**PLAIN | {place: text}))
    return constrained(scene, H)


def test_so_many_variants_are_refused() -> None:
    refused = 0
    for case in CASES:
        try:
            scene_of(*case)
        except SceneError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 300
    assert (len(CASES), refused) == (170, REFUSED)


def random_states(scene: Scene) -> States:
    """Twelve states near the reference pose, in which the sphere is some millimetres in the ground."""
    m, rng, states = scene.mj_model, np.random.default_rng(0), []
    for _ in range(12):
        qpos, change = m.qpos0.copy(), 0.15 * rng.normal(size=m.nv)
        if scene.floating:
            change[:3] *= (0, 0, 0.02)
        mujoco.mj_integratePos(m, qpos, change, 1.0)
        states.append((qpos, 0.5 * rng.normal(size=m.nv)))
    return states


def step_error(scene: Scene, states: States) -> float:
    """Return the largest difference from mj_step of a step's change of velocity, relative to it.

    Where MuJoCo's own step is unstable, the environment must be contained.
    """
    m, count = scene.mj_model, len(states)
    m.opt.timestep = H
    qpos, qvel = (torch.tensor(np.array(x)) for x in zip(*states, strict=True))
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "PASSES", 300)
        sim = Simulator(scene, count, Integration("mujoco", 1, tolerance=1e-12), H, dtype=torch.float64)
        found = sim.step(qpos, qvel, torch.full((count, m.nu), 0.3, dtype=torch.float64))[1].numpy()
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, (-1.0, 1.0)).T
    data, errors = mujoco.MjData(m), []
    for state, velocity, contained in zip(states, found, sim.nonfinite.tolist(), strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = *state, low + 0.65 * (high - low)
        mujoco.mj_step(m, data)
        error = abs(velocity - data.qvel).max() / (1e-6 + abs(data.qvel - state[1]).max())
        unstable = any(data.warning[k].number for k in BAD)
        errors.append(0.0 if contained and unstable else error)
    return max(errors)


@pytest.mark.slow
@pytest.mark.parametrize(("place", "text"), CASES)
def test_a_step_is_mujocos_or_the_file_says_why_not(place: str, text: str) -> None:
    try:
        scene = scene_of(place, text)
    except SceneError:
        pytest.skip("refused")
    m = scene.mj_model
    m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance, m.opt.ls_tolerance = 500, 500, 0, 1e-12
    rough = [sentence for sentence in approximations(scene) if not sentence.startswith("A control of")]
    assert bool(rough) == (step_error(scene, random_states(scene)) > 1e-4)


# Single features, as the file stands: exact unless it is told or refused ---------------------------------------------

ELLIPTIC = {"option": 'cone="elliptic"'}
CRANK = '<motor cranksite="site" slidersite="site" cranklength="0.1"/>'
SINGLE = {
    "elliptic cone": ELLIPTIC,
    "pyramidal cone": {},
    "pyramidal cone, impratio": {"option": 'impratio="10"'},
    "elliptic cone, large impratio": {"option": 'cone="elliptic" impratio="1e6"'},
    "position servo with kv, Euler": {"actuator": SERVO.format("position", 'kp="20" kv="2" ctrlrange="-1 1"')},
    "velocity servo, Euler": {"actuator": SERVO.format("velocity", 'kv="2" ctrlrange="-1 1"')},
    "explicit dampers": {"flag": 'eulerdamp="disable"'},
    "RK4": {"option": 'integrator="RK4"', "expected": "Left out: integrator RK4"},
    "noslip": {"option": 'noslip_iterations="10"', "expected": "Left out: noslip_iterations"},
    "PGS": {"option": 'solver="PGS" iterations="5"', "expected": "Left out: a solver that may stop"},
    "actuatorgravcomp, no actuator": {"joint": 'actuatorgravcomp="true"', "body": 'gravcomp="0.5"', "actuator": ""},
    "o_friction, no override": {"option": 'o_friction="1 1 .1 .1 .1"'},
    "joint in parent": {"actuator": '<motor jointinparent="knee"/>', "expected": "not transmission jointinparent"},
    "actearly": {"actuator": SERVO.format("general", 'dyntype="filter" actearly="true"'), "expected": "dyntype filter"},
    "crank": {"actuator": CRANK, "expected": "not transmission slidercrank"},
    **{
        words: ELLIPTIC | {"geom": words}
        for words in (
            *('solref=".02 0"', 'solimp=".5 .9 .01 .5 .5"', 'solimp=".5 .9 .01 0 2"', 'solimp=".5 .9 .01 1 2"'),
            *('solimp=".5 .9 -1 .5 2"', 'margin="-.01"', 'margin=".005" gap=".02"'),
            *('friction="1e-9" priority="1"', 'friction="1e6"'),
        )
    },
}
# Half the thickness of a box [m], the speed [m/s] at which it falls on the ground, its tilt [rad], and its contact
BOXES = [
    *((0.05, 1, 0, ""), (0.001, 3, 0, 'solimp=".5 .5 .001"'), (0.001, 1, 0, 'solimp=".5 .5 .001"')),
    *((0.002, 3, 0, 'solimp=".3 .3 .001"'), (0.001, 3, 0, 'solimp=".9 .5 .001"')),
    *((0.002, 2, 0, 'solimp=".6 .6 .01" solref="-3000 -60"'), (0.005, 2, 0, 'solimp=".3 .3 .01" margin=".02"')),
    (0.002, 3, 0.01, 'solimp=".5 .5 .001"'),
]

BEYOND = "not finite in single precision"
EXACT = ""  # as in MuJoCo, whose own step may be unstable
SIXTY = '<body pos="0.1 0 0"><joint axis="0 1 0"/><geom size="0.02" contype="0" conaffinity="0"/>' * 53 + "</body>" * 53
ODD = {  # numbers and names that no robot has, by place, with the words that refuse them
    "geom": {
        EXACT: ["", 'solref="1e-30 1"', 'solref="1 1e-30"', 'solref="0 0" priority="1"'],
        "friction must be finite": ['friction="nan"', 'friction="inf"'],
        "solimp must be finite": ['solimp="nan .9 .001"', 'solimp=".9 .95 nan"', 'solimp=".9 .95 .001 .5 nan"'],
        "margin must be finite": ['margin="nan"', 'margin="inf"'],
        "solref must be finite": ['solref="inf 1"'],
        "is out of range": ['solref="-1e30 -1"'],
    },
    "option": {
        "impratio: must be positive and finite": ['impratio="nan"', 'impratio="0"', 'impratio="-1"'],
        "is out of range": ['impratio="1e-30"'],
        EXACT: [
            *('gravity="0 0 -1e30"', 'density="1e-30"', 'magnetic="nan 0 0"'),
            *('timestep="nan"', 'timestep="0"', 'timestep="-1"'),
        ],
        BEYOND: [
            *('gravity="nan 0 0"', 'gravity="0 0 inf"', 'gravity="0 0 1e39"'),
            *('density="nan"', 'density="inf"', 'viscosity="nan"'),
        ],
        "only a fluid at rest": ['wind="nan 0 0"'],
    },
    "joint": {
        BEYOND: [
            *('damping="nan"', 'damping="inf"', 'damping="1e39"', 'stiffness="nan"', 'armature="nan"', 'ref="nan"'),
            *('springref="nan" stiffness="1"', 'pos="nan 0 0"'),
        ],
        EXACT: [
            *('stiffness="1e15"', 'armature="1e20"', 'frictionloss="1e30"', 'ref="1e20"'),
            *('range="-1 1" solreflimit="0 0"', 'range="-inf inf"'),
        ],
        "must be finite": ['frictionloss="nan"', 'range="-1 1" solimplimit="nan"', 'range="-1 1" margin="inf"'],
    },
    "body": {
        BEYOND: ['gravcomp="nan"'],
        "'trunk': quat must be finite": ['quat="nan 0 0 0"'],  # as its pos, a part of qpos0
        EXACT: ['quat="1e-20 0 0 0"'],
    },
    "actuator": {
        BEYOND: [
            *(SERVO.format("motor", words) for words in ('gear="nan"', 'ctrlrange="-inf inf"')),
            *(SERVO.format("position", words) for words in ('kp="nan"', 'kp="1" kv="nan"')),
        ],
        EXACT: [SERVO.format("position", 'kp="1e20" ctrlrange="-1 1"')],
    },
    "rest": {
        EXACT: ['<custom><text name="\u96ea \U0001f600" data="\u2028"/></custom>'],
        "repeated name": ['<custom><text name="t" data="a"/><text name="t" data="b"/></custom>'],
    },
    "root": {EXACT: [f"<freejoint/>{SIXTY}"]},
}
ODD_CASES = [(place, text, words) for place, found in ODD.items() for words, texts in found.items() for text in texts]


def judge(fields: dict[str, str]) -> None:
    """Check that the robot is refused or told in these words, if there are any, and is stepped as by MuJoCo if not."""
    fields, expected = dict(fields), fields.get("expected", "")
    try:
        scene = constrained(parse(ROBOT.format(**PLAIN | fields)), H)
    except SceneError as error:
        assert expected and expected in str(error) and "\n" not in str(error)
        return
    told = " ".join(approximations(scene))
    assert (expected in told) if expected else (not told and step_error(scene, random_states(scene)) < 1e-4)


@pytest.mark.parametrize("name", SINGLE)
def test_single_feature(name: str) -> None:
    judge(SINGLE[name])


@pytest.mark.parametrize(("place", "text", "expected"), ODD_CASES, ids=[f"{p}: {t[:60]}" for p, t, _ in ODD_CASES])
def test_odd_number(place: str, text: str, expected: str) -> None:
    option = {"option": 'tolerance="0"'}  # otherwise MuJoCo's solver stops early where inertias differ much
    judge(option | {place: text, "expected": expected})


@pytest.mark.parametrize("box", BOXES, ids=str)
def test_single_feature_of_a_box(box: tuple[float, float, float, str]) -> None:
    """That sinks in by more than its thickness: the corners of its lower half alone touch the ground."""
    half, speed, tilt, contact = box
    geom = f'<geom type="box" size=".1 .05 {half}" mass="1" {contact}/>'
    body = f'<body euler="0 {tilt} 0" pos="0 0 {half + 0.003 + 0.1 * tilt}"><freejoint/>{geom}</body>'
    scene = parse(robot(body, '<option cone="elliptic" tolerance="0" iterations="300"/>'))
    data, states = mujoco.MjData(scene.mj_model), []
    data.qvel[2] = -speed
    for _ in range(40):
        states.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(scene.mj_model, data)
    assert step_error(scene, states) < 1e-6 and not approximations(scene)


# Random robots whose servos have kv -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=[pytest.mark.slow] * (seed > 5)) for seed in range(10)])
def test_random_robot_with_kv(seed: int) -> None:
    """Floating, on a hinge or on two slides; stepped by Euler or by implicitfast, half of them with a forcerange."""
    base, integrator = ("floating", "fixed", "planar")[seed % 3], ("Euler", "implicitfast")[seed // 3 % 2]
    servo = '<position kp="0.5" kv="0.1"' + ' forcerange="-9 9"' * (seed % 2)
    mjcf = random_tree(base, seed).replace("<motor", servo).replace("<option", f'<option integrator="{integrator}"')
    scene = parse(mjcf)
    assert (scene.mj_model.actuator_biasprm[:, 2] < 0).all()
    qpos, qvel, _ = free_states(scene, 12, np.random.default_rng(seed))
    assert step_error(scene, list(zip(qpos, qvel, strict=True))) < 1e-6
