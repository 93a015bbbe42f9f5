"""Joystick: a legged robot follows a commanded velocity, as MuJoCo Playground and mjlab train it, with smooth terms.

The command is the velocity of the root along its own x and y axes [m/s] and its yaw rate [rad/s]; it changes within an
episode. A clock moves the legs' reference: in the air they fold, on the ground their feet go backward as fast as the
command asks. Robots are data, as in unitree.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from diffsim.sim.elevation import Elevation
from diffsim.symmetry.mirror import PSEUDOVECTOR, VECTOR, Mirror, Reflection, Sides, partners, reflections
from diffsim.tasks.base import Contact, Parts, Task, width
from diffsim.tasks.locomotion import rotate
from diffsim_robots.common import add_up, push, score
from diffsim_robots.feet import Feet
from diffsim_robots.variation import Ranges

FREQUENCY_OF_COMMANDS = 0.2  # 1/s, how often a new command comes on average
NEAR, SLIP = 0.01, 0.05  # m over the ground, within which a foot's speed counts as slip; (m/s)^2, the score's scale
STANDING = 0.1  # share of commands that are zero; each of the three numbers of others is with the same probability
SPIN = 20.0  # rad/s^2 of yaw for a pull of 1 m/s^2: torque that the ground's friction puts on turning feet
WEIGHTS = {  # of the reward's terms; see reward_terms. A weight of 0 switches a term off
    "alive": 4.0,  # a perfect step's reward
    "track_linear_velocity": -0.5,
    "track_angular_velocity": -0.25,
    "lin_vel_z": -0.5,
    "ang_vel_xy": -0.2,
    "upright": -0.4,
    "base_height": -0.2,
    "pose": -1.2,
    "action_rate": -2.2,
    "foot_height": -0.4,
    "foot_slip": -0.15,
    "feet_apart": -1.0,
}
ORDER = (  # of additions, see add_up
    ("alive",),
    ("track_linear_velocity",),
    ("track_angular_velocity",),
    ("lin_vel_z", "ang_vel_xy"),
    ("upright", "base_height"),
    ("pose", "action_rate"),
    ("foot_height", "foot_slip", "feet_apart"),
)
# Noise of the sensors, uniform to both sides: joints [rad], rates [rad/s], angular and linear velocity, gravity
JOINT_NOISE, RATE_NOISE, GYRO_NOISE, VELOCITY_NOISE, GRAVITY_NOISE = 0.03, 0.5, 0.2, 0.1, 0.05


class Leg(NamedTuple):
    """A leg, and where it is in the gait."""

    joints: tuple[str, str]  # (pitch, roll) names of those that move the foot along x and y
    folds: dict[str, float]  # of joints in the middle of the swing [rad]
    place: tuple[float, float]  # x and y of the hip from the root [m]
    phase: float  # share of the cycle by which it is ahead


class Robot(NamedTuple):
    """A robot as the task knows it."""

    joints: tuple[str, ...]  # names in order of qpos
    home: tuple[float, ...]  # (joints,) [rad] of the keyframe
    height: float  # m, of the root there
    legs: tuple[Leg, ...]  # joints of no leg stay near the keyframe's
    length: float  # m, of a leg, from hip to foot there
    lift: float  # m, of a foot in the middle of the swing
    cycle: float  # Hz, of the gait; legs of the two sides are half a cycle apart
    sides: Sides  # (right, left) beginnings of the joints' names
    apart: float = 0.0  # m, least distance across of a left and a right foot, whose legs else collide; 0: not observed
    command: tuple[float, float, float] = (1.0, 0.6, 1.0)  # largest vx, vy [m/s] and yaw rate [rad/s]


class Joystick(Task):
    """qpos = (position, quaternion wxyz, joints), qvel = (world linear, body angular velocity, joint rates).

    Memory: memory_parts. The clock is in cycles, latency in control steps; a push is due in the next step.

    Attributes:
        weights: of the reward's terms, by name.
    """

    robot: ClassVar[Robot]
    contact: ClassVar[Contact] = "mujoco"
    symmetric, initial_gain = True, 0.01
    varied_by = "diffsim_robots.variation:Variation"
    ranges: ClassVar[Ranges] = {
        "friction": (0.7, 1.3),
        "mass": (0.85, 1.15),
        "motor": (0.8, 1.2),
        "latency": (0.0, 1.0),
        "push": (0.0, 1.0),
        "pull": (0.0, 0.6),
    }
    substeps = 4
    control_dt = 0.02
    episode_length = 1000

    forward_column = None  # what counts is the command
    weights: ClassVar[dict[str, float]] = WEIGHTS
    # By how much the actions of an episode come late; how large the pushes are that come at random; how steadily
    # something pulls, as a slope, a load or rolling feet do [m/s^2]
    disturbances: Ranges = {"latency": (0.0, 0.0), "push": (0.0, 0.0), "pull": (0.0, 0.0)}

    def __init_subclass__(cls) -> None:
        """Its sizes: those of what `begin`, `remember` and `observe_with` say, in their order; names are mjlab's."""
        if "robot" not in vars(cls):
            return
        n = len(cls.robot.joints)
        body = ("base_lin_vel", 3), ("base_ang_vel", 3), ("projected_gravity", 3)
        sensed = *body, ("joint_pos", n), ("joint_vel_x0.1", n)
        seen = *sensed, ("actions", n), ("command", 3), ("clock_sin", 1), ("clock_cos", 1)
        private = *((f"true_{name}", size) for name, size in sensed), ("height", 1), ("action_change", n)
        private = *private, ("joints_from_reference", n)
        legs = len(cls.robot.legs)
        gap = (("feet_apart", 1),) * bool(cls.robot.apart)
        cls.obs_parts = *seen, *private, *gap, ("feet_from_reference", legs), ("feet_slip", legs)
        acted: Parts = (("last_action", n), ("action_before", n))
        disturbed = ("noise", width(sensed)), ("latency", 1), ("pull", 3), ("push", 2)
        cls.memory_parts = ("command", 3), ("clock", 1), *acted, *disturbed
        cls.actor_dim, cls.obs_dim, cls.num_memory = map(width, (seen, cls.obs_parts, cls.memory_parts))
        cls.num_noise, cls.num_random = 20 + 2 * n, 25 + 2 * n

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        robot, n = self.robot, len(self.robot.joints)
        self.start = (0.0, 0.0, robot.height, 1.0, 0.0, 0.0, 0.0, *robot.home, *(0.0,) * (6 + n))
        self.spread = (0.0,) * 7 + (0.2,) * n + (0.5,) * 6 + (0.5,) * n
        super().__init__(device, dtype)

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        fold, phase, stride = tensor([0.0] * n), tensor([0.0] * n), tensor([[0.0] * 3] * n)
        reach = 1.0 / (4.0 * robot.cycle * robot.length)  # rad per m/s: a stance is half a cycle
        for leg in robot.legs:
            x, y = leg.place
            pitch, roll = map(robot.joints.index, leg.joints)
            stride[pitch] = reach * tensor((1.0, 0.0, -y))
            stride[roll] = -reach * tensor((0.0, 1.0, x))
            for name, angle in leg.folds.items():
                fold[robot.joints.index(name)] = angle
            for joint in {pitch, roll, *map(robot.joints.index, leg.folds)}:
                phase[joint] = leg.phase
        self._fold, self._phase, self._stride = fold, phase, stride.mT.contiguous()
        self._home, self._most = tensor(robot.home), tensor(robot.command)
        scales = (VELOCITY_NOISE,) * 3 + (GYRO_NOISE,) * 3 + (GRAVITY_NOISE,) * 3
        self._noise = tensor(scales + (JOINT_NOISE,) * n + (0.1 * RATE_NOISE,) * n)
        self._down = tensor((0.0, 0.0, -1.0))
        self._n = n
        self._phases = tensor([leg.phase for leg in robot.legs])
        names = [f"{leg.joints[0]}_joint" for leg in robot.legs]
        self._feet = Feet.of(self.load_robot().mj_model, names, device, dtype)
        self._rest = robot.height + self._feet.places(self._home)[:, 2]  # m, of the feet, which sink in

    @classmethod
    def has_mirror(cls) -> bool:
        return True

    @cached_property
    def mirror(self) -> Mirror:
        """See Task. The image's clock is half a cycle ahead."""
        device, dtype = self.device, self.dtype
        qpos, qvel, action, joints, rates = reflections(self.load_robot().mj_model, self.robot.sides, device, dtype)
        signs = (*VECTOR, *PSEUDOVECTOR, *VECTOR), (1.0, -1.0, -1.0, -1.0, -1.0), (1.0,)
        body, command, height = (Reflection.of(enumerate(part), device, dtype) for part in signs)
        sensed = body, joints, rates
        names = [leg.joints[0] for leg in self.robot.legs]
        legs = Reflection.of(((k, 1.0) for k in partners(names, self.robot.sides)), device, dtype)
        apart = (height,) * bool(self.robot.apart)  # the same in the image
        obs = Reflection.cat((*sensed, action, command, *sensed, height, action, joints, *apart, legs, legs))
        return Mirror(qpos, qvel, action, obs)

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        """The keyframe, with joints and rates drawn around it; `begin` takes the other numbers."""
        return super().reset(rand[..., : len(self.start)])

    def begin(self, rand: Tensor) -> Tensor:
        """A command, a phase and a latency; no action yet."""
        drawn, phase, late, steady = rand[..., len(self.start) :].split((7, 1, 1, 3), dim=-1)
        least, most = self.disturbances["latency"]
        nothing = phase.new_zeros(*phase.shape[:-1], self.num_memory)
        given = {"command": self._draw(drawn), "clock": phase, "pull": self._pull(steady)}
        given["latency"] = least + (most - least) * late
        return self._hold(self.recall(nothing) | given)

    def _hold(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Return the memory (..., num_memory) that has these parts."""
        return torch.cat([parts[name] for name, _ in self.memory_parts], dim=-1)

    def _pull(self, rand: Tensor) -> Tensor:
        """Draw what pulls during an episode, (..., 3) of rand (..., 3): along x and y [m/s^2], about z [rad/s^2]."""
        (least, most), (way, turn) = self.disturbances["pull"], (2.0 * rand[..., :2] - 1.0).split(1, dim=-1)
        size = least + (most - least) * rand[..., 2:]
        return size * torch.cat(((math.pi * way).cos(), (math.pi * way).sin(), SPIN * turn), dim=-1)

    def _draw(self, rand: Tensor) -> Tensor:
        """A command (..., 3) from rand (..., 7)."""
        size, kept, some = rand[..., :3], rand[..., 3:6] >= STANDING, rand[..., 6:7] >= STANDING
        return (2.0 * size - 1.0) * self._most * kept * some

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        held = self.recall(memory)
        drawn, when, sensors, due = noise.split((7, 1, 9 + 2 * self._n, 3), dim=-1)
        held["command"] = torch.where(
            when < self.control_dt * FREQUENCY_OF_COMMANDS, self._draw(drawn), held["command"]
        )
        held["clock"] = (held["clock"] + self.control_dt * self.robot.cycle).remainder(1.0)
        held["last_action"], held["action_before"] = action, held["last_action"]
        held["noise"] = (2.0 * sensors - 1.0) * self._noise
        held["push"] = push(due, self.disturbances["push"], self.control_dt)
        return self._hold(held)

    def disturb(self, qvel: Tensor, action: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Pushes and pulls, and actions that come late: over a control step the mean of what the servos are given."""
        if not any(most for _, most in self.disturbances.values()):
            return qvel, action
        held = self.recall(memory)
        late, kick, pull = held["latency"], held["push"], self.control_dt * held["pull"]
        whole = late.clamp(max=1.0)
        action = torch.lerp(torch.lerp(action, held["last_action"], whole), held["action_before"], late - whole)
        moved = (
            qvel[..., :2] + kick + pull[..., :2],
            qvel[..., 2:5],
            qvel[..., 5:6] + pull[..., 2:],
            qvel[..., 6:],
        )
        return torch.cat(moved, dim=-1), action

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """For the actor, with noise: linear and angular velocity, gravity's direction, in the body's frame; joints from
        the keyframe's, 0.1 joint rates; the last action, the command, sine and cosine of the clock. For the critic also
        these without noise; height, the change of the action, how far joints and, in height, feet are from the
        reference, and how fast those near the ground slip; of a robot on two legs how far left of the second the first
        foot is."""
        position, quat, joints = qpos.split((3, 4, self._n), dim=-1)
        velocity, angular, rates = qvel.split((3, 3, self._n), dim=-1)
        held = self.recall(memory)
        command, clock, last = held["command"], held["clock"], held["last_action"]
        world = torch.stack((velocity, self._down.expand_as(velocity)), dim=-2)
        inverse = torch.cat((quat[..., :1], -quat[..., 1:]), dim=-1).unsqueeze(-2)
        velocity, gravity = rotate(inverse, world).unbind(dim=-2)
        sensed = torch.cat((velocity, angular, gravity, joints - self._home, 0.1 * rates), dim=-1)
        turn = 2.0 * math.pi * clock
        private = sensed, position[..., 2:], last - held["action_before"], joints - self.reference(command, clock)
        place, speed = self._feet.motion(joints, rates)
        speed = speed + velocity.unsqueeze(-2) + torch.linalg.cross(angular.unsqueeze(-2), place)
        high = position[..., 2:] - (place * gravity.unsqueeze(-2)).sum(-1)
        if self.ground is not None:
            high = high - self._rise(self.ground, position[..., :1], quat, place)
        along = speed.square().sum(-1) - (speed * gravity.unsqueeze(-2)).sum(-1).square()
        swing = self._moving(command) * (turn + 2.0 * math.pi * self._phases).sin().clamp(min=0.0).square()
        slip = (1.0 - swing) * torch.exp(-(high.clamp(min=0.0) / NEAR).square()) * score(along, SLIP)
        gap = (place[..., :1, 1] - place[..., 1:2, 1],) * bool(self.robot.apart)
        feet = *gap, high - self._rest - self.robot.lift * swing, slip
        return torch.cat((sensed + held["noise"], last, command, turn.sin(), turn.cos(), *private, *feet), dim=-1)

    @staticmethod
    def _rise(ground: Elevation, x: Tensor, quat: Tensor, place: Tensor) -> Tensor:
        """By how much (..., L) [m] the ground is higher below the feet than below the root, which is at x (..., 1)."""
        return ground.at(x + rotate(quat.unsqueeze(-2), place)[..., 0]) - ground.at(x)

    @staticmethod
    def _moving(command: Tensor) -> Tensor:
        """(..., 1) from 0 for a command of zero to 1."""
        square = command.square().sum(-1, keepdim=True)
        return square / (square + 0.01)

    def reference(self, command: Tensor, clock: Tensor) -> Tensor:
        """Joints (..., n) of a gait at the command's speed; at rest the keyframe's.

        On the ground a foot goes backward evenly; in the air it comes to its place at the ground's speed.
        """
        turn = (clock + self._phase).remainder(1.0)
        air = (2.0 * turn).clamp(max=1.0)
        stride = ((8.0 * air - 12.0) * air + 2.0) * air + 1.0 + (4.0 * turn - 2.0).clamp(min=0.0)
        fold = (2.0 * math.pi * turn).sin().clamp(min=0.0).square()
        return self._home + self._moving(command) * self._fold * fold + command @ self._stride * stride

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return add_up(self.reward_terms(obs, action), ORDER)

    def reward_terms(self, obs: Tensor, action: Tensor) -> dict[str, Tensor]:
        """Both velocities, then a calm, upright, level root at its height; the reference's joints, smooth actions; the
        reference's feet, no slip, legs that do not cross."""
        part = self.named(obs)
        velocity, angular, gravity = (
            part[f"true_{name}"] for name in ("base_lin_vel", "base_ang_vel", "projected_gravity")
        )
        command, height = part["command"], part["height"][..., 0]
        terms = {
            "alive": torch.ones_like(height),
            "track_linear_velocity": score((velocity[..., :2] - command[..., :2]).square().sum(-1), 0.03),
            "track_angular_velocity": score((angular[..., 2] - command[..., 2]).square(), 0.03),
            "lin_vel_z": score(velocity[..., 2].square(), 0.5),
            "ang_vel_xy": score(angular[..., :2].square().sum(-1), 4.0),
            "upright": score(gravity[..., :2].square().sum(-1), 0.1),
            "base_height": score((height - self.robot.height).square(), 0.01),
            "pose": score(part["joints_from_reference"].square(), 0.05).mean(-1),
            "action_rate": score(part["action_change"].square().mean(-1), 0.2),
            "foot_height": score(part["feet_from_reference"].square(), 0.0004).mean(-1),
            "foot_slip": part["feet_slip"].mean(-1),
        }
        if self.robot.apart:
            near = (self.robot.apart - part["feet_apart"][..., 0]).clamp(min=0.0)
            terms["feet_apart"] = score(near.square(), 0.003)
        return {name: self.weights[name] * term for name, term in terms.items()}

    def metadata(self) -> dict[str, str]:
        """Tell `export` what a program needs to know of the task; the command's name is mjlab's."""
        robot = self.robot
        most = ",".join(f"{size:g}" for size in robot.command)
        return dict(
            command_names="twist",
            command_range=most,
            gait_frequency=f"{robot.cycle:g}",
            root_height=f"{robot.height:g}",
        )

    def terminated(self, obs: Tensor) -> Tensor:
        """Tilted by more than 60 degrees, or the root below 60 % of its height."""
        part = self.named(obs)
        return (part["true_projected_gravity"][..., 2] > -0.5) | (part["height"][..., 0] < 0.6 * self.robot.height)
