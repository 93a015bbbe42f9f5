"""A captured graph against the same operations run one by one."""

from __future__ import annotations

import pytest
import torch

import diffsim
from diffsim.training import graph
from diffsim.training.evaluation import Player


def rollouts(name: str, captured: bool, poison: int | None = None, adjoint_clip: float = 0.0) -> list[torch.Tensor]:
    """Rewards, their gradient and the state of six rollouts; one environment is thrown out of the finite numbers."""
    torch.manual_seed(0)
    env = diffsim.make(name, num_envs=16, seed=0, horizon=8, device="cuda", adjoint_clip=adjoint_clip)
    action = torch.zeros(8, 16, env.scene.nu, device="cuda", requires_grad=True)
    velocity = torch.zeros_like(env.qvel)

    def rollout() -> tuple[torch.Tensor, ...]:
        env.detach()
        env.qvel = env.qvel + velocity
        noise = torch.rand_like(action) * 2 - 1
        results = [env.step(a) for a in (action + noise).unbind()]
        rewards, ended = torch.stack([r[1] for r in results]), torch.stack([r[4]["nonfinite"] for r in results])
        (gradient,) = torch.autograd.grad(rewards.sum(), action)
        return rewards.detach(), gradient, env.qpos.detach(), ended

    call = graph.capture(rollout, "cuda", env) if captured else rollout
    history = []
    for k in range(6):
        velocity.zero_()
        if k == 4 and poison is not None:
            velocity[poison] = torch.inf
        history.append([x.clone() for x in call()])
    return [torch.stack(column) for column in zip(*history, strict=True)]


@pytest.mark.gpu
@pytest.mark.parametrize("name, adjoint_clip", [("cartpole", 0.0), ("ant", 0.0), ("ant", 1.0)])
def test_graph_and_eager_agree(name: str, adjoint_clip: float) -> None:
    """Bitwise, noise and random start states included: each replay draws the numbers that an eager call would."""
    captured, eager = (rollouts(name, way, adjoint_clip=adjoint_clip) for way in (True, False))
    assert all(torch.equal(a, b) for a, b in zip(captured, eager, strict=True))
    rewards = captured[0]
    assert not torch.equal(rewards[4], rewards[5])


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["ant", "go2"])
def test_evaluations_by_a_graph_are_those_of_eager_steps(name: str) -> None:
    """Also the second one, when all is captured, of a policy that has changed since; not all episodes end at once."""
    torch.manual_seed(0)
    found = []
    for graphs in (True, False):
        env = diffsim.make(name, num_envs=16, seed=0, horizon=1, device="cuda")
        torch.manual_seed(0)
        policy = torch.nn.Sequential(torch.nn.Linear(env.task.obs_dim, env.scene.nu), torch.nn.Tanh()).cuda()
        player = Player(env, policy, graphs)
        first = player.evaluate()
        torch.nn.init.zeros_(policy[0].weight)
        player.take(policy)
        found += [first, player.evaluate()]
    for captured, eager in zip(found[:2], found[2:], strict=True):
        assert torch.equal(captured.returns, eager.returns) and torch.equal(captured.lengths, eager.lengths)
        shown = torch.arange(len(eager.qpos), device="cuda").unsqueeze(1) < eager.lengths
        assert torch.equal(captured.qpos[shown], eager.qpos[shown])
        assert torch.equal(captured.action[shown], eager.action[shown])
    assert not torch.equal(found[0].returns, found[1].returns)


@pytest.mark.gpu
def test_a_graph_contains_what_is_not_finite() -> None:
    bad, good = 3, [k for k in range(16) if k != 3]
    clean, poisoned = rollouts("ant", True), rollouts("ant", True, poison=bad)
    assert poisoned[3][4, 0, bad] and poisoned[3].sum() == 1 and not clean[3].any()
    for ours, expected in zip(poisoned[:2], clean[:2], strict=True):
        assert torch.equal(ours[:, :, good], expected[:, :, good]) and ours.isfinite().all()
    assert (poisoned[1][4, 0, bad] == 0).all()
