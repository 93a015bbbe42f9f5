"""What happens before the first step: kernels in threads, damaged caches, and what is written beside them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Four threads that make the same environment and step it for the first time. Optimisation would take ten seconds.
THREADS = """
import threading, torch, warp
warp.config.optimization_level = 0
import diffsim
torch.set_num_threads(1)
start, results = threading.Barrier(4), []

def first_steps():
    start.wait()
    env = diffsim.make("cartpole", 2, seed=0, threads=1)
    action = torch.full((2, 1), 0.3, requires_grad=True)
    results.append(torch.autograd.grad(env.step(action)[1].sum(), action)[0].tolist())

threads = [threading.Thread(target=first_steps) for _ in range(4)]
[thread.start() for thread in threads], [thread.join() for thread in threads]
assert len(results) == 4 and results == results[:1] * 4
print(results[0])
"""


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(folder / "kernels")}
    folder = folder / "here"
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=True, timeout=120)


def test_threads_may_take_first_steps_and_a_damaged_cache_is_compiled_anew(tmp_path: Path) -> None:
    first = run(THREADS, tmp_path)
    assert first.stderr == "compiling kernels for cartpole (once, about 10 s) ...\n"
    assert run(THREADS, tmp_path).stdout == first.stdout
    modules = sorted(tmp_path.glob("kernels/**/wp_*.o"))
    assert len(modules) == 2
    os.truncate(modules[0], 2000)
    modules[1].with_name(modules[1].name.partition(".")[0] + ".meta").write_text("{")
    again = run(THREADS, tmp_path)
    assert again.stdout == first.stdout and "compiling kernels for cartpole" in again.stderr


def test_mujocos_warnings_leave_no_file(tmp_path: Path) -> None:
    mujocos_warning = """
import diffsim, mujoco
model = diffsim.load_scene(f"{diffsim.__path__[0]}/assets/cartpole.xml").mj_model
data = mujoco.MjData(model)
data.qpos[:] = 1e20
mujoco.mj_step(model, data)
"""
    result = run(mujocos_warning, tmp_path)
    assert "MuJoCo: Nan, Inf or huge value" in result.stderr
    assert not list((tmp_path / "here").iterdir())


def test_a_training_starts_without_pytorchs_compiler(tmp_path: Path) -> None:
    """It takes 1.2 s to import, and torch.optim would. Nor are the environments of evaluations made before they run."""
    program = """
import gc, sys, shac, warp
warp.config.optimization_level = 0
assert gc.isenabled()
arguments = "--env cartpole --num-envs 2 --horizon 4 --iterations 2 --stop-after 1 --eval-episodes 2 --quiet"
shac.Run.eval_env = None
shac.main([*arguments.split(), "--device", "cpu", "--run-dir", "run"])
print([name for name in ("torch._dynamo", "sympy") if name in sys.modules])
"""
    assert run(program, tmp_path).stdout.splitlines()[-1] == "[]"
