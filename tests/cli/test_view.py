"""script.py: videos of a run; mistakes and full disks are one line and leave no file."""

from __future__ import annotations

import functools
import resource
from pathlib import Path

import pytest
import torch
from learners import refusal

from diffsim.training import load_policy
from diffsim_cli import commands as command
from diffsim_cli import view
from diffsim_cli.watch import make_policy_env


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_video_of_a_run(name, opengl, tiny_run, tmp_path, capsys):
    path = tmp_path / name
    options = ["--seconds", "0.5", "--episodes", "3", "--size", "64", "48", "--substeps", "2"]
    view.main([str(tiny_run / "checkpoint.pt"), "--video", str(path), *options])
    assert path.stat().st_size > 1000
    printed = capsys.readouterr().out
    assert "cartpole, shac.py, iteration 2, 3 episodes: return median" in printed
    assert str(path) in printed


def test_substeps_are_those_of_the_training_unless_given(tiny_run):
    saved = load_policy(str(tiny_run / "checkpoint.pt"))
    assert make_policy_env(saved, 1).sim.integration.substeps == saved.args["substeps"]
    assert make_policy_env(saved, 1, substeps=7).sim.integration.substeps == 7


@pytest.mark.parametrize("words", ["view --video x.mp4", "drive ant --port 0 --checkpoint", "export x.onnx"])
def test_a_checkpoint_names_no_code_to_run(words, tmp_path, monkeypatch, capsys):
    """A file that a policy's env names is run only where the command line names it, too."""
    monkeypatch.chdir(tmp_path)
    state = torch.load(command.shipped("ant"), weights_only=True)
    torch.save(state | {"args": state["args"] | {"env": "task.py"}}, "policy.pt")
    code = 'open("ran", "w").close()\nfrom diffsim.tasks.ant import Ant\nclass Own(Ant): name = "own"'
    Path("task.py").write_text(code)
    name, *flags = words.split()
    given = [*flags, "policy.pt"] if name != "export" else ["policy.pt", *flags]
    call = functools.partial(view.main, given) if name == "view" else functools.partial(command.main, [name, *given])
    assert refusal(call, capsys).endswith(
        "of your own task, whose code runs only if you name its file: add --env task.py, or give drive the file in "
        "place of the robot"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.pt", "task.py"]
    with pytest.raises(ValueError, match="add --env task.py"):
        make_policy_env(load_policy("policy.pt"), 1)
    command.main(["export", "policy.pt", "alone.pt"])  # which needs no task
    assert not Path("ran").exists() and make_policy_env(load_policy("alone.pt"), 1, env="task.py").task.name == "own"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("{new}/nothing.pt --video {new}/a.mp4", "no such checkpoint: {new}/nothing.pt"),
        ("{run}/progress.csv --video {new}/a.mp4", "{run}/progress.csv is not a complete checkpoint"),
        ("{run} --video {new}/a.avi", "--video: a video ends in .mp4 or .gif, not '.avi'"),
        ("{run} --video {new}/a.mp4 --size 100000 100000", "1 to 4096 pixels, not 100000 x 100000"),
        ("{run} --video {new}/a.mp4 --size 100 100", "--video: width and height of an .mp4 are multiples of 16"),
        ("{run} --video {new}/a.mp4 --seconds 0", "--seconds, --episodes, --substeps and --size must be positive"),
        ("{run} --episodes 3 --video {run}/progress.csv/a.mp4", "File exists"),
    ],
)
def test_mistakes_are_one_line(arguments, message, tiny_run, tmp_path, capsys):
    places = {"run": tiny_run, "new": tmp_path}
    words = arguments.format(**places).split()
    assert message.format(**places) in refusal(lambda: view.main(words), capsys, silent=False)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize("flags", ["--video {0}/a.mp4", "--video {0}/a.gif"])
def test_a_full_disk_is_one_line_and_leaves_what_was_there(opengl, flags, tiny_run, tmp_path, capsys):
    path = Path(flags.format(tmp_path).split()[1])
    path.write_text("an older file")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, hard))
        options = [*"--episodes 3 --seconds 0.5 --size 64 48".split(), *flags.format(tmp_path).split()]
        error = refusal(lambda: view.main([str(tiny_run), *options]), capsys, silent=False)
        assert error.startswith(f"script.py: cannot write {path}: ")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_text() == "an older file" and [*tmp_path.iterdir()] == [path]
