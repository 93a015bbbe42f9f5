"""Pictures and videos: what is drawn follows qpos and stands upright, videos play at true speed, mistakes are named."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import repeat
from pathlib import Path

import numpy as np
import pytest
import scenes
from learners import refusal
from numpy.typing import NDArray

from diffsim import Scene, load_scene
from diffsim.tasks.base import ASSETS
from diffsim_cli import render, view
from diffsim_cli.render import Renderer, film, save_video

Array = NDArray[np.float64]
HOPPER = load_scene(ASSETS / "hopper.xml")


def frames_of(scene: Scene, qpos: Array, *size: int, ctrl: Iterable[Array | None] = repeat(None)) -> np.ndarray:
    with Renderer(scene, *size) as renderer:
        return np.stack([*map(renderer.draw, qpos, ctrl)])


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
    with Renderer(HOPPER, 160, 120) as one, Renderer(HOPPER, 160, 120) as other:  # beside each other
        for renderer in (one, other):
            np.testing.assert_array_equal(renderer.draw(qpos[0]), frames[0])
        with pytest.raises(ValueError, match=r"shape \(5,\) into shape \(6,\)"):
            one.draw(np.zeros(5))


def test_quality_changes_no_content(opengl: None, monkeypatch: pytest.MonkeyPatch) -> None:
    full, fast = np.zeros((2, 112, 160, 3), int)
    for frame, where in ((full, "a GPU"), (fast, "llvmpipe")):
        monkeypatch.setattr(render, "check_opengl", lambda where=where: where)
        frame[:] = frames_of(HOPPER, np.zeros((1, 6)), 160, 112)[0]
    assert (fast != full).any() and (abs(fast - full).max(-1) > 60).mean() < 0.03  # edges alone


def test_a_robot_without_a_camera_is_followed(opengl: None) -> None:
    """It fills the picture whatever the size of its floor, and stays in the light where it leaves the file's lamp."""
    ball = scenes.parse(
        """<mujoco><worldbody>
          <geom type="plane" size="20 20 .1"/>
          <light pos="0 0 3"/>
          <body pos="0 0 0.2"><freejoint/><geom size="0.2" rgba="1 0 0 1"/></body>
        </worldbody></mujoco>"""
    )
    for frame in frames_of(ball, np.array([[x, 0, 0.2, 1, 0, 0, 0] for x in (0.0, 15.0)]), 64, 48).astype(int):
        rows = ((frame[..., 0] - frame[..., 2]) > 50).any(1)
        assert 15 < rows.sum() < 40 and frame[~rows].mean() > 70


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


# OpenGL that is not there ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", ["", "off"])
def test_missing_opengl_is_named_with_its_remedy(
    wanted: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    render.check_opengl.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", wanted)
    monkeypatch.setattr("mujoco.Renderer", lambda *_: 1 / 0)
    remedy = f"unset MUJOCO_GL={wanted}" if wanted else "apt install libegl1 libgl1 libgl1-mesa-dri"
    with pytest.raises(RuntimeError, match=f"no OpenGL to draw with: {remedy}"):
        Renderer(HOPPER, 8, 8)
    assert f"--video: no OpenGL to draw with: {remedy}" in refusal(lambda: view.main(["nowhere.pt"]), capsys)


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


def test_a_film_has_thirty_frames_a_second_or_more(opengl: None, tmp_path: Path) -> None:
    for dt, steps, frames, fps in ((1 / 60, 9, 5, 30.0), (1 / 50, 6, 6, 50.0), (1 / 25, 3, 3, 25.0)):
        video, rate = read_mp4(film(tmp_path / "film.mp4", HOPPER, np.zeros((steps, 6)), dt, size=(32, 16)))
        assert len(video) == frames and rate == fps and video.shape[1:] == (16, 32, 3)


def test_an_mp4_asked_for_is_written_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        save_video(tmp_path / "a.mp4", grey(0), 30)
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(OSError, match="folder.mp4"):
        save_video(tmp_path / "folder.mp4", grey(1), 30)
    monkeypatch.setattr("imageio_ffmpeg._io.get_ffmpeg_exe", lambda: "/bin/false")
    with pytest.raises(OSError, match="cannot write .*b.mp4"):
        save_video(tmp_path / "b.mp4", grey(1), 30)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.mp4"]


@pytest.mark.parametrize("name", ["go1", "go2", "g1"])
def test_robots_of_unitree_wear_meshes_that_are_not_simulated(name: str) -> None:
    scene = load_scene(ASSETS / f"{name}.xml")
    model = render.dressed(scene)
    assert model and model.nmesh > 10 and not scene.mj_model.nmesh
    assert (render.LOOKS / f"{name}.npz").stat().st_size < 400_000
    for field in ("jnt_type", "jnt_pos", "jnt_axis", "body_pos", "body_quat", "body_mass", "actuator_ctrlrange"):
        np.testing.assert_array_equal(getattr(model, field), getattr(scene.mj_model, field), field)


def test_a_plain_file_gets_our_floor_and_sky(tmp_path: Path) -> None:
    """One with textures keeps its own."""
    body = '<body pos="0 0 1"><freejoint/><geom size=".1"/></body>'
    (tmp_path / "plain.xml").write_text(
        f'<mujoco><worldbody><geom type="plane" size="0 0 1"/>{body}</worldbody></mujoco>'
    )
    model = render.dressed(scene := load_scene(tmp_path / "plain.xml"))
    assert model and model.ntex == 2 and model.geom_matid[0] == 0 and not scene.mj_model.ntex
    assert render.dressed(load_scene(ASSETS / "ant.xml")) is None
