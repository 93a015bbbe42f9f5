"""Tracking: clips of other projects' files, what is refused, the reference, the reward, the mirror, and the end."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from learners import stopped
from scenes import task_scene
from torch import Tensor

import diffsim
import ppo_baseline
from diffsim.training import checkpoint
from diffsim_robots.common import FREQUENCY_OF_PUSHES
from diffsim_robots.imitation.clip import Clip, read_clip
from diffsim_robots.imitation.task import STRAY, HumanoidImitation
from diffsim_robots.imitation.tracking import AHEAD, BEFORE_END, REACH, STANDING, TURNED, G1Track
from diffsim_robots.terrain import incline

REAL = torch.float64
N = 29


@pytest.fixture(scope="module")
def task() -> G1Track:
    return G1Track(dtype=REAL)


def sway(seconds: float, fps: float) -> np.ndarray:
    """qpos (T, 36) of a slow motion that turns about all axes and goes forward."""
    t = np.arange(round(seconds * fps) + 1)[:, None] / fps
    angle, axis = 0.4 * np.sin(2 * t), np.array([[1.0, 2.0, -2.0]]) / 3
    place = np.concatenate((0.3 * t + 1, 0.1 * np.sin(t), 0.76 + 0.01 * np.cos(3 * t)), 1)
    joints = 0.2 + 0.1 * np.sin(2 * t + np.arange(N))
    joints[:, [1, 5, 7, 11, 13]] -= 0.2  # of small ranges
    return np.concatenate((place, np.cos(angle / 2), np.sin(angle / 2) * axis, joints), 1)


def write_csv(path: Path, qpos: np.ndarray) -> Path:
    """As Unitree's LAFAN1 and G1 Moves: no header, quaternion xyzw."""
    np.savetxt(path, qpos[:, [0, 1, 2, 4, 5, 6, 3, *range(7, qpos.shape[1])]], delimiter=",")
    return path


def some(task: G1Track, count: int, off: float = 0.1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """qpos, qvel, action and memory of robots that are beside the reference."""
    generator = torch.Generator().manual_seed(0)
    memory = task.begin(torch.rand(count, 1, dtype=REAL, generator=generator))
    memory[:, 1:] = torch.rand(count, 2 * N + 2, dtype=REAL, generator=generator) - 0.5
    qpos, qvel = task.reference(memory)
    qpos = qpos + off * torch.randn(qpos.shape, dtype=REAL, generator=generator)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    return qpos, qvel + off * torch.randn(qvel.shape, dtype=REAL, generator=generator), memory[:, 1 : 1 + N], memory


# Files ----------------------------------------------------------------------------------------------------------------


def test_both_csv_forms_and_a_folder_are_the_motion_that_they_hold(tmp_path: Path) -> None:
    expected = torch.from_numpy(sway(2, 60))
    lafan = write_csv(tmp_path / "lafan.csv", sway(2, 30))
    moves = write_csv(tmp_path / "moves.csv", sway(2, 60))
    np.savez(tmp_path / "own.npz", qpos=sway(2, 60), fps=60, loop=False)
    torch.testing.assert_close(read_clip(lafan).qpos, expected, atol=2e-3, rtol=0)
    for source in (f"{moves}:60", tmp_path / "own.npz"):
        clip = read_clip(source)
        torch.testing.assert_close(clip.qpos, expected, atol=1e-12, rtol=0)
        assert clip.name == Path(str(source).partition(":")[0]).stem and not clip.loop
    assert len(read_clip(moves).qpos) == 241  # of 30 rows in a second
    both = read_clip(f"{tmp_path}:60")
    assert both.lengths == (61, 121, 121) and both.name == tmp_path.name and len(both.motions()) == 3
    assert torch.equal(both.motions()[1].qpos, read_clip(f"{moves}:60").qpos)
    task = G1Track.with_clip(both)(dtype=REAL)
    assert task.motions[1].tolist() == [50, 100, 100] and task.motions[0].tolist() == [0, 51, 152]
    torch.save(G1Track.with_clip(both).stored(), file := tmp_path / "clip.pt")
    G1Track.restore("moves", torch.load(file, weights_only=True))
    assert G1Track.with_clip("moves").given_clip == both != read_clip(moves)
    G1Track.restore("moves", {})


def test_bad_clips_are_refused_in_one_line(tmp_path: Path) -> None:
    good, fast, wide = sway(2, 60), sway(2, 60), sway(2, 60) * np.where(np.arange(36) < 7, 1, 10)
    fast[:, 22] = 2.6 * np.sin(10 * np.arange(len(fast)) / 60)  # of a shoulder; at twice the speed it is too fast
    jump = np.concatenate((good[:60], good[60:] + np.eye(36)[0]))
    wrong = {
        "clip bad: the root moves by up to 12.* m/s; does it jump, or is it not in m?": jump,
        "qpos has 28 columns, the robot has 36": good[:, :28],
        "is up to .* rad beyond its limits .*; are the angles in radians?": wide,
        "turns by up to .* rad/s, more than a motor's 40; is it played too fast?": fast,
        "must be a .csv file with finite rows .* of 0.1 s to 1 h": good * np.nan,
        "must be a .csv file with finite rows": good[:3],
    }
    for complaint, qpos in wrong.items():
        file = write_csv(tmp_path / "bad.csv", qpos)
        with pytest.raises(ValueError, match=f"^clip .*{complaint}$" if "joint" in complaint else complaint) as found:
            diffsim.make(f"g1_track:{file}:{120 if 'fast' in complaint else 60}", 1)
        assert "\n" not in str(found.value)
    for content in ("", "x,y,z\n", "1,2,3\n1,2\n"):
        file.write_text(content)
        with pytest.raises(ValueError, match="must be a .csv file with finite rows of root position"):
            read_clip(file)
    (empty := tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no such clip: .*empty; give an .npz or .csv file, a folder of them, or one"):
        read_clip(empty)
    write_csv(empty / "a.csv", good), write_csv(empty / "b.csv", good[:, :30])
    with pytest.raises(
        ValueError, match=r"clips of .*empty are for several robots: their qpos have \{36, 30\}|\{30, 36"
    ):
        read_clip(empty)
    write_csv(empty / "b.csv", wide)
    with pytest.raises(ValueError, match="clip empty, file 2: joint '.*' is up to"):
        diffsim.make(f"g1_track:{empty}:60", 1)
    with pytest.raises(ValueError, match="task 'humanoid_imitation' tracks one motion, not the 2 of two"):
        motion = read_clip("humanoid_run").qpos
        two = Clip("two", torch.cat((motion, motion)), False, (24, 24))
        diffsim.make(HumanoidImitation.with_clip(two), 1)


@pytest.mark.parametrize("name", ["g1_karate", "g1_jazz_walk"])
def test_a_quaternion_in_another_order_is_told_by_the_feet(tmp_path: Path, name: str) -> None:
    qpos, about = read_clip(name).qpos.numpy(), np.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x: upside down
    shifted = np.concatenate((qpos[:, :3], np.roll(qpos[:, 3:7], -1, 1), qpos[:, 7:]), 1)
    np.savez(npz := tmp_path / "bad.npz", qpos=shifted, fps=60, loop=False)
    np.savetxt(csv := tmp_path / "bad.csv", qpos, delimiter=",")  # wxyz
    for source, order in ((npz, "xyzw, but is read as wxyz"), (f"{csv}:60", "wxyz, but is read as xyzw")):
        with pytest.raises(
            ValueError, match=f"^clip bad: feet slip by .* m/s; the root's quaternion seems to be {order}$"
        ):
            diffsim.make(f"g1_track:{source}", 1)
    for row in qpos:
        row[1:3] *= -1
        mujoco.mju_mulQuat(row[3:7], about, row[3:7].copy())
    diffsim.make(G1Track.with_clip(Clip("handstand", torch.from_numpy(qpos), loop=False)), 1)


# The reference --------------------------------------------------------------------------------------------------------


def test_the_shipped_clips_stand_on_the_ground() -> None:
    model = task_scene("g1_track").mj_model
    data = mujoco.MjData(model)
    feet = [g for g in range(1, model.ngeom) if model.geom_contype[g]]
    folder, size = Path(diffsim.__path__[0]) / "assets/clips", 0
    for name, seconds in (("g1_karate", 25.7), ("g1_jazz_walk", 10.6)):
        task, heights, found = G1Track.with_clip(name)(dtype=REAL), [], np.zeros(model.nv)
        for qpos in task._qpos.numpy():
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            heights.append((data.geom_xpos[feet, 2] - model.geom_size[feet, 0]).min())
        assert abs(np.quantile(heights, STANDING)) < 1e-6 and min(heights) > -0.02
        assert task._qpos[0, :2].tolist() == [0, 0]
        assert int(task.motions[1]) * 0.02 == pytest.approx(seconds, abs=0.1)
        for t in (50, 200, 400):  # half the difference between the frames before and after
            mujoco.mj_differentiatePos(model, found, 0.04, task._qpos[t - 1].numpy(), task._qpos[t + 1].numpy())
            np.testing.assert_allclose(task._qvel[t].numpy(), found, atol=0.02)
        assert not task._qvel[-1].any()
        size += (folder / f"{name}.npz").stat().st_size
    assert size < 150_000


def test_a_single_bad_frame_does_little_harm() -> None:
    qpos = torch.from_numpy(sway(4, 60))
    bad = qpos.clone()
    bad[100, 20] += 1.0
    good, mended = (G1Track.with_clip(Clip("sway", each, False))(dtype=REAL) for each in (qpos, bad))
    assert (good._qpos - mended._qpos).abs().max() < 0.21 and (good._qvel - mended._qvel).abs().max() < 12


def test_servos_reach_the_clip_and_a_little_more_on_both_sides(task: G1Track) -> None:
    model = diffsim.make("g1_track", 1).scene.mj_model
    low, high = torch.from_numpy(model.actuator_ctrlrange).T
    joints = task._qpos[:, 7:].quantile(torch.tensor([0.002, 0.998], dtype=REAL), dim=0)
    assert (low <= joints[0] - REACH + 1e-6).all() and (high >= joints[1] + REACH - 1e-6).all()
    assert (high - low < 5).all()
    image = task.mirror.action(torch.stack((low, high)))
    torch.testing.assert_close(torch.stack((image.amin(0), image.amax(0))), torch.stack((low, high)))


# What is observed and rewarded ----------------------------------------------------------------------------------------


def test_parts_of_the_observation_are_what_they_are_called(task: G1Track) -> None:
    """Of a robot whose x is the world's y."""
    qpos, qvel, action, memory = some(task, 3)
    qpos[:, 3:7] = np.sqrt(0.5) * torch.tensor([1.0, 0, 0, 1])
    obs = task.named(task.observe_with(qpos, qvel, action, memory))
    (target, speed), (later, _) = task.reference(memory), task.reference(memory, AHEAD)

    def here(vector: Tensor) -> Tensor:
        return torch.stack((vector[:, 1], -vector[:, 0], vector[:, 2]), 1)

    expected = dict(velocity=here(qvel), root_off=here(target[:, :3] - qpos[:, :3]), reference_velocity=here(speed))
    expected |= dict(reference_ahead=here(later[:, :3] - target[:, :3]), angular_velocity=qvel[:, 3:6])
    expected |= {"joints_off": qpos[:, 7:] - target[:, 7:], "rates_off_x0.1": 0.1 * (qvel - speed)[:, 6:]}
    expected |= {"joints": qpos[:, 7:], "joint_rates_x0.1": 0.1 * qvel[:, 6:], "last_action": action}
    expected |= {"action_change": action - memory[:, 1 + N : -2], "joints_ahead": (later - target)[:, 7:]}
    expected["gravity"] = torch.tensor([0, 0, -1.0], dtype=REAL).expand(3, 3)
    turn = np.zeros((3, 3))
    for k in range(3):
        mujoco.mju_subQuat(turn[k], target[k, 3:7].numpy(), qpos[k, 3:7].numpy())
    expected["root_turned"] = torch.from_numpy(turn)
    assert obs.keys() == expected.keys() and sum(part.shape[1] for part in obs.values()) == task.obs_dim
    for name, value in expected.items():
        torch.testing.assert_close(obs[name], value)


def test_each_term_of_the_reward_and_its_gradient(task: G1Track) -> None:
    qpos, qvel, action, memory = some(task, 4, off=0.0)
    memory[:, 1 + N : -2] = action
    best = task.reward(task.observe_with(qpos, qvel, action, memory), action)
    torch.testing.assert_close(best, torch.full((4,), 3.0, dtype=REAL))
    names, sizes = zip(*task.obs_parts, strict=True)
    begin, d = dict(zip(names, np.cumsum((0, *sizes)), strict=False)), 0.1
    costs = {"root_off": 0.5 * np.log1p(d**2 / 0.02), "root_turned": 0.4 * np.log1p(d**2 / 0.1)}
    costs |= {"joints_off": 0.5 * np.log1p(d**2 / 0.5), "rates_off_x0.1": 0.1 * np.log1p(d**2 / 0.5)}
    costs |= dict.fromkeys(("velocity", "reference_velocity"), 0.15 * np.log1p(d**2 / 0.2)) | {
        "action_change": d**2 / 50
    }
    for part, size in task.obs_parts:
        off = torch.zeros(size, task.obs_dim, dtype=REAL)
        off[:, begin[part] :][:, :size].fill_diagonal_(d)
        np.testing.assert_allclose(3.0 - task.reward(off, off), costs.get(part, 0.0), atol=1e-12, err_msg=part)
    qpos, qvel, action, memory = some(task, 2)

    def reward(qpos: Tensor, qvel: Tensor, last: Tensor, before: Tensor) -> Tensor:
        memory_ = torch.cat((memory[:, :1], last, before, memory[:, -2:]), 1)
        return task.reward(task.observe_with(qpos, qvel, last, memory_), last)

    parts = qpos, qvel, action, memory[:, 1 + N : -2]
    assert torch.autograd.gradcheck(reward, [part.clone().requires_grad_() for part in parts])


def test_the_image_tracks_the_mirrored_clip(task: G1Track) -> None:
    """It sees the image, gains the same, ends alike; the clip's mirror image has the same ranges and heights."""
    mirror = task.mirror
    image = G1Track.with_clip(Clip("image", mirror.qpos(task.clip.qpos), False))(dtype=REAL)
    torch.testing.assert_close(image._qpos, mirror.qpos(task._qpos), rtol=0, atol=1e-9)
    qpos, qvel, action, memory = some(task, 50)
    step, last, before, kick = memory.split((1, N, N, 2), 1)
    flip = torch.tensor([1.0, -1.0], dtype=REAL)
    mirrored = torch.cat((step, mirror.action(last), mirror.action(before), flip * kick), 1)
    seen = image.observe_with(mirror.qpos(qpos), mirror.qvel(qvel), mirror.action(action), mirrored)
    obs = task.observe_with(qpos, qvel, action, memory)
    torch.testing.assert_close(seen, mirror.obs(obs), rtol=0, atol=1e-9)
    torch.testing.assert_close(image.reward(seen, action), task.reward(obs, action))
    pushed, targets = image.disturb(mirror.qvel(qvel), mirror.action(action), mirrored)
    expected, told = task.disturb(qvel, action, memory)
    torch.testing.assert_close(pushed, mirror.qvel(expected), rtol=0, atol=1e-9)
    torch.testing.assert_close(targets, mirror.action(told), rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        image.scene().mj_model.actuator_ctrlrange, task.scene().mj_model.actuator_ctrlrange, atol=1e-6
    )


# Start, clock and end -------------------------------------------------------------------------------------------------


def test_episodes_start_anywhere_but_near_an_end(tmp_path: Path) -> None:
    motions = [torch.from_numpy(sway(seconds, 60)) for seconds in (4, 0.5)]
    clip = Clip("two", torch.cat(motions), False, tuple(map(len, motions)))
    task = G1Track.with_clip(clip)(dtype=REAL)
    rand = torch.arange(2000, dtype=REAL).unsqueeze(1) / 2000
    step = task.first_step(rand)
    assert step.unique().tolist() == [*range(200 - BEFORE_END), 201] and step[1000] == 0
    qpos, qvel = task.reset(rand)
    assert torch.equal(qpos, task._qpos[step]) and torch.equal(qvel, task._qvel[step])
    memory = torch.zeros(2, task.num_memory, dtype=REAL)
    memory[:, 0] = torch.tensor([198.0, 201.0])
    frames = []
    for k in range(30):
        action = torch.full((2, N), float(k), dtype=REAL)
        memory = task.remember(memory, action, torch.full((2, 3), 0.5, dtype=REAL))
        frames.append(memory[:, 0].tolist())
    assert frames[:3] == [[199, 202], [200, 203], [200, 204]] and frames[-1] == [200, 226]  # held at the ends
    assert torch.equal(memory[:, 1 : 1 + N], action) and torch.equal(memory[:, 1 + N : -2], action - 1)
    assert not memory[:, -2:].any()


def test_a_run_goes_on_with_a_shorter_clip_by_new_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the checkpoint stand on frames that it lacks."""
    monkeypatch.setattr(diffsim.Simulator, "advance", lambda _, qpos, qvel, ctrl: (qpos, qvel))  # no kernel
    clip = str(write_csv(tmp_path / "short.csv", sway(2, 30)))
    flags = "--env g1_track:randomise=none --num-envs 8 --horizon 1 --minibatch-size 8 --eval-episodes 2 --eval-every 0"
    words = [*flags.split(), "--device", "cpu", "--quiet", "--iterations", "2"]
    with stopped(1):
        ppo_baseline.main([*words, "--run-dir", str(tmp_path)])
    assert checkpoint.load(path := tmp_path / "checkpoint.pt")["ranks"][0]["env"]["memory"][:, 0].max() > 120
    ppo_baseline.main(["--resume", str(tmp_path), "--env", f"g1_track:{clip}", "--quiet"])
    state = checkpoint.load(path)
    assert state["iteration"] == 2 and state["ranks"][0]["env"]["memory"][:, 0].max() <= 120
    assert state["task"]["name"] == "short" and state["args"]["env"] == f"g1_track:{clip}"


def test_on_a_slope_the_ghost_stands_on_the_ground() -> None:
    env = diffsim.make("g1_track:g1_jazz_walk", 2, seed=0, terrain=incline(10.0, -2.0))
    assert env.qpos[:, 2].min() > 1.0
    torch.testing.assert_close(env.task.ghost(env.memory), env.qpos)


def test_pushes_come_at_random_and_as_large_as_asked() -> None:
    env = diffsim.make("g1_track:g1_jazz_walk", 2000, seed=0)
    env.task.disturbances = {"push": (0.2, 0.4)}
    memory, noise = env.memory, torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    kick = env.task.remember(memory, torch.zeros(2000, N), noise)[:, -2:]
    size = kick.norm(dim=1)
    share = float((size > 0).float().mean())
    assert share == pytest.approx(0.02 * FREQUENCY_OF_PUSHES, abs=0.004)
    assert size[size > 0].min() >= 0.2 - 1e-6 and size.max() <= 0.4 + 1e-6
    memory = env.task.remember(memory, torch.zeros(2000, N), noise)
    pushed, _ = env.task.disturb(env.qvel, torch.zeros(2000, N), memory)
    torch.testing.assert_close(pushed - env.qvel, torch.cat((kick, torch.zeros(2000, 33)), 1), atol=1e-6, rtol=0)


def test_the_end(task: G1Track) -> None:
    qpos, qvel, action, memory = some(task, 1, off=0.0)

    def ends(place: float = 0.0, turn: float = 0.0) -> bool:
        off = qpos.clone()
        off[:, 1] += place
        spin = torch.tensor([np.cos(turn / 2), 0, 0, np.sin(turn / 2)], dtype=REAL)
        mujoco.mju_mulQuat(found := np.zeros(4), qpos[0, 3:7].numpy(), spin.numpy())
        off[0, 3:7] = torch.from_numpy(found)
        return bool(task.terminated(task.observe_with(off, qvel, action, memory)))

    assert not ends() and not ends(STRAY - 1e-3) and ends(STRAY + 1e-3)
    assert not ends(turn=TURNED - 1e-3) and ends(turn=TURNED + 1e-3) and ends(turn=-TURNED - 1e-3)


def test_an_action_changes_the_next_joints_of_the_reference(task: G1Track) -> None:
    qpos, qvel, action, memory = some(task, 5)
    low, high = torch.from_numpy(task.scene().mj_model.actuator_ctrlrange).T
    _, told = task.disturb(qvel, action, memory)
    target = (low + high + (high - low) * told) / 2
    expected = (task.reference(memory, 1)[0][:, 7:] + REACH * action).clamp(low, high)
    torch.testing.assert_close(target, expected)


def test_a_robot_follows_for_a_while_when_it_does_nothing() -> None:
    env = diffsim.make("g1_track:g1_jazz_walk", 4, seed=0, stochastic_init=False)
    for step in range(20):
        with torch.no_grad():
            _, reward, terminated, _, _ = env.step(torch.zeros(4, N))
        assert reward.min() > 2.0 and not terminated.any() and (env.memory[:, 0] == step + 1).all()
