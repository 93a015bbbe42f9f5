"""Three worlds in which a policy can act: this simulator, MuJoCo, and our laws of contact and limits in MuJoCo.

None of this calls a task or a kernel: observations come from qpos and qvel by the tasks' tables, the laws from Eq. 3
and 4 of docs/physics.md. tests/benchmarks/test_transfer.py holds both against the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from diffsim import Scene, Simulator, load_scene
from diffsim.sim.launcher import available_cores
from diffsim.view.gait import contact_bodies

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TARGETS = {"ant": 10_000.0, "humanoid": 200.0}  # m; the robot is to face the point (target, 0)
UNSEEN = {"hopper": 1, "half_cheetah": 1, "walker": 1, "swimmer": 2}  # first positions that a planar robot does not see
OBSERVED = {"cartpole", *TARGETS, *UNSEEN}  # tasks
FASTEST = 1e5  # m/s or rad/s; beyond it a world is lost, as in Simulator

mujoco.set_mju_user_warning(lambda _: None)  # that a simulation is unstable, which World.step says


# Observations ---------------------------------------------------------------------------------------------------------


def rotations(quat: Array) -> Array:
    """(..., 3, 3) of quaternions wxyz (..., 4): body to world."""
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def observe(task: str, qpos: Array, qvel: Array, action: Array) -> Array:
    """The observation (N, obs_dim) of MuJoCo's qpos (N, nq), qvel (N, nv) and the action (N, nu) that led there."""
    if task == "cartpole":  # Table 6
        (x, angle), (x_rate, rate) = qpos.T, qvel.T
        return np.stack((x, x_rate, np.sin(angle), np.cos(angle), rate), 1)
    if task in UNSEEN:  # Tables 7 and 8
        return np.concatenate((qpos[:, UNSEEN[task] :], qvel), 1)
    body = rotations(qpos[:, 3:7])  # Tables 9 and 10; columns: the body's axes in the world
    way = np.array([TARGETS[task], 0.0]) - qpos[:, :2]
    heading = (body[:, :2, 0] * way).sum(1) / np.linalg.norm(way, axis=1)
    angular = np.einsum("nij,nj->ni", body, qvel[:, 3:6])
    columns = (
        qpos[:, 2:3],
        qpos[:, [4, 5, 6, 3]],  # xyzw
        qvel[:, :3],
        angular,
        qpos[:, 7:],
        0.1 * qvel[:, 6:],
        body[:, 2, 2, None],
        heading[:, None],
        action,
    )
    return np.concatenate(columns, 1)


# Laws -----------------------------------------------------------------------------------------------------------------


def contact_force(scene: Scene, depth: Array, velocity: Array) -> Array:
    """Eq. 3: force (..., 3) on points at signed depths (...), negative inside, that move with velocity (..., 3)."""
    normal = np.maximum((scene.k_d * velocity[..., 2] - scene.k_n) * np.minimum(depth, 0.0), 0.0)
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    cone = np.divide(scene.mu * normal, speed, out=np.full_like(speed, np.inf), where=speed > 0)
    viscosity = np.where(normal > 0, np.minimum(scene.k_t, cone), 0.0)
    return np.stack((-viscosity * velocity[..., 0], -viscosity * velocity[..., 1], normal), -1)


def limit_force(scene: Scene, links: NDArray[np.intp], q: Array, rate: Array) -> Array:
    """Eq. 4: force (..., k) of the limits of some links, whose joints are at q (..., k) and move at rate (..., k).

    The damper grows with the violation, as that of contact with the depth, and a limit never pulls.
    """
    stiffness, damping = scene.k_limit[links], scene.d_limit[links]
    below, above = np.maximum(scene.lower[links] - q, 0.0), np.maximum(q - scene.upper[links], 0.0)
    up, down = np.maximum(stiffness - damping * rate, 0.0), np.maximum(stiffness + damping * rate, 0.0)
    return up * below - down * above


def cross(a: Array, b: Array) -> Array:
    """a x b (..., 3); np.cross takes several times as long for few vectors."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


class Bodies(NamedTuple):
    """What the points of N robots need of MuJoCo's, (N, nbody, ...) each."""

    xpos: Array
    xmat: Array
    cvel: Array
    subtree_com: Array


class Points:
    """The spheres of a scene that may touch the ground, on the bodies of its MuJoCo model.

    Attributes:
        body: (nc,) MuJoCo's number of the body of each.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, model = scene, scene.mj_model
        self.body = contact_bodies(scene)
        self.root = model.body_rootid[self.body]
        # A link's frame has the axes of its body and sits at the anchor of its joint.
        joint = model.dof_jntid[scene.contact_link + scene.nv - scene.nlink]
        self.centre = model.jnt_pos[joint] + scene.contact_position

    def __call__(self, bodies: Bodies) -> tuple[Array, Array, Array]:
        """Lowest points (N, nc, 3), their signed depths (N, nc), negative inside, and their velocities (N, nc, 3)."""
        xmat = bodies.xmat[:, self.body].reshape(*bodies.xmat.shape[:1], len(self.body), 3, 3)
        point = bodies.xpos[:, self.body] + np.einsum("ncij,cj->nci", xmat, self.centre)
        point[..., 2] -= self.scene.contact_radius
        twist = bodies.cvel[:, self.body]  # about the centre of mass of the whole tree
        velocity = twist[..., 3:] + cross(twist[..., :3], point - bodies.subtree_com[:, self.root])
        return point, point[..., 2] - self.scene.ground_height, velocity


def contacts(scene: Scene, qpos: Array, qvel: Array) -> tuple[Array, Array]:
    """Of F states, how far each contact sphere is in the ground (m; negative: above it), and its speed along it (m/s).

    Args:
        qpos, qvel: (F, nq), (F, nv).

    Returns:
        (F, nc) each.
    """
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    found = Bodies(*(np.empty((len(qpos), *getattr(data, name).shape)) for name in Bodies._fields))
    views = [getattr(data, name) for name in Bodies._fields]
    for k, (q, v) in enumerate(zip(qpos, qvel, strict=True)):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        for whole, view in zip(found, views, strict=True):
            whole[k] = view
    _, depth, velocity = Points(scene)(found)
    return -depth, np.hypot(velocity[..., 0], velocity[..., 1])


# Worlds ---------------------------------------------------------------------------------------------------------------


class World(Protocol):
    """N robots that take control steps."""

    def step(self, qpos: Array, qvel: Array, action: Array, alive: Flags) -> tuple[Array, Array, Flags]:
        """qpos (N, nq) and qvel (N, nv) after a control step, and which robots (N,) left the finite numbers.

        Those, and all that are not alive, stay as they were.
        """


class Here:
    """This simulator."""

    def __init__(self, sim: Simulator) -> None:
        self.sim = sim

    @torch.no_grad()
    def step(self, qpos: Array, qvel: Array, action: Array, alive: Flags) -> tuple[Array, Array, Flags]:
        tensors = (torch.as_tensor(x, dtype=self.sim.dtype, device=self.sim.device) for x in (qpos, qvel, action))
        new = [x.double().numpy(force=True) for x in self.sim.step(*tensors)]
        q, v = (np.where(alive[:, None], after, before) for after, before in zip(new, (qpos, qvel), strict=True))
        return q, v, alive & self.sim.nonfinite.numpy(force=True)


class MuJoCo:
    """MuJoCo with its own contact and limits on a scene's file.

    Args:
        scene: its file is read again, whose mu is the friction of all geoms, whatever the scene's own is.
        num_envs: number of robots N.
        control_dt: s of a control step.
        friction: times that mu.
        substeps: steps of a control step; by default the fewest that are no longer than the file's.
    """

    def __init__(
        self, scene: Scene, num_envs: int, control_dt: float, friction: float = 1.0, substeps: int | None = None
    ) -> None:
        self.model = mujoco.MjModel.from_xml_path(scene.path)
        self.model.geom_friction[:, 0] = friction * load_scene(scene.path).mu
        self.substeps = substeps or math.ceil(control_dt / self.model.opt.timestep - 1e-6)
        self.model.opt.timestep = control_dt / self.substeps
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = [mujoco.MjData(self.model) for _ in range(num_envs)]
        low, high = self.model.actuator_ctrlrange.T
        self._middle, self._reach = (low + high) / 2, (high - low) / 2
        self._pool = ThreadPoolExecutor(available_cores())

    def step(self, qpos: Array, qvel: Array, action: Array, alive: Flags) -> tuple[Array, Array, Flags]:
        rows = np.flatnonzero(alive)
        ctrl, qpos, qvel, lost = self._middle + self._reach * action, qpos.copy(), qvel.copy(), np.zeros_like(alive)
        for k in rows:
            self.data[k].qpos[:], self.data[k].qvel[:], self.data[k].ctrl[:] = qpos[k], qvel[k], ctrl[k]
        self._advance([self.data[k] for k in rows])
        for k in rows:
            if (np.abs(self.data[k].qvel) < FASTEST).all() and np.isfinite(self.data[k].qpos).all():
                qpos[k], qvel[k] = self.data[k].qpos, self.data[k].qvel
            else:
                lost[k] = True
        return qpos, qvel, lost

    def _advance(self, data: Sequence[mujoco.MjData]) -> None:
        def run(share: Sequence[mujoco.MjData]) -> None:
            for d in share:
                mujoco.mj_step(self.model, d, self.substeps)  # without Python's lock

        count = available_cores()
        list(self._pool.map(run, (data[k::count] for k in range(count))))


class Control(MuJoCo):
    """Our laws of contact and limits as external forces in MuJoCo's dynamics, explicitly integrated.

    It shares nothing with this simulator but the scene's constants and spheres. What it does not reproduce is the
    harness's error, or that of the other's integrator.
    """

    def __init__(self, scene: Scene, num_envs: int, control_dt: float, substeps: int) -> None:
        super().__init__(scene, num_envs, control_dt, substeps=substeps)
        flags = mujoco.mjtDisableBit
        self.model.opt.disableflags |= flags.mjDSBL_CONSTRAINT | flags.mjDSBL_EULERDAMP
        self.scene, self.points = scene, Points(scene)
        self.links = np.flatnonzero(np.isfinite(scene.lower) | np.isfinite(scene.upper))
        self.dofs = self.links + scene.nv - scene.nlink
        self.owner = (self.points.body == np.arange(self.model.nbody)[:, None]).astype(float)  # (nbody, nc)

    def _advance(self, data: Sequence[mujoco.MjData]) -> None:
        if not data:
            return
        # What MuJoCo writes, seen one robot at a time, and a copy of it for all.
        seen = {name: [getattr(d, name)[None] for d in data] for name in (*Bodies._fields, "xipos", "qpos", "qvel")}
        now = {name: np.concatenate(views) for name, views in seen.items()}
        bodies = Bodies(*(now[name] for name in Bodies._fields))
        targets = [(d, d.xfrc_applied, d.qfrc_applied) for d in data]
        adr, step1, step2 = self.scene.qpos_adr[self.links], mujoco.mj_step1, mujoco.mj_step2
        for _ in range(self.substeps):
            for d in data:
                step1(self.model, d)
            for name, views in seen.items():
                np.concatenate(views, out=now[name])
            point, depth, velocity = self.points(bodies)
            force = contact_force(self.scene, depth, velocity)
            wrench = np.concatenate((force, cross(point - now["xipos"][:, self.points.body], force)), -1)
            on_bodies = self.owner @ wrench
            on_joints = limit_force(self.scene, self.links, now["qpos"][:, adr], now["qvel"][:, self.dofs])
            for (d, xfrc, qfrc), body, joint in zip(targets, on_bodies, on_joints, strict=True):
                xfrc[:], qfrc[self.dofs] = body, joint
                step2(self.model, d)
