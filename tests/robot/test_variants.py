"""170 variants of one MJCF file: a step is as in MuJoCo, or the file is refused, or the report tells what is rough."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from scenes import parse

from diffsim import Integration, Scene, SceneError, Simulator, startup
from diffsim.extra.report import approximations
from diffsim.robot.constraint import constrained
from diffsim.sim import simulator

H = 0.002  # s
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
REFUSED = 40


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


@pytest.mark.slow
@pytest.mark.parametrize(("place", "text"), CASES)
def test_a_step_is_mujocos_or_the_file_says_why_not(place: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        scene = scene_of(place, text)
    except SceneError:
        pytest.skip("refused")
    m, rng, states = scene.mj_model, np.random.default_rng(0), []
    m.opt.timestep, m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance, m.opt.ls_tolerance = H, 500, 500, 0, 1e-12
    for _ in range(12):
        qpos, change = m.qpos0.copy(), 0.15 * rng.normal(size=m.nv)
        if scene.floating:
            change[:3] *= (0, 0, 0.02)
        mujoco.mj_integratePos(m, qpos, change, 1.0)
        states.append((qpos, 0.5 * rng.normal(size=m.nv)))
    qpos, qvel = (torch.tensor(np.array(x)) for x in zip(*states, strict=True))
    monkeypatch.setattr(simulator, "PASSES", 300)
    with startup.quick_kernels(), torch.no_grad():
        sim = Simulator(scene, 12, Integration("mujoco", 1, tolerance=1e-12), H, 1, dtype=torch.float64)
        found = sim.step(qpos, qvel, torch.full((12, m.nu), 0.3, dtype=torch.float64))[1].numpy()
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, (-1.0, 1.0)).T
    data, errors = mujoco.MjData(m), []
    for k, state in enumerate(states):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = *state, low + 0.65 * (high - low)
        mujoco.mj_step(m, data)
        errors.append(abs(found[k] - data.qvel).max() / (1e-6 + abs(data.qvel - state[1]).max()))
    rough = [sentence for sentence in approximations(scene) if not sentence.startswith("A control of")]
    assert bool(rough) == (max(errors) > 1e-4)
