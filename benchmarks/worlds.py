"""Worlds in which policies act, this simulator or MuJoCo, and the one loop that steps them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from common import Case
from numpy.typing import NDArray
from torch import Tensor

from diffsim import DiffEnv, Scene, Simulator, load_scene
from diffsim.robot.elements import numeric
from diffsim.sim.launcher import available_cores
from diffsim.tasks import Task
from diffsim.training import fail
from diffsim.training.evaluation import SEED
from diffsim_cli.render import slabs

Array = NDArray[np.float64]
FASTEST = 1e5  # m/s or rad/s; beyond it a robot is lost, as in Simulator
PUSHED_EVERY = 4.0  # s
FAR_ASIDE = 50.0  # m to each side, where a terrain ends
GROUND_LAW = "condim friction solref solimp solmix priority margin gap contype conaffinity".split()

mujoco.set_mju_user_warning(lambda _: None)  # that a simulation is unstable, which World.step says


class Here:
    """N robots in this simulator, whose state is the caller's."""

    def __init__(self, sim: Simulator) -> None:
        self.sim = sim

    def step(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return qpos (N, nq) and qvel (N, nv) after a control step, and which robots (N,) left the finite numbers.

        These stay as they were.
        """
        new = self.sim.step(*(x.to(self.sim.device, self.sim.dtype) for x in (qpos, qvel, action)))
        return new[0].to(qpos), new[1].to(qvel), self.sim.nonfinite.to(qpos.device, copy=True)


def mujoco_model(scene: Scene, control_dt: float, substeps: int | None = None) -> mujoco.MjModel:
    """A scene's file as MuJoCo reads it, with the fewest steps of equal length that are no longer than the file's. Of a
    scene that is no file's, as a task may make one, its model.

    Given substeps of a control step, with those and elliptic cones: the law of --contact mujoco. Without, the paper's
    tasks have pyramidal cones.
    """
    file = Path(scene.path).is_file()
    model = mujoco.MjModel.from_xml_path(scene.path) if file else copy.copy(scene.mj_model)
    if substeps is not None:
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    elif len(numeric(model, "k_n")):  # the paper's tasks, in MuJoCo's default cone
        model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.timestep = control_dt / (substeps or math.ceil(control_dt / model.opt.timestep - 1e-6))
    return model


class MuJoCo:
    """MuJoCo with its own contact and limits on a scene's file, of whose friction `friction` is a factor.

    That is the springs' mu of the file, whatever the scene's own is, or with own_friction what each geom has there. Of
    substeps see mujoco_model.
    """

    qpos: slice | NDArray[np.int_] = slice(None)  # where the file has what the task has
    qvel: slice | NDArray[np.int_] = slice(None)

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        control_dt: float,
        friction: float = 1.0,
        own_friction: bool = False,
        substeps: int | None = None,
    ) -> None:
        model = mujoco_model(scene, control_dt, substeps)
        if not own_friction:
            model.geom_friction[:, 0] = load_scene(scene.path).mu
        model.geom_friction[:, 0] *= friction
        low, high = model.actuator_ctrlrange.T
        self._middle, self._reach = (low + high) / 2, (high - low) / 2
        self._begin(model, num_envs, control_dt)

    def _begin(self, model: mujoco.MjModel, num_envs: int, control_dt: float) -> None:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.model, self.substeps = model, max(1, round(control_dt / model.opt.timestep))
        self.data = [mujoco.MjData(model) for _ in range(num_envs)]
        self._pool = ThreadPoolExecutor(available_cores())

    def advance(self, data: mujoco.MjData, action: Array) -> None:
        data.ctrl[:] = self._middle + self._reach * action
        mujoco.mj_step(self.model, data, self.substeps)  # without Python's lock

    def step(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        new_qpos, new_qvel, actions = (x.double().numpy(force=True).copy() for x in (qpos, qvel, action))
        lost = np.zeros(len(qpos), bool)

        def run(rows: Sequence[int]) -> None:
            for k in rows:
                data = self.data[k]
                data.qpos[self.qpos], data.qvel[self.qvel] = new_qpos[k], new_qvel[k]
                self.advance(data, actions[k])
                if (np.abs(data.qvel) < FASTEST).all() and np.isfinite(data.qpos).all():
                    new_qpos[k], new_qvel[k] = data.qpos[self.qpos], data.qvel[self.qvel]
                else:
                    lost[k] = True

        count = available_cores()
        list(self._pool.map(run, (range(k, len(lost), count) for k in range(count))))
        return torch.from_numpy(new_qpos).to(qpos), torch.from_numpy(new_qvel).to(qvel), torch.from_numpy(lost)


def on_terrain(spec: mujoco.MjSpec, profile: Array) -> mujoco.MjModel:
    """A file's model with a profile (K, 2) in the place of its planes: boxes whose upper faces are the segments, with
    all numbers of the first plane."""
    planes = [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    if not planes:
        fail("--rough takes the place of planes, and the file has none")
    law = {name: getattr(planes[0], name) for name in GROUND_LAW}
    for (length, _, thickness), centre, rotation in slabs(profile):
        mujoco.mju_mat2Quat(quat := np.empty(4), rotation.ravel())
        size = [length, FAR_ASIDE, thickness]
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=centre, quat=quat, **law)
    for plane in planes:
        spec.delete(plane)
    return spec.compile()


World = Here | MuJoCo


class OtherFile(MuJoCo):
    """MuJoCo on any file of a robot, driven as the task's own; joints are those of the same names.

    Servos get the policy's targets, and a motor the torque that the task's servo would have: the file's passive damping
    of its joint acts there, and so do its clamps. A file that lacks a joint or its actuator ends the benchmark.

    On a profile (K, 2) the ground is made of boxes, see on_terrain.
    """

    def __init__(
        self,
        env: DiffEnv,
        num_envs: int,
        file: Path | None,
        friction: float,
        mass: float = 1.0,
        gains: float = 1.0,
        profile: Array | None = None,
    ) -> None:
        own = env.scene.mj_model
        if file and not file.is_file():
            fail(f"no such file: {file}; MuJoCo Menagerie is at github.com/google-deepmind/mujoco_menagerie")
        model = copy.copy(own) if file is None else mujoco.MjModel.from_xml_path(str(file))
        if profile is not None:
            model = on_terrain(mujoco.MjSpec.from_file(str(file or env.scene.path)), profile)
        model.geom_friction[:, 0] *= friction
        model.pair_friction[:, :2] *= friction
        model.body_mass *= mass
        model.body_inertia *= mass
        mujoco.mj_setConst(model, mujoco.MjData(model))
        names = [own.joint(j).name for j in range(1, own.njnt)]
        at_joints = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        actuator = {model.joint(model.actuator_trnid[a, 0]).name: a for a in at_joints}
        if missing := [name for name in names if name not in actuator]:
            fail(f"{file}: no actuator of the joints {', '.join(missing)}")
        joints, self._ctrl = np.array([model.joint(n).id for n in names]), np.array([actuator[n] for n in names])
        self._joint_qpos, self._joint_qvel = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self.qpos = np.concatenate((np.arange(7), self._joint_qpos))
        self.qvel = np.concatenate((np.arange(6), self._joint_qvel))
        self._servo = model.actuator_biastype[self._ctrl] == mujoco.mjtBias.mjBIAS_AFFINE
        self._order = [own.actuator_trnid[:, 0].tolist().index(j) for j in range(1, own.njnt)]
        low, high = own.actuator_ctrlrange[self._order].T
        self._middle, self._reach = (low + high) / 2, (high - low) / 2
        self._stiffness = gains * own.actuator_gainprm[self._order, 0]
        self._damping = -gains * own.actuator_biasprm[self._order, 2]
        servos = self._ctrl[self._servo]
        model.actuator_gainprm[servos, 0] *= gains
        model.actuator_biasprm[servos, 1:3] *= gains
        self._least, self._most = model.actuator_ctrlrange[self._ctrl].T
        self._limited = model.actuator_ctrllimited[self._ctrl] != 0
        self._begin(model, num_envs, env.control_dt)

    def advance(self, data: mujoco.MjData, action: Array) -> None:
        target = self._middle + self._reach * action[self._order]
        if self._servo.all():
            data.ctrl[self._ctrl] = np.where(self._limited, target.clip(self._least, self._most), target)
            mujoco.mj_step(self.model, data, self.substeps)
            return
        for _ in range(self.substeps):
            torque = self._stiffness * (target - data.qpos[self._joint_qpos])
            torque -= self._damping * data.qvel[self._joint_qvel]
            ctrl = np.where(self._servo, target, torque)
            data.ctrl[self._ctrl] = np.where(self._limited, ctrl.clip(self._least, self._most), ctrl)
            mujoco.mj_step(self.model, data)


# Policies in a world --------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """The state from which a policy goes on."""

    qpos: Tensor  # (n, nq)
    qvel: Tensor  # (n, nv)
    action: Tensor  # (n, nu) the last one, which some tasks observe
    memory: Tensor  # (n, num_memory) of the task


class Step(NamedTuple):
    """What a control step has led to."""

    state: State
    obs: Tensor  # (n, obs_dim)
    reward: Tensor  # (n,), none of a step in which a robot was lost
    fallen: Tensor  # (n,) who has fallen by then, or is lost


def starts(env: DiffEnv, dtype: torch.dtype | None = None) -> State:
    """The start states that all worlds share, those of an evaluation."""
    env.reset(seed=SEED)
    nothing = torch.zeros(env.num_envs, env.scene.nu, device=env.device)
    parts = env.qpos, env.qvel, nothing, env.memory
    return State(*(part.to(dtype or env.dtype, copy=True) if part.is_floating_point() else part for part in parts))


def pushes(size: float, control_dt: float, drawn: np.random.Generator) -> Callable[[int, State], State]:
    """For rollout: every PUSHED_EVERY s each root's velocity changes by size [m/s] in a random horizontal direction."""

    def push(step: int, state: State) -> State:
        if not size or not step or step % round(PUSHED_EVERY / control_dt):
            return state
        angles, kicks = drawn.uniform(0, 2 * np.pi, len(state.qvel)), np.zeros(state.qvel.shape)
        kicks[:, :2] = size * np.stack((np.cos(angles), np.sin(angles)), 1)
        return state._replace(qvel=state.qvel + torch.from_numpy(kicks))

    return push


@torch.no_grad()
def rollout(
    world: World,
    task: Task,
    policy: Callable[[Tensor], Tensor],
    start: State,
    steps: int,
    push: Callable[[int, State], State] = lambda step, state: state,
) -> Iterator[Step]:
    """Each of so many control steps. Nothing is reset: what has fallen lies there. Sensors have no noise.

    Args:
        task: says what is observed and rewarded, and who has fallen.
        push: what happens to the robots before a step, which the policy has not seen.
    """
    state, n = start, len(start.qpos)
    fallen = torch.zeros(n, dtype=torch.bool, device=start.qpos.device)
    ground = task.ground

    def observe(state: State) -> Tensor:
        return task.observe_with(state.qpos if ground is None else ground.lower(state.qpos), *state[1:])

    obs, middle = observe(state), start.qpos.new_full((n, task.num_noise), 0.5)
    for step in range(steps):
        action = policy(obs.float()).clamp(-1.0, 1.0).to(obs.dtype)
        state = push(step, state)
        qpos, qvel, lost = world.step(state.qpos, *task.disturb(state.qvel, action, state.memory))
        state = State(qpos, qvel, action, task.remember(state.memory, action, middle))
        obs = observe(state)
        fallen = fallen | (lost := lost.to(fallen.device)) | task.terminated(obs)
        yield Step(state, obs, task.reward(obs, action).masked_fill(lost, 0.0), fallen)


class Motion(NamedTuple):
    """The first episode of each of n robots in one world."""

    qpos: Array  # (T + 1, n, nq) from the start on; valid up to an episode's length
    qvel: Array  # (T + 1, n, nv)
    returns: Array  # (n,)
    lengths: NDArray[np.int_]  # (n,) control steps
    fallen: NDArray[np.bool_]  # (n,) whether the episode ended with a fall


def episodes(world: World, task: Task, policy: Callable[[Tensor], Tensor], start: State, steps: int) -> Motion:
    """Episodes of at most so many steps."""
    n = len(start.qpos)
    path, alive, returns, lengths = [start], torch.ones(n, dtype=torch.bool), torch.zeros(n).double(), torch.zeros(n)
    for step in rollout(world, task, policy, start, steps):
        path.append(step.state)
        returns += torch.where(alive, step.reward, 0.0)
        lengths += alive
        alive = ~step.fallen
        if not alive.any():
            break
    qpos, qvel = (torch.stack(states).numpy() for states in list(zip(*path, strict=True))[:2])
    return Motion(qpos, qvel, returns.numpy(), lengths.int().numpy(), (~alive).numpy())


def in_double(env: DiffEnv) -> Task:
    """The environment's task in float64 on the CPU."""
    return type(env.task)(dtype=torch.float64).bind(env.scene)


def travel(case: Case, world: World, steps: int) -> Motion:
    """A policy's episodes in a world, from the start states that all worlds share."""
    return episodes(world, in_double(case.env), case.saved.network, starts(case.env, torch.float64), steps)
