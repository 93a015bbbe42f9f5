"""Checkpoints: one file that continues a run exactly, and from which any script's policy can be loaded."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import torch
from torch import nn

from diffsim.env import DiffEnv
from diffsim.training.errors import fail

FORMAT = 2
SCRIPTS = Path(__file__).resolve().parents[2]  # where the scripts lie: the repository's root


class Stateful(Protocol):
    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: Any) -> Any: ...


class Learner(Protocol):
    """What a script's algorithm shows to what surrounds it."""

    @property
    def modules(self) -> Mapping[str, Stateful]:
        """Everything, beside environments and random numbers, that the next iteration depends on."""

    @property
    def policy(self) -> nn.Module:
        """The deterministic policy: observations (..., obs_dim) -> actions (..., nu)."""


def save(path: Path, state: Mapping[str, Any]) -> None:
    """Replace the file in one step: whoever reads it finds the old one or the new one, whole."""
    temporary = path.with_suffix(".tmp")
    torch.save({"format": FORMAT, **state}, temporary)
    os.replace(temporary, path)


def load(path: Path, script: str | None = None) -> dict[str, Any]:
    """The checkpoint at path, of the given script if one is named; anything else ends the script."""
    if not path.is_file():
        fail(f"no such checkpoint: {path}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] == FORMAT and state["script"] == (script or state["script"]):
            return state
    except Exception:  # torch.load raises whatever broken bytes lead it to
        pass
    fail(f"{path} is not a whole checkpoint of {script or 'any'}.py" if script else f"{path} is not a whole checkpoint")


def load_learner(path: Path, env: DiffEnv) -> Learner:
    """The learner of any script's checkpoint, built for env (its device and sizes) with the checkpoint's weights."""
    state = load(path)
    script = _script(state["script"])
    args = script.Args(**state["args"])
    args.device = str(env.device)
    learner: Learner = getattr(script, state["learner"])(args, env)
    restore(learner, state)
    return learner


def restore(learner: Learner, state: Mapping[str, Any]) -> None:
    for name, module in learner.modules.items():
        module.load_state_dict(state["modules"][name])


def _script(name: str) -> ModuleType:
    """The module of a script, imported from its file once."""
    if name in sys.modules:
        return sys.modules[name]
    path = next((folder / f"{name}.py" for folder in (SCRIPTS, Path.cwd()) if (folder / f"{name}.py").is_file()), None)
    spec = importlib.util.spec_from_file_location(name, path) if path else None
    if spec is None or spec.loader is None:
        fail(f"{name}.py, which wrote the checkpoint, is neither in {SCRIPTS} nor in the working directory")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
