"""Checkpoints: one file that continues a run exactly, and whose policy anyone can load without the script."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from diffsim.training.errors import fail
from diffsim.training.layers import Likeliest, ObsNormalizer

FORMAT = 2

# What a policy may consist of, and the attributes that its constructor takes.
LAYERS: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "ELU": (nn.ELU, ()),
    "LayerNorm": (nn.LayerNorm, ("normalized_shape",)),
    "Likeliest": (Likeliest, ("actions", "components", "shared")),
    "Linear": (nn.Linear, ("in_features", "out_features")),
    "ObsNormalizer": (ObsNormalizer, ("size",)),
    "ReLU": (nn.ReLU, ()),
    "SiLU": (nn.SiLU, ()),
    "Softplus": (nn.Softplus, ()),
    "Tanh": (nn.Tanh, ()),
}


class Stateful(Protocol):
    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any], /) -> object: ...


class Learner(Protocol):
    """What a script's algorithm shows to what surrounds it."""

    @property
    def modules(self) -> Mapping[str, Stateful]:
        """Everything, beside environments and random numbers, that the next iteration depends on."""

    @property
    def policy(self) -> nn.Sequential:
        """The deterministic policy, observations (..., obs_dim) -> actions (..., nu), as a chain of LAYERS."""


@dataclass
class SavedPolicy:
    """A checkpoint's deterministic policy, with where it comes from.

    Attributes:
        network: observations (..., obs_dim) -> actions (..., nu).
        script, args, iteration: which script trained it, with which arguments (env among them), for how long.
    """

    network: nn.Sequential
    script: str
    args: dict[str, Any]
    iteration: int


def save(path: Path, script: str, learner: Learner, state: Mapping[str, Any]) -> None:
    """Replace the file in one step: whoever reads it finds the old one or the new one, whole.

    Args:
        path: the file.
        script: name of the learner's script.
        learner: whose modules and policy are saved.
        state: what else continues the run: args and iteration at least.
    """
    modules = {name: module.state_dict() for name, module in learner.modules.items()}
    policy = {"layers": _describe(learner.policy), "weights": learner.policy.state_dict()}
    _write(path, {"format": FORMAT, "script": script, **state, "modules": modules, "policy": policy})


def _write(path: Path, content: Mapping[str, Any]) -> None:
    buffer = io.BytesIO()  # torch.save to a full disk raises what says nothing of it
    torch.save(content, buffer)
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        temporary.write_bytes(buffer.getbuffer())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def find_nonfinite(learner: Learner) -> str | None:
    """The first weight that is not finite, if any. Frozen ones may be infinite: log_std of a policy without noise."""
    modules = dict(learner.modules) | {"policy": learner.policy}
    for owner, module in modules.items():
        for name, weight in (
            (*module.named_parameters(), *module.named_buffers()) if isinstance(module, nn.Module) else ()
        ):
            frozen = isinstance(weight, nn.Parameter) and not weight.requires_grad
            if bool((weight.isnan() if frozen else ~weight.isfinite()).any()):
                return f"{owner}.{name}"
    return None


def load(path: Path, script: str | None = None) -> dict[str, Any]:
    """The checkpoint at path, of the given script if one is named; anything else ends the script with one line."""
    if not path.is_file():
        fail(f"no such checkpoint: {path}")
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not look at the checksums that it writes
            if archive.testzip() is not None:
                raise ValueError
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        form = state["format"]
        if form == FORMAT and "script" not in state:
            raise ValueError
    except Exception:  # zipfile and torch.load raise whatever broken bytes lead them to
        fail(f"{path} is not a whole checkpoint" + (f" of {script}.py" if script else ""))
    if form != FORMAT:
        fail(f"{path} is a checkpoint of format {form}, and this version reads format {FORMAT}")
    if script not in (None, state["script"]):
        fail(f"{path} is a checkpoint of {state['script']}.py, not of {script}.py")
    return state


def load_policy(path: Path) -> SavedPolicy:
    """The policy of any script's checkpoint, on the CPU in float32; anything else ends the script with one line."""
    state = load(path)
    try:
        network = nn.Sequential(*(LAYERS[name][0](*arguments) for name, *arguments in state["policy"]["layers"]))
        network.load_state_dict(state["policy"]["weights"])
    except (KeyError, RuntimeError):
        fail(f"{path} is not a whole checkpoint")
    return SavedPolicy(network, state["script"], state["args"], state["iteration"])


def export_policy(path: Path, output: Path) -> None:
    """Write what load_policy needs of a checkpoint: its policy and where that comes from, some hundred kB."""
    state = load(path)
    _write(output, {name: state[name] for name in ("format", "script", "args", "iteration", "policy")})


def restore(learner: Learner, state: Mapping[str, Any]) -> None:
    """Load the weights and statistics of a checkpoint into a learner; other sizes end the script with one line."""
    try:
        for name, module in learner.modules.items():
            module.load_state_dict(state["modules"][name])
    except (KeyError, RuntimeError) as error:
        fail(f"the checkpoint does not fit the script as it is now: {' '.join(str(error).split())}")


def _describe(policy: nn.Sequential) -> list[list[Any]]:
    """Each layer's name and constructor arguments."""
    described = []
    for layer in policy:
        name = type(layer).__name__
        if name not in LAYERS:
            raise TypeError(f"a policy cannot be saved with layer {name}; checkpoint.LAYERS has {', '.join(LAYERS)}")
        described.append([name, *(getattr(layer, attribute) for attribute in LAYERS[name][1])])
    return described
