"""How well examples/identify.py finds masses, friction and damping in logs that MuJoCo makes with other values.

python benchmarks/identification.py path/to/mujoco_menagerie

Cases: the load of a KUKA iiwa, all of that arm's masses, centres and inertias, and a Go2 that walks by its policy. Each
number differs from the file's by a random factor, a centre of mass by some centimetres. Positions and velocities of the
log have noise of 1e-3. Writes identify.csv; errors are in percent of the true value, those of centres in mm.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import tyro
import worlds
from common import CommonFlags, Tasks, check_names, run
from tables import ROOT, grouped, markdown, numbers
from torch import Tensor

import diffsim
from diffsim import Scene, load_scene
from diffsim.parameters import ParametricSimulator
from diffsim.robot.elements import control_range
from diffsim.tasks.base import ASSETS
from diffsim.training import fail, load_policy
from diffsim.training.checkpoint import POLICIES

sys.path.append(str(ROOT / "examples"))
import identify  # noqa: E402

SECONDS, DT, EPISODES, NOISE = 5.0, 0.02, 8, 1e-3
CHANGE = 0.4  # standard deviation of the true values, as a part of the prior's
CASES = "load", "arm", "go2"


class Case(NamedTuple):
    """A robot and what is fitted."""

    file: Path
    fit: tuple[str, ...]
    only: tuple[str, ...] = ()
    policy: str = ""  # task whose policy drives the robot; else sines do


@dataclass
class Args(CommonFlags):
    folder: tyro.conf.Positional[Path] = Path()  # a clone of MuJoCo Menagerie
    cases: tuple[str, ...] = CASES
    env: tyro.conf.Suppress[Tasks] = ()
    draw_only: tyro.conf.Suppress[bool] = False  # there is nothing to draw

    def case(self, name: str) -> Case:
        arm = self.folder / "kuka_iiwa_14" / "scene.xml"
        return {
            "load": Case(arm, ("mass", "com"), ("link7",)),
            "arm": Case(arm, ("mass", "com", "inertia")),
            "go2": Case(ASSETS / "go2.xml", ("mass", "friction", "damping", "armature"), policy="go2"),
        }[name]


def write_log(path: Path, sim: ParametricSimulator, policy: str = "", seconds: float = SECONDS) -> None:
    """Let MuJoCo move robots with the simulator's parameters, and write what the docstring of identify.py says."""
    rng, scene, rows = np.random.default_rng(0), sim.scene, list[np.ndarray]()
    low, high = control_range(scene.mj_model)
    world = worlds.MuJoCo(scene, EPISODES, DT, own_friction=True)
    timestep, world.model = world.model.opt.timestep, sim.mj_model()
    world.model.opt.timestep = timestep

    def step(qpos: Tensor, qvel: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ctrl = low + (action.double().numpy() + 1) / 2 * (high - low)
        rows.append(np.concatenate((np.full((EPISODES, 1), len(rows) * DT), qpos, qvel, ctrl), axis=1))
        return world.step(qpos, qvel, action)

    if policy:
        env, network = diffsim.make(policy, EPISODES), load_policy(POLICIES / f"{policy}.pt").network
        start = worlds.starts(env, torch.float64)
        recorded: worlds.World = SimpleNamespace(step=step)  # type: ignore[assignment]
        for _ in worlds.rollout(recorded, worlds.in_double(env), network, start, round(seconds / DT)):
            pass
    else:
        qpos = torch.tensor(scene.qpos0).repeat(EPISODES, 1)
        qvel = torch.zeros(EPISODES, scene.nv, dtype=torch.float64)
        rate, phase = (torch.tensor(rng.uniform(0.5, most, (EPISODES, scene.nu))) for most in (6.0, 6.3))
        for k in range(round(seconds / DT)):
            qpos, qvel, _ = step(qpos, qvel, 0.4 * torch.sin(rate * k * DT + phase))
    table = np.array(rows).swapaxes(0, 1).reshape(-1, rows[0].shape[1])  # one robot after the other
    table[:, 1 : 1 + scene.nq + scene.nv] += rng.normal(0, NOISE, (len(table), scene.nq + scene.nv))
    counts = {"qpos": scene.nq, "qvel": scene.nv, "ctrl": scene.nu}
    header = ",".join(["time", *(f"{name}{k}" for name, count in counts.items() for k in range(count))])
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")


def measure(name: str, case: Case, log: Path) -> list[dict[str, object]]:
    scene: Scene = load_scene(case.file)
    sim = ParametricSimulator(scene, 1, diffsim.Integration("mujoco", 1), DT)
    unknowns = identify.Unknowns(sim, case.fit, case.only)
    true = CHANGE * torch.randn(len(unknowns.labels), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sim.parameters = unknowns.values(true)
    write_log(log, sim, case.policy)
    _, found, covariance, _ = identify.estimate(scene, identify.read_log(log, scene), case.fit, case.only)
    determined = int((torch.linalg.eigvalsh(covariance) < identify.KNOWN**2).sum())
    columns = [unknowns.numbers(x) for x in (0 * true, true, found)]
    rows = list[dict[str, object]]()
    for k, ((parameter, element), file, truth, fitted) in enumerate(zip(unknowns.labels, *columns, strict=True)):
        before, after = (
            1e3 * abs(x - truth) if parameter == "com" else 100 * abs(x / truth - 1) for x in (file, fitted)
        )
        row = {"case": name, "parameter": parameter, "element": element, "number": k, "file": file, "truth": truth}
        row |= {"fitted": fitted, "deviation": float(covariance[k, k].sqrt()), "error": after, "file's error": before}
        rows.append(row | {"determined": determined})
    return rows


def main(args: Args) -> None:
    check_names("--cases", args.cases, CASES)
    for name in args.cases:
        case = args.case(name)
        if not case.file.is_file():
            fail(f"no such file: {case.file}; MuJoCo Menagerie is at github.com/google-deepmind/mujoco_menagerie")
        with TemporaryDirectory() as folder:
            args.replace("identify", measure(name, case, Path(folder) / "log.csv"), ("case",))
    summary = []
    for (name, parameter), rows in grouped(args.read("identify"), "case", "parameter").items():
        before, after = (f"{median(numbers(rows, column)):.2g}" for column in ("file's error", "error"))
        known = sum(deviation < identify.KNOWN for deviation in numbers(rows, "deviation"))
        summary.append({"case": name, "parameter": parameter, "numbers": len(rows), "known alone": known})
        summary[-1] |= {"median error of the file": before, "of the fit": after}
    args.publish("identify", markdown(summary), "")


if __name__ == "__main__":
    run(main, Args, __doc__)
