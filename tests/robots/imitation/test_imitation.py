"""Clips, and the task that tracks one: its reward against closed forms and MuJoCo, its clock, its end, its flags."""

from __future__ import annotations

import math
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
from diffsim import tasks
from diffsim.training import checkpoint, load_policy, parse
from diffsim_cli.export import export_policy
from diffsim_cli.watch import make_policy_env
from diffsim_robots.imitation import task as imitation
from diffsim_robots.imitation.clip import Clip, read_clip
from diffsim_robots.imitation.task import STRAY, HumanoidImitation
from diffsim_robots.variation import on_a_plane

REAL = torch.float64
NQ, NV, NU = 28, 27, 21
NOTHING = torch.zeros(NU, dtype=REAL)


@pytest.fixture(scope="module")
def task() -> HumanoidImitation:
    return HumanoidImitation(dtype=REAL)


def stroll(seconds: float, fps: float, loop: bool) -> np.ndarray:
    """qpos (T, nq) float64 of a slow smooth motion that turns about all axes; it ends as it begins."""
    t = np.arange(round(seconds * fps) + 1) / fps
    swing = 0.1 * np.sin(2 * np.pi * t[:, None] / seconds + np.arange(NQ)) - 0.1
    angle, axis = 0.3 * np.cos(2 * np.pi * t / seconds), np.array([1.0, 2.0, -2.0]) / 3
    qpos = np.concatenate(
        (swing[:, :3], np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis, swing[:, 7:]), 1
    )
    qpos[:, 0] = 0.8 * t
    qpos[:, 2] += 1.3
    return qpos if loop else qpos[: (len(qpos) - 1) * 3 // 4 + 1]


def write(path: Path, **content: object) -> Path:
    np.savez(path, **content)  # type: ignore[arg-type]
    return path


def on_reference(task: HumanoidImitation, step: Tensor) -> tuple[Tensor, Tensor]:
    """The state at any step, from the clip alone."""
    clip, period = task.clip, len(task.clip)
    qpos = clip.qpos[step % period].clone()
    qpos[..., :2] += (step // period).unsqueeze(-1) * clip.advance
    return qpos, clip.velocity()[step % period]


def observe(task: HumanoidImitation, qpos: Tensor, qvel: Tensor, action: Tensor, step: Tensor) -> Tensor:
    return task.observe_with(qpos, qvel, action, step.to(qpos).unsqueeze(-1))


# Clips ----------------------------------------------------------------------------------------------------------------


def test_the_shipped_clip_loops_and_runs(task: HumanoidImitation) -> None:
    clip = task.clip
    assert clip == read_clip("humanoid_run") and str(clip) == "humanoid_run" and clip.loop
    torch.testing.assert_close(clip.qpos[0, 2:], clip.qpos[-1, 2:], atol=1e-7, rtol=0)
    assert clip.qpos[0, :2].tolist() == [0, 0]
    assert clip.advance[0] / len(clip) * 60 == pytest.approx(8.4, abs=0.1) and clip.advance[1] == 0
    torch.testing.assert_close(clip.velocity()[0], clip.velocity()[-1])
    assert (Path(diffsim.__path__[0]) / "assets/clips/humanoid_run.npz").stat().st_size < 5000


@pytest.mark.parametrize("loop", [True, False])
def test_rates_are_resampled(loop: bool, tmp_path: Path) -> None:
    expected = torch.tensor(stroll(4, 60, loop))
    for k, content in enumerate(({"fps": 30}, {"dt": 1 / 120}, {"fps": 60.0})):
        fps = content.get("fps") or 1 / content["dt"]
        clip = read_clip(write(tmp_path / f"{k}.npz", qpos=stroll(4, fps, loop), loop=loop, **content))
        torch.testing.assert_close(clip.qpos, expected, atol=1e-3 if fps == 30 else 1e-9, rtol=0)
        torch.testing.assert_close(clip.qpos[:, 3:7].norm(dim=1), torch.ones(len(clip.qpos), dtype=REAL))


def test_a_turn_is_resampled_along_the_arc_whatever_the_signs(tmp_path: Path) -> None:
    """Two full turns at 10 frames per second: the speed is even between frames, and no sign of a quaternion jumps."""
    angle = np.linspace(0, 4 * np.pi, 21)
    qpos = np.zeros((21, NQ))
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    qpos[5:9, 3:7] *= -1
    clip = read_clip(write(tmp_path / "turn.npz", qpos=qpos, fps=10))
    assert len(clip) == 120
    spin = torch.zeros(121, NV, dtype=REAL)
    spin[:, 5] = 2 * np.pi
    torch.testing.assert_close(clip.velocity(), spin)
    assert ((clip.qpos[1:, 3:7] * clip.qpos[:-1, 3:7]).sum(1) > 0.9).all()


def test_velocities_are_those_that_mujoco_integrates(task: HumanoidImitation) -> None:
    model = task_scene("humanoid").mj_model
    clip = Clip("stroll", torch.tensor(stroll(2, 60, True)), loop=False)
    qvel, found = clip.velocity().numpy(), np.zeros(NV)
    for t in (1, 50, 119):
        steps = []
        for a, b in ((t - 1, t), (t, t + 1)):
            mujoco.mj_differentiatePos(model, found, 1 / 60, clip.qpos[a].numpy(), clip.qpos[b].numpy())
            steps.append(found.copy())
        np.testing.assert_allclose(qvel[t], np.mean(steps, 0), atol=1e-10)


GOOD = stroll(2, 30, True)
NO_CLIPS = (  # another layout, in many ways; the last ones are no .npz files
    *({"qpos": GOOD, "fps": fps} for fps in (0, "fast", 1e-4)),
    *({"qpos": GOOD, "dt": dt} for dt in (-1.0, np.nan)),
    *({"qpos": qpos, "fps": 30} for qpos in (np.array([{}]), GOOD[:2], GOOD[:0], GOOD[0], GOOD * np.nan, GOOD * 0)),
    *({"qpos": qpos, "fps": 30} for qpos in (GOOD[:, :5], GOOD.astype(str), GOOD + 1j)),
    *({"qpos": GOOD, "fps": 30, "loop": loop} for loop in ("False", 0.5, 2, [True, False])),
    *({"qpos": GOOD}, {"fps": 30}, b"hello", b"", b"PK\x03\x04hello"),
)
WRONG_CLIPS = {
    "its last frame differs from its first by up to .* add loop=False": GOOD[:20],
    "qpos has 27 columns, the robot has 28": GOOD[:, :-1],
    "beyond its limits .* in radians?": GOOD * np.where(np.arange(28) < 7, 1, 180 / np.pi),
}


def test_bad_clips_are_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "bad.npz"
    for content in NO_CLIPS:
        file.write_bytes(content) if isinstance(content, bytes) else write(file, **content)
        with pytest.raises(ValueError, match=r"bad.npz must be an .npz file with finite qpos \(frames, nq\), .* 1 h$"):
            read_clip(file)
    for complaint, qpos in WRONG_CLIPS.items():
        with pytest.raises(ValueError, match=complaint):
            diffsim.make(f"humanoid_imitation:{write(file, qpos=qpos, fps=30)}", 1)
    with pytest.raises(
        ValueError, match="no such clip: nowhere; give an .npz or .csv file, a folder of them, or one of .*humanoid_run"
    ):
        read_clip("nowhere")
    with pytest.raises(ValueError, match="task 'ant' has no option 'humanoid_run': write rough=20, randomise=none or"):
        diffsim.make("ant:humanoid_run", 1)


# The reward -----------------------------------------------------------------------------------------------------------


def test_the_reward_is_one_on_the_reference(task: HumanoidImitation) -> None:
    step = torch.arange(5 * len(task.clip))
    obs = observe(task, *on_reference(task, step), NOTHING, step)
    assert obs.shape == (len(step), task.obs_dim)
    torch.testing.assert_close(task.reward(obs, NOTHING), torch.ones(len(step), dtype=REAL), rtol=0, atol=1e-12)
    assert not task.terminated(obs).any()
    torch.testing.assert_close(obs[: len(task.clip)], obs[-len(task.clip) :], atol=1e-12, rtol=0)  # the phase wraps
    assert torch.equal(task.frame(obs), step % len(task.clip))


def test_each_term_falls_as_its_equation(task: HumanoidImitation) -> None:
    """Where one number alone is off."""
    step, d = torch.tensor(9), 0.15
    ones = torch.ones(4, dtype=REAL)

    def terms(qpos_off: dict[int, float], qvel_off: dict[int, float]) -> Tensor:
        qpos, qvel = on_reference(task, step)
        for k, value in qpos_off.items():
            qpos[k] += value
        for k, value in qvel_off.items():
            qvel[k] += value
        return torch.stack(task.terms(observe(task, qpos, qvel, NOTHING, step)))

    def expected(**logs: float) -> Tensor:
        return (ones * torch.tensor([logs.get(name, 0.0) for name in "pvec"], dtype=REAL)).exp()

    for k in range(3):  # the root's place: all end effectors and the centre of mass move with it
        torch.testing.assert_close(terms({k: d}, {}), expected(e=-40 * 4 * d**2, c=-10 * d**2))
    for k in range(3, NV):  # of the root's velocity the angular part alone counts, as the joints' rates do
        torch.testing.assert_close(terms({}, {k: d}), expected(v=-0.1 * d**2))
    torch.testing.assert_close(terms({}, {0: d, 1: d, 2: d}), ones)
    for k in range(7, NQ):
        found = terms({k: d}, {})
        torch.testing.assert_close(found[:2], expected(p=-2 * d**2)[:2])
        assert found[3] < 1
    qpos, qvel = on_reference(task, step)
    w, u = qpos[3].clone(), qpos[4:7].clone()
    s, c = math.sin(0.1), math.cos(0.1)  # turned by 0.2 about its own z axis
    qpos[3:7] = torch.stack((w * c - u[2] * s, u[0] * c + u[1] * s, u[1] * c - u[0] * s, u[2] * c + w * s))
    for sign in (1, -1):
        qpos[3:7] *= sign
        found = torch.stack(task.terms(observe(task, qpos, qvel, NOTHING, step)))
        torch.testing.assert_close(found[:2], expected(p=-2 * 0.2**2)[:2])
    weighted = torch.tensor([0.65, 0.1, 0.15, 0.1], dtype=REAL) @ found
    torch.testing.assert_close(task.reward(observe(task, qpos, qvel, NOTHING, step), NOTHING), weighted)


def test_places_are_mujocos(task: HumanoidImitation, rng: np.random.Generator) -> None:
    model, step = task_scene("humanoid").mj_model, torch.tensor(30)
    data, seen = mujoco.MjData(model), []
    qpos, qvel = on_reference(task, step)
    off = qpos.clone()
    off[:3] += 0.02
    off[7:] += torch.tensor(0.1 * rng.normal(size=NQ - 7))
    for q in (qpos, off):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        seen.append((np.array([data.geom(name).xpos for name in HumanoidImitation.ends]), data.subtree_com[0].copy()))
    ends, centre = (np.square(a - b).sum() for a, b in zip(*seen, strict=True))
    found = task.terms(observe(task, off, qvel, NOTHING, step))
    assert [x.item() for x in found[2:]] == pytest.approx([math.exp(-40 * ends), math.exp(-10 * centre)], rel=1e-9)


def test_gradients_are_exact(task: HumanoidImitation, rng: np.random.Generator) -> None:
    step = torch.tensor([3, 29])
    states = on_reference(task, step)
    qpos, qvel = ((x + torch.tensor(0.03 * rng.normal(size=x.shape))).requires_grad_() for x in states)

    def terms(qpos: Tensor, qvel: Tensor) -> tuple[Tensor, ...]:
        obs = observe(task, qpos, qvel, NOTHING, step)
        return *task.terms(obs), task.reward(obs, NOTHING)

    assert torch.autograd.gradcheck(terms, (qpos, qvel))
    exact = [x.requires_grad_() for x in states]  # at the maximum, where rotations are equal
    for gradient in torch.autograd.grad(terms(*exact)[-1].sum(), exact):
        assert gradient.abs().max() < 1e-10


# Start, clock and end -------------------------------------------------------------------------------------------------


def test_episodes_start_anywhere_on_the_clip(task: HumanoidImitation) -> None:
    rand = torch.arange(1000, dtype=REAL).unsqueeze(1) / 1000
    step, (qpos, qvel) = task.first_step(rand), task.reset(rand)
    assert step.unique().tolist() == list(range(len(task.clip))) and step[500] == 0
    assert step.bincount().min() >= 1000 // len(task.clip)
    assert torch.equal(qpos, task.clip.qpos[step]) and torch.equal(qvel, task.clip.velocity()[step])
    one = HumanoidImitation(dtype=torch.float32)
    almost = torch.tensor([[0.49999997]])  # + 0.5 is 1 in single precision
    assert one.first_step(almost).item() in (0, len(one.clip) - 1)


def test_the_phase_is_kept_in_single_precision() -> None:
    clip = Clip("long", torch.tensor(stroll(100, 60, True)), loop=True)
    task, step = HumanoidImitation.with_clip(clip)(), torch.arange(12_000)
    qpos, qvel = (x.float() for x in on_reference(task, step))
    obs = observe(task, qpos, qvel, NOTHING.float(), step)
    assert torch.equal(task.frame(obs), step % 6000)
    assert task.reward(obs, NOTHING).min() > 1 - 1e-4


def test_the_environment_keeps_the_clock() -> None:
    env = diffsim.make("humanoid_imitation", 7, seed=0, horizon=4)
    task, step = env.task, env.memory[:, 0].clone()
    assert isinstance(task, HumanoidImitation) and len(set(step.tolist())) > 3
    assert torch.equal(task.frame(env.reset(seed=0)[0]), step.long()) and torch.equal(step, env.memory[:, 0])
    generator, ends = torch.Generator().manual_seed(0), 0
    for _ in range(60):
        before = env.memory[:, 0].long()
        with torch.no_grad():
            obs, reward, terminated, _, info = env.step(torch.randn(7, NU, generator=generator))
        assert torch.equal(task.frame(info["final_obs"]), (before + 1) % task.period)
        assert torch.equal(task.frame(obs), env.memory[:, 0].long() % task.period)
        assert torch.equal(env.memory[~terminated, 0].long(), before[~terminated] + 1)
        torch.testing.assert_close(task.reward(obs, obs)[terminated], torch.ones(int(terminated.sum())))
        ends += int(terminated.sum())
    assert ends > 8
    other = diffsim.make("humanoid_imitation", 7, seed=1, horizon=4)
    other.load_state_dict(env.state_dict())
    other.detach(), env.detach()
    for _ in range(30):
        with torch.no_grad():
            actions = torch.randn(7, NU, generator=generator)
            assert torch.equal(env.step(actions)[0], other.step(actions)[0])
    env.reset()
    assert not env.episode_step.any() and torch.equal(task.frame(env._obs), env.memory[:, 0].long())
    assert torch.equal(env.set_state(env.qpos, env.qvel), env._obs)
    calm = diffsim.make("humanoid_imitation", 2, stochastic_init=False)
    assert calm.memory.tolist() == [[0], [0]]
    assert "memory" not in diffsim.make("cartpole", 1).state_dict()


def test_the_end(task: HumanoidImitation) -> None:
    step = torch.tensor(4)

    def ends(height: float | None = None, pitch: float = 0.0, **off: float) -> bool:
        qpos, qvel = on_reference(task, step)
        for name, value in off.items():
            qpos["xyz".index(name)] += value
        if height is not None:
            qpos[2] = height
            qpos[3:7] = torch.tensor([math.cos(pitch / 2), 0, math.sin(pitch / 2), 0])
        return bool(task.terminated(observe(task, qpos, qvel, NOTHING, step)))

    assert not ends(x=STRAY - 0.01) and ends(x=STRAY + 0.01) and ends(x=0.4, y=0.4) and ends(z=STRAY + 0.01)
    low = Clip("low", task.clip.qpos.clone(), loop=True)
    low.qpos[:, 2] = 0.3
    task = HumanoidImitation.with_clip(low)(dtype=REAL)  # so that it is not far away where the trunk touches
    assert not ends(0.181) and ends(0.179)  # upright the waist touches first, 0.12 + 0.06 m below the origin
    assert not ends(0.281, math.pi) and ends(0.279, math.pi)  # and head down the head, at 0.19 + 0.09 m


def test_a_motion_that_does_not_loop_ends() -> None:
    clip = Clip("once", torch.tensor(stroll(2, 60, True)[:61]), loop=False)
    task, step = HumanoidImitation.with_clip(clip)(dtype=REAL), torch.arange(61)
    obs = observe(task, *on_reference(task, step), NOTHING, step)
    assert task.terminated(obs).tolist() == [False] * 60 + [True]
    assert task.first_step(torch.rand(2000, 1, dtype=REAL)).unique().tolist() == list(range(60))
    # Without early termination, too; it does not go round.
    env = diffsim.make(HumanoidImitation.with_clip(clip), 2, early_termination=False, horizon=4)
    for _ in range(60):
        left = 60 - env.memory[:, 0]
        with torch.no_grad():
            _, _, terminated, truncated, _ = env.step(torch.zeros(2, NU))
        assert torch.equal(terminated, left == 1) and not truncated.any()


# Flags and checkpoints ------------------------------------------------------------------------------------------------


def test_checkpoints_hold_the_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run is resumed and evaluated, in another process, when its file is gone."""
    monkeypatch.setattr(imitation, "RESTORED", {})
    file = write(tmp_path / "mine.npz", qpos=stroll(2, 30, True), fps=30)
    clip, run, there = read_clip(file), tmp_path / "run", str(tmp_path / "run" / "checkpoint.pt")
    flags = f"--env humanoid_imitation:{file} --num-envs 4 --horizon 2 --minibatch-size 4 --eval-episodes 2"
    options = [*flags.split(), "--device", "cpu", "--quiet", "--iterations", "2", "--run-dir", str(run)]
    with stopped(1):
        ppo_baseline.main(options)
    assert f'"env": "humanoid_imitation:{file}"' in (run / "args.json").read_text()
    file.unlink()
    with pytest.raises(ValueError, match="no such clip"):
        tasks.find_task(f"humanoid_imitation:{file}")
    ppo_baseline.main(["--resume", there, "--quiet"])
    assert checkpoint.load(run / "checkpoint.pt")["iteration"] == 2
    export_policy(run / "checkpoint.pt", tmp_path / "policy.pt")
    for path in (run / "checkpoint.pt", tmp_path / "policy.pt"):
        imitation.RESTORED.clear()
        env = make_policy_env(load_policy(path), 2)
        assert isinstance(env.task, HumanoidImitation) and env.task.clip == clip and str(env.task.clip) == "mine"
    imitation.RESTORED.clear()
    ppo_baseline.main(["--evaluate", there, "--eval-episodes", "2", "--run-dir", str(tmp_path / "evaluation")])
    env = make_policy_env(load_policy(there), 1, env="humanoid_imitation:humanoid_run")  # tracked as well
    assert env.task.clip == read_clip("humanoid_run")  # type: ignore[attr-defined]
    name = "humanoid_imitation:humanoid_run"
    assert parse(ppo_baseline.Args, ["--evaluate", there, "--env", name]).env == name


def test_a_restored_clip_serves_its_task_with_any_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And no longer once a checkpoint is loaded that brings none."""
    monkeypatch.setattr(imitation, "RESTORED", {})
    file = write(tmp_path / "mine.npz", qpos=stroll(2, 30, True), fps=30)
    name = f"humanoid_imitation:mass=0.9:1.1,{file},rough=10"
    trained = tasks.find_task(name)
    stored = trained.stored()
    file.unlink()
    tasks.restore_task(name, stored)
    found = tasks.find_task(name)
    assert found().clip == trained().clip and found.slope == 10.0  # type: ignore[attr-defined]
    assert found.ranges == {"mass": (0.9, 1.1)} == trained.ranges  # type: ignore[attr-defined]
    assert found.varied_by == trained.varied_by is not None and found.stored().keys() == stored.keys()
    for other in (on_a_plane(name), f"humanoid_imitation:{file},mass=0.5:1"):
        assert tasks.find_task(other)().clip == trained().clip  # type: ignore[attr-defined]
    tasks.restore_task(name, {})
    with pytest.raises(ValueError, match="no such clip"):
        tasks.find_task(name)


def test_a_shipped_clip_is_not_stored() -> None:
    for name in ("humanoid_imitation", "humanoid_imitation:humanoid_run", "humanoid"):
        assert tasks.find_task(name).stored() == {}
    renamed = Clip("another", read_clip("humanoid_run").qpos, loop=True)
    assert HumanoidImitation.with_clip(renamed).stored()["name"] == "another"


def test_an_observation_without_the_time_is_refused(task: HumanoidImitation) -> None:
    with pytest.raises(NotImplementedError, match="depends on its memory: use observe_with"):
        task.observe(torch.zeros(1, NQ), torch.zeros(1, NV), torch.zeros(1, NU))
