"""A robot of MuJoCo Menagerie that walks forward, and its ONNX file in MuJoCo; docs/own_robot.md explains it.

git clone https://github.com/google-deepmind/mujoco_menagerie
python shac.py --env examples/own_quadruped.py --iterations 400
python -m diffsim export runs/<run>/checkpoint.pt a1.onnx --env examples/own_quadruped.py
python examples/own_quadruped.py a1.onnx
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from diffsim.tasks import Task

SPEED = 0.6  # m/s


class WalkA1(Task):
    """qpos = (position, quaternion wxyz, 12 joints); action: targets of the servos, 0 is the keyframe's."""

    name = "walk_a1"
    asset = "mujoco_menagerie/unitree_a1/scene.xml"
    action_scale = 0.4  # rad
    control_dt = 0.02  # s, 50 actions a second
    episode_length = 500
    spread = (0.0,) * 7 + (0.2,) * 12 + (0.2,) * 18  # of joints and rates at the start
    min_height = 0.18  # m

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """Height, the vertical in the body's frame, velocities, joints, their rates, and the action before."""
        w, x, y, z = qpos[..., 3:7].unbind(-1)
        up = torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), dim=-1)
        return torch.cat((qpos[..., 2:3], up, qvel[..., :6], qpos[..., 7:], 0.1 * qvel[..., 6:], action), dim=-1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        """2 for not falling, less the errors of velocity, course and attitude, and the motors' effort."""
        up, velocity, turning, rates = obs[..., 3], obs[..., 4:7], obs[..., 7:10], obs[..., 22:34]
        course = 4.0 * (velocity[..., 0] - SPEED).square() + velocity[..., 1:].square().sum(-1)
        effort = 0.1 * action.square().sum(-1) + 0.1 * rates.square().sum(-1)
        return 2.0 - course - 0.1 * turning.square().sum(-1) - 2.0 * (1.0 - up) - effort


def play(path: str, task: Task, seconds: float = 10.0, draw: float = 0.5) -> float:
    """Run an ONNX file in MuJoCo, as a robot's computer would, until a fall; returns the distance [m].

    draw: in [0, 1], in place of the random numbers of the task's memory.
    """
    if not path.endswith(".onnx") or not Path(path).is_file():
        sys.exit(f"{path} is no ONNX file: give one that `diffsim export` has written")
    from onnxruntime import InferenceSession

    policy, model = InferenceSession(path), task.load_robot().mj_model
    told = policy.get_modelmeta().custom_metadata_map
    home, scale = (np.array(told[name].split(","), float) for name in ("default_joint_pos", "action_scale"))
    data, action = mujoco.MjData(model), torch.zeros(model.nu)
    memory = task.begin(torch.full((model.nq + model.nv,), draw))
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(round(seconds / task.control_dt)):
        qpos, qvel = (torch.tensor(x, dtype=torch.float32) for x in (data.qpos, data.qvel))
        obs = task.observe_with(qpos, qvel, action, memory)
        if task.terminated(obs):
            break
        action = torch.tensor(policy.run(["action"], {"observation": obs[None].numpy()})[0][0])
        memory = task.remember(memory, action, memory)
        data.ctrl[:] = home + scale * action.numpy()  # targets of the servos [rad]
        for _ in range(round(task.control_dt / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return data.qpos[0]


if __name__ == "__main__":
    print(f"{play(sys.argv[-1], WalkA1()):.2f} m in 10 s")
