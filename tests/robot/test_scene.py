"""What follows from a scene's arrays: its features, its carrier, its links without a load."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import CRANE, DISTINCT, ROBOTS, parse, pendulum, task_scene, without

import diffsim
from diffsim.robot.constants import check_soft, constrained
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene
from diffsim.robot.types import SceneError


def test_distinct_robots_have_every_feature() -> None:
    some, every = (set().union(*(task_scene(name).features for name in names)) for names in (DISTINCT, ROBOTS))
    assert some == every


def test_carrier_is_no_slide_that_a_muscle_of_the_world_could_notice():
    assert parse(CRANE).carrier == 0 and without(parse(CRANE), "muscle").carrier == 2


def test_only_the_links_before_the_first_load_are_inert():
    assert {name: task_scene(name).inert for name in ("hopper", "half_cheetah", "cartpole", "ant")} == {
        "hopper": 2,
        "half_cheetah": 2,
        "cartpole": 0,
        "ant": 0,
    }
    assert parse(CRANE).inert == 2


def constants(scene: Scene) -> dict[str, float]:
    return {name: np.atleast_1d(getattr(scene, name))[-1].item() for name in PENALTY_CONSTANTS}


def test_constants_of_soft_contact_are_the_files_or_given_and_hold_for_every_joint():
    given = {name: 10.0 + i for i, name in enumerate(PENALTY_CONSTANTS)}
    numbers = "".join(f'<numeric name="{name}" data="{value}"/>' for name, value in given.items())
    scene = parse(pendulum('range="-1 1"', rest=f"<custom>{numbers}</custom>"))
    assert constants(scene) == given
    assert constants(parse(pendulum('range="-1 1"')).with_penalty(given)) == given
    other = scene.with_penalty({"k_n": 5.0, "k_limit": 7.0})
    assert constants(other) == given | {"k_n": 5.0, "k_limit": 7.0} and (other.k_limit == 7).all()


@pytest.mark.parametrize(
    ("joint", "world", "missing"),
    [
        ("", None, "k_n, k_d, k_t, mu"),
        ('range="-1 1"', "", "k_limit, d_limit"),
        ('range="-1 1"', None, "k_n, k_d, k_t, mu, k_limit, d_limit"),
    ],
)
def test_soft_contact_needs_its_constants(joint, world, missing):
    """MuJoCo's contact does not, nor does a robot that touches nothing and has no limits."""
    scene = parse(pendulum(joint) if world is None else pendulum(joint, world=world))
    assert "limit" in scene.features or not joint
    with pytest.raises(SceneError) as error:
        diffsim.Simulator(scene, 1)
    first = missing.split(",")[0]
    assert str(error.value) == (
        f"robot: soft contact needs {missing}; choose MuJoCo's contact, give them as penalty, or name them in the file:"
        f' <custom><numeric name="{first}" data="1e4"/></custom>'
    )
    constrained(scene, 1e-3)
    check_soft(parse(pendulum(world="")))
    check_soft(scene.with_penalty(dict.fromkeys(missing.split(", "), 1.0)))
