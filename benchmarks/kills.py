"""Kill trainings at random moments, resume them, and compare their ends bit for bit with runs that were left alone.

python benchmarks/kills.py                           every script, five times, three kills each, on one thread
python benchmarks/kills.py --scripts shac sapo --times 2
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

ROOT = Path(__file__).resolve().parents[1]
COMMON = "--env cartpole --device cpu --threads 1 --eval-episodes 2 --quiet"
SMALL = "--num-envs 4 --horizon 16 --iterations 60"
FLAGS = {
    "shac": SMALL,
    "sapo": f"{SMALL} --population 2 --critic-iterations 4",
    "bptt": SMALL,
    "ppo_baseline": f"{SMALL} --minibatch-size 32",
    "pfpn": f"{SMALL} --minibatch-size 32",
    "sac_baseline": "--num-envs 4 --iterations 40 --steps 8 --seed-steps 16 --batch-size 32 --buffer-size 1000",
    "mbpo": "--num-envs 4 --iterations 20 --steps 8 --seed-steps 16 --batch-size 32 --updates 10 --model-updates 10",
    "pods": "--num-envs 4 --horizon 24 --iterations 40",
    "gps": "--horizon 30 --iterations 6 --restarts 4 --samples 10 --ilqr-iterations 20",
}


@dataclass
class Args:
    scripts: tuple[str, ...] = tuple(FLAGS)  # names of scripts, without .py
    times: int = 5  # runs of each
    kills: int = 3  # kills in each run
    seed: int = 1  # seed of the moments


def start(script: str, *arguments: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(ROOT / f"{script}.py"), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def finish(process: subprocess.Popen[bytes]) -> None:
    if process.wait():
        raise SystemExit(f"{process.args!r} ended with exit code {process.returncode}")


def same(a: Any, b: Any) -> bool:
    """Bitwise, whatever the nesting."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b) or (a != a and b != b)


def survives(script: str, folder: Path, whole: dict[str, Any], seconds: float, kills: int, rng: random.Random) -> bool:
    """Whether a run that is killed so often ends like the whole one, which took so many seconds."""
    checkpoint = folder / "checkpoint.pt"
    cadence = ["--save-every", rng.randint(1, 9), "--eval-every", rng.randint(0, 9)]

    def go_on() -> subprocess.Popen[bytes]:
        first = [*COMMON.split(), *FLAGS[script].split(), "--run-dir", folder]
        return start(script, *(["--resume", checkpoint] if checkpoint.exists() else first), *cadence)

    for _ in range(kills):
        process = go_on()
        time.sleep(rng.uniform(0.3, 1.0) * seconds)
        process.kill()
        process.wait()
        if checkpoint.exists() and torch.load(checkpoint, weights_only=True)["iteration"] == whole["iteration"]:
            break  # it was faster
    else:
        finish(go_on())
    end = torch.load(checkpoint, weights_only=True)
    return all(same(end[name], whole[name]) for name in ("modules", "ranks", "policy", "iteration", "control_steps"))


def main() -> None:
    args, failed = tyro.cli(Args, description=__doc__), 0
    rng = random.Random(args.seed)
    for script in args.scripts:
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            finish(start(script, *COMMON.split(), *FLAGS[script].split(), "--run-dir", Path(folder) / "whole"))
            seconds = time.perf_counter() - begin
            whole = torch.load(Path(folder) / "whole" / "checkpoint.pt", weights_only=True)
            ends = [survives(script, Path(folder) / str(k), whole, seconds, args.kills, rng) for k in range(args.times)]
        failed += ends.count(False)
        print(f"{script}: {ends.count(True)} of {len(ends)} runs end bitwise equal", flush=True)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
