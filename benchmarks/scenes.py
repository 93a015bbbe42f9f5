"""A half cheetah with less and with more physics than the task's: what a force law costs that a scene does not require.

python rpo.py --env benchmarks/scenes.py:Unlimited
"""

import mujoco

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.tasks.base import ASSETS
from diffsim.tasks.half_cheetah import HalfCheetah


class Unlimited(HalfCheetah):
    """Its joints turn without limits."""

    name, like = "unlimited", "half_cheetah"

    @classmethod
    def load_robot(cls) -> Scene:
        spec = mujoco.MjSpec.from_file(str(ASSETS / cls.asset))
        for joint in spec.joints:
            joint.limited = False
        return load_scene(spec)


class Dragged(HalfCheetah):
    """Air resists its links."""

    name, like = "dragged", "half_cheetah"

    @classmethod
    def load_robot(cls) -> Scene:
        spec = mujoco.MjSpec.from_file(str(ASSETS / cls.asset))
        spec.option.density, spec.option.viscosity = 1.2, 1.8e-5
        return load_scene(spec)
