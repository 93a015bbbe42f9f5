"""Find what of a training is no finite number any more."""

from __future__ import annotations

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
