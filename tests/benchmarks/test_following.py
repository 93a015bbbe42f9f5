"""How benchmarks/joystick.py judges policies that follow commands."""

from __future__ import annotations

import shutil
from pathlib import Path

import joystick
import mujoco
import numpy as np
import pytest
import worlds
from common import parse
from learners import refusal
from tables import read_csv

from diffsim.tasks import TASKS
from diffsim.training.checkpoint import POLICIES
from diffsim_robots.terrain import uneven

BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


def test_errors_are_those_of_means_over_a_second() -> None:
    """Swinging about the command within a second costs nothing, nor does the first second; an offset does."""
    velocities = np.tile(np.array(joystick.COMMANDS), (200, 1, 1))
    velocities[:50] = 9.0
    velocities[:, :, 1] += np.tile([0.5, -0.5], 100)[:, None]
    velocities[:, 2] += [0.3, 0.4, -0.2]
    error, yaw = joystick.errors(velocities, 50)
    expected = np.zeros((2, len(joystick.COMMANDS)))
    expected[:, 2] = 0.5, 0.2
    np.testing.assert_allclose([error, yaw], expected, atol=1e-12)


def judged(flags: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    joystick.main(
        parse(joystick.Args, None, [*flags.split(), *"--seconds 5 --friction 1 --output".split(), str(folder)])
    )
    return capsys.readouterr().out


def test_tables_have_worlds_of_each_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors are those without disturbance, and empty until these are measured."""
    policy = str(POLICIES / "go2.pt")
    shown = [
        judged(f"{policy} {more}", tmp_path, capsys)
        for more in ("--push 0.5", "--push 0", "--latency 20 --mass 1.15 --gains 0.8")
    ]
    pushed, calm, disturbed = read_csv(tmp_path / "joystick.csv")
    error = f"{float(calm['error']):.3f}"
    assert "| go2 | RPO | 1 |  |  |  |  |" in shown[0]
    assert "| machine | pushes of 0.5 m/s |" in shown[0] and "| policies | 100% (100%) |" in shown[0]
    assert f"| go2 | RPO | 1 |  | {error} ({error}) |" in shown[1]
    assert "| machine | friction x 1, pushes of 0.5 m/s, all |" in shown[2]  # they agree
    assert 0 < float(calm["error"]) < float(pushed["error"]) < 0.1
    assert float(disturbed["error"]) != float(calm["error"]) and disturbed["latency"] == "20"
    for column, most in (("left-right", 0.5), ("clearance (m)", 0.2), ("slip (m/s)", 0.5), ("cost of transport", 5)):
        assert 0 <= float(calm[column]) < most


def test_a_race_is_won_by_the_first_checkpoint_that_is_good_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A checkpoint beside a progress.csv has the seconds of its own iteration; falls do not count as reached."""
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(POLICIES / "go2.pt", run / "at_400.pt")
    (run / "progress.csv").write_text("iteration,seconds,eval_return\n1,5,\n400,77,\n100000,99,\n")
    out = judged(f"{run / 'at_400.pt'} --race", tmp_path, capsys)
    (row,) = read_csv(tmp_path / "joystick_race.csv")
    assert row["checkpoint"] == "run/at_400" and row["training s"] == "77"
    assert "| go2 | RPO | 77 |" in out
    later = [row | {"training s": "80", "error": "0.01"}, row | {"training s": "9", "error": "0.01", "whole": "0.9"}]
    first = row | {"training s": "8", "error": "0.07"}
    (line,) = joystick.race([*later, first])
    assert line["s to 0.1 m/s"] == "8" and line["s to 0.05 m/s"] == "80" and line["in all (s)"] == "80"
    (line,) = joystick.race([*later, first | {"seed": "2"}])
    assert line["s to 0.1 m/s"] == "80, 8" and line["s to 0.05 m/s"] == "80, never"


def test_rough_ground_is_made_of_boxes_and_judged_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the plane's own numbers, and heights that are the profile's."""
    out = judged(f"{POLICIES / 'go2.pt'} --rough 0 15", tmp_path, capsys)
    plane, hilly = read_csv(tmp_path / "joystick_rough.csv")
    assert (plane["rough"], hilly["rough"], plane["whole"]) == ("0", "15", "1")
    assert 0 < float(plane["error"]) < float(hilly["error"]) < 0.3
    found = [line for line in out.splitlines() if line.startswith("|")]
    assert found[0] == "| ground | go2, RPO, 0° |" and found[2] == "| whole, 15° | 100% (100%) |"
    assert found[4].startswith(f"| error (m/s), 15° | {float(hilly['error']):.3f} (")
    first, *_ = joystick.rough([row | {"learner": "ppo --symmetric rough 20"} for row in (plane, hilly)])
    assert first == {"ground": "whole, 15°", "go2, PPO, 20°": "100% (100%)"}
    spec, profile = mujoco.MjSpec.from_file(TASKS["go2"].load_robot().path), uneven(15.0, 1)[0]
    flat, model = spec.compile(), worlds.on_terrain(spec, profile)
    floor, boxes = (m.geom_bodyid == 0 for m in (flat, model))
    assert floor.sum() == 1 and boxes.sum() == len(profile) - 1 and set(model.geom_type[boxes]) == {BOX}
    for name in ("geom_friction", "geom_solref", "geom_solimp", "geom_condim", "geom_conaffinity"):
        assert (getattr(model, name)[boxes] == getattr(flat, name)[floor]).all()
    mujoco.mj_kinematics(model, data := mujoco.MjData(model))
    for x in np.linspace(-9.9, 9.9, 41):
        start, found = np.array([x, 3.0, 20.0]), np.zeros(1, np.int32)
        fallen = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, found)
        assert 20.0 - fallen == pytest.approx(np.interp(x, *profile.T), abs=1e-9)
    with pytest.raises(ValueError, match="--rough takes the place of planes, and the file has none"):
        worlds.on_terrain(mujoco.MjSpec(), profile)


def test_an_episode_that_is_too_short_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(lambda: parse(joystick.Args, None, ["--seconds", "2"]), capsys)
    assert error.endswith("--seconds must be at least 3, not 2.0")
