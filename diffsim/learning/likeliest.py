"""The layer with which the policies of pfpn.py and pfpn_sac.py end."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Likeliest(nn.Module):
    """Of each action, the location of the component with the largest weight.

    Not the mixture's mean, which lies between two peaks, where neither is.

    Args:
        actions, components: how many, m and n.
        shared: the locations are parameters, the same in all states: the input (..., m n) holds the logits of the
            weights. Otherwise it holds the logits and then the locations (..., 2 m n).

    Attributes:
        loc: (m, n) the locations, if shared.
    """

    def __init__(self, actions: int, components: int, shared: bool = True) -> None:
        super().__init__()
        self.actions, self.components, self.shared = actions, components, shared
        self.loc = nn.Parameter(torch.zeros(actions, components)) if shared else None

    def forward(self, x: Tensor) -> Tensor:
        parts = x.unflatten(-1, (-1, self.actions, self.components))
        index = parts[..., 0, :, :].argmax(-1, keepdim=True)
        loc = parts[..., 1, :, :] if self.loc is None else self.loc.expand(parts.shape[:-3] + self.loc.shape)
        return loc.gather(x.dim(), index).squeeze(-1)  # not -1, which onnx's reference evaluator gets wrong
