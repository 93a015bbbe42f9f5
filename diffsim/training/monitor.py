"""--monitor: whether a policy earns its reward from the simulator's errors of integration."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.training.evaluation import FINER, make_env
from diffsim.training.flags import Flags

WATCHED, STEPS = 16, 32  # environments and control steps of a replay
ENDLESS = dict(early_termination=False, max_episode_steps=2**31)
SUSPECT = 0.06  # m or rad, difference of the states at which a line warns


class Monitor:
    """Replays a window of the training's last environments, on the steepest ground, with FINER times the substeps."""

    def __init__(self, args: Flags, env: DiffEnv) -> None:
        self.env, self.warned, how = env, False, env.sim.integration
        count = min(WATCHED, env.num_envs)
        finer = how._replace(substeps=FINER * how.substeps)
        ground = None if env.scene.terrain is None else env.scene.terrain[-count:]
        self.envs = [make_env(args, count, substeps=each.substeps, terrain=ground, **ENDLESS) for each in (how, finer)]

    @torch.no_grad()
    def replay(self, policy: torch.nn.Module) -> dict[str, float]:
        """The policy without noise acts from where the training stands; its actions are replayed in the finer one.

        Returns:
            the root mean square difference of the degrees of freedom [m, rad] at the end, the median over environments,
            and the share of the return that is lost.
        """
        env, (coarse, fine) = self.env, self.envs
        for each in self.envs:
            n = each.num_envs
            each.generator.manual_seed(0)
            each.memory = env.memory[-n:].detach().clone()
            obs = each.set_state(env.qpos[-n:].detach().clone(), env.qvel[-n:].detach().clone())
        total = torch.zeros(2, device=env.device)
        for _ in range(STEPS):
            action = policy(obs)
            obs, reward, *_ = coarse.step(action)
            total += torch.stack((reward.sum(), fine.step(action)[1].sum()))
        here, there = total.tolist()
        found = {"sim/state_error": float(np.median(apart(env.scene.mj_model, coarse.qpos, fine.qpos)))}
        return found | {"sim/return_lost": (here - there) / max(abs(here), 1e-9)}

    def suspects(self, found: dict[str, float]) -> bool:
        """Whether to warn of a replay: once."""
        first, self.warned = not self.warned, self.warned or found["sim/state_error"] > SUSPECT
        return first and self.warned


def apart(model: mujoco.MjModel, found: Tensor, expected: Tensor) -> NDArray[np.float64]:
    """(N,) root mean square over degrees of freedom [m, rad] between states (N, nq) and (N, nq)."""
    away, errors = np.zeros(model.nv), []
    for one, other in zip(found.double().cpu().numpy(), expected.double().cpu().numpy(), strict=True):
        mujoco.mj_differentiatePos(model, away, 1.0, other, one)
        errors.append(np.sqrt(np.mean(away**2)))
    return np.array(errors)
