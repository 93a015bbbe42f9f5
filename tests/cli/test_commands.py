"""python -m diffsim: the report, the demonstration, small copies of policies; and a start without noise."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from learners import PATH, ROOT, refusal

import diffsim
import shac
from diffsim import startup
from diffsim.training import load_policy
from diffsim_cli import commands as command
from diffsim_cli import render


@pytest.fixture
def trained(tiny_run):
    return tiny_run / "checkpoint.pt"


# The report -----------------------------------------------------------------------------------------------------------


def test_the_report_names_tasks_devices_versions_and_cache(capsys):
    command.main([])
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line for line in lines if line}
    assert rows["tasks"].split(maxsplit=1)[1].split(", ") == [*diffsim.TASKS] and "go2" in rows["policies"]
    assert f"torch {version('torch')}" in rows["versions"] and f"warp-lang {wp.__version__}" in rows["versions"]
    assert rows["devices"].split()[1] == "cpu," and str(wp.config.kernel_cache_dir) in rows["kernels"]
    assert max(map(len, lines)) < 160


def test_troubles_come_with_their_remedy(monkeypatch):
    def broken(*_: object) -> None:
        raise RuntimeError("no OpenGL: install it")

    monkeypatch.setattr(render, "check_opengl", broken)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", "/proc/nowhere")
    for driver, torch_sees, cuda, shown, hint in (
        (False, False, None, None, ""),
        (True, False, None, None, "! a driver, but no GPU for torch and Warp: torch is built for CUDA None, "),
        (True, False, "12.8", "7", "built for CUDA 12.8, CUDA_VISIBLE_DEVICES is 7; see nvidia-smi"),
        (True, True, "12.8", None, "! a driver, but no GPU for Warp: "),
    ):
        monkeypatch.setattr(startup, "nvidia_driver", lambda driver=driver: driver)
        monkeypatch.setattr(torch.cuda, "is_available", lambda sees=torch_sees: sees)
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        if shown:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
        *_, cache, opengl = command.report().splitlines()
        assert "set WARP_CACHE_PATH" in cache and opengl == "! no OpenGL: install it"
        assert hint in "".join(command.report().splitlines()[-3])


# Demonstration and export ---------------------------------------------------------------------------------------------


def test_a_demonstration_of_an_exported_policy(opengl, trained, tmp_path, monkeypatch, capsys):
    policy, video = tmp_path / "policies" / "cartpole.pt", tmp_path / "new" / "demo.mp4"
    monkeypatch.setattr(command, "POLICIES", policy.parent)
    monkeypatch.setattr(command, "DEMO_SECONDS", 0.1)
    monkeypatch.setattr(command, "DEMO_EPISODES", 2)
    command.main(["export", str(trained), str(policy)])
    assert "cartpole, shac.py, iteration 2, " in capsys.readouterr().out
    command.main(["demo", "cartpole", "--output", str(video)])
    assert video.stat().st_size > 1000
    assert f"video: {video}" in capsys.readouterr().out
    assert command.shipped_tasks() == ["cartpole"]


def test_a_learner_trains(tmp_path, monkeypatch):
    """From beside the package, as a clone has it, and from within, as a wheel."""
    flags = "--env cartpole --device cpu --iterations 1 --num-envs 4 --horizon 4 --eval-episodes 2 --quiet --run-dir"
    command.main(["train", "shac", *flags.split(), str(tmp_path / "run")])
    assert load_policy(tmp_path / "run" / "checkpoint.pt").script == "shac"
    for folder, code in (("learners", 7), ("learners/baselines", 8)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"own_{code}.py").write_text(f"raise SystemExit({code})\nmain = script(None)")
    monkeypatch.setattr(command, "PACKAGE", tmp_path)
    for code in 7, 8:
        with pytest.raises(SystemExit, match=str(code)):
            command.main(["train", f"own_{code}", "--env", "nothing"])


def test_a_script_of_the_current_folder_is_before_those_that_are_brought(tmp_path, monkeypatch, capsys):
    (tmp_path / "shac.py").write_text("import sys\nraise SystemExit(len(sys.argv))\nmain = script(None)")
    (tmp_path / "idea.py").write_text("raise SystemExit(7)\nmain = script(None)")
    (tmp_path / "other.py").write_text("raise SystemExit(9)")  # no learner
    monkeypatch.chdir(tmp_path)
    for learner, code in (("shac", 3), ("shac.py", 3), ("idea", 7)):
        with pytest.raises(SystemExit, match=str(code)):
            command.main(["train", learner, "--env", "nothing"])
    error = refusal(lambda: command.main(["train", "other"]), capsys)
    assert "unknown learner 'other': choose from bptt," in error
    assert error.endswith(", or a script of the current folder (idea, shac)")


def test_quick_kernels_are_of_their_time_alone():
    before = wp.config.optimization_level, wp.config.use_precompiled_headers
    with pytest.raises(KeyError), command.quick_kernels():
        assert (wp.config.optimization_level, wp.config.use_precompiled_headers) == (0, False)
        raise KeyError
    assert before == (wp.config.optimization_level, wp.config.use_precompiled_headers)


def test_an_export_is_the_policy_alone(trained, tmp_path, capsys):
    small = tmp_path / "small.pt"
    command.main(["export", str(trained), str(small)])
    assert small.stat().st_size < 0.5 * trained.stat().st_size
    before, after, obs = load_policy(trained), load_policy(small), torch.randn(3, 5)
    assert torch.equal(before.network(obs), after.network(obs))
    assert torch.equal(load_policy(trained.parent).network(obs), after.network(obs))  # by the folder of its run
    assert (before.args, before.script, before.iteration) == (after.args, after.script, after.iteration)
    torch.save(torch.load(trained, weights_only=True) | {"simulator": "another"}, tmp_path / "other.pt")
    command.main(["export", str(tmp_path / "other.pt"), str(small)])
    assert (after.simulator, load_policy(small).simulator) == ("diffsim", "another")
    assert "trained on cartpole, not on ant" in refusal(lambda: before.task("ant"), capsys)
    assert before.task("my_cart.py") == "my_cart.py"  # what a user names is a user's to name
    assert "holds only a policy" in refusal(lambda: shac.main(["--resume", str(small)]), capsys)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("demo nothing", "unknown task 'nothing': choose from cartpole, hopper"),
        ("demo hopper", "no policy for hopper is shipped; there are: none"),
        ("train nothing --env ant", "unknown learner 'nothing': choose from bptt, gps, mbpo"),
        ("train", "Missing from diffsim train: {{bptt,gps,"),
        ("check my_task.py", "my_task.py is code: check reads the MJCF file of the task's robot, its asset"),
        ("demo --nothing", "Unrecognized options: --nothing; For full helptext, run diffsim --help"),
        ("export {tmp}/nothing.pt {tmp}/new/out.pt", "no such checkpoint: {tmp}/nothing.pt"),
        ("export {trained} {trained}/out.pt", "File exists"),
        ("export {trained} /dev/null", "cannot write /dev/null: it is no regular file"),
        ("export {trained} {tmp}", "cannot write {tmp}: it is no regular file"),
    ],
)
def test_mistakes_are_one_line(arguments, message, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "POLICIES", tmp_path / "none")
    error = refusal(lambda: command.main(arguments.format(tmp=tmp_path, trained=trained).split()), capsys)
    assert error.startswith("diffsim: ") and message.format(tmp=tmp_path, trained=trained) in error


@pytest.mark.parametrize("program", [["-m", "diffsim"], ["shac.py", "--help"]])
def test_a_closed_pipe_is_no_error(program):
    """As of `python -m diffsim | head -3`."""
    options = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | PATH, cwd=ROOT)
    with subprocess.Popen([sys.executable, *program], **options) as process:
        assert process.stdout and process.stderr
        process.stdout.close()
        assert process.stderr.read() == b"" and process.wait() == 0


# The start ------------------------------------------------------------------------------------------------------------


def test_stderr_is_held_back_and_comes_back(capfd):
    with pytest.raises(OSError, match="why"), startup._silent():
        os.write(2, b"noise")
        raise OSError("why")
    os.write(2, b"and on")
    assert capfd.readouterr().err == "and on"


def test_a_cache_that_cannot_be_written_is_named(monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", "/proc/nowhere")
    with pytest.raises(ValueError, match="cannot write to Warp's kernel cache /proc/nowhere: set WARP_CACHE_PATH"):
        diffsim.make("cartpole", 1)


def test_an_import_changes_nothing_in_its_host():
    program = """
import signal, sys, threading
before = sys.excepthook, threading.excepthook, signal.getsignal(signal.SIGINT)
import diffsim, diffsim.training
assert before == (sys.excepthook, threading.excepthook, signal.getsignal(signal.SIGINT))
assert "diffsim_cli.render" not in sys.modules  # no training needs it
"""
    subprocess.run([sys.executable, "-c", program], check=True, env=os.environ | PATH)


def test_a_full_kernel_cache_is_named(monkeypatch, tmp_path):
    env = diffsim.make("cartpole", 1, substeps=1)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e6))
    with pytest.raises(startup.KernelCacheError, match=r"kernel cache /.*: set WARP_CACHE_PATH to .* \(No space left"):
        env.step(torch.zeros(1, 1))
