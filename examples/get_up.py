"""A G1 that gets up from the ground; docs/tasks.md.

python rpo.py --env examples/get_up.py --horizon 16 --adjoint-clip 2 --initial-log-std -1 --num-envs 2048 \\
    --iterations 800 --actor-hidden 256 256 --critic-hidden 256 256 --critic-lr 1e-3 --device cuda
python benchmarks/own_tasks.py runs/<run> --own examples/get_up.py --file mujoco_menagerie/unitree_g1/scene.xml
"""

import math
from functools import cached_property

import mujoco
import torch
from torch import Tensor

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.symmetry.mirror import PSEUDOVECTOR, VECTOR, Mirror, Reflection, reflections
from diffsim.tasks import Task
from diffsim.tasks.base import ASSETS
from diffsim.tasks.locomotion import rotate
from diffsim_robots.common import score
from diffsim_robots.unitree import G1

HEIGHT, LOWEST, REACH = 0.755, 0.3, 1.5  # m, of the pelvis, standing and lying at the start; rad, of targets from home
LEGS, ARMS = (150.0, 5.0), (50.0, 2.0)  # N m/rad and N m s/rad of their servos; the waist has the legs'
HOME = G1.robot.home
AID = 0.8  # largest share of gravity that an episode is without: robots that are lighter get up earlier in training


class GetUp(Task):
    """qpos = (position, quaternion wxyz, 29 joints); action: targets of servos.

    Memory: last action, its change, the share of AID that lightens the robot.
    """

    name, asset = "get_up", "g1.xml"
    control_dt, substeps, episode_length = 0.02, 4, 250
    num_memory, num_random, symmetric = 59, 36 + 35 + 6, True

    @classmethod
    def load_robot(cls) -> Scene:
        """Let every geom but a foot's box, which spheres stand for, touch the ground."""
        spec = cls.prepare(mujoco.MjSpec.from_file(str(ASSETS / cls.asset)))
        for geom in spec.geoms:
            if geom.parent.name != "world" and geom.type != mujoco.mjtGeom.mjGEOM_BOX:
                geom.contype = 1
        return load_scene(spec)

    @staticmethod
    def prepare(spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """Give a G1 softer servos, and the range that they need."""
        for motor, joint, angle in zip(spec.actuators, spec.joints[1:], HOME, strict=True):
            arm = any(part in joint.name for part in ("shoulder", "elbow", "wrist"))
            stiffness, damping = ARMS if arm else LEGS
            motor.set_to_position(kp=stiffness, kv=damping)
            low, high = joint.range
            motor.ctrlrange = [max(low, angle - REACH), min(high, angle + REACH)]
        return spec

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        self._model = self.load_robot().mj_model
        self._home, self._down = (torch.tensor(x, device=device, dtype=dtype) for x in (HOME, (0.0, 0.0, -1.0)))

    @classmethod
    def has_mirror(cls) -> bool:
        return True

    @cached_property
    def mirror(self) -> Mirror:
        kind = self.device, self.dtype
        qpos, qvel, action, joints, rates = reflections(self._model, (("right_", "left_"),), *kind)
        body = Reflection.of(enumerate((1.0, *VECTOR, *VECTOR, *PSEUDOVECTOR)), *kind)
        aid = Reflection.of(enumerate((1.0,)), *kind)
        return Mirror(qpos, qvel, action, Reflection.cat((body, joints, rates, action, action, aid)))

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        """Tilt the robot about any horizontal axis, mostly by a right angle, and turn it."""
        noise, rates, (tilt, way, yaw) = rand[..., :36], rand[..., 36:71] - 0.5, rand[..., 71:74].unbind(-1)
        tilt, way, yaw = (2.5 * tilt).clamp(max=1.0) * math.pi / 4, 2 * math.pi * way, math.pi * yaw
        c, s, x, y = tilt.cos(), tilt.sin(), way.cos(), way.sin()
        turned = yaw.cos() * c, s * (yaw.cos() * x - yaw.sin() * y), s * (yaw.cos() * y + yaw.sin() * x), yaw.sin() * c
        quat = torch.stack(turned, dim=-1)
        high = HEIGHT + (LOWEST - HEIGHT) * (2.0 * tilt).sin()
        place = torch.stack((0 * high, 0 * high, high), dim=-1)
        joints = self._home + 0.4 * (noise[..., 7:] - 0.5)
        return torch.cat((place, quat, joints), dim=-1), rates

    def begin(self, rand: Tensor) -> Tensor:
        aid = (1.6 * rand[..., 74:75] - 0.6).clamp(min=0.0)
        return torch.cat((torch.zeros_like(rand[..., :58]), aid), dim=-1)

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        return torch.cat((action, action - memory[..., :29], memory[..., 58:]), dim=-1)

    def disturb(self, qvel: Tensor, action: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        lifted = qvel[..., 2:3] + self.control_dt * 9.81 * AID * memory[..., 58:]
        return torch.cat((qvel[..., :2], lifted, qvel[..., 3:]), dim=-1), action

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """Height; velocity, the vertical and angular velocity in the body's frame; joints relative to the keyframe's, a
        tenth of their rates, the last action, its change, aid."""
        inverse = torch.cat((qpos[..., 3:4], -qpos[..., 4:7]), dim=-1).unsqueeze(-2)
        world = torch.stack((qvel[..., :3], self._down.expand_as(qvel[..., :3])), dim=-2)
        body = rotate(inverse, world).flatten(-2)
        joints = qpos[..., 7:] - self._home
        return torch.cat((qpos[..., 2:3], body, qvel[..., 3:6], joints, 0.1 * qvel[..., 6:], memory), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """A high, upright body; the keyframe's pose and calm once it is; smooth actions."""
        height, velocity, down, angular, joints, rates, _, change, _ = obs.split(
            (1, 3, 3, 3, 29, 29, 29, 29, 1), dim=-1
        )
        low = (HEIGHT - height[..., 0]).clamp(min=0.0)
        tall = 2.0 * low + 0.5 * score(low.square(), 0.01) + 1.0 * (1.0 + down[..., 2])
        stands = torch.sigmoid((height[..., 0] - 0.6) / 0.05) * (-down[..., 2]).clamp(min=0.0)
        pose = score(joints.square(), 0.1).mean(-1)
        calm = 0.1 * score(velocity.square().sum(-1), 0.3) + 0.05 * score(angular.square().sum(-1), 2.0)
        effort = 0.5 * score(change.square(), 0.1).mean(-1) + 0.25 * score(rates.square(), 0.1).mean(-1)
        return 4.0 - tall - calm - effort - (0.1 + stands) * pose

    def achieved(self, qpos: Tensor, memory: Tensor) -> Tensor:
        """Tell which robots (...) stand."""
        return (qpos[..., 2] > 0.65) & (1.0 - 2.0 * (qpos[..., 4].square() + qpos[..., 5].square()) > 0.9)

    def for_test(self, rand: Tensor) -> Tensor:
        """Return numbers of a reset by which the robot lies and has its whole weight."""
        lies = torch.tensor([1.0], device=rand.device, dtype=rand.dtype).expand_as(rand[..., :1])
        return torch.cat((rand[..., :71], lies, rand[..., 72:74], 0.0 * lies, rand[..., 75:]), dim=-1)
