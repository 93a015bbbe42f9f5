"""DiffEnv: a task on the simulator, as a gymnasium.vector.VectorEnv on torch tensors."""

from __future__ import annotations

import copy
import math
import pkgutil
from collections import deque
from collections.abc import Iterable
from numbers import Integral
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from diffsim.robot.scene import Scene
from diffsim.sim.adjoint import ClipAdjoint
from diffsim.sim.elevation import Elevation
from diffsim.sim.integration import Integration, check_count, is_real
from diffsim.sim.launcher import check_memory
from diffsim.sim.modes import in_plain_mode
from diffsim.sim.simulator import Simulator
from diffsim.tasks import Task

State = tuple[Tensor, Tensor, Tensor, Tensor]  # qpos, qvel, observation and memory, (N, ...) each
Step = tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]  # what gymnasium's step returns
Frames = tuple[NDArray[np.uint8], ...]  # each (height, width, 3)
RENDERER = "diffsim_cli.render:Renderer"  # loaded with the first picture
STATISTICS = ("episodes", "return", "length", "nonfinite")  # see DiffEnv.take_statistics


def check_seed(seed: int) -> int:
    """Return the seed as an int; raises ValueError unless it is an integer of 64 bits, which True is not."""
    if not isinstance(seed, Integral) or isinstance(seed, bool) or not -(2**63) <= seed < 2**63:
        raise ValueError(f"seed is {seed!r}, must be one integer of 64 bits, which seeds all environments of a batch")
    return int(seed)


class ActionError(ValueError):
    """Raised when a policy outputs NaN."""


class DiffEnv(VectorEnv):
    """A batch of episodes of one task, differentiable in the actions and through the states between them.

    Actions are clipped to [-1, 1]. A step that ends an episode returns the first observation of the next one
    (gymnasium's SAME_STEP autoreset); the last one of the old episode is info["final_obs"]. No gradient crosses a
    reset. Up to `horizon` differentiable steps make a rollout, which `detach` ends; under torch.no_grad there is no
    limit.

    Example:
        env = diffsim.make("cartpole", num_envs=16, horizon=8)
        obs, info = env.reset(seed=1)                                     # (16, 5)
        action = torch.zeros(16, 1, requires_grad=True)
        obs, reward, terminated, truncated, info = env.step(action)
        reward.sum().backward()
        obs = env.detach()                                                # the next rollout

    Args:
        task: task on the simulator's device and dtype; several environments may share it.
        scene: its robot. On a terrain the task measures heights (of start, observation, reward and end) from the ground
            below the root. `qpos` stays in the world frame.
        integration: default the task's "default".
        num_envs to render_mode: see diffsim.make.
        **options: device, dtype, threads, factors, forces, block, division: see sim.Options.

    Attributes:
        qpos, qvel: (N, nq), (N, nv) the current state in MuJoCo's conventions.
        episode_step: (N,) int64 control steps since each environment's start.
        memory: (N, num_memory) the task's numbers that persist from step to step.
        generator: the torch.Generator of the start states.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"]}

    @in_plain_mode
    def __init__(
        self,
        task: Task,
        scene: Scene,
        num_envs: int,
        *,
        integration: Integration | None = None,
        seed: int | None = None,
        horizon: int = 32,
        stochastic_init: bool = True,
        early_termination: bool = True,
        max_episode_steps: int | None = None,
        adjoint_clip: float = 0.0,
        render_mode: Literal["rgb_array"] | None = None,
        **options: Any,
    ) -> None:
        task = copy.copy(task)  # its ground is this environment's
        task.ground = None
        self.task, self.scene, self.control_dt = task.bind(scene), scene, task.control_dt
        how = integration or task.integration("default")
        self.sim = sim = Simulator(scene, num_envs, how, task.control_dt, horizon, **options)
        self.num_envs, self.horizon = num_envs, horizon = sim.num_envs, sim.horizon
        self.device, self.dtype = sim.device, sim.dtype
        self.episode_length = task.episode_length
        if max_episode_steps is not None:
            self.episode_length = check_count("max_episode_steps", max_episode_steps, most=2**62)
        self.metadata = self.metadata | {"render_fps": round(1 / task.control_dt)}
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}, must be 'rgb_array'; `diffsim drive` shows a robot live")
        self.render_mode = render_mode
        self._renderer: Any = None  # made with the first picture
        self.stochastic_init, self.early_termination = stochastic_init, early_termination
        if not is_real(adjoint_clip) or not 0 <= adjoint_clip < math.inf:
            raise ValueError(f"adjoint_clip is {adjoint_clip!r}, must be a factor of at least 0")
        self.adjoint_clip = float(adjoint_clip)
        if scene.terrain is not None:
            self.task.ground = Elevation(scene, self.device, self.dtype)
        real = np.float32 if self.dtype == torch.float32 else np.float64
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.obs_dim,), real)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (scene.nu,), real)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.generator = torch.Generator(self.device)
        if seed is not None:
            self.generator.manual_seed(check_seed(seed))
        else:
            self.generator.seed()
        self._no_action = torch.zeros(num_envs, scene.nu, dtype=self.dtype, device=self.device)
        self.episode_step = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._episode_return = torch.zeros(num_envs, dtype=self.dtype, device=self.device)
        self._statistics = {name: torch.zeros_like(self._episode_return) for name in STATISTICS}
        self.qpos, self.qvel, self._obs, self.memory = self._draw_starts(1)[0]
        self._pinned: State | None = None
        self._disturb = self.task.disturb
        # Start states of the next steps, drawn for many at once: one batch of operations, not one per step
        numbers = task.num_random + scene.nq + scene.nv + task.obs_dim + task.num_memory
        drawn = f"start states of a horizon of {horizon:,} steps"
        check_memory(drawn, num_envs, horizon * numbers * self.dtype.itemsize, self.device)
        self._starts = deque(self._draw_starts(horizon))

    @property
    def np_random_seed(self) -> int:
        """Return the seed of `generator`."""
        return self.generator.initial_seed()

    @in_plain_mode
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Restart all episodes and begin a rollout; returns obs (N, obs_dim) and an empty info.

        Raises:
            ValueError: several seeds (one generator draws all start states); options.
        """
        if options:
            raise ValueError(f"options are {options!r}, but reset takes none")
        if seed is not None:
            self.generator.manual_seed(check_seed(seed))
        self._detach_state()
        self._start_episodes(torch.ones_like(self.episode_step, dtype=torch.bool), self._draw_starts(1)[0])
        if self._pinned is not None:
            self.write_back(self._pinned)
        if self.device.type == "cuda":  # the next step draws start states, as it does in each replay of a graph
            self._starts.clear()
        else:
            self._starts = deque(self._draw_starts(self.horizon))
        return self._obs.clone(), {}

    @in_plain_mode
    def step(self, action: Tensor) -> Step:
        """Take one control step in all environments, and reset those that end.

        Args:
            action: (N, nu), clipped to [-1, 1].

        Returns:
            obs (N, obs_dim), reward (N,), terminated (N,), truncated (N,), info with
            "final_obs" (N, obs_dim): the observation before any reset, valid for every environment; "_final_obs" (N,)
            marks those that ended; "episode": {"r": return, "l": control steps, "t": simulated seconds} (N,) each,
            valid under "_episode"; "nonfinite" (N,): environments whose simulation failed, which end with reward 0.

        Raises:
            ValueError: action of the wrong shape, dtype or device; an ActionError on the CPU if it is not a number.
            RuntimeError: more than `horizon` differentiable steps without `detach`.
        """
        outcome = self._act(action)
        if not self._starts:  # steps without gradients may be more than `horizon`
            self._starts.extend(self._draw_starts(self.horizon))
        return self._conclude(*outcome, self._starts.popleft())

    def advance(self, action: Tensor) -> Step:
        """Do what `step` does except the reset: obs is info["final_obs"], and ended episodes wait for `reset`."""
        return self._conclude(*self._act(action), None)

    def _act(self, action: Tensor) -> tuple[State, Tensor, Tensor, Tensor]:
        """Take a control step; returns the state after it, the reward, and (N,) bool: terminated, and not finite."""
        self.sim.check_tensor("action", action, self.scene.nu)
        if self.device.type == "cpu" and bool(torch.isnan(action).any()):
            rows = torch.isnan(action).any(1).nonzero().flatten().tolist()
            raise ActionError(f"action is NaN in environments {rows[:8]}; every action must be a number")
        action = action.clamp(-1.0, 1.0)
        qpos, qvel = self.sim.advance(self.qpos, *self._disturb(self.qvel, action, self.memory))
        if self.adjoint_clip and qpos.requires_grad:
            qpos, qvel = ClipAdjoint.apply(self.adjoint_clip, qpos, qvel)
        noise = self._uniform(self.num_envs, self.task.num_noise) if self.task.num_memory else self.memory
        obs, memory, reward, ended, failed = self._judge(qpos, qvel, action, self.memory, noise, self.sim.nonfinite)
        return (qpos, qvel, obs, memory), reward, ended, failed

    def _judge(
        self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor, noise: Tensor, nonfinite: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the observation, the memory, the reward, terminated and a copy of nonfinite after a control step."""
        failed = nonfinite.clone()
        if self.task.num_memory:
            memory = self.task.remember(memory, action, noise)
        obs = self.observe(qpos, qvel, action, memory)
        reward = self.task.reward(obs, action).masked_fill(failed, 0.0)
        with torch.no_grad():
            ended = self.task.terminated(obs) if self.early_termination else self.task.over(obs)
        return obs, memory, reward, ended | failed, failed

    def _conclude(
        self, state: State, reward: Tensor, terminated: Tensor, nonfinite: Tensor, starts: State | None
    ) -> Step:
        """Count what `_act` returned, and start new episodes where one ended, unless starts is None."""
        with torch.no_grad():
            self.episode_step += 1
            self._episode_return += reward
            truncated = (self.episode_step >= self.episode_length) & ~terminated
            done = terminated | truncated
            length = self.episode_step.clone()
            episode = {"r": self._episode_return.clone(), "l": length, "t": length * self.control_dt}
            self._statistics["episodes"] += done
            self._statistics["return"].addcmul_(done, self._episode_return)
            self._statistics["length"].addcmul_(done, length)
            self._statistics["nonfinite"] += nonfinite
        obs = state[2]
        info = {"final_obs": obs, "_final_obs": done, "episode": episode, "_episode": done, "nonfinite": nonfinite}
        self._set_state(state)
        if starts is not None:
            self._start_episodes(done, starts)
            obs = self._obs.clone()
        return obs, reward, terminated, truncated, info

    def _start_episodes(self, mask: Tensor, starts: State) -> None:
        """Start new episodes in the environments of a mask (N,); gradients of the others stay as they are."""
        row = mask.unsqueeze(1)
        self._set_state(torch.where(row, start, now) for start, now in zip(starts, self._state(), strict=True))
        self.episode_step.masked_fill_(mask, 0)
        self._episode_return.masked_fill_(mask, 0.0)

    def compile(self) -> None:
        """Compile what a step does outside the simulator with torch.compile, when the next steps are taken."""
        self._judge = torch.compile(self._judge, dynamic=False)  # type: ignore[method-assign]
        self._conclude = torch.compile(self._conclude, dynamic=False)  # type: ignore[method-assign]
        if type(self.task).disturb is not Task.disturb:
            self._disturb = torch.compile(self._disturb, dynamic=False)

    def render(self) -> Frames:
        """Draw a frame (height, width, 3) of each environment.

        Raises:
            RuntimeError: made without render_mode; no OpenGL.
        """
        if not self.render_mode:
            raise RuntimeError('there is no picture without a render_mode: make the environment with "rgb_array"')
        if self._renderer is None:
            self._renderer = pkgutil.resolve_name(RENDERER)(self.scene)
        return tuple(self._renderer.draw(row, profile=k) for k, row in enumerate(self.qpos.numpy(force=True)))

    def close_extras(self, **_: Any) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @in_plain_mode
    def detach(self) -> Tensor:
        """Cut the graph at the current state, begin a rollout there, and return observations (N, obs_dim)."""
        self._detach_state()
        self._starts = deque(self._draw_starts(self.horizon))
        return self._obs.clone()

    def _detach_state(self) -> None:
        self._set_state(part.detach() for part in self._state())
        self.sim.rewind()

    def pin_rollout(self) -> State:
        """Copy the state into fixed buffers, from which a CUDA graph replays the rollout; see graph.py."""
        self._set_state(part.detach().clone() for part in self._state())
        self._pinned = self._state()
        return self._pinned

    def write_back(self, pinned: State) -> None:
        """End a captured rollout: write the state back into the buffers that `pin_rollout` returned."""
        with torch.no_grad():
            for to, value in zip(pinned, self._state(), strict=True):
                to.copy_(value)
        self._set_state(pinned)

    def _state(self) -> State:
        return self.qpos, self.qvel, self._obs, self.memory

    def _set_state(self, state: Iterable[Tensor]) -> None:
        self.qpos, self.qvel, self._obs, self.memory = state

    def take_statistics(self) -> dict[str, Tensor]:
        """Return what happened since the last call, as () tensors, without waiting for the device.

        Returns:
            "episodes": how many ended; "return" and "length": sums over them; "nonfinite": environments that blew up;
            "nonfinite_gradients": adjoints of control steps that were not finite; on MuJoCo's contact only
            "unconverged": control steps that ended above the tolerance, and "sim/residual": the mean of
            Simulator.residual in the last step.
        """
        parts = self._statistics | {"nonfinite_gradients": self.sim.nonfinite_gradients}
        if self.sim.integration.contact == "mujoco":
            parts["unconverged"] = self.sim.unconverged
        sums = {name: part.sum() for name, part in parts.items()}
        for part in parts.values():
            part.zero_()
        if self.sim.integration.contact == "mujoco":
            sums["sim/residual"] = self.sim.residual.mean()
        return sums

    @in_plain_mode
    def set_state(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Set the states of all environments, but not their episode clocks, and return observations (N, obs_dim).

        Gradients flow into qpos (N, nq) and qvel (N, nv). The last action in the observation is 0.

        Raises:
            ValueError: wrong shape, dtype or device, or not finite.
        """
        for name, value, width in (("qpos", qpos, self.scene.nq), ("qvel", qvel, self.scene.nv)):
            self.sim.check_tensor(name, value, width)
            if not bool(torch.isfinite(value.detach()).all()):
                raise ValueError(f"{name} holds numbers that are not finite")
        self.qpos, self.qvel = qpos.clone(), qvel.clone()
        self._obs = self.observe(self.qpos, self.qvel, self._no_action)
        return self._obs.clone()

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor | None = None) -> Tensor:
        """Return the task's observation (N, obs_dim) of states, with a memory, by default the present one."""
        if self.task.ground is not None:
            qpos = self.task.ground.lower(qpos)
        return self.task.observe_with(qpos, qvel, action, self.memory if memory is None else memory)

    def state_dict(self) -> dict[str, Any]:
        """Return a dictionary that continues the episodes exactly, without the simulator's factors and forces."""
        names = ("qpos", "qvel", "obs", "memory", "episode_step", "episode_return")
        parts = zip(names, (*self._state(), self.episode_step, self._episode_return), strict=True)
        tensors = {name: part.detach().clone() for name, part in parts if name != "memory" or self.task.num_memory}
        return {"task": self.task.name, **tensors, "generator": self.generator.get_state()}

    @in_plain_mode
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state_dict of the same task, size and dtype, otherwise ValueError. Call `detach` next."""
        own = self.state_dict()
        if state.keys() != own.keys():
            raise ValueError(f"the state has {', '.join(state)}; that of an environment has {', '.join(own)}")
        for name, value in own.items():
            theirs, ours = (f"{tuple(x.shape)} {x.dtype}" if isinstance(x, Tensor) else x for x in (state[name], value))
            if theirs != ours:
                raise ValueError(f"the state's {name} is {theirs}; this environment's is {ours}")
        state = {"memory": self.memory} | state
        self._set_state(state[name].to(self.device, copy=True) for name in ("qpos", "qvel", "obs", "memory"))
        self.episode_step.copy_(state["episode_step"])
        self._episode_return.copy_(state["episode_return"])
        self.generator.set_state(state["generator"].cpu())
        self._starts.clear()

    @torch.no_grad()
    def _draw_starts(self, steps: int) -> list[State]:
        """Draw start states of all environments for a number of steps."""
        rand = self._uniform(steps, self.num_envs, self.task.num_random)
        if not self.stochastic_init:
            rand.fill_(0.5)
        (qpos, qvel), memory = self.task.reset(rand), self.task.begin(rand)
        obs = self.task.observe_with(qpos, qvel, self._no_action.expand(steps, -1, -1), memory)
        qpos = qpos if self.task.ground is None else self.task.ground.lift(qpos)
        return [*zip(*(part.unbind() for part in (qpos, qvel, obs, memory)), strict=True)]

    def _uniform(self, *size: int) -> Tensor:
        return torch.rand(size, generator=self.generator, dtype=self.dtype, device=self.device)
