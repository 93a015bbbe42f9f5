"""How benchmarks/joystick.py judges policies that follow commands."""

from __future__ import annotations

from pathlib import Path

import joystick
import numpy as np
import pytest
from common import parse
from learners import refusal
from tables import read_csv

import diffsim

POLICIES = Path(diffsim.__file__).parent / "policies"


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


def test_pushes_alone_have_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its errors, which are those without pushes, are empty until these are measured; its gait, too."""
    flags, shown = [str(POLICIES / "go2.pt"), *"--seconds 5 --friction 1 --output".split(), str(tmp_path)], list[str]()
    for more in ("--push 0.5", "--push 0", "--latency 20 --mass 1.15 --gains 0.8"):
        joystick.main(parse(joystick.Args, None, [*flags, *more.split()]))
        shown += [line for line in capsys.readouterr().out.splitlines() if line.startswith("| go2 ")]
    pushed, calm, disturbed = read_csv(tmp_path / "joystick.csv")
    assert shown[:2] == [
        "| go2 | shac | policies |  | 1 |  |  |  |  |  | 100% |  |",
        "| go2 | shac | policies |" + "  |" * 8,
    ]
    assert shown[2].endswith("| 100% | 100% |  |") and f"{float(calm['error']):.3f}" in shown[2]
    assert f"| {float(calm['action change']):.0%} |" in shown[3] and shown[4].endswith("% | 100% | 100% |") is False
    assert 0 < float(calm["error"]) < float(pushed["error"]) < 0.1
    assert float(disturbed["error"]) != float(calm["error"]) and disturbed["latency"] == "20.0"
    for column, most in (("left-right", 0.5), ("clearance (m)", 0.2), ("slip (m/s)", 0.5), ("cost of transport", 5)):
        assert 0 <= float(calm[column]) < most


def test_what_cannot_be_judged(capsys: pytest.CaptureFixture[str]) -> None:
    args = joystick.Args(checkpoints=(POLICIES / "hopper.pt",))
    assert "was trained on hopper, which follows no command" in refusal(lambda: joystick.main(args), capsys)
    error = refusal(lambda: parse(joystick.Args, None, ["--seconds", "2"]), capsys)
    assert error.endswith("--seconds must be at least 3, not 2.0")
