"""How threads divide an environment: everything is dealt once, and each lane has what its share needs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from scenes import leg_scene, parse, task_scene

import diffsim
from diffsim.kernels.thread.division import divide
from diffsim.kernels.thread.model import model_of
from diffsim.kernels.thread.spec import KernelSpec, kernel_spec

TEAMS = [(1, 1), (2, 1), (4, 1), (2, 2), (8, 4)]  # threads of an environment, and how many of them share limbs


@pytest.mark.parametrize("team", TEAMS)
@pytest.mark.parametrize("name", diffsim.TASKS)
def test_everything_is_dealt_once(name: str, team: tuple[int, int]) -> None:
    scene = task_scene(name)
    d = divide(scene, *team)
    muscles = sorted(set(scene.segment_muscle))
    for hands, things in (
        (d.masses, range(scene.nlink)),
        (d.spheres, range(len(scene.contact_link))),
        (d.muscles, muscles),
    ):
        assert sorted(k for hand in hands for k in hand) == list(things)
    trunk = d.links[0][: d.trunk + 1]
    for lane, links in enumerate(d.links):
        has = set(links)
        assert links[: d.trunk + 1] == trunk and links[d.trunk + 1 :] == sorted(has - set(trunk))
        assert all(scene.parent[i] in has for i in links)
        assert has >= set(d.masses[lane]) | {scene.contact_link[k] for k in d.spheres[lane]}
        for k in d.muscles[lane]:
            assert has >= set(scene.segment_link[scene.segment_muscle == k].flatten())
        # A limb belongs to the sharers of one group alone.
        for other, theirs in enumerate(d.links):
            assert (has & set(theirs) == set(trunk)) or other // team[1] == lane // team[1] or has == set(trunk)


@pytest.mark.parametrize(
    ("name", "team", "slots"), [("ant", (4, 1), 3), ("humanoid", (4, 1), 10), ("humanoid_mtu", (8, 4), 10)]
)
def test_limbs_make_short_routes(name: str, team: tuple[int, int], slots: int) -> None:
    assert divide(task_scene(name), *team).slots == slots


@pytest.mark.parametrize("name", ["half_cheetah", "humanoid_mtu"])
def test_the_lanes_models_add_up(name: str) -> None:
    """Entry by entry against the scene: masses, spheres, segments, and parents as slots."""
    scene = task_scene(name)
    d = divide(scene, 8, 4)
    model = model_of(scene, d, wp.float64, "cpu")
    link, mass, parent = (getattr(model, k).numpy().reshape(8, d.slots) for k in ("link", "mass", "parent"))
    count, begin = model.count.numpy(), model.contact_begin.numpy()
    total, spheres = np.zeros(scene.nlink), np.zeros(scene.nlink)
    for lane in range(8):
        for slot in range(count[lane]):
            total[link[lane, slot]] += mass[lane, slot]
            entry = lane * d.slots + slot
            spheres[link[lane, slot]] += begin[entry + 1] - begin[entry]
            assert link[lane, parent[lane, slot]] == scene.parent[link[lane, slot]]
    np.testing.assert_array_equal(total, scene.mass)
    np.testing.assert_array_equal(spheres, np.bincount(scene.contact_link, minlength=scene.nlink))
    if not len(scene.segment_muscle):
        return
    pairs = model.pair_link.numpy().reshape(-1, 2)
    lane_begin, pair_begin = model.lane_begin.numpy(), model.pair_begin.numpy()
    seen = []
    for lane in range(8):
        for pair in range(lane_begin[lane], lane_begin[lane + 1]):
            for s in range(pair_begin[pair], pair_begin[pair + 1]):
                seen.append((model.segment_muscle.numpy()[s], *link[lane, pairs[pair]]))
                assert seen[-1][0] in d.muscles[lane]
    assert sorted(seen) == sorted(zip(scene.segment_muscle, *scene.segment_link.T, strict=True))


@pytest.mark.parametrize("team", [(3, 1), (2, 4), (32, 1), (0, 1), (4, 3)])
def test_numbers_of_threads_are_checked(team: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"threads_per_env is {team[0]} and sharers {team[1]}: both must be one of"):
        divide(task_scene("cartpole"), *team)


def test_a_cpu_has_one_thread_for_an_environment() -> None:
    scene = task_scene("cartpole")
    diffsim.Simulator(scene, 1, division=(1, 1))
    with pytest.raises(ValueError, match="threads_per_env is 2, must be 1 on a CPU"):
        diffsim.Simulator(scene, 1, division=(2, 1))


def test_a_division_has_the_spheres_of_the_contact_model() -> None:
    """MuJoCo's contact has spheres of its own; with the division of soft contact, most of them would be left out."""
    for contact, count in (("soft", 13), ("mujoco", 25)):
        sim = diffsim.Simulator(task_scene("ant"), 1, diffsim.Integration(contact, 4), division=(1, 1))
        assert len(sim._launcher._model.contact_radius) == count


def motors_among_muscles() -> diffsim.Scene:
    """The humanoid with muscles, ten of which are motors of its joints instead."""
    scene = task_scene("humanoid_mtu")
    kept = scene.segment_muscle >= 10
    segments = {name: getattr(scene, name)[kept] for name in ("segment_link", "segment_position", "segment_muscle")}
    link = scene.motor_link.copy()
    link[:10] = [1, 18, 2, 17, 9, 10, 4, 13, 8, 16]
    return dataclasses.replace(scene, motor_link=link, **segments)


@pytest.mark.parametrize("team", TEAMS)
@pytest.mark.parametrize("scene", [task_scene("ant"), leg_scene(), motors_among_muscles()])
def test_a_motors_gradient_is_written_by_a_lane_that_has_its_link(scene: diffsim.Scene, team: tuple[int, int]) -> None:
    model = model_of(scene, divide(scene, *team), wp.float64, "cpu")
    slots = model.motor_slot.numpy().reshape(team[0], scene.nu)
    link = model.link.numpy().reshape(team[0], -1)
    motors = np.flatnonzero(scene.motor_link)
    assert len(motors)
    for k, lane in zip(motors, model.motor_lane.numpy()[motors], strict=True):
        assert link[lane, slots[lane, k]] == scene.motor_link[k]


def test_lanes_skip_inert_links_that_all_of_them_have() -> None:
    """A hinge on a slide and a hinge alone: the second lane starts with a link that has mass."""
    arm = '<body>{}<joint axis="0 1 0"/><geom size="0.1"/></body>'
    slide = '<joint type="slide"/>'
    scene = parse(f"<mujoco><worldbody>{arm.format(slide)}{arm.format('')}</worldbody></mujoco>")
    assert scene.inert == 1

    def spec(scene: diffsim.Scene, *team: int) -> KernelSpec:
        return kernel_spec(scene, divide(scene, *team), wp.float64, implicit=False, env_last=True)

    assert spec(scene).inert == 1
    assert spec(scene, 2, 1).inert == 0
    assert spec(scene, 2, 2).inert == 1
    assert spec(task_scene("half_cheetah"), 2, 1).inert == 2
