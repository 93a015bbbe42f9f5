"""Time a reader's first minutes: from a clone to a film of a trained ant and an own trained cart-pole.

    python tools/first_minutes.py

Everything starts from nothing: a clone of the last commit, a new environment, no packages of pip's cache, no compiled
kernels. Downloads count. Writes results/cpu/first_minutes.csv.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import tables
from tables import ROOT

COMMANDS = (
    "python -m venv .venv",
    "pip install -e .",
    "python -m diffsim demo ant",
    "python shac.py --env cartpole --seed 1",
)


def main() -> None:
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as directory:
        clone = Path(directory) / "diffsim"
        subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
        variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        variables["PATH"] = f"{clone / '.venv' / 'bin'}{os.pathsep}{variables['PATH']}"
        variables |= {"PIP_NO_CACHE_DIR": "1", "WARP_CACHE_PATH": str(Path(directory) / "kernels")}
        total = 0
        for command in COMMANDS:
            load, start = os.getloadavg()[0], time.perf_counter()
            subprocess.run(command.split(), cwd=clone, env=variables, check=True)
            seconds = round(time.perf_counter() - start)
            total += seconds
            rows.append({"command": command, "seconds": seconds, "in all": total, "load before": f"{load:.1f}"})
    tables.write_csv(ROOT / "results" / "cpu" / "first_minutes.csv", rows)
    print(tables.markdown(rows))


if __name__ == "__main__":
    main()
