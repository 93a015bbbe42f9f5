"""Motion tracking: a humanoid with servos follows one clip or many, with smooth terms for learners that use gradients.

All that is observed of the reference is seen from the robot, so that nothing tells one clip from another. A robot is
data: a subclass with its file, the names of its sides and the number of its joints.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import Array
from diffsim.symmetry.mirror import PSEUDOVECTOR, VECTOR, Mirror, Reflection, Sides, reflections
from diffsim.tasks.base import Contact, Defaults, TaskError, width
from diffsim.tasks.locomotion import rotate
from diffsim_cli.gait import trace
from diffsim_robots.common import add_up, push, score
from diffsim_robots.imitation.clip import FASTEST, Clip
from diffsim_robots.imitation.kinematics import difference
from diffsim_robots.imitation.task import STRAY, Imitation, draw
from diffsim_robots.variation import Ranges

SMOOTH = 5  # frames of 1/60 s whose mean a frame of the reference is
SWIFTEST = 10.0  # m/s
STANDING = 0.05  # share of a clip's frames in which a foot may be in the ground: captured feet slip and sink
REACH = 0.4  # rad, by how much an action changes a servo's target: its range is the clip's and so much to both sides
BEFORE_END = 60  # frames, at least, that an episode has of its clip, if this is longer
AHEAD = 3  # frames, how much earlier the reference is seen
SLIPPING = 2.5  # recorded feet slip less than a third of what they seem to with another order of the quaternion
STILL = 0.01  # m/s of the feet, below which a clip may stand still in any order
WEIGHTS = {  # of the reward's terms; see reward_terms. A weight of 0 switches a term off
    "alive": 3.0,  # a perfect step's reward
    "root_position": -0.5,
    "root_rotation": -0.4,
    "joint_position": -0.5,
    "joint_velocity": -0.1,
    "root_velocity": -0.15,
    "action_rate": -0.02,
}
ORDER = (  # of additions, see add_up
    ("alive",),
    ("root_position", "root_rotation"),
    ("joint_position", "joint_velocity"),
    ("root_velocity", "action_rate"),
)
TURNED = 1.0  # rad; the episode ends when the root is turned from the reference's by more
# Learners begin near the reference pose, with little noise: more throws the robot over.
BEGIN: dict[str, Any] = {
    "critic_hidden": (512, 256),
    "critic_lr": 1e-3,
    "target_alpha": 0.9,
    "initial_log_std": -2.0,
    "adjoint_clip": 5.0,
    "horizon": 16,
}


def slip(depth: Array, slide: Array) -> float:
    """The median slide [m] of the deepest point in a frame, see `trace`: one that bears the robot stays where it is."""
    return float(np.median(np.take_along_axis(slide, depth[:-1].argmax(1)[:, None], 1)))


class Tracking(Imitation):
    """qpos = (position, quaternion wxyz, joints), qvel = (world linear, body angular velocity, joint rates).

    A clip is played once; its last frame is held. Memory: memory_parts; a push is due in the next step.

    Attributes:
        weights: of the reward's terms, by name.
        motions: the first frame of each motion, and how many control steps it lasts, int64 on the CPU.
        low, high: (joints,) rad, between which the servos' targets are.
    """

    joints: ClassVar[int]
    sides: ClassVar[Sides]  # (right, left) beginnings of the names of joints and actuators
    contact: ClassVar[Contact] = "mujoco"
    substeps = 4
    control_dt = 0.02
    episode_length = 500  # 10 s
    forward_column = None  # what counts is the reference
    varied_by = "diffsim_robots.variation:Variation"
    ranges: ClassVar[Ranges] = {"friction": (0.7, 1.3), "push": (0.0, 0.5)}
    weights: ClassVar[dict[str, float]] = WEIGHTS
    disturbances: Ranges = {"push": (0.0, 0.0)}  # m/s, how large those are that come at random

    def __init_subclass__(cls) -> None:
        """Its sizes: those of what `begin` and `observe_with` say, in their order."""
        if "joints" not in vars(cls):
            return
        root = "velocity gravity root_off reference_velocity reference_ahead root_turned angular_velocity".split()
        each = "joints_off rates_off_x0.1 joints joint_rates_x0.1 last_action action_change joints_ahead".split()
        cls.obs_parts = *((name, 3) for name in root), *((name, cls.joints) for name in each)
        cls.memory_parts = ("frame", 1), ("last_action", cls.joints), ("action_before", cls.joints), ("push", 2)
        cls.obs_dim, cls.num_memory, cls.num_noise = width(cls.obs_parts), width(cls.memory_parts), 3

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        scene = self.load_robot()
        parts = [self._prepare(motion, scene) for motion in self.clip.motions()]
        frames = torch.tensor([len(part.qpos) for part in parts], device="cpu")
        ends = frames.cumsum(0) - 1
        qvel = torch.cat([part.velocity(self.control_dt) for part in parts])
        qvel[ends] = 0.0
        self.motions = ends + 1 - frames, frames - 1
        spans = ((a, a + max(1, n - BEFORE_END)) for a, n in torch.stack(self.motions, 1).tolist())
        self._starts = torch.cat([torch.arange(*span, device="cpu") for span in spans]).to(device)
        self._ends = ends.repeat_interleave(frames).to(device)
        self._qpos = torch.cat([part.qpos for part in parts]).to(device, dtype)
        self._qvel = qvel.to(device, dtype)
        self._down = torch.tensor((0.0, 0.0, -1.0), device=device, dtype=dtype)
        self._scene = self._within_reach(scene)
        self.low, self.high = (
            torch.tensor(bound, device=device, dtype=dtype) for bound in self._scene.mj_model.actuator_ctrlrange.T
        )

    def _prepare(self, motion: Clip, scene: Scene) -> Clip:
        """A motion at the rate of control, smoothed, from above the origin on, with its feet on the ground."""
        motion.check(scene.mj_model)
        found = motion.smoothed(SMOOTH).at(self.control_dt)
        qvel = found.velocity(self.control_dt)
        rates, speed = qvel[:, 6:].abs().amax(0), qvel[:, :3].norm(dim=1).max()
        if speed > SWIFTEST:
            raise TaskError(f"clip {motion}: the root moves by up to {speed:.3g} m/s; does it jump, or is it not in m?")
        if rates.max() > FASTEST:
            which = (
                f"joint {scene.mj_model.joint(int(rates.argmax()) + 1).name!r} turns by up to {rates.max():.3g} rad/s"
            )
            raise TaskError(f"clip {motion}: {which}, more than a motor's {FASTEST:g}; is it played too fast?")
        root, quat, joints = found.qpos.split((3, 4, self.joints), dim=1)
        shifts = {0: "", 1: "xyzw, but is read as wxyz", -1: "wxyz, but is read as xyzw"}
        feet = {k: trace(scene, torch.cat((root, quat.roll(k, 1), joints), 1).numpy()) for k in shifts}
        slips = {k: slip(*each) / self.control_dt for k, each in feet.items()}
        best = min(slips, key=slips.__getitem__)
        if slips[0] > max(SLIPPING * slips[best], STILL):
            raise TaskError(
                f"clip {motion}: feet slip by {slips[0]:.2g} m/s; the root's quaternion seems to be {shifts[best]}"
            )
        found.qpos[:, :3] -= torch.stack((*root[0, :2], torch.from_numpy(-feet[0][0].max(1)).quantile(STANDING)))
        return found

    def _within_reach(self, scene: Scene) -> Scene:
        """The robot whose servos reach the clips and a little more, to both sides alike."""
        model, quantiles = scene.mj_model, self._qpos.new_tensor((0.002, 0.998))
        joints = self._qpos[:: 1 + len(self._qpos) // 100_000, 7:].quantile(quantiles, dim=0)  # of so many at most
        reach = joints[:, model.actuator_trnid[:, 0] - 1] + REACH * quantiles.sub(0.5).sign().unsqueeze(1)
        both = torch.cat((reach, self.mirror.action(reach)))
        model.actuator_ctrlrange[:] = torch.stack((both.amin(0), both.amax(0)), 1).numpy(force=True)
        return load_scene(model)

    def scene(self) -> Scene:
        return self._scene

    @classmethod
    def has_mirror(cls) -> bool:
        return True

    @cached_property
    def mirror(self) -> Mirror:
        """See Task. The image tracks the mirrored clip, which need not be among the clips."""
        device, dtype = self._down.device, self._down.dtype
        qpos, qvel, action, joints, rates = reflections(self.load_robot().mj_model, self.sides, device, dtype)
        root = Reflection.of(enumerate((*VECTOR * 5, *PSEUDOVECTOR * 2)), device, dtype)
        return Mirror(qpos, qvel, action, Reflection.cat((root, joints, rates, joints, rates, action, action, joints)))

    def first_step(self, rand: Tensor) -> Tensor:
        return self._starts[draw(rand, len(self._starts))]

    def begin(self, rand: Tensor) -> Tensor:
        step = self.first_step(rand).to(rand.dtype).unsqueeze(-1)
        return torch.cat((step, torch.zeros_like(step).expand(*step.shape[:-1], self.num_memory - 1)), dim=-1)

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        held = self.recall(memory)
        step = held["frame"]
        step = torch.minimum(step + 1.0, self._ends[step.long()].to(step.dtype))
        return torch.cat(
            (step, action, held["last_action"], push(noise, self.disturbances["push"], self.control_dt)), dim=-1
        )

    def disturb(self, qvel: Tensor, action: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Pushes, and the servos' targets: the joints of the reference's next frame, and up to REACH more or less."""
        target = self.reference(memory, 1)[0][..., 7:] + REACH * action
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        qvel = torch.cat((qvel[..., :2] + self.recall(memory)["push"], qvel[..., 2:]), dim=-1)
        return qvel, ((target - middle) / half).clamp(-1.0, 1.0)

    def program(self, policy: nn.Module) -> tuple[nn.Module, dict[str, tuple[int, ...]], list[str]]:
        """Return what `export` writes of a policy of observations: a module, its inputs' names and shapes without the
        batch, and its outputs' names. The clip is an input, its frames from now on until AHEAD."""
        n = self.joints
        shapes: dict[str, tuple[int, ...]] = {
            "qpos": (7 + n,),
            "qvel": (6 + n,),
            "last_action": (n,),
            "action_before": (n,),
        }
        shapes |= {"reference_qpos": (1 + AHEAD, 7 + n), "reference_qvel": (6 + n,)}
        return Program(self, policy), shapes, ["action", "joint_targets"]

    def reference(self, memory: Tensor, ahead: int | Tensor = 0) -> tuple[Tensor, Tensor]:
        """qpos (..., nq) and qvel (..., nv) of the clip, now or so many frames later, be it (...) int64."""
        step = memory[..., 0].long()
        step = torch.minimum(step + ahead, self._ends[step])
        return self._qpos[step], self._qvel[step]

    def ghost(self, memory: Tensor) -> Tensor:
        qpos = self.reference(memory)[0]
        return qpos if self.ground is None else self.ground.lift(qpos)

    def metadata(self) -> dict[str, str]:
        """Tell `export` what a program needs; the frames of reference_qpos are so many control steps ahead."""
        return dict(clip_name=str(self.clip), reference_frames=",".join(map(str, range(1 + AHEAD))))

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        held = self.recall(memory)
        (target, speed), (later, _) = self.reference(memory), self.reference(memory, AHEAD)
        return self.see(qpos, qvel, held["last_action"], held["action_before"], target, speed, later)

    def see(
        self, qpos: Tensor, qvel: Tensor, last: Tensor, before: Tensor, target: Tensor, speed: Tensor, later: Tensor
    ) -> Tensor:
        """In the body's frame: velocity, gravity's direction, the way to the reference's root, the reference's
        velocity and its way until AHEAD, the turn to the reference's rotation, angular velocity; then joints and 0.1
        joint rates, first from the reference's, the last action, its change, and the reference's joints until AHEAD.

        Args:
            last, before: (..., nu) actions.
            target, speed, later: the reference's qpos (..., nq) and qvel (..., nv), and its qpos at AHEAD.
        """
        position, quat, joints = qpos.split((3, 4, self.joints), dim=-1)
        velocity, angular, rates = qvel.split((3, 3, self.joints), dim=-1)
        seen = velocity, self._down, target[..., :3] - position, speed[..., :3], later[..., :3] - target[..., :3]
        inverse = torch.cat((quat[..., :1], -quat[..., 1:]), dim=-1).unsqueeze(-2)
        root = rotate(inverse, torch.stack(torch.broadcast_tensors(*seen), dim=-2)).flatten(-2)
        off = joints - target[..., 7:], 0.1 * (rates - speed[..., 6:])
        turned = difference(quat, target[..., 3:7])
        own = joints, 0.1 * rates, last, last - before
        return torch.cat((root, turned, angular, *off, *own, later[..., 7:] - target[..., 7:]), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return add_up(self.reward_terms(obs, action), ORDER)

    def reward_terms(self, obs: Tensor, action: Tensor) -> dict[str, Tensor]:
        """The reference's root and joints, how they move, and even actions."""
        part = self.named(obs)
        speed = part["velocity"] - part["reference_velocity"]
        terms = {
            "alive": torch.ones_like(obs[..., 0]),
            "root_position": score(part["root_off"].square().sum(-1), 0.02),
            "root_rotation": score(part["root_turned"].square().sum(-1), 0.1),
            "joint_position": score(part["joints_off"].square().sum(-1), 0.5),
            "joint_velocity": score(part["rates_off_x0.1"].square().sum(-1), 0.5),
            "root_velocity": score(speed.square().sum(-1), 0.2),
            "action_rate": part["action_change"].square().sum(-1),
        }
        return {name: self.weights[name] * term for name, term in terms.items()}

    def terminated(self, obs: Tensor) -> Tensor:
        """The root strays from the reference or is turned from it."""
        part = self.named(obs)
        return (part["root_off"].square().sum(-1) > STRAY**2) | (part["root_turned"].square().sum(-1) > TURNED**2)


class Program(nn.Module):
    """State, the last two actions and the reference -> the action and the servos' targets [rad], see `export`."""

    def __init__(self, task: Tracking, policy: nn.Module) -> None:
        super().__init__()
        self.task, self.policy = task, policy

    def forward(
        self, qpos: Tensor, qvel: Tensor, last: Tensor, before: Tensor, frames: Tensor, speed: Tensor
    ) -> tuple[Tensor, Tensor]:
        action = self.policy(self.task.see(qpos, qvel, last, before, frames[:, 0], speed, frames[:, AHEAD]))
        target = frames[:, 1, 7:] + REACH * action
        return action, target.clamp(self.task.low, self.task.high)


class G1Track(Tracking):
    """29 joints; action: targets of the servos."""

    name, asset, joints, sides = "g1_track", "g1.xml", 29, (("right_", "left_"),)
    default_clip = "g1_karate"
    initial_gain = 0.01
    defaults: ClassVar[Defaults] = {
        "shac": BEGIN | {"num_envs": 1024, "iterations": 1500},
        "rpo": BEGIN | {"num_envs": 256, "initial_log_std": -3.0, "epochs": 4, "trust": 0.5, "iterations": 400},
        "rpo gpu": {"num_envs": 1024},
        "sapo": BEGIN | {"adjoint_clip": 0.0, "target_entropy": (-1.0, -2.0), "iterations": 700},
        "sapo gpu": {"num_envs": 1024, "critic_iterations": 8},
        "sapo cpu": {"critic_hidden": (256, 128), "critic_iterations": 4, "iterations": 1300},
        "ppo_baseline": {"hidden": (512, 256, 128), "horizon": 24, "initial_log_std": -1.0},
        "ppo_baseline gpu": {"num_envs": 4096, "minibatch_size": 24576},
    }
