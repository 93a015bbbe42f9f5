"""Terrains by their names, and drawn from a kind."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import task_scene

from diffsim.planning.terrains import named_terrains, random_terrain
from diffsim.robot.scene import TerrainError
from diffsim.terrain import Elevation, incline, rough, step


def test_terrains_by_their_names():
    for name, profile in (
        ("level", incline(0.0)),
        ("incline:-10", incline(-10.0)),
        ("incline:5:1.4", incline(5.0, start=1.4)),
        ("step:-5", step(-0.05)),
        ("step:2:0.7", step(0.02, start=0.7)),
        ("rough:8", rough(0, degrees=8.0)),
        ("rough:8:2", rough(0, 2.0, 8.0)),
        ("rough:8:2:7:0.5", rough(7, 2.0, 8.0, start=0.5)),
    ):
        np.testing.assert_array_equal(named_terrains(name), profile[None])
    for name in ("hill", "level:1", "incline", "incline:1:2:3", "step", "rough", "rough:1:2:3:4:5", ""):
        with pytest.raises(TerrainError, match="must be level, incline:DEGREES"):
            named_terrains("level", name)
    for name, message in (
        ("incline:95", "'incline:95': degrees is 95.0"),
        ("step:0", "height is 0.0"),
        ("rough:ten", "could not convert string to float: 'ten'"),
        ("rough:10:1:-1", "'rough:10:1:-1': seed is -1.0, must be an integer of at least 0"),
        ("rough:10:1:inf", "'rough:10:1:inf': seed is inf, must be an integer of at least 0"),
        ("rough:10:1e-7", "'rough:10:1e-7': length is 50.0, must be 1 to 10000 segments of 1e-07"),
    ):
        with pytest.raises(TerrainError, match=message):
            named_terrains(name)
    with pytest.raises(TerrainError, match="a terrain is missing: level, incline:DEGREES"):
        named_terrains()


def test_terrains_in_one_array_keep_their_heights():
    names = "incline:10", "step:-30", "rough:10:25"
    stacked, x = named_terrains(*names), np.linspace(-2.0, 60.0, 200)
    assert stacked.shape == (3, 5, 2)
    qpos = torch.zeros(len(x), 6).double()
    qpos[:, 0] = torch.tensor(x)
    for name, profile in zip(names, stacked, strict=True):
        scenes = (task_scene("hopper").with_terrain(vertices) for vertices in (named_terrains(name), profile))
        one, two = (Elevation(scene, "cpu", torch.float64).height(qpos) for scene in scenes)
        torch.testing.assert_close(one, two)
        assert one.abs().max() > 0.25


def test_random_terrains_are_of_their_kind():
    """Uniform in both directions up to the size; each begins at its own place, and rough ground has its own seed."""
    rng = torch.Generator().manual_seed(1)
    for kind in ("incline:10", "step:5"):
        names = [random_terrain(kind, rng).split(":") for _ in range(200)]
        assert {name for name, _, _ in names} == {kind.split(":")[0]}
        sizes, starts = (np.array([float(name[i]) for name in names]) for i in (1, 2))
        sizes /= float(kind.split(":")[1])
        assert -1 < sizes.min() < -0.9 and 0.9 < sizes.max() < 1 and abs(sizes.mean()) < 0.2
        assert 0.5 < starts.min() < 0.55 and 1.45 < starts.max() < 1.5
        assert abs(np.corrcoef(sizes, starts)[0, 1]) < 0.2
    for kind, segment in (("rough:10", "1"), ("rough:10:2", "2")):
        names = [random_terrain(kind, rng) for _ in range(20)]
        assert all(name.startswith(f"rough:10:{segment}:") for name in names)
        assert len({name.split(":")[3] for name in names}) == len({name.split(":")[4] for name in names}) == 20
        assert named_terrains(*names)[:, 1, 0].min() > 0.5
    one, other = (random_terrain("step:5", torch.Generator().manual_seed(3)) for _ in range(2))
    assert one == other
    for kind in ("level", "incline", "incline:10:1", "step:5:1", "rough:10:1:3", "hill:3"):
        with pytest.raises(TerrainError, match="kind of terrain .* must be incline:DEGREES"):
            random_terrain(kind, rng)
    for kind in ("incline:x", "step:x", "rough:x", "rough:10:x"):
        with pytest.raises(TerrainError, match=f"kind of terrain '{kind}': could not convert .* 'x'"):
            random_terrain(kind, rng)
    for kind, message in (
        ("incline:100", "degrees is 100.0, must lie between -90 and 90"),
        ("step:inf", "height is inf, must be finite and not 0"),
        ("rough:10:1e-7", "must be 1 to 10000 segments"),
    ):  # whatever is drawn
        with pytest.raises(TerrainError, match=f"kind of terrain '{kind}': .*{message}"):
            random_terrain(kind, rng)
