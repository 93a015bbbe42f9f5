"""Unitree's Go1, Go2 and G1 as joystick tasks. Their figures are those of MuJoCo Menagerie's files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from diffsim.tasks.base import Defaults
from diffsim_robots.joystick import WEIGHTS, Joystick, Leg, Robot


def _quadruped(order: Sequence[str]) -> Robot:
    """Return a Go1 or Go2 with the legs in this order; a trot."""
    legs = tuple(
        Leg(
            (f"{name}_thigh", f"{name}_hip"),
            {f"{name}_thigh": 0.2, f"{name}_calf": -0.4},
            (0.19 if name[0] == "F" else -0.19, 0.14 if name[1] == "L" else -0.14),
            0.0 if name in ("FL", "RR") else 0.5,
        )
        for name in order
    )
    joints = tuple(f"{name}_{part}" for name in order for part in ("hip", "thigh", "calf"))
    return Robot(joints, (0.0, 0.9, -1.8) * 4, 0.27, legs, 0.265, 0.072, 2.0, (("FR_", "FL_"), ("RR_", "RL_")))


def _humanoid() -> Robot:
    """Return a G1 with 29 joints; a walk."""
    leg = "hip_pitch hip_roll hip_yaw knee ankle_pitch ankle_roll".split()
    arm = "shoulder_pitch shoulder_roll shoulder_yaw elbow wrist_roll wrist_pitch wrist_yaw".split()
    parts = [("left_", leg), ("right_", leg), ("waist_", ["yaw", "roll", "pitch"]), ("left_", arm), ("right_", arm)]
    stance, hang = (-0.312, 0.0, 0.0, 0.669, -0.363, 0.0), (0.2, 0.0, 0.6, 0.0, 0.0, 0.0)
    legs = tuple(
        Leg(
            (f"{side}_hip_pitch", f"{side}_hip_roll"),
            {f"{side}_hip_pitch": -0.4, f"{side}_knee": 0.8, f"{side}_ankle_pitch": -0.4},
            (0.0, 0.12 if side == "left" else -0.12),
            0.0 if side == "left" else 0.5,
        )
        for side in ("left", "right")
    )
    home = (*stance, *stance, 0.0, 0.0, 0.073, 0.2, *hang, 0.2, -0.2, *hang[1:])
    joints = tuple(side + name for side, names in parts for name in names)
    return Robot(joints, home, 0.755, legs, 0.65, 0.08, 1.4, (("right_", "left_"),), apart=0.13)


# Learners begin near the standing pose, with little noise.
BEGIN: dict[str, Any] = {
    "critic_hidden": (256, 128),
    "critic_lr": 1e-3,
    "target_alpha": 0.9,
    "initial_log_std": -2.0,
    "adjoint_clip": 5.0,
}
BEGIN_RPO = BEGIN | {"horizon": 16, "num_envs": 64, "critic_iterations": 4, "epochs": 4, "trust": 0.5}
QUADRUPED: Defaults = {
    "shac": BEGIN | {"iterations": 600},
    "shac gpu": {"num_envs": 1024, "iterations": 1000},
    "rpo": BEGIN_RPO | {"iterations": 400},
    "rpo gpu": {"num_envs": 1024},
}


class Go1(Joystick):
    """12 joints; action: targets of the servos."""

    name, asset, robot = "go1", "go1.xml", _quadruped(("FR", "FL", "RR", "RL"))
    defaults = QUADRUPED


class Go2(Joystick):
    """12 joints; action: targets of servos on the motors."""

    name, asset, robot = "go2", "go2.xml", _quadruped(("FL", "FR", "RL", "RR"))
    defaults = QUADRUPED


class G1(Joystick):
    """29 joints; action: targets of the servos."""

    name, asset, robot = "g1", "g1.xml", _humanoid()
    weights = WEIGHTS | {"alive": 2.5, "action_rate": -1.0}
    ranges = {name: Joystick.ranges[name] for name in ("friction", "mass", "motor", "latency")} | {"push": (0.5, 1.5)}
    defaults: ClassVar[Defaults] = {
        "shac": BEGIN | {"horizon": 16, "iterations": 1500},
        "rpo": BEGIN_RPO | {"initial_log_std": -3.0, "iterations": 600},
        "rpo gpu": {"num_envs": 1024},
        "sapo": BEGIN | {"horizon": 16, "target_entropy": (-1.0, -1.0), "critic_iterations": 4, "iterations": 1200},
        "sapo gpu": {"num_envs": 1024},
        "sapo cpu": {"iterations": 700},
    }
