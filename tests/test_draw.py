"""tools/draw.py: films that play in a loop, and the diagram of feet."""

from __future__ import annotations

from pathlib import Path

import draw
import numpy as np
import pytest
from PIL import Image, ImageSequence

from diffsim.training.checkpoint import POLICIES
from diffsim_robots.unitree import Go2


def test_a_loop_ends_where_it_begins() -> None:
    """Periods of 20 frames; the first side is disturbed before frame 10, the second from frame 50 on."""
    drawn, turn = np.random.default_rng(1), 2 * np.pi * np.arange(70) / 20
    shade = 100 + 50 * np.sin(turn[:, None, None, None] + drawn.uniform(0, 6, (16, 24, 3)))
    left, right = shade.copy(), shade.copy()
    left[:10], right[50:] = drawn.uniform(0, 255, (10, 16, 24, 3)), drawn.uniform(0, 255, (20, 16, 24, 3))
    sides = [[*left.astype(np.uint8)], [*right.astype(np.uint8)]]
    (one, other), length = draw.find_loop(sides, 15, 25, together=False)
    assert length == 20 and one >= 10 and other + 20 < 50
    begins, length = draw.find_loop(sides, 15, 25, together=True)
    assert length == 20 and begins[0] == begins[1] and 10 <= begins[0] < 30


def test_bars_show_which_feet_are_on_the_ground() -> None:
    """Of a Go2 that stands, then hangs in the air, then stands again; the line moves from left to right."""
    scene, task = Go2.load_robot(), Go2()
    qpos = np.tile(np.array(task.start[: scene.nq]), (9, 1))
    qpos[:, 2] -= 0.02  # its feet are in the ground
    qpos[3:6, 2] += 0.2
    pictures = draw.diagrams(scene, qpos, 236)
    assert [picture.shape for picture in pictures] == [(12 + 4 * draw.ROW, 236, 3)] * 9
    width = (236 - 8 - draw.LABELS) / 9
    for row in range(4):
        line = pictures[0][6 + draw.ROW * row + draw.ROW // 2]
        for k in range(1, 9):
            wanted = draw.PALE if 3 <= k < 6 else draw.INK
            assert tuple(line[round(draw.LABELS + width * (k + 0.5))]) == wanted
    assert all(tuple(picture[4, round(draw.LABELS + width * k)]) == (214, 60, 40) for k, picture in enumerate(pictures))


def test_webp_plays_at_true_speed_for_ever(tmp_path: Path) -> None:
    frames = [*np.random.default_rng(1).integers(0, 255, (30, 16, 32, 3), dtype=np.uint8)]  # none like the one before
    path = draw.save_webp(tmp_path / "film.webp", frames, 30.0)
    with Image.open(path) as film:
        shown = [(frame.load(), frame.info["duration"])[1] for frame in ImageSequence.Iterator(film)]
        assert film.info["loop"] == 0 and film.size == (32, 16)
    assert len(shown) == 30 and sum(shown) == 1000


@pytest.mark.slow
def test_films(opengl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one with a clock, both worlds above diagrams, and of one without, which MuJoCo cannot move; a clip."""
    monkeypatch.setattr(draw, "FIGURES", tmp_path)
    draw.films((POLICIES / "go2.pt",), size=(96, 64))
    draw.films((POLICIES / "humanoid_mtu.pt",), size=(96, 64))
    draw.films((POLICIES / "g1_track.pt",), size=(96, 64))
    with Image.open(tmp_path / "g1_track.webp") as dance:
        assert dance.size == (2 * 96, 64) and dance.n_frames == 25 * draw.DANCE[1]  # type: ignore[attr-defined]
    with Image.open(tmp_path / "go2.webp") as both, Image.open(tmp_path / "humanoid_mtu.webp") as one:
        assert both.size == (2 * 96, 64 + 12 + 4 * draw.ROW) and one.size == (96, 64)
        cycles = both.n_frames * Go2.control_dt * Go2.robot.cycle  # type: ignore[attr-defined]
        assert cycles == pytest.approx(round(cycles), abs=Go2.robot.cycle * Go2.control_dt)
        assert 4.0 * 30 <= one.n_frames <= 5.0 * 30  # type: ignore[attr-defined]
    draw.batch(POLICIES / "go2.pt", count=4, seconds=0.2, size=(96, 64))
    with Image.open(tmp_path / "go2_batch.webp") as many:
        assert many.size == (96, 64) and many.n_frames == 5  # type: ignore[attr-defined]


@pytest.mark.slow
def test_films_of_commands_and_of_a_training(
    opengl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(draw, "FIGURES", tmp_path)
    draw.commands(POLICIES / "go2.pt", size=(96, 64))
    assert ", whole" in capsys.readouterr().out
    draw.learning("cartpole", marks=(0.5, 1.0), seconds=0.5, size=(96, 64))
    with Image.open(tmp_path / "go2_commands.webp") as one, Image.open(tmp_path / "cartpole_learning.webp") as two:
        assert one.size == (96, 64) and one.n_frames == round(draw.END * 25)  # type: ignore[attr-defined]
        assert two.size == (2 * 96, 64) and two.n_frames == 15  # type: ignore[attr-defined]
