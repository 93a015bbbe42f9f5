"""The GPU against the CPU, a captured graph against the same operations run one by one."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
import torch
import warp as wp
from scenes import task_scene

import bptt
import diffsim
import ppo_baseline
import shac
from diffsim import graph
from diffsim.kernels.backward import backward_kernel
from diffsim.kernels.forward import forward_kernel
from diffsim.kernels.lanes import divide
from diffsim.kernels.spec import kernel_spec
from diffsim.launcher import default_division
from diffsim.simulator import Simulator

cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU, and PyTorch sees none")
HORIZON = 32


@pytest.mark.parametrize("name", diffsim.TASKS)
def test_kernels_compile_for_a_gpu_without_one(name: str, tmp_path: Path) -> None:
    """And they hold no code for what the scene lacks."""
    scene = task_scene(name)
    spec = kernel_spec(scene, default_division(scene, 64), wp.float32, implicit=False, env_last=True)
    functions = {"add_pull": "muscle", "measure": "hill", "place_balls": "ball", "sphere_state": "contact"}
    functions["drag_wrench"] = "drag"
    for kernel in (forward_kernel(spec), backward_kernel(spec)):
        directory = tmp_path / kernel.key
        wp.compile_aot_module(kernel.module, device=None, arch=90, module_dir=directory, strip_hash=True)
        assert any(path.stat().st_size > 10_000 for path in (*directory.glob("*.cubin"), *directory.glob("*.ptx")))
        (source,) = directory.glob("*.cu")
        code = source.read_text()
        for function, feature in functions.items():
            assert (function in code) == (feature in scene.features), function


def episode(name: str, device: str, team: tuple[int, int] | None = None) -> dict[str, torch.Tensor]:
    """The state after 32 control steps of random actions, and the gradients of a random function of it."""
    n, kwargs = 8, dict(dtype=torch.float64)
    start = diffsim.make(name, num_envs=n, seed=0, **kwargs)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(HORIZON, n, start.scene.nu, generator=generator, **kwargs) * 2 - 1
    weights = [torch.randn(n, width, generator=generator, **kwargs) for width in (start.scene.nq, start.scene.nv)]
    inputs = [x.to(device).detach().requires_grad_() for x in (start.qpos, start.qvel, actions)]
    division = divide(start.scene, *team) if team else None
    kwargs |= dict(device=device, division=division)
    sim = Simulator(start.scene, n, start.sim.integration, start.control_dt, HORIZON, **kwargs)
    qpos, qvel, steps = inputs
    for action in steps:
        qpos, qvel = sim.step(qpos, qvel, action)
    assert not sim.nonfinite.any()
    loss = sum((w.to(device) * x).sum() for w, x in zip(weights, (qpos, qvel), strict=True))
    gradients = torch.autograd.grad(loss, inputs)
    return {
        k: x.detach().cpu() for k, x in zip(("qpos", "qvel", "d0", "d1", "d2"), (qpos, qvel, *gradients), strict=True)
    }


@pytest.mark.gpu
@cuda
@pytest.mark.parametrize("name", diffsim.TASKS)
def test_gpu_agrees_with_cpu(name: str) -> None:
    reference = episode(name, "cpu")
    for team in [(1, 1), (2, 1), (4, 1), (8, 4)]:
        ours = episode(name, "cuda", team)
        for key, tolerance in (("qpos", 1e-9), ("qvel", 1e-9), ("d0", 1e-8), ("d1", 1e-8), ("d2", 1e-8)):
            error = (ours[key] - reference[key]).norm() / reference[key].norm()
            assert error < tolerance, (team, key, error)


def windows(name: str, captured: bool, poison: int | None = None) -> list[torch.Tensor]:
    """Rewards, their gradient and the state of six windows; one environment is thrown out of the finite numbers."""
    torch.manual_seed(0)
    env = diffsim.make(name, num_envs=16, seed=0, horizon=8, device="cuda")
    action = torch.zeros(8, 16, env.scene.nu, device="cuda", requires_grad=True)
    velocity = torch.zeros_like(env.qvel)

    def window() -> tuple[torch.Tensor, ...]:
        env.detach()
        env.qvel = env.qvel + velocity
        noise = torch.rand_like(action) * 2 - 1
        results = [env.step(a) for a in (action + noise).unbind()]
        rewards, ended = torch.stack([r[1] for r in results]), torch.stack([r[4]["nonfinite"] for r in results])
        (gradient,) = torch.autograd.grad(rewards.sum(), action)
        return rewards.detach(), gradient, env.qpos.detach(), ended

    call = graph.capture(window, "cuda", env) if captured else window
    history = []
    for k in range(6):
        velocity.zero_()
        if k == 4 and poison is not None:
            velocity[poison] = torch.inf
        history.append([x.clone() for x in call()])
    return [torch.stack(column) for column in zip(*history, strict=True)]


@pytest.mark.gpu
@cuda
@pytest.mark.parametrize("name", ["cartpole", "ant"])
def test_graph_and_eager_agree(name: str) -> None:
    """Bitwise, noise and random start states included: each replay draws the numbers that an eager call would."""
    for captured, eager in zip(windows(name, True), windows(name, False), strict=True):
        assert torch.equal(captured, eager)
    rewards = windows(name, True)[0]
    assert not torch.equal(rewards[4], rewards[5])


@pytest.mark.gpu
@cuda
def test_a_graph_contains_what_is_not_finite() -> None:
    bad, good = 3, [k for k in range(16) if k != 3]
    clean, poisoned = windows("ant", True), windows("ant", True, poison=bad)
    assert poisoned[3][4, 0, bad] and poisoned[3].sum() == 1 and not clean[3].any()
    for ours, expected in zip(poisoned[:2], clean[:2], strict=True):
        assert torch.equal(ours[:, :, good], expected[:, :, good]) and ours.isfinite().all()
    assert (poisoned[1][4, 0, bad] == 0).all()


@pytest.mark.gpu
@cuda
@pytest.mark.parametrize("learner", [shac, bptt, ppo_baseline])
@pytest.mark.parametrize("eager", [[], ["--no-cuda-graph"]])
def test_same_seed_same_weights_on_a_gpu(tmp_path: Path, learner: ModuleType, eager: list[str]) -> None:
    checkpoints = []
    for run in ("a", "b"):
        arguments = "--env cartpole --num-envs 8 --iterations 12 --eval-every 5 --eval-episodes 2 --quiet".split()
        learner.main([*arguments, "--device", "cuda", "--run-dir", str(tmp_path / run), *eager])
        checkpoints.append(torch.load(tmp_path / run / "checkpoint.pt", weights_only=True, map_location="cpu"))
    for part in {"actor", "critic", "target", "policy", "normalise"} & checkpoints[0].keys():
        for name, value in checkpoints[0][part].items():
            assert torch.equal(checkpoints[1][part][name], value), (part, name)
