"""Pictures and videos: what is drawn follows qpos and stands upright, videos play at true speed, mistakes are named."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from numpy.typing import ArrayLike

import diffsim.tasks
import shac
from diffsim import Scene, load_scene
from diffsim.training.evaluation import Evaluation
from diffsim.view import render
from diffsim.view.render import Renderer, film, save_video

ASSETS = Path(diffsim.tasks.__file__).parent.parent / "assets"
HOPPER = load_scene(ASSETS / "hopper.xml")


@pytest.fixture(scope="module")
def opengl() -> None:
    try:
        render.check_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))


def frames_of(scene: Scene, qpos: ArrayLike, *size: int, ctrl: ArrayLike | None = None, **options: Any) -> np.ndarray:
    with Renderer(scene, *size, **options) as renderer:
        return np.stack([*renderer.draw_all(qpos, ctrl)])


def grey(count: int, size: int = 16) -> Iterator[np.ndarray]:
    """Frames that become brighter by 2 each."""
    for k in range(count):
        yield np.full((size, size, 3), 2 * k, np.uint8)


def read_mp4(path: Path) -> tuple[np.ndarray, float]:
    """Frames and frames/s."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(path)
    meta = next(reader)
    width, height = meta["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]), meta["fps"]


# Pictures -------------------------------------------------------------------------------------------------------------


def test_frames_show_the_configurations(opengl: None) -> None:
    qpos = np.zeros((3, 6))
    qpos[1, 3] = -1.0  # bend the thigh
    frames = frames_of(HOPPER, qpos, 160, 120)
    assert frames.shape == (3, 120, 160, 3) and frames.dtype == np.uint8
    np.testing.assert_array_equal(frames[0], frames[2])
    assert (frames[0] != frames[1]).any(-1).sum() > 100
    red, _, blue = frames[0, 5].mean(0)
    assert blue > red + 20  # the sky is above
    foot = np.argwhere((frames[0, ..., 0] > 180) & (frames[0, ..., 2] < 100))  # the only orange part
    assert len(foot) > 50 and foot[:, 0].min() > 60
    assert frames_of(HOPPER, qpos[:1], 2000, 10).shape == (1, 10, 2000, 3)  # wider than the model's


def test_a_renderer_draws_again_and_again_beside_another(opengl: None) -> None:
    upright, bent = np.zeros(6), np.array([0, 0, 0, -1.0, 0, 0])
    with Renderer(HOPPER, 64, 48) as one, Renderer(HOPPER, 64, 48) as other:
        first = one.draw(upright)
        np.testing.assert_array_equal(other.draw(upright), first)
        assert (one.draw(bent) != first).any()
        np.testing.assert_array_equal(one.draw(upright), first)
        with pytest.raises(ValueError, match=r"qpos must have shape \(6,\), not \(5,\)"):
            one.draw(np.zeros(5))
    one.close()


def test_quality_changes_no_content(opengl: None) -> None:
    fast, full = (frames_of(HOPPER, np.zeros((1, 6)), 160, 112, fast=fast)[0].astype(int) for fast in (True, False))
    assert (abs(fast - full).max(-1) > 60).mean() < 0.03  # edges alone


def test_a_robot_without_a_camera_is_followed(opengl: None, tmp_path: Path) -> None:
    file = tmp_path / "ball.xml"
    file.write_text(scenes.BALL.replace('size="0.1"', 'size="0.3" rgba="1 0 0 1"'))
    for x in (0.0, 50.0):
        frame = frames_of(load_scene(file), [[x, 0, 1, 1, 0, 0, 0]], 64, 48)[0].astype(int)
        assert (frame[..., 0] - frame[..., 2] > 50).sum() > 50


def test_muscles_are_coloured_by_activation(opengl: None) -> None:
    qpos = np.zeros((3, 29))
    qpos[:, [2, 3, 7, 12, 18, 23]] = 1.0  # height and quaternions
    ctrl = np.full((3, 152), -1.0)
    ctrl[1] = 1.0
    muscles = load_scene(ASSETS / "humanoid_mtu.xml")
    frames = frames_of(muscles, qpos, 160, 120, ctrl=ctrl)
    np.testing.assert_array_equal(frames[0], frames[2])
    red, blue = (frames[:2, ..., k].astype(int) - frames[:2, ..., 2 - k] for k in (0, 2))
    assert ((red > 60).sum((1, 2)) > 100).tolist() == [False, True]
    assert (blue[0] - blue[1] > 60).sum() > 100
    with pytest.raises(ValueError, match=r"ctrl must have shape \(3, 152\), not \(3, 2\)"):
        frames_of(muscles, qpos, ctrl=ctrl[:, :2])


def test_mistakes_are_named(opengl: None) -> None:
    with pytest.raises(ValueError, match=r"shape \(6, 6\), not \(6,\)"):
        frames_of(HOPPER, np.zeros(6))
    with pytest.raises(ValueError, match="no camera 'side' in this scene; it has: track"):
        frames_of(HOPPER, np.zeros((1, 6)), camera="side")


# OpenGL that is not there ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="the ways of Linux")
@pytest.mark.parametrize(
    ("variables", "remedy"),
    [
        ({}, "apt install libegl1 libgl1 libgl1-mesa-dri"),
        ({"DISPLAY": ":77"}, "apt install libegl1"),
        ({"PYOPENGL_PLATFORM": "glx"}, "PYOPENGL_PLATFORM=glx excludes EGL: unset it"),
        ({"MUJOCO_GL": "osmesa"}, "MUJOCO_GL=osmesa, but OSMesa is not there: unset MUJOCO_GL, or apt install libosm"),
        ({"MUJOCO_GL": "glfw"}, "MUJOCO_GL=glfw, but no display is there: unset MUJOCO_GL"),
        ({"MUJOCO_GL": "glx", "DISPLAY": ":77"}, "MUJOCO_GL=glx, but no display is there: unset MUJOCO_GL"),
        ({"MUJOCO_GL": "off"}, "MUJOCO_GL=off forbids to draw: unset it"),
    ],
)
def test_missing_opengl_is_named_with_its_remedy(
    variables: dict[str, str], remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    for module in ("mujoco.egl", "mujoco.osmesa"):
        monkeypatch.setitem(sys.modules, module, None)  # its import fails
    with pytest.raises(RuntimeError) as error:
        Renderer(HOPPER, 8, 8)
    assert remedy in str(error.value) and "\n" not in str(error.value)


def test_capture_video_fails_before_the_training_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["shac.py"])
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(SystemExit) as exit:
        shac.main(["--env", "cartpole", "--capture-video", "--run-dir", str(tmp_path / "run")])
    line = "shac.py: --capture-video: MUJOCO_GL=off forbids to draw: unset it\n"
    assert exit.value.code == 2 and capsys.readouterr() == ("", line) and not (tmp_path / "run").exists()


# Videos ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fps", [60.0, 25.0])
def test_an_mp4_plays_at_true_speed(fps: float, tmp_path: Path) -> None:
    path = save_video(tmp_path / "new" / "video.mp4", grey(90), fps)
    frames, rate = read_mp4(path)
    assert path.suffix == ".mp4" and len(frames) == 90 and rate == fps
    assert abs(frames.mean((1, 2, 3)) - 2 * np.arange(90)).max() < 3


@pytest.mark.parametrize(("fps", "kept"), [(60.0, 30), (50.0, 60), (33.0, 60), (120.0, 20)])
def test_a_gif_plays_at_true_speed(fps: float, kept: int, tmp_path: Path) -> None:
    from PIL import Image, ImageSequence

    with Image.open(save_video(tmp_path / "video.gif", grey(60), fps)) as gif:
        delays, levels = zip(
            *((f.info["duration"], np.asarray(f.convert("RGB")).mean()) for f in ImageSequence.Iterator(gif)),
            strict=True,
        )
    assert len(delays) == kept and min(delays) >= 20  # browsers slow down what is faster
    assert sum(delays) / 1000 == pytest.approx(60 / fps, abs=0.011)  # the last one has the delay of the one before
    # Whenever one looks, the frame is that of the time, to within half a hundredth of a second.
    starts = np.cumsum((0, *delays[:-1])) / 1000
    assert abs(np.array(levels) / 2 / fps - starts).max() < 0.006


def test_a_film_is_drawn_at_most_thirty_times_a_second(opengl: None, tmp_path: Path) -> None:
    for dt, steps, frames, fps in ((1 / 60, 9, 5, 30.0), (1 / 50, 6, 3, 25.0), (1 / 25, 3, 3, 25.0)):
        video, rate = read_mp4(film(tmp_path / "film.mp4", HOPPER, np.zeros((steps, 6)), dt, size=(32, 16)))
        assert len(video) == frames and rate == fps and video.shape[1:] == (16, 32, 3)


def test_ten_seconds_of_the_median_episode_are_filmed() -> None:
    qpos = torch.arange(3.0).reshape(1, 3, 1) + torch.zeros(1000, 3, 1)
    lengths = torch.tensor([1000, 700, 1000])
    evaluation = Evaluation(torch.tensor([5.0, 1.0, 3.0]), lengths, None, qpos, qpos, HOPPER, 1 / 60)
    shown, action = evaluation.median_episode()
    assert shown.shape == action.shape == (600, 1) and (shown == 2).all()
    evaluation.lengths[2] = 40
    assert len(evaluation.median_episode()[0]) == 40 and len(evaluation.median_episode(0.5)[0]) == 30


def test_an_mp4_asked_for_is_written_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="'.avi'"):
        save_video(tmp_path / "a.avi", grey(1), 30)
    with pytest.raises(ValueError, match="at least one frame"):
        save_video(tmp_path / "a.mp4", grey(0), 30)
    with pytest.raises(ValueError, match="multiples of 16; 20 x 20 are not"):
        save_video(tmp_path / "a.mp4", grey(1, 20), 30)
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(OSError, match="folder.mp4"):
        save_video(tmp_path / "folder.mp4", grey(1), 30)
    for program in ("/bin/false", "/nowhere/ffmpeg"):
        monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda program=program: program)
        with pytest.raises(OSError, match="cannot write .*b.mp4"):
            save_video(tmp_path / "b.mp4", grey(1), 30)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # its import fails
    with pytest.raises(RuntimeError, match="pip install --force-reinstall imageio-ffmpeg"):
        save_video(tmp_path / "c.mp4", grey(1), 30)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.mp4"]
