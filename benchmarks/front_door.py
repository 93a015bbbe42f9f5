"""How long a newcomer waits: from nothing to the ant's first frame, in a fresh environment with a fresh wheel.

    python benchmarks/front_door.py --torch torch==2.13.0 --update-results

Nothing of this clone is on the way: the wheel is built, uv makes an environment without its cache and installs what the
package needs, then the wheel; the commands run in an empty folder without compiled kernels. Writes front_door.csv:
seconds on the clock and of CPU, and whether they are this package's own.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import common
from common import ROOT
from tables import Row

# Tells when the first frame is drawn, on the clock that all processes share.
TIMED = """
import runpy, sys, time
from diffsim.view.render import Renderer
draw, drawn = Renderer.draw, []
def timed(*arguments):
    frame = draw(*arguments)
    if not drawn:
        drawn.append(print("first frame", time.monotonic(), time.process_time(), flush=True))
    return frame
Renderer.draw = timed
runpy.run_module("diffsim", run_name="__main__")
"""


@dataclass
class Args(common.CommonFlags):
    torch: str = "torch"  # which release of it is installed, as pip names it


def measure(torch: str, folder: Path) -> list[Row]:
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    clean |= {"WARP_CACHE_PATH": str(folder / "kernels"), "UV_CACHE_DIR": str(folder / "cache")}
    python, rows = str(folder / "env" / "bin" / "python"), list[Row]()

    def tell(part: str, own: bool, **seconds: float) -> None:
        cells = {name.replace("_", " "): value for name, value in seconds.items()}
        rows.append({"part": part, "own": own} | cells | {"load": os.getloadavg()[0]})
        print(rows[-1], flush=True)

    def timed(part: str, own: bool, *command: str) -> None:
        start, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        out = subprocess.run(command, cwd=folder, env=clean, check=True, stdout=subprocess.PIPE, text=True).stdout
        end, now = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        for line in out.splitlines():
            if line.startswith("first frame"):
                clock, cpu = map(float, line.split()[2:])
                tell(f"{part}: first frame", own, seconds=clock - start, cpu_seconds=cpu)
        cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
        tell(part, own, seconds=end - start, cpu_seconds=cpu)

    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT], check=True)
    install = "uv", "pip", "install", "-q", "--python", python
    timed("environment", False, "uv", "venv", "-q", "--python", sys.executable, "env")
    (wheel,) = map(str, folder.glob("*.whl"))
    timed("install, with all dependencies", False, *install, torch, wheel)
    timed("install, the wheel alone", True, *install, "--reinstall", "--no-deps", wheel)
    timed("demo ant", True, python, "-c", TIMED, "demo", "ant")
    timed("demo ant, again", True, python, "-c", TIMED, "demo", "ant")
    start, command = time.monotonic(), [str(folder / "env" / "bin" / "diffsim"), "drive", "ant", "--port", "0"]
    with subprocess.Popen(command, cwd=folder, env=clean, stdout=subprocess.PIPE, text=True) as driven:
        assert driven.stdout
        address = driven.stdout.readline().split()[0]
        with urlopen(f"{address}/stream") as stream:
            stream.read(2000)
        tell("drive ant: first picture", True, seconds=time.monotonic() - start)
        driven.terminate()
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    args = common.parse(Args, __doc__, argv)
    with tempfile.TemporaryDirectory() as folder:
        args.replace("front_door", measure(args.torch, Path(folder)), ("part",))


if __name__ == "__main__":
    main()
