"""What happens before the first step: kernels in threads, damaged caches, and what is written beside them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from learners import PATH

# Four threads that make the same environment and step it for the first time. Optimisation would take ten seconds.
THREADS = """
import threading, torch, warp
warp.config.optimization_level, warp.config.use_precompiled_headers = 0, False
import diffsim
torch.set_num_threads(1)
start, results = threading.Barrier(4), []

def first_steps():
    start.wait()
    env = diffsim.make("cartpole", 2, seed=0, threads=1, block=1)
    action = torch.full((2, 1), 0.3, requires_grad=True)
    results.append(torch.autograd.grad(env.step(action)[1].sum(), action)[0].tolist())

threads = [threading.Thread(target=first_steps) for _ in range(4)]
[thread.start() for thread in threads], [thread.join() for thread in threads]
assert len(results) == 4 and results == results[:1] * 4
print(results[0])
"""

# After which MuJoCo warns of a huge number.
DIVERGE = """
import mujoco
model = diffsim.make("cartpole").scene.mj_model
data = mujoco.MjData(model)
data.qpos[:] = 1e20
mujoco.mj_step(model, data)
"""


def run(program: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Where MUJOCO_GL names an OpenGL that may not be there: nothing is drawn."""
    environment = os.environ | PATH | {"MUJOCO_GL": "osmesa"} | environment
    folder = folder / "here"
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=True, timeout=120)


def test_threads_may_take_first_steps_and_a_damaged_cache_is_compiled_anew(tmp_path: Path) -> None:
    """Only a compilation is announced, and MuJoCo's warnings go to stderr instead of a file in the user's folder."""
    cache = {"WARP_CACHE_PATH": str(tmp_path / "kernels")}
    first = run(THREADS, tmp_path, **cache)
    assert first.stderr == "compiling kernels for cartpole (about 10 s, once for such a batch and options) ...\n"
    second = run(THREADS + DIVERGE, tmp_path, **cache)
    assert second.stdout == first.stdout and second.stdout.count("\n") == 1
    assert second.stderr.startswith("MuJoCo: Nan, Inf or huge value") and second.stderr.count("\n") == 1
    modules = sorted(tmp_path.glob("kernels/**/wp_*.o"))
    assert len(modules) == 2
    with modules[0].open("r+b") as file:  # of the same length: Warp would run it and crash
        file.seek(2000)
        file.write(bytes(4000))
    changed = run(THREADS, tmp_path, **cache)
    assert changed.stdout == first.stdout and changed.stderr == first.stderr
    assert run(THREADS, tmp_path, **cache).stderr == ""
    os.truncate(modules[0], 2000)
    modules[1].with_name(modules[1].name.partition(".")[0] + ".meta").write_text("{")
    again = run(THREADS, tmp_path, **cache)
    assert again.stdout == first.stdout and "compiling kernels for cartpole" in again.stderr
    assert not list((tmp_path / "here").iterdir())


def test_a_training_starts_without_pytorchs_compiler(tmp_path: Path) -> None:
    """It takes 1.2 s to import, and torch.optim would. Nor are the environments of evaluations made before they run."""
    program = """
import sys, shac
arguments = "--env cartpole --num-envs 2 --horizon 4 --iterations 2 --eval-episodes 2 --quiet"
shac.Run.eval_env, shac.Run.stop_after = None, 1
shac.main([*arguments.split(), "--device", "cpu", "--run-dir", "run"])
print([name for name in ("torch._dynamo", "sympy") if name in sys.modules])
"""
    assert run(program, tmp_path).stdout.splitlines()[-1] == "[]"
