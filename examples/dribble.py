"""A Go2 that dribbles a ball to commanded places; docs/tasks.md.

git clone https://github.com/google-deepmind/mujoco_menagerie
python rpo.py --env examples/dribble.py
python benchmarks/own_tasks.py runs/<run> --own examples/dribble.py --file mujoco_menagerie/unitree_go2/scene.xml
"""

from typing import ClassVar

import mujoco
import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.tasks.base import Defaults
from diffsim_robots.common import add_up, score
from diffsim_robots.joystick import ORDER
from diffsim_robots.unitree import BEGIN, Go2

RADIUS, MASS, DRAG = 0.11, 0.43, 0.002  # m, kg, N s/m and N m s: a football of size 5 that comes to rest
STIFFNESS, RANGE = 40.0, {"hip": (-0.4, 0.4), "thigh": (0.2, 1.6), "calf": (-2.5, -1.1)}  # N m/rad, rad: as of "go2"
FIELD, SPEED, NEAR = 2.0, 0.8, 0.3  # m, half the square of places; m/s, of the ball on its way; m, when it has arrived
BEHIND, ASIDE, ALIGNED = 0.4, 0.5, 0.15  # m, from the ball: behind it, on the way around it; aside when it pushes
ROBOT_Q, ROBOT_V, BALL = 19, 18, 8  # numbers of qpos and qvel before the ball's; what is observed of ball and place


class Dribble(Go2):
    """The Go2's qpos and qvel, then the ball's; action: targets of the servos.

    Memory: Go2's, whose command is the ball's place (x, y) in the world here. The velocity that the reference gait
    follows leads the robot behind the ball.
    """

    name, asset, symmetric = "dribble", "mujoco_menagerie/unitree_go2/scene.xml", False
    initial_gain = 1.0
    defaults: ClassVar[Defaults] = {"rpo": BEGIN | {"horizon": 16, "num_envs": 128, "iterations": 1600}}
    num_random = Go2.num_random + 13
    actor_dim, obs_dim = BALL + (Go2.actor_dim or 0), BALL + Go2.obs_dim
    obs_parts = (("ball", 2), ("ball_velocity", 2), ("place", 2), ("place_velocity", 2), *Go2.obs_parts)
    weights = Go2.weights | {"ball_velocity": -0.5}

    @classmethod
    def load_robot(cls) -> Scene:
        """Let only feet and the ball touch the ground, and only the ball the rest of the robot."""
        spec = cls.prepare(mujoco.MjSpec.from_file(str(super().load_robot().path)))
        for geom in spec.geoms:
            if geom.name not in ("floor", "ball", "FL", "FR", "RL", "RR"):
                geom.contype = geom.conaffinity = 0
        return load_scene(spec)

    @staticmethod
    def prepare(spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """Put servos on a Go2's motors, and add a ball that touches the ground and the robot's shapes but meshes."""
        for motor in spec.actuators:
            motor.set_to_position(kp=STIFFNESS)
            motor.forcerange, motor.ctrlrange = list(motor.ctrlrange), RANGE[motor.name.partition("_")[2]]
        ball = spec.worldbody.add_body(name="ball", pos=[0.6, 0, RADIUS])
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_FREE, damping=[DRAG, 0, 0])
        ball.add_geom(name="ball", size=[RADIUS, 0, 0], mass=MASS, contype=1, conaffinity=0, rgba=[0.9, 0.4, 0.1, 1])
        for k, geom in enumerate(spec.geoms):
            if geom.parent.name not in ("world", "ball") and geom.type != mujoco.mjtGeom.mjGEOM_MESH:
                geom.name = geom.name or f"part{k}"
                spec.add_pair(geomname1=geom.name, geomname2="ball", condim=3, friction=[0.6, 0.6, 0, 0, 0])
        spec.keys[0].qpos = [*list(spec.keys[0].qpos)[:ROBOT_Q], *ball.pos, 1, 0, 0, 0]
        return spec

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        ball, wide = (0.6, 0.0, RADIUS, 1.0, 0.0, 0.0, 0.0), (0.6, 1.0, *(0.0,) * 5)
        rolls = (0.5, 0.5, *(0.0,) * 4)
        spread = self._spread.tolist()
        self.start = (*self.start[:ROBOT_Q], *ball, *self.start[ROBOT_Q:], *(0.0,) * 6)
        self._start = torch.tensor(self.start, device=device, dtype=dtype)
        self._spread = torch.tensor((*spread[:ROBOT_Q], *wide, *spread[ROBOT_Q:], *rolls), device=device, dtype=dtype)
        self._nq = ROBOT_Q + 7

    @classmethod
    def has_mirror(cls) -> bool:
        return False

    def _draw(self, rand: Tensor) -> Tensor:
        """Draw a place."""
        return FIELD * (2.0 * rand[..., :3] - 1.0)

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """Go2's; before it in the robot's frame the ball, its velocity, the place from the ball, the way to it."""
        ball, moving, place = qpos[..., ROBOT_Q : ROBOT_Q + 2], qvel[..., ROBOT_V : ROBOT_V + 2], memory[..., :2]
        way = F.normalize(place - ball, dim=-1)
        across = torch.stack((-way[..., 1], way[..., 0]), dim=-1)
        off = qpos[..., :2] - ball
        # The reference gait goes around the ball, then behind it, and pushes when it is in line
        along, side = (off * way).sum(-1, keepdim=True), (off * across).sum(-1, keepdim=True)
        around = torch.sigmoid((along + 0.5 * BEHIND) / 0.05) * ASIDE * torch.sign(side)
        target = (around - side) * across - (BEHIND + along) * way
        lined = torch.exp(-(side / ALIGNED).square()) * torch.sigmoid(-(along + 0.5 * BEHIND) / 0.05)
        speed = (place - ball).norm(dim=-1, keepdim=True).clamp(max=SPEED) * way
        lead = 2.0 * target + lined * ((2.0 * (BEHIND + along)) * way + 1.25 * speed)
        wanted = self._turned(qpos, torch.stack((lead, way, -off, moving, place - ball, speed), dim=-2))
        command, ahead, there, rolls, left, speed = wanted.unbind(-2)
        command = torch.minimum(torch.maximum(command, -self._most[:2]), self._most[:2])
        turn = torch.atan2(ahead[..., 1], ahead[..., 0]).unsqueeze(-1).clamp(-1.0, 1.0)
        seen = torch.cat((there, rolls, left.clamp(-2.0, 2.0), speed), dim=-1)
        memory = torch.cat((command, turn, memory[..., 3:]), dim=-1)
        return torch.cat((seen, super().observe_with(qpos[..., :ROBOT_Q], qvel[..., :ROBOT_V], action, memory)), dim=-1)

    @staticmethod
    def _turned(qpos: Tensor, vectors: Tensor) -> Tensor:
        """Turn horizontal vectors (..., n, 2) into the robot's heading."""
        w, x, y, z = qpos[..., 3:7].unbind(-1)
        c, s = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
        c, s = (part.unsqueeze(-1) / (c * c + s * s).sqrt().unsqueeze(-1) for part in (c, s))
        return torch.stack((c * vectors[..., 0] + s * vectors[..., 1], c * vectors[..., 1] - s * vectors[..., 0]), -1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return add_up(self.reward_terms(obs, action), (*ORDER, ("ball_velocity",)))

    def reward_terms(self, obs: Tensor, action: Tensor) -> dict[str, Tensor]:
        """Go2's, and the ball's velocity towards the place."""
        part = self.named(obs)
        off = score((part["ball_velocity"] - part["place_velocity"]).square().sum(-1), 0.1)
        return super().reward_terms(obs, action) | {"ball_velocity": self.weights["ball_velocity"] * off}

    def achieved(self, qpos: Tensor, memory: Tensor) -> Tensor:
        """Tell which balls (...) are at their place."""
        return (qpos[..., ROBOT_Q : ROBOT_Q + 2] - memory[..., :2]).norm(dim=-1) < NEAR
