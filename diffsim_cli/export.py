"""Export: a policy without its run, as a small checkpoint or as ONNX for other programs."""

from __future__ import annotations

import logging
import os
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch import nn

from diffsim.env import DiffEnv
from diffsim.robot.elements import control_range, servos
from diffsim.training.checkpoint import POLICY, SavedPolicy, load, write
from diffsim.training.errors import fail
from diffsim.training.layers import First, ObsNormalizer


def export_policy(path: str | os.PathLike[str], output: Path, half: bool = False) -> None:
    """Write what load_policy needs of a checkpoint: its policy and where that comes from, some hundred kB.

    half: weights are rounded to 16 bits.
    """
    state = load(path)
    if half:
        state["policy"]["weights"] = {name: w.half() for name, w in state["policy"]["weights"].items()}
        if wide := [name for name, w in state["policy"]["weights"].items() if not w.isfinite().all()]:
            fail(f"{path}: weight {wide[0]} of the policy is too large for 16 bits")
    write(
        output,
        {name: value for name, value in state.items() if name in {"format", "robot", "simulator", "task", *POLICY}},
    )


def export_onnx(saved: SavedPolicy, env: DiffEnv, output: Path) -> None:
    """Write the policy as ONNX, "observation" (batch, n) -> "action" (batch, nu), clipped to [-1, 1] as env does.

    n is how many columns the policy sees (Task.actor_dim). Some tasks have other inputs, see Task.program. `describe`
    says what all the numbers are.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  # torch.onnx needs it
    except ImportError:
        fail('ONNX needs packages that are not installed: pip install -e ".[onnx]"')
    layers, n = list(saved.network), env.task.obs_dim
    match layers:
        case [ObsNormalizer() as whole, First(columns=n), *others]:
            layers = [normalizer := ObsNormalizer(n), *others]
            normalizer.mean, normalizer.std = whole.mean[:n], whole.std[:n]
    policy_layers, program = nn.Sequential(*layers, nn.Hardtanh()), getattr(env.task, "program", None)
    module, shapes, outputs = policy_layers, {"observation": (n,)}, ["action"]
    if program is not None:  # a task whose policy needs other inputs
        module, shapes, outputs = program(policy_layers)
    policy = module.eval(), tuple(torch.zeros(2, *shape) for shape in shapes.values())
    names: dict[str, Any] = dict(input_names=[*shapes], output_names=outputs, verbose=False)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that there is no torchvision
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch, about its own code
        batch = ({0: torch.export.Dim("batch")},) * len(shapes)
        # Its optimizer takes the tiny number that keeps a root from 0 for 0.
        exported: Any = torch.onnx.export(*policy, dynamo=True, dynamic_shapes=batch, optimize=False, **names)
    model = exported.model_proto
    for node in model.graph.node:
        del node.metadata_props[:]  # paths of this machine
    onnx.helper.set_model_props(model, describe(saved, env, sum(shapes.get("observation", ()))))
    output.write_bytes(model.SerializeToString())


def describe(saved: SavedPolicy, env: DiffEnv, columns: int) -> dict[str, str]:
    """What a program needs to know that runs the policy, as an ONNX file's metadata.

    columns are those of the observation that it sees, 0 if it takes none.

    Keys and formats are mjlab's where it has one: lists are separated by commas, and joints are in the action's order.
    What does not hold for a task is left out.
    """
    task, m = env.task, env.scene.mj_model
    low, high = control_range(m)
    controls = zip(range(m.nu), low, high, strict=True)
    told = dict(task=task.name, script=saved.script, iteration=str(saved.iteration), control_dt=str(env.control_dt))
    told["actuators"] = joined(f"{m.actuator(a).name or a}[{least:.9g}:{most:.9g}]" for a, least, most in controls)
    if task.obs_parts and columns:
        seen = Counter([name for name, size in task.obs_parts for _ in range(size)][:columns])
        told |= dict(observation_names=joined(seen), observation_sizes=joined(seen.values()))
    if (m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT).all():
        told["joint_names"] = joined(m.joint(j).name for j in m.actuator_trnid[:, 0])
        if servos(m).all() and (m.actuator_gear[:, 0] == 1).all():
            told |= dict(joint_stiffness=joined(m.actuator_gainprm[:, 0]))
            told |= dict(joint_damping=joined(0.0 - m.actuator_biasprm[:, 2]))
        if "joint_stiffness" in told and columns:  # target = default_joint_pos + action_scale * action
            told |= dict(default_joint_pos=joined((low + high) / 2), action_scale=joined((high - low) / 2))
    return told | (task.metadata() if hasattr(task, "metadata") else {})


def joined(values: Iterable[object]) -> str:
    """Values as they are, numbers with 9 digits, separated by commas."""
    return ",".join(f"{value:.9g}" if isinstance(value, float) else str(value) for value in values)
