"""Humanoid imitation, after DeepMimic (Peng et al. 2018, https://arxiv.org/abs/1804.02717): track a recorded motion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffsim.tasks.base import Contact, Task, TaskError
from diffsim.tasks.humanoid import Humanoid
from diffsim_robots.imitation.clip import Clip, read_clip, shipped
from diffsim_robots.imitation.kinematics import Kinematics, difference, matrix

RESTORED: dict[str, Clip] = {}  # those that a checkpoint brought along, by the option that named their file
STRAY = 0.5  # m; the episode ends when the root is further from the reference's


def draw(rand: Tensor, count: int) -> Tensor:
    """Draw an int64 (...) below count from rand (..., 1): uniform; rand = 0.5 gives the first."""
    return ((rand[..., 0] + 0.5).remainder(1.0) * count).long().clamp(max=count - 1)


class Imitation(Task):
    """A robot with a free root and hinges tracks a clip. Memory: the time in the clip, first of all.

    It is the one that `with_clip` gave, or the shipped `default_clip`. One of another robot raises a TaskError.
    """

    default_clip: ClassVar[str]
    given_clip: ClassVar[Clip | None] = None
    num_random = 1
    start, spread = (), ()
    _qpos: Tensor  # (T, nq) and (T, nv) of the reference
    _qvel: Tensor

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        self.clip = self.given_clip or read_clip(self.default_clip)

    @classmethod
    def with_clip(cls, clip: Clip | Path | str) -> type[Imitation]:
        """Return the task that tracks a clip, or that of a file or folder, see read_clip, unless one is restored."""
        given = clip if isinstance(clip, Clip) else RESTORED.get(str(clip)) or read_clip(clip)
        return type(cls.__name__, (cls,), {"given_clip": given, "__module__": cls.__module__})

    @classmethod
    def stored(cls) -> dict[str, Any]:
        """Return the clip, unless it is shipped."""
        clip = cls.given_clip
        if clip is None or (clip.name in shipped() and clip == read_clip(clip.name)):
            return {}
        return {"name": clip.name, "qpos": clip.qpos, "loop": clip.loop, "lengths": clip.lengths}

    @classmethod
    def restore(cls, options: str, stored: dict[str, Any]) -> None:
        for clip in (option for option in options.split(",") if "=" not in option):
            RESTORED.pop(clip, None)
            if stored:
                RESTORED[clip] = Clip(**stored)

    def first_step(self, rand: Tensor) -> Tensor:
        """The frame (...) int64 where an episode from rand (..., 1) starts (DeepMimic, 6.1: reference state init.)."""
        raise NotImplementedError

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        """The reference's state at the first step."""
        step = self.first_step(rand)
        return self._qpos[step], self._qvel[step]


class HumanoidImitation(Imitation):
    """The robot of the humanoid task. The reference is at frame `step` of the clip, which goes round if it is a loop.

    Memory: the control step of the clip's time.
    """

    name = "humanoid_imitation"
    like: ClassVar[str | None] = "humanoid"
    asset = Humanoid.asset
    contact: ClassVar[Contact] = Humanoid.contact
    substeps, fast = Humanoid.substeps, Humanoid.fast
    obs_dim = 57
    num_memory = 1
    default_clip = "humanoid_run"
    # The middles of these geoms
    ends: ClassVar[tuple[str, ...]] = ("right_hand", "left_hand", "right_foot_inner", "left_foot_inner")

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        if self.clip.lengths:
            raise TaskError(f"task {self.name!r} tracks one motion, not the {len(self.clip.lengths)} of {self.clip}")
        scene = self.load_robot()
        model, trunk = scene.mj_model, scene.contact_link == 0
        self._kinematics = Kinematics(model, device, dtype)
        self.clip.check(model)
        geoms = [model.geom(name).id for name in self.ends]
        self._bodies = torch.tensor(model.geom_bodyid[geoms] - 1, device=device, dtype=torch.int64)
        self._points = torch.tensor(model.geom_pos[geoms], device=device, dtype=dtype)
        self._trunk = torch.tensor(scene.contact_position[trunk], device=device, dtype=dtype)
        self._radii = torch.tensor(scene.contact_radius[trunk], device=device, dtype=dtype)

        clip = self.clip.at(self.control_dt)
        self.period = len(clip)
        self._qpos, self._qvel = clip.qpos[: self.period].to(device, dtype), clip.velocity(self.control_dt)
        self._qvel = self._qvel[: self.period].to(device, dtype)
        self._advance = self.clip.advance.to(device, dtype)
        at_origin = torch.cat((torch.zeros_like(self._qpos[:, :2]), self._qpos[:, 2:]), dim=-1)
        self._reference = torch.cat((at_origin[:, 3:], self._qvel[:, 3:], *self._places(at_origin)), dim=-1)
        self._sizes = (4, self._qpos.shape[1] - 7, self._qvel.shape[1] - 3, 3 * len(geoms), 3)

    def first_step(self, rand: Tensor) -> Tensor:
        count = self.period if self.clip.loop else self.period - 1
        return draw(rand, count)

    def begin(self, rand: Tensor) -> Tensor:
        return self.first_step(rand).to(rand.dtype).unsqueeze(-1)

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        return memory + 1.0

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """Height, quaternion wxyz, joints; qvel; x and y from the reference's; sine and cosine of the phase.

        The distance from the reference decides on reward and end, so a value function needs it. Where in the world the
        robot is, it does not.
        """
        step = memory[..., 0].long()
        frame, rounds = step % self.period, step // self.period
        lag = qpos[..., :2] - (self._qpos[frame, :2] + rounds.unsqueeze(-1) * self._advance)
        phase = frame.to(qpos.dtype).unsqueeze(-1) * (2 * math.pi / self.period)
        return torch.cat((qpos[..., 2:], qvel, lag, phase.sin(), phase.cos()), dim=-1)

    def frame(self, obs: Tensor) -> Tensor:
        """The reference's frame (...) int64, which the phase in obs (..., obs_dim) tells."""
        phase = torch.atan2(obs[..., -2], obs[..., -1]).detach()
        return (phase * (self.period / (2 * math.pi))).round().long().remainder(self.period)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """DeepMimic, 5.3: 0.65 r_p + 0.1 r_v + 0.15 r_e + 0.1 r_c, at most 1."""
        pose, velocity, end_effector, centre_of_mass = self.terms(obs)
        return 0.65 * pose + 0.1 * velocity + 0.15 * end_effector + 0.1 * centre_of_mass

    def terms(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """r_p, r_v, r_e and r_c (...): pose, velocity, end effectors and centre of mass, each in [0, 1].

        The root's rotation counts as a joint, and its angular velocity as a joint's rate.
        """
        qpos, qvel = self._state(obs)
        quat, joints, rates, ends, centre = self._reference[self.frame(obs)].split(self._sizes, dim=-1)
        places = self._places(qpos)
        turn, bend = difference(quat, qpos[..., 3:7]), qpos[..., 7:] - joints
        pose = torch.exp(-2.0 * (turn.square().sum(-1) + bend.square().sum(-1)))
        velocity = torch.exp(-0.1 * (qvel[..., 3:] - rates).square().sum(-1))
        end_effector = torch.exp(-40.0 * (places[0] - ends).square().sum(-1))
        centre_of_mass = torch.exp(-10.0 * (places[1] - centre).square().sum(-1))
        return pose, velocity, end_effector, centre_of_mass

    def terminated(self, obs: Tensor) -> Tensor:
        """The trunk touches the ground (DeepMimic, 6.2), the root strays from the reference, or the clip is over."""
        qpos, _ = self._state(obs)
        frame = self.frame(obs)
        height = obs[..., :1] + (matrix(obs[..., 1:5])[..., 2:, :] * self._trunk).sum(-1) - self._radii
        away = torch.cat((qpos[..., :2], qpos[..., 2:3] - self._qpos[frame, 2:3]), dim=-1)
        return (height < 0).any(-1) | (away.square().sum(-1) > STRAY**2) | self.over(obs)

    def over(self, obs: Tensor) -> Tensor:
        """The last frame of a clip that does not loop."""
        return super().over(obs) if self.clip.loop else self.frame(obs) == self.period - 1

    def _state(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """qpos, with x and y from the reference's, and qvel."""
        rest, qvel, lag, _ = obs.split((self._qpos.shape[1] - 2, self._qvel.shape[1], 2, 2), dim=-1)
        return torch.cat((lag, rest), dim=-1), qvel

    def _places(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Place the end effectors (..., 12) and of the centre of mass (..., 3), in the frame of qpos (..., nq)."""
        positions, rotations = self._kinematics(qpos)
        arms = (rotations.index_select(-3, self._bodies) * self._points.unsqueeze(-2)).sum(-1)
        ends = positions.index_select(-2, self._bodies) + arms
        return ends.flatten(-2), self._kinematics.centre(positions, rotations)
