"""Agility's Cassie, whose legs are closed chains of rods and springs, walks at a commanded speed; docs/tasks.md.

python rpo.py --env examples/cassie.py --horizon 16 --adjoint-clip 5 --initial-log-std -2 --iterations 200
python benchmarks/own_tasks.py runs/<run> --own examples/cassie.py
python -m diffsim export runs/<run>/checkpoint.pt cassie.onnx --env examples/cassie.py
python examples/cassie.py cassie.onnx
"""

import math
import sys
from functools import cached_property

import mujoco
import torch
from own_quadruped import play
from torch import Tensor

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.symmetry.mirror import PSEUDOVECTOR, VECTOR, Mirror, Reflection, reflections
from diffsim.tasks import Task
from diffsim.tasks.locomotion import rotate
from diffsim_robots.common import score

# A leg's five motors: hip roll, yaw and pitch, knee, foot. FOLD lifts a level foot by 0.13 m, STRIDE moves it forward.
STIFFNESS, DAMPING = (150, 100, 200, 250, 60), (5, 4, 8, 8, 2)  # N m/rad, N m s/rad, of their servos
FOLD, STRIDE, LENGTH, CYCLE = (0.0, 0.0, 0.2, -0.4, -0.2), (0.0, 0.0, 1.0, 0.0, -1.0), 0.9, 1.4  # rad, m/rad, Hz
FASTEST, HEIGHT, INWARD = 1.0, 0.98, 0.08  # m/s; m, of the pelvis; rad, of the hips' rolls before legs would collide


class Cassie(Task):
    """qpos = (position, quaternion wxyz, 20 hinges and 2 balls); action: targets of the motors, 0 is the keyframe's.

    Memory: commanded speed, clock in cycles, last action, its change.
    """

    name, asset = "cassie", "mujoco_menagerie/agility_cassie/scene.xml"
    control_dt, substeps, episode_length = 0.02, 10, 500
    action_scale = 0.5  # rad
    spread = (0.0,) * 35 + (0.4,) * 6 + (0.0,) * 26  # of the pelvis' velocity
    num_memory, symmetric = 22, True

    @classmethod
    def load_robot(cls) -> Scene:
        """Put servos on the motors."""
        spec = mujoco.MjSpec.from_file(str(super().load_robot().path))
        for k, motor in enumerate(spec.actuators):
            most = motor.gear[0] * motor.ctrlrange[1]
            motor.set_to_position(kp=STIFFNESS[k % 5], kv=DAMPING[k % 5])
            motor.gear, motor.forcerange, motor.ctrllimited = [1, 0, 0, 0, 0, 0], [-most, most], 0
        return load_scene(spec)

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device, dtype)
        self._model = m = self.load_robot().mj_model
        self._motors = torch.tensor(m.jnt_qposadr[m.actuator_trnid[:, 0]].tolist(), device=device)
        numbers = m.key_qpos[0].tolist(), FOLD, STRIDE, (0.0, 0.5), (0.0, 0.0, -1.0)
        tensors = (torch.tensor(each, device=device, dtype=dtype) for each in numbers)
        self._home, self._fold, self._stride, self._phases, self._down = tensors

    @classmethod
    def has_mirror(cls) -> bool:
        return True

    @cached_property
    def mirror(self) -> Mirror:
        """See Task. The image's clock is half a cycle ahead."""
        kind = self.device, self.dtype
        qpos, qvel, action, joints, rates = reflections(self._model, (("right-", "left-"),), *kind)
        body = Reflection.of(enumerate((1.0, *VECTOR, *VECTOR, *PSEUDOVECTOR, -1.0)), *kind)
        clock = Reflection.of(enumerate((1.0, -1.0, -1.0)), *kind)
        return Mirror(qpos, qvel, action, Reflection.cat((body, joints, rates, action, action, action, clock)))

    def begin(self, rand: Tensor) -> Tensor:
        """Draw the speed and the clock by numbers that the start does not use."""
        return torch.cat((FASTEST * rand[..., :1], rand[..., 1:2], torch.zeros_like(rand[..., :20])), dim=-1)

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        speed, clock, last, _ = memory.split((1, 1, 10, 10), dim=-1)
        return torch.cat((speed, (clock + self.control_dt * CYCLE).remainder(1.0), action, action - last), dim=-1)

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        """Height; velocity, the vertical and angular velocity in the body's frame; heading; joints, a tenth of their
        rates, the last action, its change, motors relative to the reference; commanded speed, clock."""
        speed, clock, last, change = memory.split((1, 1, 10, 10), dim=-1)
        w, x, y, z = qpos[..., 3:7].unbind(-1)
        world = torch.stack((qvel[..., :3], self._down.expand_as(qvel[..., :3])), dim=-2)
        body = rotate(torch.stack((w, -x, -y, -z), dim=-1).unsqueeze(-2), world).flatten(-2)
        heading, moved, angle = (2.0 * (x * y + w * z)).unsqueeze(-1), qpos - self._home, 2.0 * math.pi * clock
        robot = qpos[..., 2:3], body, qvel[..., 3:6], heading, moved[..., 7:], 0.1 * qvel[..., 6:]
        error = moved[..., self._motors] - self.reference(speed, clock)
        return torch.cat((*robot, last, change, error, speed, angle.sin(), angle.cos()), dim=-1)

    def reference(self, speed: Tensor, clock: Tensor) -> Tensor:
        """Return the motors (..., 10) relative to the keyframe: a leg folds and swings forward, then goes backward."""
        turn = (clock + self._phases).remainder(1.0).unsqueeze(-1)
        air, ground = (2.0 * turn).clamp(max=1.0), (2.0 * turn - 1.0).clamp(min=0.0)
        reach = ((3.0 - 2.0 * air) * air.square() - ground - 0.5) * speed.unsqueeze(-1) / (2.0 * CYCLE * LENGTH)
        fold = (2.0 * math.pi * turn).sin().clamp(min=0.0).square()
        return (fold * self._fold + reach * self._stride).flatten(-2)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """The speed; a straight course; a calm, level pelvis; the reference and smooth actions; legs side by side."""
        parts = obs.split((1, 3, 3, 3, 1, 28, 26, 10, 10, 10, 1, 2), dim=-1)
        height, velocity, down, angular, heading, joints, _, _, change, error, speed, _ = parts
        course = 0.5 * score((velocity[..., 0] - speed[..., 0]).square() + velocity[..., 1].square(), 0.03)
        course = course + 0.25 * score(angular[..., 2].square(), 0.3) + 0.5 * score(heading[..., 0].square(), 0.1)
        calm = 0.5 * score(velocity[..., 2].square(), 0.5) + 0.2 * score(angular[..., :2].square().sum(-1), 4.0)
        level = 0.4 * score(down[..., :2].square().sum(-1), 0.1) + 0.2 * score((height[..., 0] - HEIGHT).square(), 0.01)
        gait = 2.4 * score(error.square(), 0.05).mean(-1) + 2.0 * score(change.square().mean(-1), 0.2)
        apart = score((joints[..., 14] - joints[..., 0] - INWARD).clamp(min=0.0).square(), 0.003)
        return 3.0 - course - calm - level - gait - apart

    def terminated(self, obs: Tensor) -> Tensor:
        """Tilted by more than 53 degrees, or low."""
        return (obs[..., 6] > -0.6) | (obs[..., 0] < 0.7)

    def error(self, qpos: Tensor, qvel: Tensor, memory: Tensor) -> Tensor:
        """Return the velocities along and across the course (..., 2) less the commanded ones."""
        return torch.cat((qvel[..., :1] - memory[..., :1], qvel[..., 1:2]), dim=-1)


if __name__ == "__main__":
    for share in (0.0, 0.5, 1.0):
        print(f"{share * FASTEST} m/s: {play(sys.argv[-1], Cassie(), draw=share):.2f} m in 10 s")
