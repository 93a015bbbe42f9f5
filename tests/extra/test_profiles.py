"""Profiles of terrain: their shapes, and which are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import task_scene

from diffsim.extra.terrain import LENGTH, LEVEL, incline, rough, step, uneven
from diffsim.robot.scene import TerrainError


def test_generated_profiles():
    np.testing.assert_allclose(incline(-45.0, start=2.0), [[1, 0], [2, 0], [3, -1]], atol=1e-12)
    np.testing.assert_allclose(step(-0.3), [[0, 0], [1, 0], [1, -0.3], [2, -0.3]])
    profile = rough(7, segment=2.0, degrees=15.0, length=20.0, start=3.0)
    x, z = profile.T
    assert profile.shape == (13, 2)
    np.testing.assert_allclose(x, [2.0, *np.arange(3.0, 24.0, 2.0), 24.0])
    angles = np.degrees(np.arctan(np.diff(z) / np.diff(x)))
    assert angles[0] == angles[-1] == 0 and 5 < abs(angles).max() < 15
    assert np.array_equal(profile, rough(7, 2.0, 15.0, 20.0, 3.0)) and not np.array_equal(
        profile, rough(8, 2.0, 15.0, 20.0, 3.0)
    )
    profiles = uneven(20.0, 4, seed=-3)
    x, z = np.moveaxis(profiles, 2, 0)
    assert (z[abs(x) <= LEVEL] == 0).all()
    np.testing.assert_allclose([-x.min(), x.max()], LENGTH + LEVEL + 1)
    angles = np.degrees(np.arctan(np.diff(z) / np.diff(x)))
    np.testing.assert_allclose(abs(angles).max(1), [5, 10, 15, 20], rtol=0.08)  # profile by profile
    assert (abs(angles).max(1) < [5, 10, 15, 20]).all() and abs(angles.mean()) < 3
    assert len(np.unique(z[:, -1])) == len(np.unique(z[:, 0])) == 4
    assert np.array_equal(profiles, uneven(20.0, 4, -3)) and not np.array_equal(profiles, uneven(20.0, 4, 4))
    for make, message in (
        (lambda: uneven(95.0, 1), "degrees is 95.0, must lie between -90 and 90"),
        (lambda: incline(90.0), "degrees is 90.0, must lie between -90 and 90"),
        (lambda: step(0.0), "height is 0.0, must be finite and not 0"),
        *(
            (lambda w=w: rough(0, *w), f"length is {w[2]}, must be 1 to 10000 segments of {w[0]}")
            for w in ((0.0, 10.0, 50.0), (4.0, 10.0, 1.0), (1e-300, 10.0, 50.0), (np.nan, 10.0, 50.0))
        ),
        *((lambda s=s: rough(s), f"seed is {s}, must be an integer of at least 0") for s in (1.5, np.inf, np.nan, -1)),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    for profile in (incline(1.0, start=np.inf), step(1.0, start=np.inf), rough(0, start=np.nan)):
        with pytest.raises(TerrainError):
            task_scene("hopper").with_terrain(profile)
