"""The robots of the tests, and states in which the ground and the joint limits act on them."""

from __future__ import annotations

import dataclasses
import re
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
import reference
import torch
from numpy.typing import NDArray

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS
from diffsim.tasks.base import ASSETS

Array = NDArray[np.float64]

SOFT = [name for name, task in TASKS.items() if task.contact == "soft"]  # on the ground of the SHAC paper
ROBOTS = [name for name in SOFT if TASKS[name].asset == f"{name}.xml"]  # one task of each
# Together these have every feature of a task's robot: a kernel takes seconds to compile.
DISTINCT = ("half_cheetah", "humanoid", "humanoid_mtu", "swimmer")

FIRM = """<custom>
    <numeric name="k_n" data="2e4"/> <numeric name="k_d" data="2e4"/> <numeric name="k_t" data="50"/>
    <numeric name="mu" data="0.5"/>
  </custom>"""

# A free sphere of 2 kg; it falls, rolls, slides and rests.
BALL = f"""
<mujoco>
  <option cone="elliptic"/> {FIRM}
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body pos="0 0 1"> <freejoint/> <geom type="sphere" size="0.1" mass="2"/> </body>
  </worldbody>
</mujoco>"""

# A capsule with pyramidal cones, which turn with it.
BAR = BALL.replace('"sphere" size="0.1"', '"capsule" size="0.1 0.1"').replace("elliptic", "pyramidal")

# One driven hinge on the world. Its laws are in the kernels even where they do nothing, so all such robots share them.
ONE_HINGE = """
<mujoco>
  <compiler angle="radian"/>
  <custom> <numeric name="k_limit" data="300"/> <numeric name="d_limit" data="200"/> </custom>
  <worldbody> <body> <joint name="hinge" {joint}/> <inertial {inertial}/> </body> </worldbody>
  <actuator> <motor joint="hinge" gear="3" ctrlrange="-1 1" ctrllimited="true"/> </actuator>
</mujoco>"""
NO_SPRING = 'stiffness="1e-300" damping="1e-300"'

# A physical pendulum about the y axis, hanging at angle 0.
PENDULUM = ONE_HINGE.format(
    joint=f'axis="0 1 0" range="-9 9" {NO_SPRING}', inertial='pos="0 0 -0.8" mass="1.5" diaginertia="0.1 0.2 0.15"'
)

# A limited hinge about the vertical, so that only its motor and its limit act.
HINGE = ONE_HINGE.format(
    joint=f'axis="0 0 1" range="-0.5 0.5" armature="0.1" {NO_SPRING}',
    inertial='pos="0 0 0" mass="1" diaginertia="0.4 0.4 0.4"',
)

# A damped oscillation about the vertical.
OSCILLATOR = ONE_HINGE.format(
    joint='axis="0 0 1" range="-9 9" stiffness="20" damping="1"',
    inertial='pos="0 0 0" mass="1" diaginertia="0.5 0.5 0.5"',
)

# A ball joint on the world, driven about two axes of the arm's frame, and a slide along the arm.
SHOULDER = """
<mujoco>
  <worldbody>
    <body pos="0.3 0.1 1" quat="0.6 0 0.8 0">
      <joint name="shoulder" type="ball" pos="0 0 0.1" stiffness="30" damping="0.4" armature="0.05"/>
      <inertial pos="0.1 0 -0.3" mass="1.5" diaginertia="0.1 0.2 0.15"/>
      <body> <joint type="slide" axis="0 3 4"/> <inertial pos="0.2 0.1 0" mass="1" diaginertia="0.1 0.1 0.1"/> </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear="0 5 0"/> <motor joint="shoulder" gear="0 0 -4" ctrllimited="true" ctrlrange="0 3"/>
  </actuator>
</mujoco>"""

# Hinges and slides with every kind of servo, several on one joint, one beside a spring and one of a constant force.
SERVOS = """
<mujoco>
  <compiler angle="radian"/> <option integrator="implicitfast"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="a" axis="0 1 0" ref="0.2" damping="0.3" armature="0.1"/>
      <inertial pos="0 0 -0.3" mass="2" diaginertia=".1 .1 .1"/>
      <body pos="0 0 -0.5">
        <joint name="b" type="slide" axis="1 0 1" stiffness="5" springref="0.1" armature="0.1" {joint}/>
        <inertial pos="0.1 0 -0.1" mass="1" diaginertia=".1 .2 .1"/>
        <body pos="0.2 0 0">
          <joint name="c" axis="1 0 0" stiffness="2" springref="-0.4" armature="0.1"/>
          <inertial pos="0 0.1 -0.2" mass="1" diaginertia=".1 .1 .2"/>
          <body>
            <joint name="d" axis="0 1 1" armature="0.1"/> <inertial pos="0 0 0.2" mass="1" diaginertia=".2 .1 .1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="a" kp="30" kv="2" gear="-1.5" ctrlrange="-2 1" {a}/>
    <velocity joint="b" kv="4" gear="2" {b}/>
    <general joint="c" gaintype="fixed" biastype="affine" gainprm="7" biasprm="3 -20 -1" ctrlrange="-1 2" gear="2" {c}/>
    <general joint="d" biastype="affine" gainprm="2" biasprm="4 0 0" {d}/>
    {more}
  </actuator>
</mujoco>"""
FREE_SERVOS = SERVOS.format(
    **dict.fromkeys(["a", "b", "c", "d", "joint"], ""),
    more='<position joint="a" kp="10" ctrlrange="0 1"/> <general joint="b" biastype="affine" biasprm="3 0 0"/>',
)

# The same with bounds on the forces of an actuator, of a joint, of both and of a motor without a spring.
BOUNDED_SERVOS = SERVOS.format(
    joint='actuatorfrcrange="-9 12"',
    a='forcerange="-9 14"',
    b="",
    c="",
    d='forcerange="3 5"',
    more='<position joint="b" kp="9" kv="2"/>',
)

# Two fingers and a joint beyond the first, on tendons with damped servos: one between fingers that do not move each
# other, with a bounded force, and one along the chain.
GRIPPER = """
<mujoco>
  <compiler angle="radian"/> <option integrator="{integrator}"/> <default> <joint armature="0.1"/> </default>
  <worldbody>
    <body pos="0 0 1">
      <joint type="slide" axis="0 0 1" damping="0.3"/> <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
      <body pos="0.1 0 0">
        <joint name="a" axis="0 1 0" actuatorfrcrange="-8 9"/>
        <inertial pos="0.1 0 0.1" mass="1" diaginertia=".1 .2 .1"/>
        <body pos="0.3 0 0">
          <joint name="c" axis="0 1 0"/> <inertial pos="0.1 0.1 0" mass="0.5" diaginertia=".1 .2 .1"/>
        </body>
      </body>
      <body pos="-0.1 0 0">
        <joint name="b" axis="1 1 0"/> <inertial pos="0 0.1 0" mass="0.5" diaginertia=".1 .2 .1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="split"> <joint joint="a" coef="0.7"/> <joint joint="b" coef="-1.3"/> </fixed>
    <fixed name="chain"> <joint joint="a" coef="0.4"/> <joint joint="c" coef="0.8"/> </fixed>
  </tendon>
  <actuator>
    <general tendon="split" gear="1.5" ctrlrange="-1 2" gainprm="6" biastype="affine" biasprm="1 -6 -0.4"
      forcerange="-5 6"/>
    <position tendon="chain" kp="9" kv="0.5"/> <motor tendon="chain" gear="-2"/> <position joint="b" kp="3" kv="0.2"/>
    <motor joint="c"/>
  </actuator>
  <keyframe> <key qpos="0 0.3 0 0.2"/> </keyframe>
</mujoco>"""

# It has thrusters on its body and on its arm, beside a tendon of the arm and a motor.
DRONE = f"""
<mujoco>
  <compiler angle="radian"/> <option cone="elliptic" integrator="implicitfast"/> {FIRM}
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body pos="0 0 1">
      <freejoint/> <geom size="0.1" mass="2"/> <site name="nozzle" pos=".1 .2 .3" euler="0.3 0.7 -0.4"/>
      <body pos=".2 0 0">
        <joint name="a" axis="0 1 0" armature="0.1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
        <body quat="1 2 3 4">
          <inertial pos=".1 0 0" mass="1" diaginertia=".1 .1 .1"/> <site name="tip" pos=".1 .2 .3" quat="4 3 2 1"/>
        </body>
        <body pos=".3 0 0">
          <joint name="b" axis="1 0 0" armature="0.1"/> <geom size="0.05" mass="0.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon> <fixed name="both"> <joint joint="a" coef="1"/> <joint joint="b" coef="2"/> </fixed> </tendon>
  <actuator>
    <motor site="nozzle" gear="1 2 9 4 -5 6" ctrlrange="0 4"/> <motor site="tip" gear="-1 2 1 4 -5 6"/>
    <position tendon="both" kp="3" kv="0.5"/> <motor joint="b"/>
  </actuator>
</mujoco>"""

# Gravity is compensated for a part of each link, two of which are two bodies, and a free joint has inertia and damping.
COMPENSATED = """
<mujoco>
  <option gravity="1 2 -9"/>
  <worldbody>
    <body gravcomp="0.5">
      <joint type="free" armature="0.7" damping="0.4"/> <inertial pos="0.1 0 -0.3" mass="2" diaginertia=".1 .1 .1"/>
      <body pos="0 0 -0.5">
        <joint axis="1 0 1" damping="0.2"/> <inertial pos="0.1 0 -0.1" mass="1" diaginertia=".1 .2 .1"/>
        <body pos="0.2 0 0" quat="1 2 3 4" gravcomp="1.5">
          <inertial pos="0 .1 -.2" mass="1" diaginertia=".1 .1 .2"/>
        </body>
        <body pos="0.2 0 0">
          <joint type="slide" axis="0 1 1"/> <inertial pos="0 0 0.2" mass="1" diaginertia=".2 .1 .1"/>
          <body gravcomp="1"> <inertial pos="0.3 0 0.2" mass="2" diaginertia=".2 .1 .1"/> </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""

# A leg on a floating pelvis: a muscle over the hip, one over hip and knee with a piece along the thigh, one that begins
# with a segment of no length at the hip's centre, one that goes to and fro; and a motor in their midst.
LEG = """
<mujoco>
  <custom> {custom} </custom>
  <worldbody>
    <body>
      <freejoint/> <geom type="box" size="0.1 0.12 0.08" mass="8"/>
      <site name="p1" pos="0.05 0.1 0.05"/> <site name="p2" pos="-0.1 0.05 0"/> <site name="hip" pos="0 0.1 -0.05"/>
      <body pos="0 0.1 -0.05">
        <joint name="hip" type="ball" damping="1" stiffness="2"/> <geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/>
        <site name="head"/> <site name="f1" pos="0.06 0 -0.1"/> <site name="f2" pos="-0.05 0.02 -0.2"/>
        <site name="f3" pos="-0.05 0 -0.35"/>
        <body pos="0 0 -0.4">
          <joint name="knee" axis="0 1 0" armature="0.1"/> <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04"/>
          <site name="t1" pos="-0.03 0 -0.05"/> <site name="t2" pos="0.05 0 -0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="gluteus"> <site site="p1"/> <site site="f1"/> </spatial>
    <spatial name="hamstring"> <site site="p2"/> <site site="f2"/> <site site="f3"/> <site site="t1"/> </spatial>
    <spatial name="iliacus"> <site site="hip"/> <site site="head"/> <site site="f1"/> <site site="t2"/> </spatial>
    <spatial name="zigzag"> <site site="t2"/> <site site="f2"/> <site site="t1"/> <site site="p1"/> </spatial>
  </tendon>
  <actuator> {actuators} </actuator>
</mujoco>"""

# The same over a ground, with a limited knee.
GROUNDED = LEG.replace("<worldbody>", '<worldbody> <geom type="plane" size="1 1 1" pos="0 0 -100"/>').replace(
    'name="knee"', 'name="knee" limited="true" range="-40 40"'
)
CONSTANTS = {"k_n": 4e3, "k_d": 4e3, "k_t": 300, "mu": 0.6, "k_limit": 300, "d_limit": 200}
MUSCLES = {"gluteus": 400, "hamstring": 300, "iliacus": 250, "zigzag": 100}  # N


def leg(grounded: bool = False) -> str:
    """Its MJCF, with muscles as plain actuators."""
    actuators = ['<motor joint="knee" gear="7"/>'] * (len(MUSCLES) + 1)
    for n, (name, force) in enumerate(MUSCLES.items()):
        pull = f'<general tendon="{name}" gainprm="{-force}" ctrllimited="true" ctrlrange="0 1"/>'
        actuators[n + (n >= 2)] = pull
    custom = "".join(f'<numeric name="{name}" data="{value}"/>' for name, value in CONSTANTS.items() if grounded)
    return (GROUNDED if grounded else LEG).format(custom=custom, actuators="".join(actuators))


@cache
def leg_scene(grounded: bool = False) -> Scene:
    return parse(leg(grounded))


def grounded_states(scene: Scene, count: int, rng: np.random.Generator) -> tuple[Scene, tuple[Array, Array, Array]]:
    """A scene whose ground a third of the spheres of these random states touch, beyond limits and within."""
    qpos, qvel, ctrl = free_states(scene, count, rng)
    pass_limits(scene, qpos, rng)
    qvel[::2] *= 0.02  # so that some contacts stick
    return raise_ground(scene, qpos), (qpos, qvel, ctrl)


# A free box of three unlike sides, two more on hinges about unlike axes, one of them on a slide besides. It is fast in
# its fluid, so that both parts of the law count. A planar root is the swimmer's.
FISH = """
<mujoco>
  <option density="300" viscosity="2" gravity="0.3 -0.2 -9.81"/>
  <default> <geom contype="0" conaffinity="0"/> </default>
  <worldbody>
    <body>
      <freejoint/> <geom type="box" size="0.2 0.1 0.05" euler="10 20 30" pos="0.1 0.02 0.03" density="400"/>
      <body pos="0.3 0 0.1">
        <joint name="a" axis="0.2 1 0.1" damping="0.1"/> <geom type="box" size="0.1 0.05 0.2" density="400"/>
        <body pos="0 0.1 0.2">
          <joint axis="0 0 1" type="slide"/> <joint name="b" axis="1 0 0.3"/>
          <geom type="capsule" size="0.05 0.2" euler="40 0 0" density="400"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator> <motor joint="a" gear="5"/> <motor joint="b" gear="5"/> </actuator>
</mujoco>"""

# A pendulum on a cart that is pulled from the wall.
CRANE = """
<mujoco>
  <worldbody>
    <site name="wall" pos="0.5 0.2 1"/>
    <body>
      <joint type="slide" axis="1 0 0"/> <joint type="slide" axis="0 0 1"/> <joint axis="0 1 0"/>
      <inertial pos="0 0 -0.8" mass="1.5" diaginertia="0.1 0.2 0.15"/> <site name="end" pos="0.1 0 -1"/>
    </body>
  </worldbody>
  <tendon> <spatial name="rope"> <site site="end"/> <site site="wall"/> </spatial> </tendon>
  <actuator> <motor name="winch" tendon="rope" gear="-9" ctrllimited="true" ctrlrange="0 1"/> </actuator>
</mujoco>"""

FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'


def robot(body: str, rest: str = "", world: str = FLOOR) -> str:
    return f'<mujoco><compiler angle="radian"/><worldbody>{world}{body}</worldbody>{rest}</mujoco>'


def pendulum(joint: str = "", inside: str = "", rest: str = "", world: str = FLOOR) -> str:
    """A sphere on a hinge."""
    body = f'<body name="arm"><joint name="hinge" {joint}/><geom type="sphere" size="0.1" pos="0 0 -1"/>{inside}</body>'
    return robot(body, rest, world)


MUSCLE = 'name="biceps" tendon="string" force="5" lengthrange="1 2"'


def tendon(more: str = "", spring: str = "", joint: str = "<joint/>", actuator: str = "", custom: str = "") -> str:
    """A string from the world's site w to the body's site b."""
    body = (
        f'<site name="w"/><body>{joint}<geom name="g" size="0.1"/><site name="a" pos="1 0 0"/><site name="b"/></body>'
    )
    path = f'<spatial name="string" {spring}><site site="w"/><site site="a"/>{more}<site site="b"/></spatial>'
    return robot(body, f"<tendon>{path}</tendon><actuator>{actuator}</actuator><custom>{custom}</custom>")


def parse(mjcf: str) -> Scene:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(mjcf)
        return load_scene(path)


@cache
def task_scene(name: str) -> Scene:
    return load_scene(ASSETS / TASKS[name].asset)


@cache
def tree_scene(base: str, seed: int) -> Scene:
    return parse(random_tree(base, seed))


def random_tree(base: str, seed: int) -> str:
    """MJCF of a random tree: seven hinges and slides, up to three a body, welded bodies, everything else random.

    `base` is "floating", "fixed" (the first joint is a hinge), "planar" (two slides without mass lead to the rest) or
    "ball": floating, with two ball joints among the seven.
    All seeds of a base have the same shape, so one compiled kernel serves them. The ground is far below.
    """
    rng = np.random.default_rng(seed)
    joints = 0
    given = list(rng.permutation(["ball", "ball", "hinge", "hinge", "slide"])) if base == "ball" else []
    balls = set()

    def numbers(count: int) -> str:
        return " ".join(map(str, rng.normal(size=count)))

    def joint(kind: str) -> str:
        nonlocal joints
        joints += 1
        if kind == "ball":
            balls.add(joints)
            spring = f'stiffness="{rng.uniform(0, 20)}" damping="{rng.uniform(0, 2)}"'
            return f'<joint name="joint{joints}" type="ball" pos="{numbers(3)}" armature="{rng.random()}" {spring}/>'
        low, high = -rng.uniform(0.2, 1.5), rng.uniform(0.2, 1.5)
        spring = f'stiffness="{rng.uniform(0, 20)}" springref="{rng.normal()}" damping="{rng.uniform(0, 2)}"'
        limit = f'limited="true" range="{low} {high}"' if rng.random() < 0.7 else ""
        place = f'pos="{numbers(3)}" axis="{numbers(3)}" ref="{0.5 * rng.normal()}" armature="{rng.uniform(0, 0.5)}"'
        return f'<joint name="joint{joints}" type="{kind}" {place} {spring} {limit}/>'

    def kinds(most: int) -> list[str]:
        """Of a body's joints; one that turns freely is the only one."""
        result: list[str] = []
        while len(result) < most and "ball" not in result and not (result and given and given[-1] == "ball"):
            result.append(given.pop() if given else rng.choice(["hinge", "slide"]))
        return result

    def inertial() -> str:
        spread = rng.uniform(0.05, 0.5, 3)
        moments = " ".join(map(str, spread.sum() - spread))  # no moment exceeds the sum of the two others
        return (
            f'<inertial pos="{numbers(3)}" quat="{numbers(4)}" mass="{rng.uniform(0.5, 3)}" diaginertia="{moments}"/>'
        )

    def geom() -> str:
        place = f'pos="{numbers(3)}" quat="{numbers(4)}"'
        kind = rng.choice(["sphere", "capsule", "box"])
        return f'<geom type="{kind}" size="{" ".join(map(str, rng.uniform(0.05, 0.3, 3)))}" {place}/>'

    def body(joint_tags: str) -> str:
        return f'<body pos="{numbers(3)}" quat="{numbers(4)}">{joint_tags}{inertial()}{geom()}'

    first = {
        "floating": "<freejoint/>",
        "ball": "<freejoint/>",
        "fixed": joint("hinge") if base == "fixed" else "",
        "planar": joint("slide") + joint("slide") + joint("hinge") if base == "planar" else "",
    }[base]
    text, depth = body(first), 1
    while joints < 7:
        for _ in range(rng.integers(0, depth)):  # climb back to an ancestor, never beyond the first body
            text, depth = text + "</body>", depth - 1
        count = min(int(rng.integers(0, 4)), 7 - joints)  # 0: a welded body
        text, depth = text + body("".join(joint(kind) for kind in kinds(count))), depth + 1
    text += "</body>" * depth
    about = ["", "0 ", "0 0 "]  # the axes of a ball joint before the one that is driven
    motors = "".join(
        f'<motor joint="joint{j}" gear="{about[j % 3] if j in balls else ""}{10 * rng.normal()}" ctrllimited="true" '
        f'ctrlrange="{-rng.random()} 1.5"/>'
        for j in rng.choice(np.arange(1, 8), 4, replace=False)
    )
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="{rng.normal()} {rng.normal()} -9.81"/>
  <custom>
    <numeric name="k_n" data="2e3"/> <numeric name="k_d" data="2e2"/> <numeric name="k_t" data="200"/>
    <numeric name="mu" data="0.7"/> <numeric name="k_limit" data="500"/> <numeric name="d_limit" data="300"/>
  </custom>
  <worldbody> <geom type="plane" size="1 1 1" pos="0 0 -100"/> {text} </worldbody>
  <actuator> {motors} </actuator>
</mujoco>"""


def free_states(scene: Scene, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random (qpos, qvel, ctrl) within the joint limits; the ground is not looked at."""
    qpos = np.zeros((count, scene.nq))
    if scene.floating:
        qpos[:, :3] = rng.normal(size=(count, 3))
        qpos[:, 3:7] = unit(rng.normal(size=(count, 4)))
    links, joints = reference.scalar_joints(scene)
    low, high = np.maximum(scene.lower[links], -2.0), np.minimum(scene.upper[links], 2.0)
    qpos[:, joints] = rng.uniform(low, high, (count, len(links)))
    for link in np.flatnonzero(scene.ball == 0):
        qpos[:, reference.joint_qpos(scene, link) :][:, :4] = unit(rng.normal(size=(count, 4)))
    return qpos, rng.normal(size=(count, scene.nv)), rng.uniform(-1, 1, (count, scene.nu))


def acting_states(scene: Scene, count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random (qpos, qvel, ctrl) of a task's robot, pressed into the ground and with some joints beyond their limits.

    Every other state is nearly at rest, so that its contacts stick; in the rest many slide.
    """
    qpos, qvel, ctrl = free_states(scene, count, rng)
    if scene.floating:
        qpos[:, 3:7] = unit(scene.qpos0[3:7] + 0.2 * rng.normal(size=(count, 4)))
    pass_limits(scene, qpos, rng)
    if scene.ncontact:
        for e in range(count):
            lowest = reference.contacts(scene, qpos[e], qvel[e])[0].min()
            qpos[e, 2 if scene.floating else 1] -= lowest + rng.uniform(0.005, 0.03)
    qvel[::2] *= 0.02
    return qpos, qvel, ctrl


def check_that_ground_and_limits_act(scene: Scene, qpos: Array, qvel: Array) -> None:
    """Every state touches the ground, half of them pass a limit; some contacts stick and some slide."""
    links, joints = reference.scalar_joints(scene)
    assert ((qpos[:, joints] < scene.lower[links]) | (qpos[:, joints] > scene.upper[links])).any(-1).mean() >= 0.5
    if scene.ncontact:
        points = [reference.contacts(scene, *state) for state in zip(qpos, qvel, strict=True)]
        depths, velocities = np.array([p[0] for p in points]), np.array([p[1] for p in points])
        assert (depths < 0).any(-1).all()
        normal = np.maximum((scene.k_d * velocities[..., 2] - scene.k_n) * depths, 0)
        slides = scene.k_t * np.linalg.norm(velocities[..., :2], axis=-1) > scene.mu * normal
        assert slides[depths < 0].any() and not slides[depths < 0].all()


def pass_limits(scene: Scene, qpos: Array, rng: np.random.Generator) -> None:
    """Draw the limited joints anew: a third within their range, a third up to 5 % beyond each end of it."""
    for link in np.flatnonzero(np.isfinite(scene.lower)):
        beyond = 0.05 * rng.random(len(qpos))
        part = np.choose(rng.integers(0, 3, len(qpos)), [-beyond, rng.random(len(qpos)), 1 + beyond])
        qpos[:, reference.joint_qpos(scene, link)] = scene.lower[link] + part * (scene.upper[link] - scene.lower[link])


def raise_ground(scene: Scene, qpos: Array) -> Scene:
    """The scene with its ground so high that a third of the contact spheres of these states are in it."""
    rest = np.zeros(scene.nv)
    depths = np.sort(np.concatenate([reference.contacts(scene, q, rest)[0] for q in qpos]))
    third = len(depths) // 3
    return dataclasses.replace(scene, ground_height=scene.ground_height + depths[third : third + 2].mean())


def without(scene: Scene, *features: str) -> Scene:
    """A copy that lacks them, hence with smaller kernels."""
    still, free = np.zeros(scene.nlink), np.full(scene.nlink, np.inf)
    points = "contact_link", "contact_position", "contact_radius"
    segments = "segment_link", "segment_position", "segment_muscle"
    gone: dict[str, dict[str, Any]] = {
        "contact": {name: getattr(scene, name)[:0] for name in points},
        "limit": {"lower": -free, "upper": free},
        "stiffness": {"stiffness": still},
        "damping": {"damping": still},
        "muscle": {name: getattr(scene, name)[:0] for name in segments},
        "drag": {"density": 0.0, "viscosity": 0.0},
    }
    return dataclasses.replace(scene, **{name: x for feature in features for name, x in gone[feature].items()})


def without_ground(scene: Scene) -> Scene:
    """The same scene, hence the same kernels, with the ground too deep to be reached."""
    return dataclasses.replace(scene, ground_height=-1e3)


def unit(quaternion: Array) -> Array:
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def run(
    scene: Scene,
    qpos: Array,
    qvel: Array,
    ctrl: Array,
    steps: int = 1,
    dtype: torch.dtype = torch.float64,
    factors: Array | None = None,
    forces: Array | None = None,
    **simulator: object,
) -> tuple[Array, Array]:
    """qpos and qvel after some control steps of constant ctrl, without gradients."""
    optional = {name: x for name, x in (("factors", factors), ("forces", forces)) if x is not None}
    sim = Simulator(scene, len(qpos), dtype=dtype, **dict.fromkeys(optional, True), **simulator)
    for name, x in optional.items():
        setattr(sim, name, torch.as_tensor(x, dtype=dtype))
    q, v, u = (torch.as_tensor(x, dtype=dtype) for x in (qpos, qvel, ctrl))
    with torch.no_grad():
        for _ in range(steps):
            q, v = sim.step(q, v, u)
    return q.double().numpy(), v.double().numpy()


def acceleration(scene: Scene, qpos: Array, qvel: Array, ctrl: Array, **simulator: object) -> Array:
    """qacc: the change of velocity over one substep of one second."""
    return run(scene, qpos, qvel, ctrl, control_dt=1.0, integration=Integration(substeps=1), **simulator)[1] - qvel


def with_motors(path: str | Path) -> mujoco.MjSpec:
    """A file of servos at joints, with motors of the same bounds in place of them, in reverse order; compiled."""
    spec = mujoco.MjSpec.from_file(str(path))
    servos = [(servo.name, servo.target, servo.forcerange.copy()) for servo in reversed(spec.actuators)]
    for servo in list(spec.actuators):
        spec.delete(servo)
    for name, joint, forces in servos:
        motor = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.forcerange = forces
    spec.compile()
    return spec


WINCH = '<muscle name="winch" tendon="rope" force="9" lengthrange=".5 3" range="0.6 1.5"/>'
# Robots of one kind of element each, with the features that they are for
SMALL = {
    "ball joint on the world": (SHOULDER, "ball damping motor slide stiffness"),
    "servos": (FREE_SERVOS, "damping hinge motor slide stiffness"),
    "gravity compensation": (COMPENSATED, "base_damping damping floating gravcomp hinge slide"),
    "fluid": (FISH, "damping drag floating hinge motor slide"),
    "muscles": (leg(grounded=True), "ball contact damping floating hinge limit motor muscle stiffness"),
    "muscle on the world": (CRANE, "hinge muscle slide"),
    "muscle by its maximum force": (re.sub("<motor.*/>", WINCH, CRANE), "hinge muscle slide"),
}


def small_scene(name: str) -> Scene:
    xml, features = SMALL[name]
    scene = parse(xml)
    assert scene.features == {*features.split()}
    return scene
