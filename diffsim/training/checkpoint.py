"""Checkpoints: one file that continues a run exactly, and whose policy anyone can load without the script."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from diffsim.env import DiffEnv
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


class Learner(Protocol):
    """What a script's algorithm shows to what surrounds it."""

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


def parts(learner: Learner) -> dict[str, Any]:
    """What the next iteration depends on, beside environments and random numbers, by name: the learner's attributes
    that have a state_dict, but for its policy, which consists of others; and the learner itself, if it has one."""
    found = {
        name: value
        for name, value in vars(learner).items()
        if name != "policy" and hasattr(value, "load_state_dict") and not isinstance(value, DiffEnv)
    }
    return found | ({"learner": learner} if hasattr(learner, "load_state_dict") else {})


def save(path: Path, script: str, learner: Learner, state: Mapping[str, Any]) -> None:
    """Replace the file in one step: whoever reads it finds the old one or the new one, whole.

    Args:
        path: the file.
        script: name of the learner's script.
        learner: whose parts and policy are saved.
        state: what else continues the run: args and iteration at least.
    """
    modules = {name: part.state_dict() for name, part in parts(learner).items()}
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
    for owner, module in (parts(learner) | {"policy": learner.policy}).items():
        for name, weight in (
            (*module.named_parameters(), *module.named_buffers()) if isinstance(module, nn.Module) else ()
        ):
            frozen = isinstance(weight, nn.Parameter) and not weight.requires_grad
            if bool((weight.isnan() if frozen else ~weight.isfinite()).any()):
                return f"{owner}.{name}"
    return None


def load(path: Path, script: str | None = None) -> dict[str, Any]:
    """The checkpoint at path, of the given script if one is named.

    Raises:
        ValueError: there is none, it is damaged, or it is of another script or format.
    """
    if not path.is_file():
        fail(f"no such checkpoint: {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(part.file_size for part in archive.infolist()) > 2 * path.stat().st_size:
                raise ValueError("compressed, which torch.save does not do")
            if archive.testzip() is not None:  # torch does not look at the checksums that it writes
                raise ValueError("a wrong checksum")
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        form = state["format"]
        if form == FORMAT:
            _check_structure(state)
    except Exception as error:  # zipfile and torch.load raise whatever broken bytes lead them to
        why = f": {error}" if type(error) is ValueError else ""
        fail(f"{path} is not a whole checkpoint{f' of {script}.py' if script else ''}{why}")
    if form != FORMAT:
        fail(f"{path} is a checkpoint of format {form!r}, and this version reads format {FORMAT}")
    if script not in (None, state["script"]):
        fail(f"{path} is a checkpoint of {state['script']!r}, not of {script}.py")
    return state


def _check_structure(state: Mapping[str, Any]) -> None:
    """Raise a ValueError unless all that a checkpoint of this format holds is there, and of the right type."""

    def check(name: str, holds: Callable[[Any], bool], words: str) -> None:
        if name not in state or not holds(state[name]):
            raise ValueError(f"{name} is missing" if name not in state else f"{name} is not {words}")

    def is_count(x: Any) -> bool:
        return type(x) is int and 0 <= x < 2**62

    def is_number(x: Any) -> bool:
        return type(x) in (int, float) and math.isfinite(x)

    def is_named(x: Any, kind: type = object) -> bool:
        return isinstance(x, dict) and all(isinstance(k, str) and isinstance(v, kind) for k, v in x.items())

    def is_policy(x: Any) -> bool:
        return (
            is_named(x)
            and is_named(x.get("weights"), Tensor)
            and isinstance(x.get("layers"), list)
            and all(isinstance(layer, list) and layer and layer[0] in LAYERS for layer in x["layers"])
        )

    def is_rank(x: Any) -> bool:
        rng = x.get("rng") if is_named(x) else None
        return isinstance(rng, Tensor) and rng.dtype == torch.uint8 and (x.get("env") is None or is_named(x["env"]))

    check("script", lambda x: isinstance(x, str) and x.isprintable(), "the name of a script")
    check("args", lambda x: is_named(x) and isinstance(x.get("env"), str), "the arguments of a run")
    check("iteration", is_count, "a count")
    check("policy", is_policy, "a policy")
    if "modules" not in state:  # an exported policy
        return
    check("modules", is_named, "the state of a learner")
    check("control_steps", is_count, "a count")
    check("seconds", lambda x: is_number(x) and x >= 0, "a time")
    check("totals", lambda x: is_named(x, int), "counts by name")
    check("episodes", lambda x: _is_list(x, lambda row: len(row) == 3 and all(map(is_number, row))), "sums of windows")
    check("ranks", lambda x: bool(x) and _is_list(x, is_rank), "the states of the ranks")


def _is_list(values: Any, holds: Callable[[Any], bool]) -> bool:
    return isinstance(values, list) and all(holds(value) for value in values)


def load_policy(path: Path) -> SavedPolicy:
    """The policy of any script's checkpoint, on the CPU in float32.

    Raises:
        ValueError: see `load`; or its weights do not fit its layers.
    """
    state = load(path)
    try:
        with torch.device("meta"):  # sizes alone: they are compared before anything is allocated
            network = nn.Sequential(*(LAYERS[name][0](*arguments) for name, *arguments in state["policy"]["layers"]))
        network.load_state_dict(state["policy"]["weights"], assign=True)
    except (KeyError, RuntimeError, TypeError, ValueError):
        fail(f"{path} is not a whole checkpoint: its policy's weights do not fit its layers")
    return SavedPolicy(network, state["script"], state["args"], state["iteration"])


def export_policy(path: Path, output: Path) -> None:
    """Write what load_policy needs of a checkpoint: its policy and where that comes from, some hundred kB."""
    state = load(path)
    _write(output, {name: state[name] for name in ("format", "script", "args", "iteration", "policy")})


def restore(learner: Learner, state: Mapping[str, Any]) -> None:
    """Load the weights and statistics of a checkpoint into a learner.

    Raises:
        ValueError: they are of other sizes.
    """
    try:
        for name, part in parts(learner).items():
            part.load_state_dict(state["modules"][name])
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        why = f"{type(error).__name__} {' '.join(str(error).split())}"
        fail(f"the checkpoint does not fit the script as it is now: {why}")


def _describe(policy: nn.Sequential) -> list[list[Any]]:
    """Each layer's name and constructor arguments."""
    described = []
    for layer in policy:
        name = type(layer).__name__
        if name not in LAYERS:
            raise TypeError(f"a policy cannot be saved with layer {name}; checkpoint.LAYERS has {', '.join(LAYERS)}")
        described.append([name, *(getattr(layer, attribute) for attribute in LAYERS[name][1])])
    return described
