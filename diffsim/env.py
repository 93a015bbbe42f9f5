"""DiffEnv: a task on the simulator, as a gymnasium.vector.VectorEnv on torch tensors."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from diffsim.integration import Integration
from diffsim.scene import Scene
from diffsim.simulator import Simulator
from diffsim.tasks import Task


class DiffEnv(VectorEnv):
    """A batch of episodes of one task, differentiable in the actions and through the states between them.

    Actions are clipped to [-1, 1]. A step that ends an episode returns the first observation of the next one
    (gymnasium's SAME_STEP autoreset); the last one of the old episode is info["final_obs"]. No gradient crosses a
    reset. Up to `horizon` differentiable steps make a window, which `detach` ends; under torch.no_grad there is no
    limit.

    Args:
        task: task on the simulator's device and dtype.
        scene: its robot.
        integration: default the task's "default".
        num_envs, horizon, threads: see Simulator.
        seed: of the random start states.
        stochastic_init: draw start states; otherwise each episode starts from the task's unperturbed one.
        early_termination: end episodes where the task says that the robot has fallen.

    Attributes:
        qpos, qvel: (N, nq), (N, nv) the current state in MuJoCo's conventions.
        episode_step: (N,) int64 control steps since each environment's start.
        generator: the torch.Generator of the start states.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    qpos: Tensor
    qvel: Tensor
    _obs: Tensor

    def __init__(
        self,
        task: Task,
        scene: Scene,
        num_envs: int,
        *,
        integration: Integration | None = None,
        seed: int | None = None,
        horizon: int = 32,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        stochastic_init: bool = True,
        early_termination: bool = True,
        threads: int | None = None,
    ) -> None:
        self.task, self.scene, self.num_envs, self.horizon = task, scene, num_envs, horizon
        self.control_dt, self.episode_length = task.control_dt, task.episode_length
        self.stochastic_init, self.early_termination = stochastic_init, early_termination
        self.sim = Simulator(
            scene,
            num_envs,
            integration or task.integration("default"),
            task.control_dt,
            horizon,
            device,
            dtype,
            threads,
        )
        self.device, self.dtype = self.sim.device, dtype
        real = np.float32 if dtype == torch.float32 else np.float64
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.obs_dim,), real)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (scene.nu,), real)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.generator = torch.Generator(self.device)
        if seed is None:
            self.generator.seed()
        else:
            self.generator.manual_seed(seed)

        self._no_action = torch.zeros(num_envs, scene.nu, dtype=dtype, device=self.device)
        self.episode_step = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._episode_return = torch.zeros(num_envs, dtype=dtype, device=self.device)
        self._restart()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start all episodes anew; returns obs (N, obs_dim) and an empty info."""
        if seed is not None:
            self.generator.manual_seed(seed)
        self._restart()
        return self._obs, {}

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """One control step of all environments.

        Args:
            action: (N, nu), clipped to [-1, 1].

        Returns:
            obs (N, obs_dim), reward (N,), terminated (N,), truncated (N,), info with
            "final_obs" (N, obs_dim): the observation before any reset, valid for every environment; "_final_obs" (N,)
            marks those that ended; "episode": {"r": return, "l": control steps, "t": simulated seconds} (N,) each,
            valid under "_episode"; "nonfinite" (N,): environments that blew up, which end with reward 0.

        Raises:
            ValueError: action of the wrong shape, dtype or device, or, on the CPU, not a number.
            RuntimeError: more than `horizon` differentiable steps without `detach`.
        """
        self.sim.check_tensor("action", action, self.scene.nu)
        if self.device.type == "cpu" and bool(torch.isnan(action.detach()).any()):
            rows = torch.isnan(action).any(1).nonzero().flatten().tolist()
            raise ValueError(f"action is NaN in environments {rows[:8]}; every action must be a number")
        action = action.clamp(-1.0, 1.0)
        recorded = torch.is_grad_enabled() and (
            action.requires_grad or self.qpos.requires_grad or self.qvel.requires_grad
        )
        if recorded and self._recorded == self.horizon:
            raise RuntimeError(
                f"horizon of {self.horizon} differentiable steps exceeded: call env.detach() to start a new "
                "window, step under torch.no_grad(), or make the environment with a larger horizon"
            )
        self._recorded += recorded
        if self._time == self.horizon:
            self._draw_starts()
        start_qpos, start_qvel, start_obs = (start[self._time] for start in self._starts)
        self._time += 1

        qpos, qvel = self.sim.step(self.qpos, self.qvel, action)
        nonfinite = self.sim.nonfinite.clone()
        final_obs = self.task.observe(qpos, qvel, action)
        reward = self.task.reward(final_obs, action).masked_fill(nonfinite, 0.0)
        with torch.no_grad():
            self.episode_step += 1
            self._episode_return += reward
            terminated = self.task.terminated(final_obs) | nonfinite if self.early_termination else nonfinite
            truncated = (self.episode_step >= self.episode_length) & ~terminated
            done = terminated | truncated
            length = self.episode_step.clone()
            episode = {"r": self._episode_return.clone(), "l": length, "t": length * self.control_dt}
            self.episode_step.masked_fill_(done, 0)
            self._episode_return.masked_fill_(done, 0.0)
        row = done.unsqueeze(1)
        self.qpos, self.qvel = torch.where(row, start_qpos, qpos), torch.where(row, start_qvel, qvel)
        self._obs = torch.where(row, start_obs, final_obs)
        info = {
            "final_obs": final_obs,
            "_final_obs": done,
            "episode": episode,
            "_episode": done,
            "nonfinite": nonfinite,
        }
        return self._obs, reward, terminated, truncated, info

    def detach(self) -> Tensor:
        """Cut the graph at the current state, start a new window there, and return its observation (N, obs_dim)."""
        self.qpos, self.qvel, self._obs = self.qpos.detach(), self.qvel.detach(), self._obs.detach()
        self._recorded = 0
        self.sim.rewind()
        self._draw_starts()
        return self._obs

    def pin(self) -> tuple[Tensor, Tensor, Tensor]:
        """Move the state into memory of its own, where a captured window can start again and again; see graph.py."""
        self.qpos, self.qvel, self._obs = (x.detach().clone() for x in (self.qpos, self.qvel, self._obs))
        return self.qpos, self.qvel, self._obs

    def carry_over(self, start: tuple[Tensor, Tensor, Tensor]) -> None:
        """End a captured window: write the state back to where it started, as returned by `pin`."""
        with torch.no_grad():
            for to, value in zip(start, (self.qpos, self.qvel, self._obs), strict=True):
                to.copy_(value)
        self.qpos, self.qvel, self._obs = start

    def set_state(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Put all environments into given states, keeping their episode clocks; returns the observation (N, obs_dim).

        Gradients flow into qpos (N, nq) and qvel (N, nv). The last action in the observation is 0.

        Raises:
            ValueError: wrong shape, dtype or device, or not finite.
        """
        for name, value, width in (("qpos", qpos, self.scene.nq), ("qvel", qvel, self.scene.nv)):
            self.sim.check_tensor(name, value, width)
            if not bool(torch.isfinite(value.detach()).all()):
                raise ValueError(f"{name} holds numbers that are not finite")
        self.qpos, self.qvel = qpos, qvel
        self._obs = self.task.observe(qpos, qvel, self._no_action)
        return self._obs

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that continues the episodes exactly, as of the start of a window."""
        return {
            "qpos": self.qpos.detach().clone(),
            "qvel": self.qvel.detach().clone(),
            "obs": self._obs.detach().clone(),
            "episode_step": self.episode_step.clone(),
            "episode_return": self._episode_return.clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a state_dict of an environment of the same task and size; call `detach` next."""
        self.qpos, self.qvel = state["qpos"].to(self.device), state["qvel"].to(self.device)
        self._obs = state["obs"].to(self.device)
        self.episode_step.copy_(state["episode_step"])
        self._episode_return.copy_(state["episode_return"])
        self.generator.set_state(state["generator"].cpu())
        self._time = self.horizon

    def _restart(self) -> None:
        self.episode_step.zero_()
        self._episode_return.zero_()
        self._recorded = 0  # differentiable steps since the window began
        self.sim.rewind()
        qpos, qvel, obs = self._draw(1)
        self.qpos, self.qvel, self._obs = qpos[0], qvel[0], obs[0]
        self._draw_starts()

    def _draw_starts(self) -> None:
        # Start states of a whole window at once: one batch of small operations instead of one per step.
        self._starts, self._time = self._draw(self.horizon), 0

    @torch.no_grad()
    def _draw(self, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        size = (steps, self.num_envs, self.task.num_random)
        rand = torch.rand(size, generator=self.generator, dtype=self.dtype, device=self.device)
        if not self.stochastic_init:
            rand = torch.full_like(rand, 0.5)
        qpos, qvel = self.task.reset(rand)
        return qpos, qvel, self.task.observe(qpos, qvel, self._no_action.expand(steps, -1, -1))


class NumpyEnv(gymnasium.Env[Any, Any]):
    """One episode at a time in NumPy, for tools that expect gymnasium's plain environments."""

    metadata = {"render_modes": []}

    def __init__(self, env: DiffEnv) -> None:
        self.env = env
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        obs, _ = self.env.reset(seed=seed)
        return obs[0].numpy().copy(), {}

    @torch.no_grad()
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        tensor = torch.as_tensor(np.asarray(action), dtype=self.env.dtype).reshape(1, -1)
        _, reward, terminated, truncated, info = self.env.step(tensor)
        return info["final_obs"][0].numpy().copy(), reward.item(), bool(terminated), bool(truncated), {}
