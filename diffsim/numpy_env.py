"""NumpyEnv and NumpyVectorEnv: DiffEnv in NumPy, as gymnasium's wrappers and other libraries expect it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from numbers import Integral
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike, NDArray

from diffsim.env import DiffEnv
from diffsim.view.screen import Frames

Array = NDArray[np.floating[Any]]
Info = dict[str, Any]


class NumpyEnv(gymnasium.Env[Array, Array]):
    """One episode at a time in NumPy. It has no time limit of its own: gymnasium.make adds that of its id.

    Start states are drawn from `np_random`, which `reset(seed=...)` seeds. After an episode's end, `reset` must follow.

    Attributes:
        env: the environment on tensors, with qpos, qvel, set_state, scene and task; it belongs to this one.
    """

    def __init__(self, env: DiffEnv) -> None:
        self.env = env
        self.metadata, self.render_mode = env.metadata, env.render_mode
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space
        self._np_random, self._np_random_seed = seeding.np_random(env.np_random_seed)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """Start an episode; returns obs (obs_dim,) and an empty info."""
        super().reset(seed=None if seed is None else _check_seed(seed))
        return _begin(self.env, np.zeros(1, np.int64), [self.np_random])[0], {}

    @torch.no_grad()
    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, Info]:
        """One control step; as of DiffEnv.step, for action (nu,). info["nonfinite"]: the simulation blew up."""
        tensor = _tensor(self.env, np.reshape(action, (1, -1)))
        obs, reward, terminated, _, info = self.env.advance(tensor)
        nonfinite = bool(info["nonfinite"])
        return _array(obs)[0], reward.item(), bool(terminated), False, {"nonfinite": nonfinite}

    def render(self) -> NDArray[np.uint8] | None:
        """A frame (height, width, 3) in render_mode "rgb_array"; in "human" the window has it after every step."""
        frames = self.env.render()
        return frames[0] if frames else None

    def close(self) -> None:
        self.env.close()


class NumpyVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """A batch of episodes in NumPy, which behaves as gymnasium's SyncVectorEnv of as many NumpyEnv.

    Each environment draws its start states from a generator of its own. `reset(seed=5)` seeds them with 5, 6, 7, ...
    and `reset(seed=[...])` with the numbers given, where None leaves one as it is.

    Args:
        env: what is stepped, on tensors, which from now on belongs to this one.
        autoreset_mode: SAME_STEP: a step that ends an episode returns the first observation of the next one;
            NEXT_STEP: the step after it does, and ignores that action; DISABLED: reset(options={"reset_mask": ...})
            must follow. Names like "NextStep" are understood, too.
    """

    def __init__(self, env: DiffEnv, autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP) -> None:
        self.env, self.num_envs = env, env.num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = env.metadata | {"autoreset_mode": self.autoreset_mode}
        self.render_mode = env.render_mode
        self.observation_space, self.single_observation_space = env.observation_space, env.single_observation_space
        self.action_space, self.single_action_space = env.action_space, env.single_action_space
        self._ended = np.zeros(self.num_envs, bool)
        self._seeds, self._generators = [0] * self.num_envs, [np.random.default_rng(0)] * self.num_envs
        self._seed(range(self.num_envs), [env.np_random_seed + i for i in range(self.num_envs)])

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each environment's generator."""
        return tuple(self._seeds)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Each environment's generator of start states."""
        return tuple(self._generators)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Array, Info]:
        """Start all episodes anew, or only those of options={"reset_mask": mask (N,) bool}.

        Returns:
            obs (N, obs_dim) of all environments, and an empty info.

        Raises:
            ValueError: seeds or a mask of another length, or a mask that is not bool.
        """
        rows = self.env.masked(options).numpy(force=True)
        if seed is not None:
            if isinstance(seed, Sequence | np.ndarray):
                seeds = list(seed)
            else:
                seeds = [_check_seed(seed) + i for i in range(self.num_envs)]
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; give one each, or one integer")
            self._seed(rows, [None if each is None else _check_seed(each) for each in seeds])
        self._ended[rows] = False
        return self._begin(rows), {}

    @torch.no_grad()
    def step(self, actions: ArrayLike) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """One control step of all environments; arguments and errors as of DiffEnv.step.

        Returns:
            obs (N, obs_dim), reward (N,) float64, terminated (N,), truncated (N,), info with "nonfinite" (N,):
            environments that blew up; and, in SAME_STEP where an episode ended, gymnasium's "final_obs" (N,) of arrays
            or None, "final_info", and their masks "_final_obs", "_final_info".
        """
        late = np.flatnonzero(self._ended)
        if len(late) and self.autoreset_mode is AutoresetMode.DISABLED:
            ids = late[:8].tolist()
            raise RuntimeError(f"episodes {ids} have ended: call reset(options={{'reset_mask': mask}})")
        obs, *rest, torch_info = self.env.advance(_tensor(self.env, actions))
        reward, terminated, truncated, nonfinite = (_array(x) for x in (*rest, torch_info["nonfinite"]))
        observation, reward = _array(obs), reward.astype(np.float64)
        if len(late) and self.autoreset_mode is AutoresetMode.NEXT_STEP:
            for values in (reward, terminated, truncated, nonfinite):
                values[late] = 0
            observation = self._begin(late)
        self._ended = done = terminated | truncated
        info: Info = {"nonfinite": nonfinite, "_nonfinite": np.ones_like(done)}
        if done.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final_obs = np.full(self.num_envs, None, object)
            ended = np.flatnonzero(done)
            for i in ended:
                final_obs[i] = observation[i]
            final_info = {"nonfinite": nonfinite & done, "_nonfinite": done.copy()}
            info |= {"final_obs": final_obs, "_final_obs": done.copy()}
            info |= {"final_info": final_info, "_final_info": done.copy()}
            observation = self._begin(ended)
            self._ended = np.zeros_like(done)
        return observation, reward, terminated, truncated, info

    def render(self) -> Frames | None:
        """A frame of each environment in render_mode "rgb_array"; in "human" the first one's is in the window."""
        return self.env.render()

    def close_extras(self, **_: Any) -> None:
        self.env.close()

    def _seed(self, rows: Iterable[int], seeds: Sequence[int | None]) -> None:
        for i in rows:
            if seeds[i] is not None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])

    def _begin(self, rows: NDArray[np.int64]) -> Array:
        return _begin(self.env, rows, [self._generators[i] for i in rows])


def _check_seed(seed: object) -> int:
    """The seed as an int, be it NumPy's; gymnasium takes True and 1.0, too."""
    if not isinstance(seed, Integral) or isinstance(seed, bool):
        raise ValueError(f"seed is {seed!r}, must be an integer")
    return int(seed)


def _begin(env: DiffEnv, rows: NDArray[np.int64], generators: Sequence[np.random.Generator]) -> Array:
    """New episodes in the environments `rows`, each drawn from its generator; returns all observations."""
    rand = np.empty((len(rows), env.task.num_random))
    for row, generator in zip(rand, generators, strict=True):
        generator.random(out=row)
    if env.task.num_noise and generators:  # of the steps to come
        env.generator.manual_seed(int(generators[0].integers(2**62)))
    return _array(env.begin(torch.as_tensor(rows, device=env.device), _tensor(env, rand)))


def _tensor(env: DiffEnv, array: ArrayLike) -> torch.Tensor:
    """A copy; raises ValueError if the array holds anything but real numbers."""
    array = np.asarray(array)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"action is an array of {array.dtype}, must be one of real numbers")
    with np.errstate(over="ignore"):  # to infinity, and so to the end of the range
        array = np.array(array, env.single_action_space.dtype, order="C")  # whatever its strides and its byte order
    return torch.from_numpy(array).to(env.device)


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    """A copy, whatever the tensor's device: callers keep what they get, and may write into it."""
    return np.array(tensor.numpy(force=True))
