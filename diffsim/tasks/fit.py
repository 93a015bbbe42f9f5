"""What a task leaves out, filled in from its robot; what it says, checked before anything is simulated."""

from __future__ import annotations

import mujoco
import torch

from diffsim.robot.scene import Scene
from diffsim.tasks.base import Task


@torch.no_grad()
def fit(task: Task, scene: Scene) -> None:
    """Give a task start, num_random, obs_dim and forward if it lacks them, and check its numbers and shapes.

    Raises:
        ValueError: one of them does not fit to the robot or to what `observe` returns.
    """
    n, m = scene.nq + scene.nv, scene.mj_model
    if not hasattr(task, "forward"):
        task.forward = forward(scene)
    if not hasattr(task, "num_random"):
        task.num_random = n
    if type(task).reset is Task.reset:
        task._nq = scene.nq
        free, ball = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
        places = zip(m.jnt_type, m.jnt_qposadr.tolist(), strict=True)
        task._quaternions = [k + 3 * (kind == free) for kind, k in places if kind in (free, ball)]
        if not len(task._start):
            task._start = torch.cat((task._start.new_tensor(home(scene)), task._start.new_zeros(scene.nv)))
        found = {"start": len(task._start), "num_random": task.num_random}
        if task._spread.ndim:
            found["spread"] = len(task._spread)
        for name, count in found.items():
            check(task, name if name == "num_random" else f"len({name})", count, n, "nq + nv")
    rand = task._start.new_full((2, task.num_random), 0.5)
    qpos, qvel = task.reset(rand)
    check(task, "the width of reset's qpos", qpos.shape[-1], scene.nq, "nq")
    check(task, "the width of reset's qvel", qvel.shape[-1], scene.nv, "nv")
    action = task._start.new_zeros(2, scene.nu)
    obs = task.observe_at(qpos, qvel, action, task.first_step(rand))
    task.obs_dim = getattr(task, "obs_dim", obs.shape[-1])
    check(task, "obs_dim", task.obs_dim, obs.shape[-1], "what observe returns")
    results = {"observe": (obs, (2, task.obs_dim)), "terminated": (task.terminated(obs), (2,))}
    if type(task).reward is not Task.reward:  # who only watches needs none
        results["reward"] = task.reward(obs, action), (2,)
    for name, (value, shape) in results.items():
        if value.shape != shape:
            raise ValueError(f"task {task.name!r}: {name} of 2 environments is {tuple(value.shape)}, must be {shape}")


def check(task: Task, name: str, value: int, expected: int, what: str) -> None:
    if value != expected:
        raise ValueError(f"task {task.name!r}: {name} is {value}, must be {expected} ({what})")


def home(scene: Scene) -> list[float]:
    """qpos of the keyframe "home", or of the first one, or qpos0 of a file without any."""
    m = scene.mj_model
    key = max(mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
    return [float(x) for x in (m.key_qpos[key] if m.nkey else scene.qpos0)]


def forward(scene: Scene) -> int | None:
    """Column of qpos that is the root's x, of its free joint or of its slide along x.

    None for a robot that nothing carries, neither a ground nor a fluid, or that has no such joint, as an arm.
    """
    if not scene.features & {"contact", "drag"}:
        return None
    m = scene.mj_model
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    for joint in range(m.njnt):
        kind, root = m.jnt_type[joint], m.body_weldid[m.body_parentid[m.jnt_bodyid[joint]]] == 0
        along = kind == mujoco.mjtJoint.mjJNT_SLIDE and data.xaxis[joint, 0] > 0.99
        if root and (along or kind == mujoco.mjtJoint.mjJNT_FREE):
            return int(m.jnt_qposadr[joint])
    return None
