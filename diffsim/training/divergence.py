"""Find what of a training is no finite number any more, or never had a gradient."""

from __future__ import annotations

import torch
from torch import nn

from diffsim.env import DiffEnv
from diffsim.training.checkpoint import Learner, parts
from diffsim.training.layers import ObsNormalizer


def find_weight(learner: Learner) -> str | None:
    """Return the first weight that is not finite. Frozen ones may be infinite: log_std of a policy without noise."""
    for owner, module in (parts(learner) | {"policy": learner.policy}).items():
        for name, weight in (
            (*module.named_parameters(), *module.named_buffers()) if isinstance(module, nn.Module) else ()
        ):
            frozen = isinstance(weight, nn.Parameter) and not weight.requires_grad
            if bool((weight.isnan() if frozen else ~weight.isfinite()).any()):
                return f"{owner}.{name}"
    return None


def find_observation(learner: Learner | None, env: DiffEnv | None) -> int | None:
    """Return the first column of observations that is not finite, or was not in those that normalizers have seen."""
    own = () if learner is None else vars(learner).values()
    modules = nn.ModuleList(part for part in own if isinstance(part, nn.Module)).modules()
    seen = [m.mean.unsqueeze(0) for m in modules if isinstance(m, ObsNormalizer) and m.size is not None]
    seen += [env.state_dict()["obs"]] if env is not None else []
    columns = [(~obs.isfinite()).any(0).nonzero().flatten().tolist() for obs in seen]
    return next((found[0] for found in columns if found), None)


@torch.enable_grad()
def reward_has_gradient(env: DiffEnv) -> bool:
    """Tell whether the reward depends smoothly on the robot's state, at the environments' states and near them."""
    generator = torch.Generator(env.device).manual_seed(0)  # a training's random numbers stay the same

    def draw(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=generator, device=like.device, dtype=like.dtype)

    qpos, qvel = ((x.detach() + 0.05 * draw(x)).requires_grad_() for x in (env.qpos, env.qvel))
    action = (0.3 * draw(env.qpos.new_zeros(env.num_envs, env.scene.nu))).clamp(-1.0, 1.0)
    reward = env.task.reward(env.observe(qpos, qvel, action), action)
    if not reward.requires_grad:
        return False
    slopes = torch.autograd.grad(reward.sum(), (qpos, qvel), allow_unused=True)
    return any(slope is not None and bool(slope.any()) for slope in slopes)
