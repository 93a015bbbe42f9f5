"""The worlds of benchmarks/transfer.py, and what is measured in them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import transfer
from common import parse
from learners import refusal
from tables import markdown, read_csv

import diffsim
from diffsim import Integration, Simulator
from diffsim.training import evaluate, gait, load_policy, make_policy_env

POLICIES = Path(diffsim.__file__).parent / "policies"
DT = 1 / 60


def states(name: str, n: int) -> tuple[diffsim.DiffEnv, transfer.Array, transfer.Array]:
    env = diffsim.make(name, n, seed=3, dtype=torch.float64)
    return env, env.qpos.numpy().copy(), env.qvel.numpy().copy()


def test_the_worlds_agree_where_nothing_touches() -> None:
    """In flight and within the joints' ranges both solve the same equations, with the same motors at the same times."""
    env, qpos, qvel = states("hopper", 3)
    qpos[:, 1], qpos[:, 3:] = 5.0, torch.tensor([-0.5, -0.5, 0.0])
    here = Simulator(env.scene, 3, Integration("semi_implicit", 64), DT, dtype=torch.float64)
    ends = []
    for world in (transfer.Here(here), transfer.MuJoCo(env.scene, 3, DT)):
        q, v, rng = qpos, qvel, np.random.default_rng(0)
        for _ in range(5):
            q, v, lost = world.step(q, v, 0.1 * rng.uniform(-1, 1, (3, 3)), np.ones(3, bool))
            assert not lost.any()
        ends.append(q)
    moved = np.abs(ends[0] - qpos)[:, 3:].max()
    assert moved > 0.01 and np.abs(ends[0] - ends[1]).max() < 0.03 * moved


# Motions --------------------------------------------------------------------------------------------------------------


def test_episodes_here_are_those_of_an_evaluation() -> None:
    policy = load_policy(POLICIES / "hopper.pt").network
    env = diffsim.make("hopper", 3, max_episode_steps=40)
    expected = evaluate(env, policy)
    env.reset(seed=transfer.SEED)
    task = type(env.task)(dtype=torch.float64)
    start = env.qpos.double().numpy(), env.qvel.double().numpy()
    motion = transfer.act(transfer.Here(env.sim), task, policy, *start, nu=3, steps=40)
    assert motion.returns == pytest.approx(expected.returns.numpy(), rel=1e-4)
    assert motion.lengths.tolist() == [40] * 3 and not motion.fallen.any()
    assert transfer.speed(motion, DT) == pytest.approx(expected.speed, rel=0.02)  # which leaves the last step out


def test_an_episode_ends_with_a_fall_and_a_world_that_is_lost_stays_as_it_was() -> None:
    env, qpos, qvel = states("hopper", 3)
    qpos[1, 1:3], qvel[2, 0] = (-0.6, 1.5), 2e5  # one lies above the ground, one is faster than all that is simulated
    for world in (transfer.MuJoCo(env.scene, 3, DT), transfer.Here(env.sim)):
        motion = transfer.act(world, env.task, lambda obs: torch.zeros(len(obs), 3), qpos, qvel, nu=3, steps=5)
        assert motion.fallen.tolist() == [False, True, True] and motion.lengths.tolist() == [5, 1, 1]
        assert (motion.qpos[-1, 2] == qpos[2]).all() and np.isfinite(motion.qpos).all()


def test_the_summary_of_a_known_motion() -> None:
    """A stiff hopper glides along with its foot 10 mm deep, then 30 mm; the second episode ends after half of it."""
    env = diffsim.make("hopper", 2, stochastic_init=False, dtype=torch.float64)
    scene, rest = env.scene, env.qpos[:1].numpy()
    depth = gait.trace(scene, rest)[0]
    t = DT * np.arange(61)
    qpos, qvel = np.tile(rest, (61, 2, 1)), np.zeros((61, 2, scene.nv))
    qpos[..., 0], qvel[..., 0] = 1.5 * t[:, None], 1.5
    qpos[..., 1] += depth.max() - np.where(t < 0.7, 0.01, 0.03)[:, None]
    lengths, fallen = np.array([60, 30]), np.array([False, True])
    motion = transfer.Motion(qpos, qvel, np.array([3.0, 1.0]), lengths, fallen)
    row = transfer.measure(motion, scene, DT)
    assert row == pytest.approx(
        {"return": 2.0, "speed": 1.5, "whole": 0.5, "penetration": 10.0, "penetration 95 %": 30.0}
    )
    qpos[..., 1] += 1.0
    assert transfer.measure(motion, scene, DT)["penetration"] == ""  # in flight


def test_friction_is_that_of_the_file_times_a_factor() -> None:
    scene = diffsim.make("ant", 1, penalty={"mu": 0.3}).scene  # of the training, not of the file
    world = transfer.MuJoCo(scene, 1, DT, 1.5)
    assert world.model.geom_friction[:, 0] == pytest.approx(1.5 * 0.75)
    assert world.substeps == 16 and world.substeps * world.model.opt.timestep == pytest.approx(DT)
    assert transfer.MuJoCo(diffsim.make("walker", 1).scene, 1, DT).substeps == 17  # of 1 ms at most
    assert transfer.MuJoCo(scene, 1, DT, 1.5, own_friction=True).model.geom_friction[:, 0] == pytest.approx(1.5)


def test_the_same_law_differs_from_the_file_in_cones_and_steps_alone() -> None:
    scene = diffsim.make("hopper", 1, contact="mujoco").scene
    own, same = (transfer.MuJoCo(scene, 1, DT, 1.0, True, substeps) for substeps in (None, 4))
    assert (own.substeps, same.substeps) == (16, 4) and same.model.opt.timestep == pytest.approx(DT / 4)
    assert (own.model.opt.cone, same.model.opt.cone) == (
        mujoco.mjtCone.mjCONE_PYRAMIDAL,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    file = mujoco.MjModel.from_xml_path(scene.path)
    assert (own.model.geom_friction == file.geom_friction).all() and own.model.opt.timestep == file.opt.timestep


@pytest.mark.parametrize("simulator", ["diffsim", "mujoco_warp"])
def test_what_is_kept_counts_from_the_world_of_the_training(simulator: str, tmp_path: Path) -> None:
    state = torch.load(POLICIES / "hopper.pt", weights_only=True)
    exact = {"contact": "mujoco", "integrator": "mujoco", "substeps": 4, "theta": 0.0, "passes": 4}
    path, folder = tmp_path / "ppo" / "hopper__1" / "checkpoint.pt", tmp_path / "csv"
    path.parent.mkdir(parents=True)
    args = state["args"] | exact | {"seed": 1}
    torch.save(state | {"args": args} | ({"simulator": simulator} if simulator != "diffsim" else {}), path)
    flags = "--episodes 2 --steps 20 --friction 1 --output".split()
    transfer.main(parse(transfer.Args, None, [str(path), *flags, str(folder)]))
    rows = {row["condition"]: row for row in read_csv(folder / "transfer.csv")}
    trained, judge = ("here", "MuJoCo x1") if simulator == "diffsim" else ("MuJoCo same", "here")
    assert {*rows} == {"here", "finer", "MuJoCo same", "MuJoCo x1"} and [*rows][0] == trained
    kept = float(rows[judge]["speed"]) / float(rows[trained]["speed"])
    assert float(rows[trained]["kept"]) == 1 and float(rows[judge]["kept"]) == pytest.approx(kept, rel=0.01)
    assert float(rows["here"]["speed"]) == pytest.approx(float(rows["MuJoCo same"]["speed"]), rel=0.01)  # one law
    (line,) = transfer.table([*rows.values()])
    assert (line["judged in"], line["kept"]) == (judge, f"{float(rows[judge]['kept']):.0%}")


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_writes_a_row_for_each_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(POLICIES / f"{name}.pt") for name in ("hopper", "cartpole")]
    flags = "--episodes 2 --steps 50 --friction 1 0.5 --output".split()
    for _ in range(2):  # the second time over the rows of the first
        transfer.main(parse(transfer.Args, None, [*paths, *flags, str(tmp_path)]))
    rows = read_csv(tmp_path / "transfer.csv")
    hopper, cartpole = ([row for row in rows if row["task"] == name] for name in ("hopper", "cartpole"))
    assert [row["condition"] for row in hopper] == ["here", "finer", "MuJoCo x1", "MuJoCo x0.5"]
    assert [row["condition"] for row in cartpole] == ["here", "finer", "MuJoCo x1"]
    assert all(row["contact"] == "soft" and float(row["penetration"]) > 0 for row in hopper)
    here, finer, own, _ = (float(row["speed"]) for row in hopper)
    assert finer == pytest.approx(here, rel=0.02)
    assert float(hopper[2]["kept"]) == pytest.approx(own / here, rel=0.01)
    assert all(row["return"] and not row["speed"] + row["penetration"] for row in cartpole)
    alone, travelling = transfer.table(rows)
    assert markdown([alone, travelling]) in capsys.readouterr().out
    assert [*alone] == ["task", "contact", "learner", "seeds", "here", "MuJoCo x0.5", "MuJoCo x1", "trained in"] + [
        *("judged in", "kept", "worst", "whole", "depth here", "depth MuJoCo x1")
    ]
    # Cartpole touches nothing: a return, the same in MuJoCo.
    assert float(alone["here"]) == pytest.approx(float(alone["MuJoCo x1"]), rel=0.02) and alone["kept"] == ""
    assert (travelling["learner"], travelling["here"]) == ("policies/hopper", f"{here:.2f}")


def test_the_table_joins_seeds() -> None:
    """Medians over seeds, the worst of what is kept, shares of each friction."""
    rows = list[dict[str, str]]()
    for seed, here, there, whole in (("1", 4, 2, 1), ("2", 3, 2.7, 0.5), ("3", 2, 1.8, 0.9)):
        own = {"task": "ant", "contact": "mujoco", "seed": seed, "checkpoint": f"shac_rigid/ant__{seed}"}
        for name, value in (("here", here), ("MuJoCo x1", there)):
            kept, depth = str(value / here), str(10 * value)
            row = own | {"condition": name, "speed": str(value), "return": "5", "kept": kept, "penetration": depth}
            rows.append(row | {"whole": str(whole)})
    (line,) = transfer.table(rows)
    assert [*map(str, line.values())] == [
        *"ant mujoco shac_rigid 3 3.00 2.00 here".split(),
        *("MuJoCo x1", "90%", "50%", "80% / 80%", "30.0", "20.0"),
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "of what? give a checkpoint"),
        ("none.pt", "no such checkpoint: "),
        ("humanoid_mtu.pt", "humanoid_mtu, whose muscles are not simulated in MuJoCo here"),
        ("other.pt", "was trained elsewhere: unknown task 'juggler': choose from cartpole, hopper"),
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
