"""Checkpoints: one file that continues a run exactly, and whose policy anyone can load without the script."""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Protocol

import torch
from torch import nn

from diffsim.env import DiffEnv
from diffsim.tasks import FILE, TASKS, base_name, restore_task
from diffsim.training.errors import fail

POLICIES = Path(__file__).resolve().parents[1] / "policies"  # that come with the package
FORMAT = 2
POLICY = {"script", "args", "iteration", "policy"}  # what an exported policy has
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")  # codes of a terminal; a path may have other unprintable characters
SHOWN = ("script", "iteration", "simulator")  # in messages, besides args
HOME = "diffsim"  # the simulator in which policies are trained, unless a checkpoint names another one

# What a policy may consist of, where it is, and the attributes that its constructor takes.
LAYERS = {
    "ELU": ("torch.nn:ELU", ()),
    "First": ("diffsim.training.layers:First", ("columns",)),
    "LayerNorm": ("torch.nn:LayerNorm", ("normalized_shape",)),
    "Likeliest": ("diffsim.learning.likeliest:Likeliest", ("actions", "components", "shared")),
    "Linear": ("torch.nn:Linear", ("in_features", "out_features")),
    "MirrorMean": ("diffsim.symmetry.networks:MirrorMean", ("size",)),
    "ObsNormalizer": ("diffsim.training.layers:ObsNormalizer", ("size",)),
    "ReLU": ("torch.nn:ReLU", ()),
    "SiLU": ("torch.nn:SiLU", ()),
    "Softplus": ("torch.nn:Softplus", ()),
    "Tanh": ("torch.nn:Tanh", ()),
    "WithMirrorImage": ("diffsim.symmetry.networks:WithMirrorImage", ("size",)),
}


class Learner(Protocol):
    """What a script's algorithm shows to what surrounds it."""

    @property
    def policy(self) -> nn.Sequential:
        """The deterministic policy, observations (..., obs_dim) -> actions (..., nu), as a chain of LAYERS."""


@dataclass
class SavedPolicy:
    """A checkpoint's deterministic policy, with where it comes from."""

    network: nn.Sequential  # observations (..., obs_dim) -> actions (..., nu)
    script: str  # that trained it
    args: dict[str, Any]  # with which arguments, env among them
    iteration: int
    simulator: str = HOME
    robot: str | None = None  # its fingerprint, in newer checkpoints

    def __str__(self) -> str:
        return f"{self.script}.py, iteration {self.iteration}"

    def task(self, given: str | None = None) -> str:
        """The name of its task, or the given file of an own one: what a checkpoint names is data, and no code to run.

        Raises ValueError if the policy was trained on a file's task and none is given, or on another one of TASKS.
        """
        trained = self.args["env"]
        if (own := FILE.fullmatch(trained)) and given is None:
            fail(
                f"a policy of your own task, whose code runs only if you name its file: add --env {trained}, or give "
                "drive the file in place of the robot"
            )
        if given is not None and not own and base_name(given) in {*TASKS} - {base_name(trained)}:
            fail(f"a policy that was trained on {trained}, not on {given}")
        return given or trained


def parts(learner: Learner) -> dict[str, Any]:
    """What the next iteration depends on, besides environments and random numbers, by name: the learner's attributes
    that have a state_dict, except its policy, which consists of others; and the learner itself, if it has one."""
    found = {
        name: value
        for name, value in vars(learner).items()
        if name != "policy" and hasattr(value, "load_state_dict") and not isinstance(value, DiffEnv)
    }
    return found | ({"learner": learner} if hasattr(learner, "load_state_dict") else {})


def save(path: Path, script: str, learner: Learner, state: Mapping[str, Any]) -> None:
    """Replace the file in one step: whoever reads it finds the old one or the new one, whole.

    It holds the learner's parts and policy, and the state: what else continues the run, args and iteration at least.
    """
    modules = {name: part.state_dict() for name, part in parts(learner).items()}
    policy = {"layers": _describe(learner.policy), "weights": learner.policy.state_dict()}
    write(path, {"format": FORMAT, "script": script, **state, "modules": modules, "policy": policy})


def write(path: Path, content: Mapping[str, Any]) -> None:
    buffer = io.BytesIO()  # torch.save to a full disk raises what says nothing of it
    torch.save(content, buffer)
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        temporary.write_bytes(buffer.getbuffer())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load(path: str | os.PathLike[str], script: str | None = None) -> dict[str, Any]:
    """The checkpoint at path, or of the run whose folder that is, whole, of this format and of the script if one is
    named; else raises ValueError."""
    if (path := Path(path)).is_dir():
        path /= "checkpoint.pt"
    if not path.is_file():
        fail(f"no such checkpoint: {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            whole = archive.testzip() is None  # torch does not look at the checksums that it writes
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        form = state["format"]
        whole = whole and (form != FORMAT or state.keys() >= POLICY)
        if whole and form == FORMAT:
            whole = isinstance(state["script"], str) and isinstance(state["args"]["env"], str)
            shown = *state["args"], *state["args"].values(), *(state.get(name) for name in SHOWN)
            whole &= not any(CONTROL.search(str(text)) for text in shown)
    except Exception:  # zipfile and torch.load raise whatever broken bytes lead them to
        whole = False
    if not whole:
        fail(f"{path} is not a complete checkpoint{f' of {script}.py' if script else ''}: it is damaged")
    if form != FORMAT:
        fail(f"{path} is a checkpoint of format {form!r}, and this version reads format {FORMAT}")
    if script not in (None, state["script"]):
        fail(f"{path} is a checkpoint of {state['script']!r}, not of {script}.py")
    restore_task(state["args"]["env"], state.get("task", {}))
    return state


def load_policy(path: str | os.PathLike[str]) -> SavedPolicy:
    """Read the policy of any script's checkpoint, without noise, on the CPU in float32; no code of the file runs.

    Example:
        from diffsim.training import load_policy
        from diffsim.training.checkpoint import POLICIES
        policy = load_policy(POLICIES / "ant.pt").network       # or runs/<run>/checkpoint.pt
        action = policy(torch.zeros(64, 37))                    # (64, 8) in [-1, 1]

    Args:
        path: checkpoint, or what `diffsim export` wrote.

    Returns:
        `network`, an nn.Module from observations (..., obs_dim) of the actor to actions (..., nu), and the `args`,
        `script` and `iteration` of its training.

    Raises:
        ValueError: the file is missing, broken or no checkpoint.
    """
    state = load(path)
    try:
        with torch.device("meta"):  # sizes alone: they are compared before anything is allocated
            layers = (resolve_name(LAYERS[name][0])(*arguments) for name, *arguments in state["policy"]["layers"])
            network = nn.Sequential(*layers)
            kinds = {name: weight.dtype for name, weight in network.state_dict().items()}
        if any(w.is_complex() for w in state["policy"]["weights"].values()):
            raise TypeError("complex weights")
        weights = {name: w.to(kinds[name]) for name, w in state["policy"]["weights"].items()}  # searched in float64
        network.load_state_dict(weights, assign=True)
        if task := TASKS.get(base_name(state["args"]["env"])):
            network(torch.zeros(1, task.obs_dim))  # on the device meta this would take seconds, of torch's imports
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError):
        fail(f"{path} is not a complete checkpoint: its policy's weights do not fit its layers or its task")
    for name, weight in network.state_dict().items():
        if not (name.endswith("count") or bool(weight.isfinite().all())):  # 16 bits do not hold a normalizer's count
            fail(f"{path}: weight {name} of the policy is not finite")
    others = state.get("simulator", HOME), state.get("robot")
    return SavedPolicy(network, state["script"], state["args"], state["iteration"], *others)


def restore(learner: Learner, state: Mapping[str, Any], env: tuple[DiffEnv, Any] | None = None) -> None:
    """Load a checkpoint into a learner and, if given, an environment; raises ValueError if it is of other sizes."""
    try:
        for name, part in parts(learner).items():
            part.load_state_dict(state["modules"][name])
        if env is not None:
            env[0].load_state_dict(env[1])
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        why = f"{type(error).__name__} {' '.join(str(error).split())}"
        if sizes := re.search(r"size mismatch for (\S+): .*?\[(.*?)\].*?\[(.*?)\]", why):  # the first of many
            why = "{}.{} has shape ({}), not ({})".format(name, *sizes.groups())
        fail(f"the checkpoint does not fit the flags, or the script as it is now: {why}")


def _describe(policy: nn.Sequential) -> list[list[Any]]:
    """Each layer's name and constructor arguments."""
    described = []
    for layer in policy:
        name = type(layer).__name__
        if name not in LAYERS:
            raise TypeError(f"a policy cannot be saved with layer {name}; checkpoint.LAYERS has {', '.join(LAYERS)}")
        described.append([name, *(getattr(layer, attribute) for attribute in LAYERS[name][1])])
    return described
