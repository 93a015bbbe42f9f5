"""Which revisions train the same policies: hashes of policies after three iterations, and the chain of comparisons.

`python benchmarks/paper.py --same REVISION` compares a revision with this one on this machine; with --update-results
it adds a link to results/fingerprints.csv. A result counts while each link from its revision to the newest one keeps
the fingerprints that its training depends on, its learner's and those of its task, and while a preset that it was
trained with (--accuracy fast) is the same. A link that differs gives its --reason.
"""

from __future__ import annotations

import functools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import common
import tables
from tables import ROOT

from diffsim.training import fail
from diffsim_cli.commands import find_learners

CASES = {name: f"{name} --env hopper --num-envs 16" for name in find_learners()}  # small trainings
CASES |= {  # learners that need other flags
    "population": "sapo --env hopper --population 2 --num-envs 16",
    "pods": "pods --env cartpole --num-envs 16",
    "ppo_baseline": "ppo_baseline --env hopper --minibatch-size 512 --num-envs 16",
    "sac_baseline": "sac_baseline --env hopper --num-envs 16 --seed-steps 32",
    "mbpo": "mbpo --env hopper --num-envs 16 --seed-steps 16 --model-updates 4 --updates 4 --sample-enhance 1",
    "pfpn": "pfpn --env hopper --minibatch-size 512 --num-envs 16",
    "gps": "gps --env cartpole --samples 4 --guiding-samples 4 --active 8 --horizon 20 --ilqr-iterations 2",
    # the physics and the tasks
    "cartpole": "shac --env cartpole --num-envs 16",
    "half_cheetah": "shac --env half_cheetah --num-envs 16",
    "ant": "shac --env ant --num-envs 16",
    "humanoid": "shac --env humanoid --num-envs 16",
    "humanoid_mtu": "shac --env humanoid_mtu --num-envs 16",
    "sapo_humanoid_mtu": "sapo --env humanoid_mtu --num-envs 16",
    "humanoid_imitation": "shac --env humanoid_imitation --num-envs 16",
    "mujoco": "shac --env ant --contact mujoco --num-envs 16",
    "joystick": "shac --env go2 --num-envs 16",
    "fast": "shac --env half_cheetah --accuracy fast --num-envs 16",
}
SMALL = "--device {} --threads 1 --iterations 3 --eval-every 0 --eval-episodes 1 --quiet"
TRAIN_AND_HASH = """
import hashlib, runpy, sys, torch
del sys.argv[0]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as end:
    if end.code:
        raise
state = torch.load(f"{sys.argv[-1]}/checkpoint.pt", map_location="cpu", weights_only=False)
print(hashlib.sha256(b"".join(w.numpy().tobytes() for w in state["policy"]["weights"].values())).hexdigest()[:12])
"""  # in the process of the checkout, which knows what its checkpoint holds
COLUMNS = ("revision", "parent", "machine", "equal", "differ", "reason")


def depends(command: str) -> set[str]:
    """The fingerprints on which a training's numbers depend; its learner's, its task's, and those of its flags."""
    script, *flags = command.split()
    task = flags[flags.index("--env") + 1] if "--env" in flags else ""
    physics = {"hopper": "shac"} | dict.fromkeys(("go1", "go2", "g1"), "joystick")
    return {script, f"{script}_{task}", physics.get(task, task), *({"mujoco", "fast"} & {*flags})} & {*CASES}


def fingerprint(checkout: Path, name: str, device: str = "cpu") -> str:
    """The hash of a case's policy, trained by the scripts of a checkout; empty if they do not train it."""
    script, *flags = CASES[name].split()
    with TemporaryDirectory() as folder:
        words = [str(tables.script_of(script, checkout)), *flags, *SMALL.format(device).split(), "--run-dir", folder]
        call, paths = [sys.executable, "-c", TRAIN_AND_HASH, *words], {"PYTHONPATH": str(checkout)}
        done = subprocess.run(call, cwd=folder, env=os.environ | paths, capture_output=True, text=True)
    if done.returncode == 0:
        return done.stdout.split()[-1]
    print(f"{name} does not run in {checkout}: {(done.stderr.strip() or 'failed').splitlines()[-1]}", flush=True)
    return ""


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A revision in a git worktree of its own, for a while."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkout"
        call = ["git", "worktree", "add", "--detach", str(path), revision]
        if subprocess.run(call, cwd=ROOT, capture_output=True).returncode:
            fail(f"--same: no revision {revision} in this history")
        try:
            yield path
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(path)], cwd=ROOT, capture_output=True)


def compare(before: Path, after: Path, device: str = "cpu") -> dict[str, bool]:
    """Whether each case has one and the same policy in both checkouts. Two processes run side by side."""
    with ThreadPoolExecutor(2) as pool:
        both = [[pool.submit(fingerprint, checkout, name, device) for name in CASES] for checkout in (before, after)]
        found = {}
        for name, *hashes in zip(CASES, *both, strict=True):
            old, new = (each.result() for each in hashes)
            found[name] = bool(old) and old == new
            told = f"equal, {new}" if found[name] else f"{old or None} before, {new or None} now"
            print(f"{name}: {told}", flush=True)
    return found


# The chain -----------------------------------------------------------------------------------------------------------


def path() -> Path:
    return common.RESULTS / "fingerprints.csv"


def links() -> list[dict[str, str]]:
    return tables.read_csv(path())


@functools.cache
def same_files(revision: str, other: str, script: str = "") -> bool:
    """Whether what a script's trainings depend on is byte for byte the same in both; without a script, of every one.

    A revision that is not in history is the same as none.
    """
    scripts = (f"{script}.py", f"baselines/{script}.py") if script else (":(glob)*.py", "baselines", ":!view.py")
    paths = ":(glob)diffsim/**/*.py", ":(glob)diffsim_robots/**/*.py", "diffsim/assets", *scripts
    call = ["git", "diff", "--quiet", revision, other, "--", *paths]
    return subprocess.run(call, cwd=ROOT, stderr=subprocess.DEVNULL).returncode == 0


@functools.cache
def preset(revision: str, command: str) -> list[str]:
    """What a task's file sets for --accuracy fast at a revision: substeps, "implicit"; empty for another training."""
    if "--accuracy fast" not in command:
        return []
    words = command.split()
    call = ["git", "show", f"{revision}:diffsim/tasks/{words[words.index('--env') + 1]}.py"]
    lines = subprocess.run(call, cwd=ROOT, capture_output=True, text=True).stdout.splitlines()
    found = next((line for line in lines if line.strip().startswith("fast = ")), "")
    return sorted(re.findall(r"\d+|\bimplicit\b", found))


def counts(revision: str, command: str) -> bool:
    """Whether a result of a training there, a script with its flags, is one of the newest recorded revision."""
    if preset(revision, command) != preset("HEAD", command):
        return False
    script, names, at = command.split()[0], depends(command), ""
    for link in reversed(links()):
        if at and not same_files(link["revision"], at):
            return False
        if same_files(revision, link["revision"], script):
            return True
        if not names <= {*link["equal"].split()}:
            return False
        if same_files(revision, at := link["parent"], script):
            return True
    return False


def open_end() -> str:
    """What to run if nobody has compared HEAD with the newest recorded revision; empty if they are the same."""
    newest = links()[-1]["revision"] if links() else ""
    if newest and same_files(newest, "HEAD"):
        return ""
    last = f"the package or a script has changed since {newest}" if newest else "no revision is recorded"
    return f"{last}: python benchmarks/paper.py --same {newest or 'REVISION'} --update-results"


def record(args: common.CommonFlags, revision: str, reason: str) -> None:
    """Compare this revision with another one, and add the link to the chain if results are to be updated."""
    newest = links()[-1]["revision"] if links() else revision
    if args.update_results and not same_files(newest, revision):
        fail(f"the chain ends at {newest}: --same {newest}")
    if args.update_results and links() and not open_end():
        fail(f"nothing to record: what trainings depend on is as in {newest}")
    with checked_out(revision) as before:
        found = compare(before, ROOT, args.device)
    equal, differ = ([name for name in CASES if found[name] == which] for which in (True, False))
    print(f"{len(equal)} of {len(CASES)} are equal" + (f"; {', '.join(differ)} differ" if differ else ""))
    if args.update_results:
        if differ and not reason:
            fail("not recorded: a change that means to move numbers says why (--reason, and a line in CHANGELOG.md)")
        machine = tables.origin(args.device).removeprefix("# ").partition("; ")[0]
        values = tables.revision(), revision, machine, " ".join(equal), " ".join(differ), reason if differ else ""
        tables.replace_csv(path(), [dict(zip(COLUMNS, values, strict=True))], ("revision",), args.device)
