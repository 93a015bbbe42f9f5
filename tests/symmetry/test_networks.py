"""Left and right treated alike: policies of mirror images, exactly, and what becomes of them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest
import sapo
import torch
from learners import assert_resumes, refusal, run
from torch import Tensor, nn

import diffsim
import rpo
import shac
from diffsim.symmetry.mirror import Reflection
from diffsim.symmetry.networks import mirror_inputs, mirror_outputs, mirror_statistics
from diffsim.tasks import TASKS
from diffsim.training import ObsNormalizer, load_policy, parse
from diffsim.training.checkpoint import save
from diffsim.training.layers import First

MIRRORED = ("ant", "humanoid", "go1", "go2", "g1")
LEARNERS = {
    "shac": ("SHAC", "--actor-hidden 16 --critic-hidden 16"),
    "rpo": ("RPO", "--actor-hidden 16 --critic-hidden 16"),
    "sapo": ("SAPO", "--actor-hidden 16 --critic-hidden 16 --population 2"),
    "ppo_baseline": ("PPO", "--hidden 16"),
}


def build(script: str, task: str, flags: str = "", num_envs: int = 4, horizon: int = 8) -> Any:
    """A learner with weights, biases and statistics of its observations that are not those of a beginner."""
    torch.manual_seed(0)
    kind, own = LEARNERS[script]
    module = importlib.import_module(script)
    words = f"--env {task} --device cpu --symmetric --horizon {horizon} --num-envs {num_envs} {own} {flags}".split()
    learner = getattr(module, kind)(parse(module.Args, words), diffsim.make(task, num_envs, seed=0, horizon=horizon))
    for part in [part for part in vars(learner).values() if isinstance(part, nn.Module)]:
        for p in [p for p in part.parameters() if p.requires_grad]:
            p.data.add_(0.2 * torch.randn_like(p))
        for normalizer in [m for m in part.modules() if isinstance(m, ObsNormalizer) and m.size]:
            normalizer.update(2.0 + torch.randn(50, normalizer.size) * torch.rand(normalizer.size))
    return learner


def assert_alike(a: Tensor, b: Tensor) -> None:
    torch.testing.assert_close(a, b, rtol=0, atol=2e-6)


@pytest.mark.parametrize("task", MIRRORED)
@pytest.mark.parametrize("script", LEARNERS)
def test_in_the_mirror_a_policy_acts_as_its_image(script: str, task: str, tmp_path: Path) -> None:
    """As it learns and as it is loaded from a checkpoint; both halves of the network count."""
    learner = build(script, task)
    mirror, args = learner.env.task.mirror, {"env": task}
    obs = 2.0 + torch.randn(20, learner.env.task.obs_dim)
    save(tmp_path / "policy.pt", script, learner, {"args": args, "iteration": 1})
    for policy in (learner.policy, load_policy(tmp_path / "policy.pt").network):
        action = policy(obs)
        assert_alike(policy(mirror.obs(obs)), mirror.action(action))
        assert not torch.allclose(action, mirror.action(action), atol=0.01)
        if (seen := learner.env.task.actor_dim) is not None:
            hidden = torch.cat((obs[:, :seen], torch.randn_like(obs[:, seen:])), dim=1)
            assert torch.equal(policy(hidden), action)


def values(learner: Any, obs: Tensor) -> Tensor:
    """Of observations, by each value function and member, in the last two columns."""
    if isinstance(learner, shac.SHAC | rpo.RPO):
        return learner.critic(learner.actor.normalizer(obs)).unsqueeze(-1)
    if isinstance(learner, sapo.SAPO):
        return learner.values(learner.critics, learner.actor.normalizer(obs).repeat(2, 1, 1)).movedim(-1, 0)
    return learner.actor_critic(learner.actor_critic.normalizer(obs))[1][:, None, None]


@pytest.mark.parametrize("task", ["ant", "go2"])
@pytest.mark.parametrize("script", LEARNERS)
def test_a_state_and_its_image_are_worth_the_same(script: str, task: str) -> None:
    learner = build(script, task)
    obs = 2.0 + torch.randn(20, learner.env.task.obs_dim)
    value, image = (values(learner, x) for x in (obs, learner.env.task.mirror.obs(obs)))
    assert_alike(value, image)
    assert (value.std(0) > 0.01).all()


@pytest.mark.parametrize("flags", ["--state-std", "--no-state-std"])
def test_the_noise_of_the_image_is_as_large(flags: str) -> None:
    actor, mirror = (learner := build("sapo", "ant", flags)).actor, learner.env.task.mirror
    obs, noise = torch.randn(20, 37), torch.randn(2, 20, 8)
    (action, surprise), (image, same) = (
        actor(actor.normalizer(o).expand(2, -1, -1), n)
        for o, n in ((obs, noise), (mirror.obs(obs), mirror.action(noise)))
    )
    assert_alike(image, mirror.action(action))
    torch.testing.assert_close(same, surprise, rtol=1e-5, atol=1e-4)
    if flags == "--no-state-std":
        others = build("shac", "ant").actor, build("rpo", "ant").actor, build("ppo_baseline", "ant").actor_critic
        for log_std in (actor.log_std, *(other.log_std for other in others)):
            assert torch.equal(log_std, log_std.index_select(-1, mirror.action.index)) and log_std.std()


@pytest.mark.parametrize("script", LEARNERS)
def test_all_weights_have_gradients(script: str) -> None:
    learner = build(script, "ant")
    obs, policy = torch.randn(20, 37), learner.policy  # SAPO's is a copy
    functions = policy, getattr(learner, {"sapo": "critics", "ppo_baseline": "actor_critic"}.get(script, "critic"))
    for function, result in zip(functions, (policy(obs), values(learner, obs)), strict=True):
        weights = [p for name, p in function.named_parameters() if "mean" not in name and "log_std" not in name]
        assert all(g.abs().sum() > 0 for g in torch.autograd.grad(result.square().sum(), weights))


def test_training_keeps_it_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = "--env ant --symmetric --num-envs 2 --horizon 4 --iterations 4 --device cpu --quiet --eval-episodes 1"
    whole = assert_resumes(shac, tmp_path, f"{flags} --actor-hidden 16 --critic-hidden 16 --eval-every 0", 2)
    mirror, obs = TASKS["ant"]().mirror, torch.randn(20, 37)
    policy = load_policy(tmp_path / "whole" / "checkpoint.pt").network
    assert_alike(policy(mirror.obs(obs)), mirror.action(policy(obs)))
    mean, var = (whole["modules"]["actor"][f"normalizer.{name}"] for name in ("mean", "var"))
    assert torch.equal(mirror.obs(mean), mean) and torch.equal(var[mirror.obs.index], var) and mean.abs().max() > 0.1
    words = ["--resume", str(tmp_path / "whole"), "--iterations", "5", "--no-symmetric"]
    assert "the checkpoint does not fit the flags" in refusal(lambda: shac.main(words), capsys)


@pytest.mark.gpu
@pytest.mark.parametrize("task", ["ant", "go2"])
@pytest.mark.parametrize("script", LEARNERS)
def test_a_gpu_trains_and_keeps_it(script: str, task: str, tmp_path: Path) -> None:
    """In CUDA graphs; networks are made on the CPU, and the task's mirror on the GPU."""
    flags = f"--env {task} --symmetric --num-envs 16 --horizon 4 --iterations 6 --device cuda --quiet --eval-episodes 2"
    run(importlib.import_module(script), tmp_path, *flags.split())
    mirror = TASKS[task]().mirror
    obs = torch.randn(20, len(mirror.obs.index))
    policy = load_policy(tmp_path / "checkpoint.pt").network
    assert_alike(policy(mirror.obs(obs)), mirror.action(policy(obs)))


def test_statistics_are_those_of_observations_and_their_images() -> None:
    torch.manual_seed(0)
    mirror = TASKS["humanoid"]().mirror
    own, both = ObsNormalizer(76), ObsNormalizer(76)
    mirror_statistics(own, mirror.obs)
    for _ in range(3):
        obs = 3.0 * torch.randn(40, 76) + torch.randn(76)
        own.update(obs)
        both.update(torch.cat((obs, mirror.obs(obs))))
    torch.testing.assert_close(own.mean, both.mean, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(own.var, both.var, rtol=1e-5, atol=1e-5)
    obs = torch.randn(5, 76)
    assert torch.equal(own(mirror.obs(obs)), mirror.obs(own(obs)))


@pytest.mark.parametrize("script", LEARNERS)
def test_who_is_symmetric(script: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The joystick's robots, unless told otherwise; a task without a mirror cannot be."""
    kind = importlib.import_module(script).Args
    for name in TASKS:
        assert parse(kind, ["--env", name, "--device", "cpu"]).symmetric == (name in ("go1", "go2", "g1"))
    assert not parse(kind, ["--env", "go2", "--device", "cpu", "--no-symmetric"]).symmetric
    for name in ("hopper", "humanoid_mtu"):
        message = f"--symmetric: task {name!r} has no mirror image"
        assert message in refusal(lambda name=name: parse(kind, ["--env", name, "--symmetric"]), capsys)


def test_what_the_actor_sees_needs_its_own_image(capsys: pytest.CaptureFixture[str]) -> None:
    swap = Reflection(torch.tensor([0, 2, 1]), torch.ones(3))
    for network in (nn.Sequential(First(1)), nn.Sequential(First(3)), nn.Sequential()):
        mirror_inputs(network, swap)
    message = "--symmetric: the first 2 numbers of an observation, which the actor sees, need others' images"
    assert message in refusal(lambda: mirror_inputs(nn.Sequential(First(2)), swap), capsys)
    f = nn.Sequential(nn.Linear(3, 3))
    x = torch.randn(5, 3)
    expected = (f(x) + swap(f(swap(x)))) / 2
    mirror_inputs(f, swap)
    mirror_outputs(f, swap)
    torch.testing.assert_close(f(x), expected)
