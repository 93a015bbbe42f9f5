"""The worlds of benchmarks/transfer.py against the package, and what is measured in them."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import reference
import torch
import transfer
import worlds
from common import parse
from learners import refusal
from tables import read_csv

import diffsim
from diffsim import Integration, Scene, Simulator
from diffsim.training import evaluate, load_policy, make_policy_env

POLICIES = Path(diffsim.__file__).parent / "policies"
DT = 1 / 60


def states(name: str, n: int, **options: dict[str, float]) -> tuple[diffsim.DiffEnv, worlds.Array, worlds.Array]:
    env = diffsim.make(name, n, seed=3, dtype=torch.float64, **options)
    return env, env.qpos.numpy(), env.qvel.numpy()


@pytest.mark.parametrize("name", sorted(worlds.OBSERVED))
def test_observations_are_those_of_the_task(name: str, rng: np.random.Generator) -> None:
    env, qpos, qvel = states(name, 50)
    qpos, qvel = qpos + rng.normal(size=qpos.shape), 5 * rng.normal(size=qvel.shape)
    if env.scene.floating:
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)  # now anyhow, upside down too
    action = rng.uniform(-1, 1, (50, env.scene.nu))
    expected = env.task.observe(*map(torch.from_numpy, (qpos, qvel, action)))
    np.testing.assert_allclose(worlds.observe(name, qpos, qvel, action), expected.numpy(), rtol=1e-13, atol=1e-13)


# Laws -----------------------------------------------------------------------------------------------------------------


def test_contact_is_that_of_the_reference(rng: np.random.Generator) -> None:
    scene = diffsim.make("ant", 1).scene
    depth, velocity = rng.normal(scale=0.05, size=500), rng.normal(scale=3.0, size=(500, 3))
    velocity[:50] *= 0.01  # below the friction cone
    velocity[50:60, :2] = 0.0
    expected = np.array([reference.contact_law(scene, d, v)[0] for d, v in zip(depth, velocity, strict=True)])
    force = worlds.contact_force(scene, depth, velocity)
    np.testing.assert_allclose(force, expected, rtol=1e-12)
    sticks = scene.k_t * np.hypot(velocity[:, 0], velocity[:, 1]) < scene.mu * force[:, 2]
    assert (sticks & (force[:, 2] > 0)).any() and (~sticks & (force[:, 2] > 0)).any()
    assert ((depth < 0) & (force[:, 2] == 0)).any()  # it leaves too fast


@pytest.mark.parametrize(
    ("q", "rate", "force"),
    [
        (0.0, 9.0, 0.0),  # within its range
        (1.2, 0.0, -0.2 * 100.0),
        (1.2, 3.0, -0.2 * (100.0 + 10.0 * 3.0)),  # on its way out: the damper adds
        (1.2, -3.0, -0.2 * (100.0 - 10.0 * 3.0)),
        (1.2, -11.0, 0.0),  # it never pulls
        (-1.2, -3.0, 0.2 * (100.0 + 10.0 * 3.0)),
        (-1.2, 11.0, 0.0),
    ],
)
def test_a_limit_pushes_back_and_its_damping_grows_with_the_violation(q: float, rate: float, force: float) -> None:
    scene = diffsim.make("hopper", 1, penalty={"k_limit": 100.0, "d_limit": 10.0}).scene
    scene = dataclasses.replace(scene, lower=np.full(scene.nlink, -1.0), upper=np.full(scene.nlink, 1.0))
    links = np.array([4])
    assert worlds.limit_force(scene, links, np.array([q]), np.array([rate]))[0] == pytest.approx(force)


# The control ----------------------------------------------------------------------------------------------------------


def end(world: worlds.World, scene: Scene, qpos: worlds.Array, qvel: worlds.Array, steps: int) -> worlds.Array:
    """qpos after so many steps of random actions, on whose way feet touch the ground and joints their limits."""
    alive, rng, touched, beyond = np.ones(len(qpos), bool), np.random.default_rng(0), False, False
    for _ in range(steps):
        qpos, qvel, lost = world.step(qpos, qvel, rng.uniform(-1, 1, (len(qpos), scene.nu)), alive)
        assert not lost.any()
        touched |= bool((worlds.contacts(scene, qpos, qvel)[0] > 0).any())
        joints = qpos[:, scene.qpos_adr]
        beyond |= bool(((joints < scene.lower) | (joints > scene.upper)).any())
    assert touched and beyond
    return qpos


def simulator(scene: Scene, n: int, how: Integration) -> worlds.Here:
    return worlds.Here(Simulator(scene, n, how, DT, dtype=torch.float64))


@pytest.mark.parametrize("name", ["hopper", "half_cheetah", "ant", "humanoid"])
def test_the_control_reproduces_this_simulator(name: str) -> None:
    """The same scheme in float64 from other code: rounding alone differs, and grows along the motion."""
    env, *start = states(name, 3, penalty={"d_limit": 500.0})
    scene, how = env.scene, Integration("semi_implicit", env.task.substeps)
    expected = end(worlds.Control(scene, 3, DT, how.substeps), scene, *start, steps=40)
    assert np.abs(end(simulator(scene, 3, how), scene, *start, steps=40) - expected).max() < 1e-11
    for constant in ("k_n", "k_d", "k_t", "mu", "k_limit", "d_limit"):  # a term that is missing or wrong shows
        changed = dataclasses.replace(scene, **{constant: 0.99 * getattr(scene, constant)})
        error = np.abs(end(simulator(changed, 3, how), scene, *start, steps=40) - expected).max()
        assert error > 1e-5, constant


def test_the_control_and_the_implicit_integrator_meet_at_first_order() -> None:
    """On ground and limits that are firmer than the file's."""
    env, *start = states("hopper", 3, penalty={"k_n": 1e5, "k_d": 2e5, "k_limit": 5e3, "d_limit": 5e3})
    errors = []
    for substeps in (64, 128, 256):
        pair = worlds.Control(env.scene, 3, DT, substeps), simulator(env.scene, 3, Integration("implicit", substeps))
        control, here = (end(world, env.scene, *start, steps=30) for world in pair)
        errors.append(np.abs(control - here).max())
    assert all(1.6 < coarse / fine < 2.4 for coarse, fine in pairwise(errors)), errors


# Motions --------------------------------------------------------------------------------------------------------------


def test_episodes_here_are_those_of_an_evaluation() -> None:
    policy = load_policy(POLICIES / "hopper.pt").network
    env = diffsim.make("hopper", 3, max_episode_steps=40)
    expected = evaluate(env, policy)
    env.reset(seed=transfer.SEED)
    task = type(env.task)(dtype=torch.float64)
    start = env.qpos.double().numpy(), env.qvel.double().numpy()
    motion = transfer.act(worlds.Here(env.sim), task, policy, *start, nu=3, steps=40)
    assert motion.returns == pytest.approx(expected.returns.numpy(), rel=1e-4)
    assert motion.lengths.tolist() == [40] * 3 and not motion.fallen.any()
    assert transfer.speed(motion, DT) == pytest.approx(expected.speed, rel=0.02)  # which leaves the last step out


def test_an_episode_ends_with_a_fall_and_a_world_that_is_lost_stays_as_it_was() -> None:
    env, qpos, qvel = states("hopper", 3)
    qpos, qvel = qpos.copy(), qvel.copy()
    qpos[1, 1:3], qvel[2, 0] = (-0.6, 1.5), 2e5  # one lies above the ground, one is faster than all that is simulated
    for world in (worlds.MuJoCo(env.scene, 3, DT), worlds.Control(env.scene, 3, DT, 16), worlds.Here(env.sim)):
        motion = transfer.act(world, env.task, lambda obs: torch.zeros(len(obs), 3), qpos, qvel, nu=3, steps=5)
        assert motion.fallen.tolist() == [False, True, True] and motion.lengths.tolist() == [5, 1, 1]
        assert (motion.qpos[-1, 2] == qpos[2]).all() and np.isfinite(motion.qpos).all()


def test_the_summary_of_a_known_motion() -> None:
    """A stiff hopper glides along with its foot 10 mm deep, then 30 mm; the second episode ends after half of it."""
    env = diffsim.make("hopper", 2, stochastic_init=False, dtype=torch.float64)
    scene, rest = env.scene, env.qpos[:1].numpy()
    depth, _ = worlds.contacts(scene, rest, np.zeros((1, scene.nv)))
    t = DT * np.arange(61)
    qpos, qvel = np.tile(rest, (61, 2, 1)), np.zeros((61, 2, scene.nv))
    qpos[..., 0], qvel[..., 0] = 1.5 * t[:, None], 1.5
    qpos[..., 1] += depth.max() - np.where(t < 0.7, 0.01, 0.03)[:, None]
    lengths, fallen = np.array([60, 30]), np.array([False, True])
    motion = transfer.Motion(qpos, qvel, np.array([3.0, 1.0]), lengths, fallen)
    row = transfer.measure(motion, scene, DT)
    assert row == pytest.approx(
        {"return": 2.0, "speed": 1.5, "whole": 0.5, "penetration": 10.0, "penetration 95 %": 30.0, "slip": 1.5}
    )
    qpos[..., 1] += 1.0
    assert transfer.measure(motion, scene, DT)["penetration"] == ""  # in flight


def test_friction_is_that_of_the_file_times_a_factor() -> None:
    scene = diffsim.make("ant", 1, penalty={"mu": 0.3}).scene  # of the training, not of the file
    world = worlds.MuJoCo(scene, 1, DT, 1.5)
    assert world.model.geom_friction[:, 0] == pytest.approx(1.5 * 0.75)
    assert world.substeps == 16 and world.substeps * world.model.opt.timestep == pytest.approx(DT)
    assert worlds.MuJoCo(diffsim.make("walker", 1).scene, 1, DT).substeps == 17  # of 1 ms at most


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_writes_a_row_for_each_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(POLICIES / f"{name}.pt") for name in ("hopper", "cartpole")]
    flags = "--episodes 2 --steps 50 --friction 1 0.5 --curves --output".split()
    for _ in range(2):  # the second time over the rows of the first
        transfer.main(parse(transfer.Args, None, [*paths, *flags, str(tmp_path)]))
    rows = read_csv(tmp_path / "transfer.csv")
    hopper, cartpole = ([row for row in rows if row["task"] == name] for name in ("hopper", "cartpole"))
    assert [row["condition"] for row in hopper] == ["here", "finer", "control", "MuJoCo x1", "MuJoCo x0.5"]
    assert [row["condition"] for row in cartpole] == ["here", "finer", "control", "MuJoCo x1"]
    assert all(row["contact"] == "soft" and float(row["penetration"]) > 0 for row in hopper)
    here, finer, control, own, _ = (float(row["speed"]) for row in hopper)
    assert control == finer == pytest.approx(here, rel=0.02)
    assert float(hopper[3]["kept"]) == pytest.approx(own / here, rel=0.01)
    assert all(row["return"] and not row["speed"] + row["penetration"] for row in cartpole)
    assert (tmp_path / "transfer.png").stat().st_size > 5_000
    header, _, *lines = transfer.table(rows).splitlines()
    assert transfer.table(rows) in capsys.readouterr().out
    assert header.startswith("| task | contact | learner | seeds | here | MuJoCo x0.5 | MuJoCo x1 | kept | worst |")
    assert [line.split(" | ")[0] for line in lines] == ["| cartpole", "| hopper"]
    assert "| -4" in lines[0] and f"| policies/hopper | 1 | {here:.2f} |" in lines[1]


def test_the_table_joins_seeds() -> None:
    """Medians over seeds, the worst of what is kept, the control's largest error, shares of each friction."""
    rows = list[dict[str, str]]()
    for seed, here, control, there, whole in (("1", 4, 4.1, 2, 1), ("2", 3, 2.7, 2.7, 0.5), ("3", 2, 2, 1.8, 0.9)):
        own = {"task": "ant", "contact": "firm", "seed": seed, "checkpoint": f"shac_firm/ant__{seed}"}
        for name, value in (("here", here), ("control", control), ("MuJoCo x1", there)):
            kept, depth = str(value / here), str(10 * value)
            row = own | {"condition": name, "speed": str(value), "return": "5", "kept": kept, "penetration": depth}
            rows.append(row | {"whole": str(whole)})
    (line,) = transfer.table(rows).splitlines()[2:]
    cells = line.strip("| ").split(" | ")
    assert cells == "ant firm shac_firm 3 3.00 2.00 90% 50% 0.30 80% 30.0 20.0".split()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "of what? give a checkpoint"),
        ("none.pt", "no such checkpoint: "),
        ("humanoid_mtu.pt", "humanoid_mtu, whose muscles are not simulated in MuJoCo here"),
        ("other.pt", "was trained on 'juggler', which is no task; choose from cartpole, hopper"),
    ],
)
def test_what_cannot_be_compared(name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = POLICIES / name if name == "humanoid_mtu.pt" else tmp_path / name
    if name == "other.pt":
        state = torch.load(POLICIES / "cartpole.pt", weights_only=True)
        torch.save(state | {"args": state["args"] | {"env": "juggler"}}, path)
    args = parse(transfer.Args, None, [str(path)] if name else [])
    assert message in refusal(lambda: transfer.main(args), capsys)


def test_a_video_shows_both_worlds(tmp_path: Path) -> None:
    try:
        diffsim.view.render.check_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))
    saved = load_policy(POLICIES / "hopper.pt")
    env = make_policy_env(saved, 1)
    qpos = env.qpos.double().numpy()
    motion = transfer.Motion(np.stack([qpos] * 9), np.zeros((9, 1, 6)), np.zeros(1), np.array([8]), np.array([False]))
    transfer.film(tmp_path / "both.gif", env, motion, motion)
    assert (tmp_path / "both.gif").stat().st_size > 1_000
