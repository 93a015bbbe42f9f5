"""Pictures: what is drawn follows qpos, stands upright, and mistakes are named."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import diffsim.tasks
from diffsim.render import render_frames, save_video
from diffsim.scene import load_scene

ASSETS = Path(diffsim.tasks.__file__).parent.parent / "assets"
HOPPER, MUSCLES = ASSETS / "hopper.xml", ASSETS / "humanoid_mtu.xml"


def draw(*args: object, **kwargs: object) -> np.ndarray:
    try:
        return render_frames(*args, **kwargs)  # type: ignore[arg-type]
    except RuntimeError as error:
        if "finds no OpenGL" not in str(error):
            raise
        pytest.skip(str(error))


def test_frames_show_the_configurations() -> None:
    qpos = np.zeros((3, 6))
    qpos[1, 3] = -1.0  # bend the thigh
    scene = load_scene(HOPPER)
    frames = draw(scene, qpos, width=160, height=120)
    assert frames.shape == (3, 120, 160, 3) and frames.dtype == np.uint8
    np.testing.assert_array_equal(frames[0], frames[2])
    assert (frames[0] != frames[1]).any(-1).sum() > 100
    red, _, blue = frames[0, 5].mean(0)
    assert blue > red + 20  # the sky is above
    foot = np.argwhere((frames[0, ..., 0] > 180) & (frames[0, ..., 2] < 100))  # the only orange part
    assert len(foot) > 50 and foot[:, 0].min() > 60
    np.testing.assert_array_equal(draw(HOPPER, qpos[:1], width=160, height=120)[0], frames[0])
    assert draw(scene, qpos[:1], width=2000, height=10).shape == (1, 10, 2000, 3)  # wider than the model's buffer


def test_muscles_are_coloured_by_activation() -> None:
    qpos = np.zeros((3, 29))
    qpos[:, [2, 3, 7, 12, 18, 23]] = 1.0  # height and quaternions
    ctrl = np.full((3, 152), -1.0)
    ctrl[1] = 1.0
    frames = draw(MUSCLES, qpos, width=160, height=120, ctrl=ctrl)
    np.testing.assert_array_equal(frames[0], frames[2])
    red, blue = (frames[:2, ..., k].astype(int) - frames[:2, ..., 2 - k] for k in (0, 2))
    assert ((red > 60).sum((1, 2)) > 100).tolist() == [False, True]
    assert (blue[0] - blue[1] > 60).sum() > 100
    with pytest.raises(ValueError, match=r"ctrl must have shape \(3, 152\), not \(3, 2\)"):
        render_frames(MUSCLES, qpos, ctrl=ctrl[:, :2])


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match=r"shape \(T, 6\), not \(6,\)"):
        render_frames(HOPPER, np.zeros(6))
    with pytest.raises(ValueError, match="no camera 'side' in this scene; it has: track"):
        render_frames(HOPPER, np.zeros((1, 6)), camera="side")
    with pytest.raises(ValueError, match="'.avi'"):
        save_video("a.avi", np.zeros((1, 4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="at least one frame"):
        save_video("a.gif", np.zeros((0, 4, 4, 3), np.uint8))


def test_without_a_library_of_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("MUJOCO_GL", "DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)  # its import fails
    with pytest.raises(RuntimeError, match="libegl1"):
        render_frames(HOPPER, np.zeros((1, 6)), width=8, height=8)


def test_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imageio = pytest.importorskip("imageio.v3")
    frames = np.zeros((60, 16, 16, 3), np.uint8)
    frames += np.arange(0, 240, 4, dtype=np.uint8)[:, None, None, None]
    path = save_video(tmp_path / "new" / "video.gif", frames, fps=60.0)
    read = imageio.imread(path)
    assert len(read) == 30  # every second frame
    np.testing.assert_array_equal(read[3, 0, 0], frames[6, 0, 0])
    assert imageio.immeta(path)["duration"] == pytest.approx(1000 / 30, abs=5)  # ms
    monkeypatch.setattr("diffsim.render.find_spec", lambda name: None if name == "imageio_ffmpeg" else object())
    assert save_video(tmp_path / "video.mp4", frames) == tmp_path / "video.gif"
    monkeypatch.setattr("diffsim.render.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="pip install"):
        save_video(tmp_path / "video.mp4", frames)
