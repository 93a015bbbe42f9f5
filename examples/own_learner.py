"""A learner in forty lines swings up a pole along the simulator's gradient; docs/own_learner.md explains it.

    python examples/own_learner.py

The policy acts for a rollout, steps along the gradient of its mean reward, and goes on from the last state.
"""

import gymnasium
import torch
from torch import nn

import diffsim
from diffsim.training import ObsNormalizer

NUM_ENVS, HORIZON, LR, MAX_GRAD_NORM = 64, 64, 1e-2, 1.0


def train(task: str = "cartpole", iterations: int = 200, seed: int = 1) -> list[float]:
    """Return the mean return of the episodes that ended, for each iteration in which some did."""
    torch.set_num_threads(1)  # torch's idle threads would take the simulator's cores
    torch.manual_seed(seed)
    env = diffsim.make(task, NUM_ENVS, horizon=HORIZON, seed=seed)
    obs_dim = gymnasium.spaces.flatdim(env.single_observation_space)
    nu = gymnasium.spaces.flatdim(env.single_action_space)
    normalizer = ObsNormalizer(obs_dim)
    layers = nn.Linear(obs_dim, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, nu), nn.Tanh()
    policy = nn.Sequential(normalizer, *layers)
    optimizer = torch.optim.Adam(policy.parameters(), LR)

    returns = []
    env.reset()
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = LR * (1 - iteration / iterations)
        obs, seen, rewards, ended = env.detach(), [], [], []  # no gradient goes back to the last rollout
        for _ in range(HORIZON):
            seen.append(obs.detach())
            obs, reward, terminated, truncated, info = env.step(policy(obs))
            rewards.append(reward)
            ended.append(info["episode"]["r"][info["_episode"]])
        optimizer.zero_grad()
        (-torch.stack(rewards).mean()).backward()  # through the rewards, the physics and the policy
        nn.utils.clip_grad_norm_(policy.parameters(), MAX_GRAD_NORM)
        optimizer.step()
        normalizer.update(torch.stack(seen))  # between rollouts: within one, the policy stays the same
        if len(finished := torch.cat(ended)):
            returns.append(finished.mean().item())
            print(f"iteration {iteration + 1}: return {returns[-1]:.0f}")
    return returns


if __name__ == "__main__":
    train()
