"""NumpyEnv and NumpyVectorEnv: DiffEnv in NumPy, as gymnasium's wrappers and other libraries expect it."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorWrapper
from numpy.typing import ArrayLike, NDArray

from diffsim import make
from diffsim.env import DiffEnv, check_seed
from diffsim.sim.modes import in_plain_mode

Array = NDArray[np.floating[Any]]
Info = dict[str, Any]


class NumpyEnv(gymnasium.Env[Array, Array]):
    """One episode at a time in NumPy. It has no time limit of its own: gymnasium.make adds that of its id.

    After an episode's end, `reset` must follow.

    Attributes:
        env: the environment on tensors, with qpos, qvel, set_state, scene and task; it belongs to this one.
    """

    def __init__(self, env: DiffEnv) -> None:
        self.env = env
        self.metadata, self.render_mode = env.metadata, env.render_mode
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """Start an episode; returns obs (obs_dim,) and an empty info."""
        super().reset(seed=None if seed is None else check_seed(seed))
        return to_numpy(self.env.reset(seed=seed)[0])[0], {}

    @in_plain_mode
    @torch.no_grad()
    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, Info]:
        """One control step with action (nu,), see DiffEnv.step. info["nonfinite"]: the simulation failed."""
        obs, reward, terminated, _, info = self.env.advance(to_action(self.env, np.reshape(action, (1, -1))))
        return to_numpy(obs)[0], reward.item(), bool(terminated), False, {"nonfinite": bool(info["nonfinite"])}

    def render(self) -> NDArray[np.uint8]:
        """A frame (height, width, 3)."""
        return self.env.render()[0]

    def close(self) -> None:
        self.env.close()


class NumpyVectorEnv(VectorWrapper):
    """DiffEnv with NumPy arrays instead of tensors, without gradients.

    It returns copies, which callers may change, and takes actions of any real type; gymnasium's ArrayConversion does
    neither.
    """

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """See DiffEnv.reset."""
        return to_numpy(self.env.reset(seed=seed, options=options))

    @torch.no_grad()
    def step(self, actions: ArrayLike) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """See DiffEnv.step. The info leaves "episode" to gymnasium's RecordEpisodeStatistics, which refuses its own."""
        *results, info = self.env.step(to_action(self.unwrapped, actions))
        own = {name: value for name, value in info.items() if name not in ("episode", "_episode")}
        return to_numpy((*results, own))


def to_action(env: Any, array: ArrayLike) -> torch.Tensor:
    """A copy on the environment's device; raises ValueError if the array holds anything but real numbers."""
    array = np.asarray(array)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"action is an array of {array.dtype}, must be one of real numbers")
    with np.errstate(over="ignore"):  # to infinity, and so to the end of the range
        array = np.array(array, env.single_action_space.dtype, order="C")  # whatever its strides and its byte order
    return torch.from_numpy(array).to(env.device)


def to_numpy(value: Any) -> Any:
    """Copies of all tensors in a tensor, a tuple or a dictionary: callers may write into what they get."""
    if isinstance(value, torch.Tensor):
        return np.array(value.numpy(force=True))
    if isinstance(value, dict):
        return {name: to_numpy(part) for name, part in value.items()}
    return tuple(to_numpy(part) for part in value)


def make_one(name: str, **arguments: Any) -> NumpyEnv:
    """Make what gymnasium.make gives for a task's id."""
    return NumpyEnv(make(name, num_envs=1, horizon=1, **arguments))


def make_vec(name: str, num_envs: int, **arguments: Any) -> NumpyVectorEnv:
    """Make what gymnasium.make_vec gives for a task's id that ends in -numpy."""
    return NumpyVectorEnv(make(name, num_envs, horizon=1, **arguments))
