"""Random robots against MuJoCo: rollouts of 100 steps, step by step and as a whole.

    python benchmarks/rollouts.py               kernels of each robot are compiled: some 10 s each

From each state of MuJoCo's rollout both simulators take one step; its error is that of the change of velocity, relative
to its largest entry. A free rollout's error is compared with that of MuJoCo's own, whose first velocity is perturbed by
a ten billionth. MuJoCo's model has what the simulator takes from the file: condim 3 for 4 and 6, the loader's points
for meshes. Columns of the file tell how much steps of the file as it is differ from it. Writes rollouts.csv.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from common import TASKS, CommonFlags, Tasks, run

from diffsim import Simulator
from diffsim.robot.contacts import contact_points
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import Array
from diffsim.sim import simulator
from diffsim.sim.integration import Integration
from diffsim.training import Count
from diffsim_cli.gait import trace

STEPS, PERTURBED = 100, 1e-10  # m/s or rad/s
CONES, INTEGRATORS, KINDS = ("pyramidal", "elliptic"), ("Euler", "implicitfast"), ("sphere", "capsule", "box", "mesh")
GEOMS = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in KINDS]
PASSES = 200  # of Newton's method: to rounding


@dataclass
class Args(CommonFlags):
    robots: Count = 50
    env: tyro.conf.Suppress[Tasks] = TASKS
    draw_only: tyro.conf.Suppress[bool] = False  # there is nothing to draw


def random_robot(seed: int) -> str:
    """MJCF of a tree of three to six bodies; cone, integrator, a kind of geom and condim go by the seed."""
    rng, meshes, servos = np.random.default_rng(seed), list[str](), list[str]()

    def some(low: float | list[float], high: float | list[float]) -> str:
        return " ".join(map(str, np.atleast_1d(rng.uniform(np.array(low), np.array(high)))))

    def geom(k: int) -> str:
        kind = KINDS[seed // 4 % 4] if k == 0 else rng.choice(KINDS)
        shape = f'size="{some([0.03] * 3, [0.08] * 3)}"'
        if kind == "mesh":
            corners = rng.normal(size=(rng.integers(4, 15), 3)) * rng.uniform(0.03, 0.08, 3)
            meshes.append(f'<mesh name="m{k}" vertex="{" ".join(map(str, corners.flatten()))}"/>')
            shape = f'mesh="m{k}"'
        condim = rng.choice([1, 3, 3]) if seed % 3 else rng.choice([3, 4, 6])
        law = f'condim="{condim}" margin="{rng.choice([0, 0.01])}" solref="{some([0.01, 0.5], [0.05, 1.5])}"'
        law += (
            f' friction="{some([0.2, 0.002, 0.0005], [1.2, 0.02, 0.005])}" solimp="{some([0.5, 0.9], [0.9, 0.97])} .01"'
        )
        return (
            f'<geom name="g{k}" type="{kind}" {shape} euler="{some([-3] * 3, [3] * 3)}" mass="{some(0.2, 1)}" {law}/>'
        )

    def joint(k: int) -> str:
        if k == 0:
            planar = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>'
            return planar if seed % 5 == 0 else "<freejoint/>"
        if rng.random() < 0.15:
            return '<joint type="ball" damping="0.1" armature="0.01"/>'
        reach, loss = rng.uniform(0.02, 0.5), rng.choice([0, 1]) * rng.uniform(0.05, 0.3)
        kind, bound = ("slide", 0.1 * reach) if rng.random() < 0.3 else ("hinge", reach)
        servo = f'<position joint="j{k}" kp="{some(5, 30)}" kv="{some(0.2, 2)}" ctrlrange="-1 1"'
        servos.append(servo + rng.choice(["", ' forcerange="-2 2"']) + "/>")
        text = (
            f'<joint name="j{k}" type="{kind}" axis="{some([-1] * 3, [1] * 3)}" range="{-bound} {bound}" damping="0.1"'
        )
        return f'{text} armature="0.01" frictionloss="{loss}"/>'

    bodies, children = int(rng.integers(3, 7)), dict[int, list[int]]()
    for k in range(1, bodies):
        children.setdefault(int(rng.integers(0, k)), []).append(k)

    def body(k: int) -> str:
        inside = joint(k) + geom(k) + "".join(map(body, children.get(k, ())))
        return f'<body pos="{some([-0.15] * 3, [0.15] * 3)}">{inside}</body>'

    tree = body(0)
    option = f'cone="{CONES[seed % 2]}" integrator="{INTEGRATORS[seed // 2 % 2]}" impratio="{some(1, 5)}"'
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.004" {option}/>
    <asset>{"".join(meshes)}</asset><default><geom contype="0"/></default>
    <worldbody><geom type="plane" size="0 0 1" contype="1" conaffinity="0" friction="{some(0.2, 1)}" condim="1"/>{tree}
    </worldbody><actuator>{"".join(servos)}</actuator></mujoco>"""


def solved(m: mujoco.MjModel) -> mujoco.MjModel:
    """A model whose solver converges."""
    m.opt.iterations, m.opt.tolerance, m.opt.ls_iterations, m.opt.ls_tolerance = 200, 0, 100, 1e-10
    return m


def as_simulated(text: str, m: mujoco.MjModel) -> mujoco.MjModel:
    """The file with condim 3 for more, and with tiny spheres at the points of its meshes."""
    spec = mujoco.MjSpec.from_string(text)
    for geom in list(spec.geoms):
        geom.condim = min(geom.condim, 3)
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            geom.conaffinity, turn, k = 0, np.zeros(9), m.geom(geom.name).id
            mujoco.mju_quat2Mat(turn, m.geom_quat[k])
            same = {name: getattr(geom, name) for name in ("condim", "margin", "solref", "solimp", "friction")}
            for point in contact_points(m, k)[0] @ turn.reshape(3, 3).T + m.geom_pos[k]:
                geom.parent.add_geom(size=[1e-12, 0, 0], pos=point, mass=0, contype=0, **same)
    return solved(spec.compile())


def rollout(m: mujoco.MjModel, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array, list[int]]:
    """States (T + 1, nq), (T + 1, nv) of MuJoCo, and the number of contacts in each step."""
    data, states, contacts = mujoco.MjData(m), [(qpos, qvel)], []
    data.qpos, data.qvel = qpos, qvel
    for data.ctrl in ctrl:
        mujoco.mj_step(m, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
        contacts.append(data.ncon)
    return np.array([q for q, _ in states]), np.array([v for _, v in states]), contacts


def start(scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """The reference pose, turned, the joints moved, and 2 mm deep in the ground."""
    m, qpos = scene.mj_model, scene.qpos0.copy()
    spread = np.where(np.arange(m.nv) < 3 + 3 * scene.floating, 1.0, 0.1)
    mujoco.mj_integratePos(m, qpos, spread * rng.normal(size=m.nv), 1.0)
    return qpos + scene.root.up * (trace(scene, qpos[None])[0].max() - 0.002), 0.5 * rng.normal(size=m.nv)


def measure(seed: int) -> dict[str, Any]:
    rng, text = np.random.default_rng(seed), random_robot(seed)
    scene = load_scene(mujoco.MjModel.from_xml_string(text))
    m, file = as_simulated(text, scene.mj_model), solved(mujoco.MjModel.from_xml_string(text))
    state, ctrl = start(scene, rng), rng.uniform(-1, 1, (STEPS, m.nu))
    qpos, qvel, contacts = rollout(m, *state, ctrl)
    perturbed = rollout(m, state[0], state[1] + PERTURBED * rng.normal(size=m.nv), ctrl)[0]
    of_file = np.array([rollout(file, q, v, u[None])[1][1] for q, v, u in zip(qpos, qvel, ctrl, strict=False)])
    how, free = Integration("mujoco", 1, tolerance=1e-13), [qpos[0]]
    each, one = (Simulator(scene, n, how, m.opt.timestep, dtype=torch.float64) for n in (STEPS, 1))
    with torch.no_grad():
        speeds = each.step(*(torch.tensor(x) for x in (qpos[:-1], qvel[:-1], ctrl)))[1].numpy()
        now = torch.tensor(qpos[:1]), torch.tensor(qvel[:1])
        for action in torch.tensor(ctrl)[:, None]:
            now = one.step(*now, action)
            free.append(now[0][0].numpy().copy())
    change = abs(qvel[1:] - qvel[:-1]).max(1)
    step, step_of_file = (abs(found - qvel[1:]).max(1) / change for found in (speeds, of_file))
    kinds = {KINDS[GEOMS.index(kind)] for kind in scene.mj_model.geom_type if kind in GEOMS}
    return {
        **{"robot": seed, "cone": CONES[seed % 2], "integrator": INTEGRATORS[seed // 2 % 2]},
        **{"geoms": " ".join(sorted(kinds)), "condim": int(scene.mj_model.geom_condim.max()), "nv": m.nv},
        **{"contacts": float(np.mean(contacts)), "residual": float(each.residual.max())},
        **{"error of a step": float(step.max()), "error of the rollout (m, rad)": float(abs(free - qpos).max())},
        **{"perturbed (m, rad)": float(abs(perturbed - qpos).max())},
        **{"file, median": float(np.median(step_of_file)), "file, largest": float(step_of_file.max())},
    }


def main(args: Args) -> None:
    simulator.PASSES = PASSES
    for seed in range(args.robots):
        args.keep("rollouts", measure(seed), ("robot",))


if __name__ == "__main__":
    run(main, Args, __doc__)
