"""What follows from a scene's arrays: its features, its carrier, its links without a load."""

from __future__ import annotations

import pytest
from scenes import CRANE, DISTINCT, ROBOTS, parse, task_scene


def test_distinct_robots_have_every_feature() -> None:
    some, every = (set().union(*(task_scene(name).features for name in names)) for names in (DISTINCT, ROBOTS))
    assert some == every


@pytest.mark.parametrize("name", ROBOTS)
def test_features_of_the_tasks(name):
    expected = {
        "cartpole": {"hinge", "slide", "limit", "damping", "motor"},
        "hopper": {"hinge", "slide", "limit", "damping", "motor", "contact"},
        "half_cheetah": {"hinge", "slide", "limit", "damping", "motor", "contact", "stiffness"},
        "ant": {"floating", "hinge", "limit", "damping", "motor", "contact"},
        "humanoid": {"floating", "hinge", "limit", "damping", "motor", "contact", "stiffness"},
        "swimmer": {"hinge", "slide", "limit", "motor", "drag"},
        "walker": {"hinge", "slide", "limit", "damping", "motor", "contact"},
        "humanoid_mtu": {"floating", "ball", "hinge", "limit", "damping", "contact", "stiffness", "muscle"},
    }
    assert task_scene(name).features == expected[name]


def test_carrier_is_no_slide_that_a_muscle_of_the_world_could_notice():
    assert parse(CRANE).carrier == 0 and parse(CRANE).without("muscle").carrier == 2


def test_without():
    scene = task_scene("humanoid")
    bare = scene.without("contact", "limit", "stiffness", "damping")
    assert bare.features == {"floating", "hinge", "motor"} and bare.ncontact == 0
    assert scene.features > bare.features
    assert scene.without("contact").features == scene.features - {"contact"}
    with pytest.raises(ValueError, match="floating.*contact, limit, stiffness, damping, muscle, drag"):
        scene.without("floating")


def test_only_the_links_before_the_first_load_are_inert():
    assert {name: task_scene(name).inert for name in ("hopper", "half_cheetah", "cartpole", "ant")} == {
        "hopper": 2,
        "half_cheetah": 2,
        "cartpole": 0,
        "ant": 0,
    }
    assert parse(CRANE).inert == 2
