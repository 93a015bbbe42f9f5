"""The GPU against the CPU; kernels for a GPU are compiled without one."""

from __future__ import annotations

import copy
import dataclasses
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from scenes import SOFT, leg, parse, task_scene

import diffsim
from diffsim.kernels.backward import backward_kernel
from diffsim.kernels.forward import forward_kernel
from diffsim.kernels.thread.division import divide
from diffsim.kernels.thread.spec import kernel_spec
from diffsim.kernels.thread.wide import module_options
from diffsim.robot.constants import constrained
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import FACTORS
from diffsim.sim import simulator
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim_robots.terrain import rough

HORIZON = 32
KNEE = '<joint name="knee"'


def compiled(module: wp.Module, arch: int) -> str:
    """A module's source once it is compiled to PTX; both stay beside Warp's own cache, since that takes seconds."""
    wp.init()
    folder = Path(wp.config.kernel_cache_dir) / f"sm{arch}"
    result = folder / module.get_module_identifier()
    if not result.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder) as temporary:
            wp.compile_aot_module(module, device=None, arch=arch, module_dir=f"{temporary}/new", use_ptx=True)
            os.replace(f"{temporary}/new", result)
    assert any(path.stat().st_size > 10_000 for path in result.glob("*.ptx"))
    (source,) = result.glob("*.cu")
    return source.read_text()


@pytest.mark.slow  # half a minute; the constraints' kernels stay
def test_kernels_with_every_feature_compile_for_a_gpu_without_one() -> None:
    """A leg whose knee slides, too, in a fluid and on terrain, with factors and forces; threads share its limb."""
    text = leg(grounded=True).replace(KNEE, f'<joint type="slide" axis="0 0 1"/> {KNEE}')
    scene = dataclasses.replace(parse(text).with_terrain(rough(0)), density=1.0)
    kind = dict(implicit=True, env_last=True, varied=True, forced=True)
    spec = kernel_spec(scene, divide(scene, 8, 4), wp.float32, **kind)
    everything = "floating hinge slide ball contact terrain limit stiffness damping motor muscle drag"
    assert spec.features == {*everything.split()}
    for kernel in (forward_kernel(spec), backward_kernel(spec)):
        source = compiled(kernel.module, arch=90)
        for function in ("add_muscles", "place_balls", "nearest_of_each", "drag_wrench", "add_forces"):
            assert function in source, function


@pytest.mark.parametrize(
    "dtype, cone",
    [
        (wp.float64, mujoco.mjtCone.mjCONE_ELLIPTIC),
        pytest.param(wp.float32, mujoco.mjtCone.mjCONE_ELLIPTIC, marks=pytest.mark.slow),
        pytest.param(wp.float32, mujoco.mjtCone.mjCONE_PYRAMIDAL, marks=pytest.mark.slow),
    ],
)
def test_kernels_with_constraints_compile_for_a_gpu_without_one(dtype: type, cone: mujoco.mjtCone) -> None:
    model = copy.copy(task_scene("ant").mj_model)
    model.opt.cone = cone
    scene = constrained(load_scene(model), 1 / 240)
    spec = kernel_spec(scene, divide(scene, 4), dtype, implicit=False, env_last=True, varied=True, constrained=True)
    for kernel in (forward_kernel(spec), backward_kernel(spec)):
        compiled(kernel.module, arch=90)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("env_last", [False, True])
@pytest.mark.parametrize("hard", [False, True])
def test_fast_arithmetic_is_that_of_constraints_in_single_precision_on_a_gpu(
    dtype: type, env_last: bool, hard: bool
) -> None:
    soft = task_scene("ant")
    scene = constrained(soft, 1 / 240) if hard else soft
    spec = kernel_spec(scene, divide(scene), dtype, implicit=False, env_last=env_last, constrained=hard)
    fast = (dtype, env_last, hard) == (wp.float32, True, True)
    assert module_options(spec).get("fast_math", False) is fast
    for kernel in (forward_kernel(spec), backward_kernel(spec)):
        assert bool(kernel.module.options["fast_math"]) is fast


def episode(
    name: str, device: str, team: tuple[int, int] | None = None, integration: Integration | None = None
) -> dict[str, torch.Tensor]:
    """The state after 32 control steps of random actions, and the gradients of a random function of it.

    With `integration` every environment has factors, external forces and terrain of its own, else there are none.
    """
    n, kwargs = 8, dict(dtype=torch.float64)
    start = diffsim.make(name, num_envs=n, seed=0, **kwargs)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(HORIZON, n, start.scene.nu, generator=generator, **kwargs) * 2 - 1
    weights = [torch.randn(n, width, generator=generator, **kwargs) for width in (start.scene.nq, start.scene.nv)]
    parts = [start.qpos, start.qvel, actions]
    if integration:
        factors = torch.rand(n, len(FACTORS), generator=generator, **kwargs) + 0.5
        parts.append(torch.randn(n, start.scene.nbody, 6, generator=generator, **kwargs))
    inputs = [x.to(device).detach().requires_grad_() for x in parts]
    scene = start.scene
    if integration:
        scene = scene.with_terrain(np.stack([rough(seed, degrees=4.0, start=-2.5) for seed in range(n)]))
    kwargs |= dict(device=device, division=team, **dict.fromkeys(("factors", "forces"), integration is not None))
    sim = Simulator(scene, n, integration or start.sim.integration, start.control_dt, HORIZON, **kwargs)
    qpos, qvel, steps, *optional = inputs
    if integration:
        (sim.forces,) = optional
        sim.factors = factors.to(device)
    for action in steps:
        qpos, qvel = sim.step(qpos, qvel, action)
    assert not sim.nonfinite.any()
    loss = sum((w.to(device) * x).sum() for w, x in zip(weights, (qpos, qvel), strict=True))
    gradients = torch.autograd.grad(loss, inputs)
    names = ("qpos", "qvel", *(f"d{k}" for k in range(len(gradients))))
    return {k: x.detach().cpu() for k, x in zip(names, (qpos, qvel, *gradients), strict=True)}


@pytest.mark.gpu
@pytest.mark.parametrize(
    "name, integration",
    [(name, None) for name in SOFT]
    + [(name, Integration(implicit=True)) for name in ("ant", "humanoid_mtu")]
    + [("ant", Integration("mujoco", 4, tolerance=1e-12))],
)
def test_gpu_agrees_with_cpu(name: str, integration: Integration | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without factors, forces and terrain, and with them and the gradient in forces."""
    monkeypatch.setattr(simulator, "PASSES", 60)
    reference = episode(name, "cpu", integration=integration)
    for team in [(1, 1), (2, 1), (4, 1), (8, 4)]:
        ours = episode(name, "cuda", team, integration)
        for key, value in reference.items():
            error = (ours[key] - value).norm() / value.norm()
            assert error < (1e-9 if key in ("qpos", "qvel") else 1e-8), (team, key, error)
