"""The NumPy environments agree with gymnasium's own make, checker, wrappers and vector environments."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from learners import assert_same

import diffsim
from diffsim.tasks import TASKS

IDS = {name: f"diffsim/{name.title().replace('_', '')}-v0" for name in TASKS}
HOPPER, HOPPERS = IDS["hopper"], "diffsim/Hopper-numpy-v0"
CHECKED = "cartpole", "hopper", "ant"  # with physics: kernels of one environment, which other tests compile


def random_actions(steps: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (steps, *shape)).astype(np.float32)


# One environment ------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*Box observation space")
@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_makes_every_kind(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    single = gymnasium.make(IDS[name])
    if name not in CHECKED:
        monkeypatch.setattr(diffsim.Simulator, "step", lambda _, qpos, qvel, ctrl: (qpos, qvel + 0.01 * ctrl.sum()))
    check_env(single.unwrapped, skip_render_check=True)
    obs, _ = single.reset(seed=5)
    task = TASKS[name]()
    rand = torch.as_tensor(seeding.np_random(5)[0].random(task.num_random), dtype=torch.float32)
    action = torch.zeros(single.action_space.shape)
    state = *task.reset(rand), action
    np.testing.assert_allclose(obs, task.observe_with(*state, task.begin(rand)), rtol=1e-6)
    for suffix, kind in (("-v0", diffsim.DiffEnv), ("-numpy-v0", diffsim.NumpyVectorEnv)):
        vector = gymnasium.make_vec(IDS[name].replace("-v0", suffix), num_envs=3)
        assert type(vector) is kind and vector.num_envs == 3
        assert vector.env.num_envs == 3 if suffix == "-numpy-v0" else vector.episode_length == task.episode_length
        vector.close()
    single.close()


def test_no_import_of_diffsim_is_needed() -> None:
    code = 'import gymnasium; print(gymnasium.make("diffsim:diffsim/Cartpole-v0").spec.max_episode_steps)'
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "240"


def test_single_environment_steps_as_the_vector_does() -> None:
    single, action = gymnasium.make(HOPPER), np.ones(3, np.float32)
    env = single.unwrapped
    assert isinstance(env, diffsim.NumpyEnv)
    vector = diffsim.make("hopper", num_envs=1, seed=7)
    single.reset(seed=7)
    vector.set_state(env.env.qpos, env.env.qvel)
    for _ in range(1000):
        obs, reward, terminated, truncated, info = single.step(action)
        with torch.no_grad():
            _, rewards, end, timeout, infos = vector.step(torch.ones(1, 3))
        np.testing.assert_array_equal(obs, infos["final_obs"][0])
        assert (reward, terminated, truncated) == (rewards.item(), end.item(), timeout.item())
        assert info == {"nonfinite": False} and type(info["nonfinite"]) is bool
        if terminated or truncated:
            break
    assert terminated and isinstance(reward, float) and obs.dtype == np.float32
    np.testing.assert_array_equal(env.env.task.observe(env.env.qpos, env.env.qvel, torch.ones(1, 3))[0], obs)


def test_the_seed_of_make_counts_and_np_random_draws() -> None:
    first, again, other = (gymnasium.make(HOPPER, seed=seed).unwrapped for seed in (3, 4, 3))
    start = first.reset()[0]
    assert first.np_random_seed == 3 and again.np_random_seed == 4
    np.testing.assert_array_equal(again.reset(seed=3)[0], start)
    other.np_random = seeding.np_random(3)[0]
    np.testing.assert_array_equal(other.reset()[0], start)
    assert other.np_random_seed == -1 and (first.reset()[0] != start).any()
    unseeded = gymnasium.make(HOPPER).unwrapped
    np.testing.assert_array_equal(unseeded.reset()[0], unseeded.reset(seed=unseeded.np_random_seed)[0])


@pytest.mark.parametrize("steps", [None, 3, 300])
def test_the_time_limit_is_gymnasiums_and_truncates_once(steps: int | None) -> None:
    env = gymnasium.make(IDS["cartpole"], max_episode_steps=steps)
    assert isinstance(env, wrappers.TimeLimit) and gymnasium.spec(IDS["cartpole"]).max_episode_steps == 240
    env.reset(seed=0)
    limits = [env.step(np.zeros(1, np.float32))[3] for _ in range(steps or 240)]
    assert limits.index(True) == len(limits) - 1
    unlimited = gymnasium.make(IDS["cartpole"], max_episode_steps=-1)
    unlimited.reset(seed=0)
    assert not any(unlimited.step(np.zeros(1, np.float32))[3] for _ in range(300))


def test_blow_ups_are_passed_on() -> None:
    qvel = torch.zeros(2, 6)
    qvel[1] = 1e30
    single, vector = gymnasium.make(HOPPER).unwrapped, gymnasium.make_vec(HOPPERS, num_envs=2)
    single.reset()
    vector.reset()
    for env in (single.env, vector.env):
        env.set_state(env.qpos, qvel[-env.num_envs :])
    _, reward, terminated, _, info = single.step(np.zeros(3))
    assert terminated and reward == 0 and info == {"nonfinite": True}
    *_, infos = vector.step(np.zeros((2, 3)))
    assert infos["nonfinite"].tolist() == infos["final_info"]["nonfinite"].tolist() == [False, True]


# Many environments ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_behaves_as_gymnasiums_vector_of_single_environments(mode: AutoresetMode) -> None:
    """Bit by bit, with episodes that fall and episodes that run out of time; but "nonfinite" is there for everyone.

    In float64, as in float32 several environments are a block, whose sums are rounded otherwise than those of one.
    """
    options = dict(num_envs=4, max_episode_steps=75, dtype=torch.float64)
    ours = gymnasium.make_vec(HOPPERS, autoreset_mode=mode, **options)
    theirs = gymnasium.make_vec(HOPPER, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options)
    assert isinstance(theirs, SyncVectorEnv) and ours.metadata == theirs.metadata
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    ends = np.zeros(2, int)
    for seed in ([4, 3, 2, 1], 7):
        assert_same(ours.reset(seed=seed), theirs.reset(seed=seed))
        assert ours.np_random_seed == theirs.np_random_seed
        for action in random_actions(160, 4, 3):
            action[:2] = 1.0  # which makes them fall
            (*arrays, info), (*expected, their_info) = ours.step(action), theirs.step(action)
            assert_same((*arrays,), (*expected,))
            ends += arrays[2].sum(), arrays[3].sum()
            assert info.pop("nonfinite").tolist() == [False] * 4 and info.pop("_nonfinite").all()
            for key in ("nonfinite", "_nonfinite"):
                their_info.pop(key, None)
            assert_same(info, their_info)
    assert (ends > 3).all()
    for a, b in zip(ours.np_random, theirs.np_random, strict=True):
        assert a.bit_generator.state == b.bit_generator.state


def test_reset_of_some_with_seeds_of_some() -> None:
    env = gymnasium.make_vec(HOPPERS, num_envs=3)
    obs, _ = env.reset(seed=1)
    assert env.np_random_seed == (1, 2, 3)
    mask = np.array([True, False, True])
    some, info = env.reset(seed=[2, 8, None], options={"reset_mask": mask})
    assert info == {} and env.np_random_seed == (2, 2, 3)
    np.testing.assert_array_equal(some[[0, 1]], obs[[1, 1]])
    assert (some[2] != obs[2]).any()
    obs[:] = 0  # what was returned is the caller's
    np.testing.assert_array_equal(env.reset(options={"reset_mask": np.array([True, True, False])})[0][2], some[2])
    for arguments, message in (
        (dict(seed=[1, 2]), "2 seeds for 3"),
        (dict(options={"reset_mask": np.ones(2, bool)}), r"bool \(2,\), must be bool \(3,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(**arguments)


def test_without_autoreset() -> None:
    env = gymnasium.make_vec(HOPPERS, num_envs=2, autoreset_mode="Disabled", max_episode_steps=2)
    env.reset(seed=0)
    env.env.episode_step[1] = 1
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    obs, _, _, truncated, info = env.step(np.zeros((2, 3)))
    assert truncated.tolist() == [False, True] and info.keys() == {"nonfinite", "_nonfinite"}
    with pytest.raises(RuntimeError, match=r"episodes \[1\] have ended: call reset"):
        env.step(np.zeros((2, 3)))
    fresh, _ = env.reset(options={"reset_mask": truncated})
    np.testing.assert_array_equal(fresh[0], obs[0])
    assert env.step(np.zeros((2, 3)))[3].tolist() == [True, False]


def test_actions_of_other_types() -> None:
    env = gymnasium.make_vec(HOPPERS, num_envs=2)
    results = []
    read_only = np.full((2, 3), 0.5, np.float32)
    read_only.flags.writeable = False
    plain = np.full((2, 3), 0.5)
    for action in (read_only, plain, plain.tolist(), plain[:, ::-1], plain.astype(">f8"), plain.astype(np.longdouble)):
        env.reset(seed=0)
        results.append(env.step(action)[0])
    for result in results[1:]:
        np.testing.assert_array_equal(results[0], result)
    for action in (plain.astype(complex), plain.astype(object), plain.astype(str)):
        with pytest.raises(ValueError, match=f"array of {action.dtype}, must be one of real numbers"):
            env.step(action)
    with pytest.raises(ValueError, match=r"action has shape \(2, 2\), must be \(2, 3\)"):
        env.step(np.zeros((2, 2)))


@pytest.mark.parametrize("seed", [True, 1.5, [1.5, 2], [True, 2]])
def test_seeds_are_integers(seed: Any) -> None:
    single, many = gymnasium.make(HOPPER), gymnasium.make_vec(HOPPERS, num_envs=2)
    for env in (many, single) if not isinstance(seed, list) else (many,):
        with pytest.raises(ValueError, match="must be an integer"):
            env.unwrapped.reset(seed=seed)


# Wrappers and pictures ------------------------------------------------------------------------------------------------


def test_vector_wrappers() -> None:
    env = gymnasium.make_vec(HOPPERS, num_envs=3, max_episode_steps=20)
    env = wrappers.vector.RecordEpisodeStatistics(env)
    env = wrappers.vector.NormalizeReward(env)
    env = wrappers.vector.ClipReward(env, -0.5, 0.5)
    env.reset(seed=0)
    plain = gymnasium.make_vec(HOPPERS, num_envs=3, max_episode_steps=20)
    plain.reset(seed=0)
    returns, ends = np.zeros(3), 0
    for action in random_actions(60, 3, 3):
        obs, reward, terminated, truncated, info = env.step(action)
        expected = plain.step(action)
        np.testing.assert_array_equal(obs, expected[0])
        assert np.abs(reward).max() <= 0.5
        returns += expected[1]
        done = terminated | truncated
        if done.any():
            np.testing.assert_allclose(info["episode"]["r"][done], returns[done])
            assert info["_episode"].tolist() == done.tolist()
        returns[done], ends = 0, ends + done.sum()
    assert ends >= 9 and env.env.env.episode_count == ends


def test_the_wrapper_that_wants_the_reset_in_the_next_step() -> None:
    with pytest.raises(ValueError, match="NEXT_STEP"):
        wrappers.vector.NormalizeObservation(gymnasium.make_vec(HOPPERS, num_envs=2))
    env = gymnasium.make_vec(HOPPERS, num_envs=16, autoreset_mode="NextStep", max_episode_steps=20)
    env = wrappers.vector.NormalizeObservation(env)
    env.reset(seed=0)
    seen = np.stack([env.step(action)[0] for action in random_actions(100, 16, 3)])
    assert seen.dtype == np.float32 and abs(seen[50:].mean()) < 0.3 and 0.5 < seen[50:].std() < 2


def draw(env: Any) -> Any:
    try:
        return env.render()
    except RuntimeError as error:
        if "OpenGL" not in str(error):
            raise
        pytest.skip(str(error))


def test_pictures() -> None:
    single = gymnasium.make(HOPPER, render_mode="rgb_array")
    single.reset(seed=1)
    vectors = [gymnasium.make_vec(name, num_envs=2, render_mode="rgb_array") for name in (HOPPER, HOPPERS)]
    vectors[0].set_state(single.unwrapped.env.qpos.repeat(2, 1), torch.zeros(2, 6))
    vectors[1].reset(seed=[1, 2])
    frame = draw(single)
    assert frame.shape == (352, 480, 3) and frame.dtype == np.uint8
    for env in vectors:
        frames = env.render()
        assert type(frames) is tuple and len(frames) == 2 and env.metadata["render_fps"] == 60
        np.testing.assert_array_equal(frames[0], frame)
    assert (frames[1] != frame).any()
    env = single.unwrapped
    env.env.set_state(torch.tensor([[0.0, -0.6, 1.5, 0, 0, 0]]), torch.zeros(1, 6))
    assert single.step(np.zeros(3, np.float32))[2]
    lying = single.render()  # the last picture of an episode shows how it ended
    single.reset(seed=1)
    np.testing.assert_array_equal(single.render(), frame)
    assert (lying != frame).any(-1).sum() > 1000


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_gymnasiums_checker_draws() -> None:
    env = gymnasium.make(HOPPER, render_mode="rgb_array")
    env.reset()
    draw(env)
    if "human" not in env.metadata["render_modes"]:  # otherwise it would open a window
        check_env(env.unwrapped)


def test_modes_of_rendering() -> None:
    with pytest.raises(ValueError, match="render_mode 'depth'; choose from rgb_array, human"):
        diffsim.make("hopper", render_mode="depth")  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="without a render_mode"):
        diffsim.make("hopper").render()


def test_record_video(tmp_path: Any) -> None:
    pytest.importorskip("moviepy")
    env = wrappers.RecordVideo(gymnasium.make(HOPPER, render_mode="rgb_array", max_episode_steps=3), str(tmp_path))
    env.reset(seed=0)
    draw(env)
    while not any(env.step(np.zeros(3, np.float32))[2:4]):
        pass
    env.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]
