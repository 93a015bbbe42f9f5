"""The NumPy environments agree with DiffEnv and with gymnasium's make, checker and wrappers."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import diffsim
from diffsim.numpy_env import NumpyEnv, NumpyVectorEnv
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
        monkeypatch.setattr(diffsim.Simulator, "advance", lambda _, qpos, qvel, ctrl: (qpos, qvel + 0.01 * ctrl.sum()))
    check_env(single.unwrapped, skip_render_check=True)
    obs, _ = single.reset(seed=5)
    task = TASKS[name]()
    np.testing.assert_array_equal(obs, diffsim.make(name, num_envs=1, horizon=1).reset(seed=5)[0][0])
    for suffix, kind in (("-v0", diffsim.DiffEnv), ("-numpy-v0", NumpyVectorEnv)):
        vector = gymnasium.make_vec(IDS[name].replace("-v0", suffix), num_envs=3)
        assert type(vector) is kind and vector.num_envs == 3
        assert vector.unwrapped.episode_length == task.episode_length
        assert gymnasium.spec(IDS[name].replace("-v0", suffix)).max_episode_steps == task.episode_length
        vector.close()
    single.close()


def test_no_import_of_diffsim_is_needed() -> None:
    code = 'import gymnasium; print(gymnasium.make("diffsim:diffsim/Cartpole-v0").spec.max_episode_steps)'
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "240"


def test_single_environment_steps_as_the_vector_does() -> None:
    single, action = gymnasium.make(HOPPER, seed=7), np.ones(3, np.float32)
    env = single.unwrapped
    assert isinstance(env, NumpyEnv)
    vector = diffsim.make("hopper", num_envs=1, seed=7, horizon=1)
    for seed in (None, 8):  # make's counts, as long as no other is given
        np.testing.assert_array_equal(single.reset(seed=seed)[0], vector.reset(seed=seed)[0][0])
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
    assert infos["nonfinite"].tolist() == infos["_final_obs"].tolist() == [False, True]


# Many environments ----------------------------------------------------------------------------------------------------


def test_a_batch_is_the_tensors_batch_in_arrays() -> None:
    """Observations, rewards, ends, masks and all infos; what was returned is the caller's."""
    env, plain = gymnasium.make_vec(HOPPERS, num_envs=4), diffsim.make("hopper", num_envs=4, horizon=1)
    assert env.unwrapped.metadata == plain.metadata and env.observation_space == plain.observation_space
    obs, _ = env.reset(seed=3)
    np.testing.assert_array_equal(obs, plain.reset(seed=3)[0])
    ends = 0
    for action in random_actions(100, 4, 3):
        action[:2] = 1.0  # which makes them fall
        *arrays, info = env.step(action)
        with torch.no_grad():
            *tensors, expected = plain.step(torch.from_numpy(action))
        for array, tensor in zip(arrays, tensors, strict=True):
            assert type(array) is np.ndarray
            np.testing.assert_array_equal(array, tensor)
        assert info.keys() == expected.keys() - {"episode", "_episode"}
        for name in info:
            np.testing.assert_array_equal(info[name], expected[name])
        ends += arrays[2].sum()
        arrays[0][:], info["final_obs"][:] = 0, 0
    assert ends > 2


def test_gymnasium_records_the_statistics_of_episodes() -> None:
    env = RecordEpisodeStatistics(gymnasium.make_vec(HOPPERS, num_envs=4, max_episode_steps=40))
    plain, ended = diffsim.make("hopper", num_envs=4, horizon=1, max_episode_steps=40), 0
    env.reset(seed=3)
    plain.reset(seed=3)
    for action in random_actions(100, 4, 3):
        action[:2] = 1.0  # which makes them fall
        info = env.step(action)[-1]
        with torch.no_grad():
            expected = plain.step(torch.from_numpy(action))[-1]
        done = expected["_episode"].numpy()
        np.testing.assert_array_equal(info.get("_episode", np.zeros(4, bool)), done)
        for name in "rl" if done.any() else "":
            np.testing.assert_allclose(info["episode"][name][done], expected["episode"][name][done], rtol=1e-5)
        ended += done.sum()
    assert ended > 6 and env.episode_count == ended


def test_actions_of_other_types_and_seeds() -> None:
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
    with pytest.raises(ValueError, match=r"action is \(2, 2\) .*, must be a torch.Tensor of \(2, 3\)"):
        env.step(np.zeros((2, 2)))
    for kind in (gymnasium.make(HOPPER), env):
        for seed in (True, 1.5):
            with pytest.raises(ValueError, match="must be one integer"):
                kind.unwrapped.reset(seed=seed)


# Wrappers and pictures ------------------------------------------------------------------------------------------------


def draw(env: Any) -> Any:
    try:
        return env.render()
    except RuntimeError as error:
        if "OpenGL" not in str(error):
            raise
        pytest.skip(str(error))


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_pictures() -> None:
    single = gymnasium.make(HOPPER, render_mode="rgb_array")
    single.reset(seed=1)
    vectors = [gymnasium.make_vec(name, num_envs=2, render_mode="rgb_array") for name in (HOPPER, HOPPERS)]
    frame = draw(single)
    assert frame.shape == (352, 480, 3) and frame.dtype == np.uint8
    for env in vectors:
        env.unwrapped.set_state(single.unwrapped.env.qpos.repeat(2, 1), torch.zeros(2, 6))
        frames = env.render()
        assert type(frames) is tuple and len(frames) == 2 and env.metadata["render_fps"] == 60
        np.testing.assert_array_equal(frames[0], frame)
    single.unwrapped.env.set_state(torch.tensor([[0.0, -0.6, 1.5, 0, 0, 0]]), torch.zeros(1, 6))
    assert single.step(np.zeros(3, np.float32))[2]
    lying = single.render()  # the last picture of an episode shows how it ended
    single.reset(seed=1)
    np.testing.assert_array_equal(single.render(), frame)
    assert (lying != frame).any(-1).sum() > 1000
    check_env(single.unwrapped)


def test_modes_of_rendering() -> None:
    with pytest.raises(ValueError, match="render_mode is 'depth', must be 'rgb_array'"):
        diffsim.make("hopper", render_mode="depth")  # type: ignore[arg-type]
    with pytest.raises(RuntimeError, match="without a render_mode"):
        diffsim.make("hopper").render()
