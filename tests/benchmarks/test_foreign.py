"""What loads of a folder, and how far its accelerations are from MuJoCo's."""

from __future__ import annotations

import foreign
from common import parse
from scenes import BOUNDED_SERVOS, pendulum
from tables import read_csv


def test_a_folder_becomes_a_table(tmp_path, capsys):
    robots = {
        "servos": BOUNDED_SERVOS,
        "rubbed": pendulum('axis="0 1 0" frictionloss="1"'),
        "bad": pendulum(rest='<actuator><velocity joint="hinge" kv="-2"/></actuator>'),
    }
    for name, mjcf in robots.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(mjcf)
    flags = ["--states", "8", "--output", str(tmp_path / "out")]
    foreign.main(parse(foreign.Args, None, [str(tmp_path), *flags]))
    assert "2 of 3 load" in capsys.readouterr().out
    rows = {row["file"]: row for row in read_csv(tmp_path / "out" / "foreign.csv")}
    bad = "actuator number 0: stiffness and damping of a servo must not be negative"
    assert rows["bad/scene.xml"]["refused"] == bad
    for name in ("servos", "rubbed"):
        assert rows[f"{name}/scene.xml"]["refused"] == ""
        assert float(rows[f"{name}/scene.xml"]["relative error of qacc"]) < 1e-9
