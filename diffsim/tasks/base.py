"""Task: a robot, its start states, its observation, its reward, and the end of its episodes.

The methods are differentiable torch on batches of any leading shape; they make no tensor from Python data and never
wait for the device, so they can be captured into a CUDA graph. Equations and tables are those of the SHAC paper (Xu et
al. 2022, appendix A.3); what it leaves open (start states, substeps) follows its public benchmark. World frame, z up.
"""

from __future__ import annotations

import os
import pkgutil
import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

import mujoco
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.robot.elements import home_key
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.sim.elevation import Elevation
from diffsim.sim.integration import TOLERANCE, Contact, Integration, check_contact

Accuracy = Literal["fast", "default", "accurate"]
Asset: TypeAlias = str | os.PathLike[str] | mujoco.MjModel | mujoco.MjSpec
Parts: TypeAlias = tuple[tuple[str, int], ...]  # names and sizes
Defaults: TypeAlias = Mapping[str, Mapping[str, Any]]
RATE = {"soft": 960, "mujoco": 240}  # 1/s, substeps of a task that does not say how many
OPTIONS = "diffsim_robots.variation:configure"  # reads options after a task's name
OWN_TASK = "diffsim.tasks.own_task"  # checks tasks outside this package, centres actions
OURS = "diffsim.", "diffsim_robots."  # modules whose tasks need no check
ASSETS = Path(__file__).resolve().parents[1] / "assets"


class TaskError(ValueError):
    """Raised for an unknown task, or one that does not fit its robot, with a message of one line."""


class Task:
    """A task. Subclasses fill in the attributes and the methods `observe` and `reward`.

    docs/own_robot.md lists the attributes and their defaults. An episode starts uniformly in start +- spread / 2, where
    both list qpos, then qvel.

    Example:
        class Forward(diffsim.Task):
            name, asset = "forward", "robot.xml"

            def observe(self, qpos, qvel, action):
                return torch.cat((qpos[..., 1:], qvel), dim=-1)

            def reward(self, obs, action):
                return obs[..., 5]                                        # m/s

        env = diffsim.make(Forward, num_envs=4)

    Raises:
        TaskError: by `make`, of a task that does not fit its robot.
    """

    name: ClassVar[str] = "task"
    asset: ClassVar[Asset]  # of a file's name, load_robot says where it is looked for
    contact: ClassVar[Contact] = "mujoco"  # unless the user asks for the other one
    substeps: ClassVar[int]  # simulation steps per control step: the "default" accuracy on this contact
    fast: ClassVar[Integration]  # on soft contact, chosen by measurement: docs/numerics.md
    obs_dim: int
    num_random: int  # random numbers per reset
    forward_column: int | None  # of qpos [m], grows as the robot moves forward; None if it does not travel
    actor_dim: ClassVar[int | None] = None  # how many of them, the first ones, the actor sees; None: all, as a critic
    obs_parts: ClassVar[Parts] = ()  # of the observation, for `named` and `export`; empty: unnamed
    memory_parts: ClassVar[Parts] = ()  # of the memory, for `recall`
    like: ClassVar[str | None] = None  # a task of the paper, with whose settings learners begin
    defaults: ClassVar[Defaults] = {}  # of learners' flags, by script, "shac", and by script and device, "shac gpu"
    initial_gain: ClassVar[float] = 1.0  # factor of an actor's last weights at first; below 1: small actions (mlp)
    symmetric: ClassVar[bool] = False  # whether learners treat left and right alike unless told otherwise
    mirrored_by: ClassVar[str | None] = None  # "module:function" that makes its `mirror`
    varied_by: ClassVar[str | None] = None  # "module:Class" of what a training changes, see diffsim_robots/variation.py
    num_memory: ClassVar[int] = 0  # numbers kept for each environment from step to step: see begin and remember
    num_noise: ClassVar[int] = 0  # random numbers per control step, for `remember`
    episode_length: ClassVar[int] = 1000  # control steps
    control_dt: float = 1 / 60  # s
    action_scale: ClassVar[float | None] = None  # control per action, from the start's on; None: over the ctrlrange
    min_height: ClassVar[float | None] = None  # m; the episode ends when obs[0] is below
    ground: Elevation | None = None  # set by an environment on terrain: heights are then those over it at the root's x
    start: tuple[float, ...] = ()  # by default the robot's keyframe "home", its first one, or qpos0; at rest
    spread: tuple[float, ...] | float = 0.0

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        self.device, self.dtype = torch.device(device), dtype
        self._start = torch.tensor(self.start, device=device, dtype=dtype)
        self._spread = torch.tensor(self.spread, device=device, dtype=dtype)
        self._nq, self._quaternions = (len(self.start) + 1) // 2, list[int]()

    @classmethod
    def load_robot(cls) -> Scene:
        """Load the robot of the asset; override it to change the robot.

        Example:
            from diffsim.robot.pairs import with_pairs

            class Touching(diffsim.Task):
                name = "touching"

                @classmethod
                def load_robot(cls):
                    return with_pairs(diffsim.load_scene("robot.xml"))    # its parts touch each other

        A file of diffsim's tasks is in diffsim/assets. Another task's is searched next to the file of the class that
        names it, in the working directory and in diffsim/assets.

        Raises:
            TaskError: there is no asset, or no such file.
            SceneError: the robot cannot be simulated.
        """
        owner = next((kind for kind in cls.__mro__ if "asset" in vars(kind)), cls).__module__
        asset: Asset | None = getattr(cls, "asset", None)
        if asset is None:
            raise TaskError(f"task {cls.name!r} names no robot: give it an asset, such as a file's path")
        if not isinstance(asset, str | os.PathLike):
            return load_scene(asset)
        beside = getattr(sys.modules.get(owner), "__file__", None) or "."
        folders = [] if owner.startswith(OURS) else [Path(beside).resolve().parent, Path.cwd()]
        for folder in (*folders, ASSETS):
            if (folder / asset).is_file():
                return load_scene(folder / asset)
        raise TaskError(f"task {cls.name!r}: no robot file {str(asset)!r} in {' or '.join(map(str, folders))}")

    def scene(self) -> Scene:
        """Return the robot as this task drives it; by default that of `load_robot`, with its action_scale."""
        return self.load_robot() if self.action_scale is None else pkgutil.resolve_name(OWN_TASK).around_start(self)

    @torch.no_grad()
    def bind(self, scene: Scene) -> Task:
        """Fit the task to its robot and return it: find missing start, num_random, obs_dim and forward_column.

        Raises:
            TaskError: of a task outside this package, see tasks/own_task.py.
        """
        own = None if type(self).__module__.startswith(OURS) else pkgutil.resolve_name(OWN_TASK)
        self.forward_column = getattr(self, "forward_column", way_forward(scene))
        if own is not None:
            own.check_attributes(self, scene.nq)
        n, m = scene.nq + scene.nv, scene.mj_model
        self.num_random = getattr(self, "num_random", n)
        if type(self).reset is Task.reset:
            self._nq, self._quaternions = scene.nq, scene.quaternion_adr.tolist()
            if not len(self._start):
                home = self._start.new_tensor(m.key_qpos[home_key(m)] if m.nkey else scene.qpos0)
                self._start = torch.cat((home, self._start.new_zeros(scene.nv)))
        if own is not None:
            own.check_methods(self, scene)
        if not hasattr(self, "obs_dim"):
            rand = self._start.new_full((1, self.num_random), 0.5)
            obs = self.observe_with(*self.reset(rand), self._start.new_zeros(1, scene.nu), self.begin(rand))
            self.obs_dim = obs.shape[-1]
        return self

    @classmethod
    def presets(cls, contact: str | None = None) -> dict[str, Integration]:
        """Return its presets "fast", "default" (the paper's) and "accurate" on a contact model, its own if None.

        "accurate" has four times the substeps of "default", and errs a quarter. There is no "fast" on MuJoCo's contact:
        what saves much time there errs too much (docs/numerics.md).

        Raises:
            ValueError: another contact model.
        """
        contact = cls.contact if contact is None else contact
        check_contact(contact)
        own = hasattr(cls, "substeps") and contact == cls.contact
        default = Integration(contact, cls.substeps if own else max(1, round(RATE[contact] * cls.control_dt)))
        accurate = default._replace(substeps=4 * default.substeps)
        if contact == "mujoco":
            accurate = accurate._replace(tolerance=TOLERANCE / 10)
        fast = {"fast": cls.fast} if contact == "soft" and hasattr(cls, "fast") else {}
        return fast | {"default": default, "accurate": accurate}

    @classmethod
    def integration(cls, accuracy: str, contact: str | None = None) -> Integration:
        """Return one of the presets.

        Raises:
            ValueError: another name, or a preset that the task has not.
        """
        presets = cls.presets(contact)
        if accuracy not in presets:
            on = f" on {contact or cls.contact} contact"
            raise ValueError(f"task {cls.name!r} has no preset {accuracy!r}{on}; choose from {', '.join(presets)}")
        return presets[accuracy]

    @classmethod
    def falls(cls) -> bool:
        """Tell whether episodes end when the robot falls, not only by time."""
        return cls.min_height is not None or cls.terminated is not Task.terminated

    @classmethod
    def has_mirror(cls) -> bool:
        """Tell whether the task has a mirror image."""
        return cls.mirrored_by is not None

    @cached_property
    def mirror(self) -> Any:
        """Return the task's mirror image, left and right exchanged (symmetry/mirror.py).

        It is made at the first call, which a CUDA graph cannot capture. Raises ValueError if the task has none.
        """
        if self.mirrored_by is None:
            raise ValueError(f"task {self.name!r} has no mirror image")
        return pkgutil.resolve_name(self.mirrored_by)(self)

    @classmethod
    def configured(cls, options: str) -> type[Task]:
        """Return the task with the options that follow its name and a colon; raises TaskError for unknown ones."""
        return pkgutil.resolve_name(OPTIONS)(cls, options)

    @classmethod
    def terrain(cls, num_envs: int, seed: int) -> np.ndarray | None:
        """Return the profiles of its ground, (K, 2) or (num_envs, K, 2), see Scene.with_terrain; None: a plane."""
        return None

    @classmethod
    def stored(cls) -> dict[str, Any]:
        """Return what a checkpoint must hold of it to make it again, besides its name: data that torch.save takes."""
        return {}

    @classmethod
    def restore(cls, options: str, stored: dict[str, Any]) -> None:
        """Let `configured` take what `stored` gave in place of the files that the options name; none if it is empty."""

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        """Draw start states qpos (..., nq), qvel (..., nv) from rand (..., num_random), uniform in [0, 1).

        rand = 0.5 everywhere gives the unperturbed start.
        """
        drawn = torch.addcmul(self._start, rand - 0.5, self._spread)
        for k in self._quaternions:
            drawn[..., k : k + 4] = F.normalize(drawn[..., k : k + 4], dim=-1)
        return drawn[..., : self._nq], drawn[..., self._nq :]

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """Return the observation (..., obs_dim) of qpos (..., nq) and qvel (..., nv).

        action (..., nu) is the one that led there, clipped to [-1, 1]; zeros at the start of an episode. Raises a
        NotImplementedError if the task's observation depends on its memory.
        """
        raise NotImplementedError(f"an observation of task {self.name!r} depends on its memory: use observe_with")

    def begin(self, rand: Tensor) -> Tensor:
        """Return the memory (..., num_memory) at an episode's start from rand (..., num_random); empty by default."""
        return rand[..., :0]

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        """Return the memory (..., num_memory) after a control step.

        Args:
            memory: (..., num_memory) before it; gradients flow through it within a rollout.
            action: (..., nu) of the step, clipped to [-1, 1].
            noise: (..., num_noise) uniform in [0, 1).
        """
        return memory

    def named(self, obs: Tensor) -> dict[str, Tensor]:
        """Return the parts of observations (..., obs_dim) by the names of obs_parts."""
        return split(obs, self.obs_parts)

    def recall(self, memory: Tensor) -> dict[str, Tensor]:
        """Return the parts of memory (..., num_memory) by the names of memory_parts."""
        return split(memory, self.memory_parts)

    def ghost(self, memory: Tensor) -> Tensor | None:
        """Return the world qpos (..., nq) that the robot should track, for videos and pages, or None."""
        return None

    def disturb(self, qvel: Tensor, action: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Apply pushes and delays to qvel (..., nv) and action (..., nu) before a control step.

        memory: (..., num_memory) before the step.
        """
        return qvel, action

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """Do what `observe` does, given the memory (..., num_memory) after the step."""
        return self.observe(qpos, qvel, action)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Return the reward (...) of action (..., nu), clipped to [-1, 1], which led to obs (..., obs_dim)."""
        raise NotImplementedError

    def reward_terms(self, obs: Tensor, action: Tensor) -> dict[str, Tensor]:
        """Return the weighted terms (...) whose sum is the reward, by name; evaluations log them. None by default."""
        return {}

    def terminated(self, obs: Tensor) -> Tensor:
        """Return bool (...), true where the robot has fallen or the task is over."""
        return self.over(obs) if self.min_height is None else obs[..., 0] < self.min_height

    def over(self, obs: Tensor) -> Tensor:
        """Return bool (...), true where the task is finished, which ends episodes without early termination, too."""
        return torch.zeros_like(obs[..., 0], dtype=torch.bool)


class Planar(Task):
    """A robot of hinges and slides; it observes its state except its position, the first `places` of qpos.

    Tables 7 and 8: height and pitch (or yaw), joints, then the rates of x, height (or y), pitch and joints.
    """

    places: ClassVar[int] = 1

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        return torch.cat((qpos[..., self.places :], qvel), dim=-1)


def width(parts: Parts) -> int:
    """Return the number of columns of all parts."""
    return sum(size for _, size in parts)


def split(values: Tensor, parts: Parts) -> dict[str, Tensor]:
    """Return the columns (..., size) of each part of values (..., width) by its name."""
    names, sizes = zip(*parts, strict=True)
    return dict(zip(names, values.split(sizes, dim=-1), strict=True))


def height_reward(delta: Tensor, upper: float, slope: float) -> Tensor:
    """Return R_height, Eqs. 16-17, 21-22: with D = clip(delta, -1, upper) [m], -200 D^2 below zero, slope D above."""
    return slope * delta.clamp(0.0, upper) - 200.0 * delta.clamp(-1.0, 0.0).square()


def way_forward(scene: Scene) -> int | None:
    """Return the column of qpos that is the root's x, of its free joint or its slide along x.

    None if the robot has no such joint, as an arm, or if neither ground nor fluid moves it forward.
    """
    found = np.flatnonzero(scene.root.along > 0.99)
    return int(found[0]) if len(found) and scene.features & {"contact", "drag"} else None
