"""A G1 whose legs touch each other in training, so that its reward needs no term for them; docs/tasks.md.

python rpo.py --env examples/self_contact.py:Whole --device cuda
python benchmarks/joystick.py runs/<run> --own examples/self_contact.py:Whole --push 2 \\
    --file mujoco_menagerie/unitree_g1/scene.xml
"""

from itertools import product
from typing import ClassVar

import mujoco

from diffsim.robot.mjcf import load_scene
from diffsim.robot.pairs import with_pairs
from diffsim.robot.scene import Scene
from diffsim.tasks.base import ASSETS, Defaults
from diffsim_robots.unitree import BEGIN, G1

LEG = "hip_roll", "hip_yaw", "knee", "ankle_roll"  # links whose first geoms touch those of the other leg


class Ghost(G1):
    """A G1 whose legs pass through each other, as the shipped one's, without a reward for feet that stay apart."""

    name, robot, initial_gain = "ghost", G1.robot._replace(apart=0.0), 1.0
    defaults: ClassVar[Defaults] = {
        "rpo": BEGIN | {"horizon": 16, "initial_log_std": -3.0, "num_envs": 1024, "iterations": 600}
    }


class Whole(Ghost):
    """A G1 whose legs touch each other."""

    name, robot = "whole", Ghost.robot

    @classmethod
    def load_robot(cls) -> Scene:
        spec = mujoco.MjSpec.from_file(str(ASSETS / cls.asset))
        sides = [[spec.body(f"{side}_{link}_link").first_geom() for link in LEG] for side in ("left", "right")]
        for geoms, side in zip(sides, ("left", "right"), strict=True):
            for geom, link in zip(geoms, LEG, strict=True):
                geom.name = f"{side}_{link}"
        for left, right in product(*sides):
            spec.add_pair(geomname1=left.name, geomname2=right.name)
        return with_pairs(load_scene(spec))
