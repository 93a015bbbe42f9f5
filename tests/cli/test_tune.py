"""diffsim tune: errors of known order, the choice among known rows, a stiff spring's known bound, and bad input."""

import csv
import math

import mujoco
import pytest
import torch
from learners import refusal

import diffsim
from diffsim import Integration
from diffsim.training.checkpoint import POLICIES
from diffsim_cli.commands import main
from diffsim_cli.tune import subject, thin
from diffsim_cli.tune.extremes import first_failure
from diffsim_cli.tune.front import Reference, Row, choice, front
from diffsim_cli.tune.motion import Motion

# Its damper and its limits do nothing, but so it shares the kernels of the tests' hinges.
PENDULUM = """
<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/>
<custom><numeric name="k_limit" data="300"/><numeric name="d_limit" data="200"/></custom>
<worldbody><body>
  <joint axis="0 1 0" range="-1e5 1e5" damping="1e-300" {joint}/>
  <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05" mass="1" contype="0" conaffinity="0"/>
</body></worldbody><actuator>{motor}</actuator></mujoco>"""
MOTOR = '<motor joint="swing" gear="4" ctrlrange="-1 1"/>'


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    path = tmp_path_factory.mktemp("tune") / "pendulum.xml"
    path.write_text(PENDULUM.format(joint='name="swing" stiffness="0.1"', motor=MOTOR))
    return path


@pytest.fixture(scope="module")
def motion(pendulum):
    env = diffsim.make(subject(str(pendulum)), 4, seed=0, contact="soft")
    return Motion(env, None)


def exactly(motion, substeps):
    return Reference(motion, Integration(substeps=substeps), torch.float64)


def test_errors_fall_with_the_order_of_the_integrator(motion):
    truth = exactly(motion, 512)
    euler = [exactly(motion, n).errors(truth) for n in (4, 8)]
    for column in ("state 0.1 s", "state 0.5 s"):
        assert euler[0][column] / euler[1][column] == pytest.approx(2, rel=0.15)
    assert euler[0]["gradient 32"] / euler[1]["gradient 32"] == pytest.approx(2, rel=0.2)
    again = exactly(motion, 512).errors(truth)
    assert again["state 0.5 s"] == again["gradient 8"] == again["contained"] == 0


def test_start_states_lie_on_the_motion_and_actions_lead_on(motion, pendulum):
    """The first quarter starts where the environment was after 0.25 s; replaying its actions leads to the next one."""
    env = diffsim.make(subject(str(pendulum)), 4, seed=0, contact="soft")
    assert motion.qpos.shape == (4, 1) and motion.actions.shape == (32, 4, 1)
    qpos, qvel = env.qpos.double()[:1], env.qvel.double()[:1]
    sim = diffsim.Simulator(env.scene, 1, env.sim.integration, env.control_dt, dtype=torch.float64)
    for _ in range(15):
        qpos, qvel = sim.step(qpos, qvel, torch.zeros(1, 1, dtype=torch.float64))
    assert not torch.allclose(motion.qpos[0], qpos[0])  # the actions do something
    assert motion.actions.abs().max() <= 1 and motion.actions.std() > 0.1


def row(substeps, cost, error, gradient=None, contained=0.0):
    gradient = error if gradient is None else gradient
    numbers = {"us with gradient": cost, "state 0.5 s": error, "gradient 8": gradient, "contained": contained}
    return Row(Integration(substeps=substeps), numbers)


def test_the_fastest_setting_that_is_good_enough_is_chosen():
    cheap, good, better, worse, lost = (
        *(row(2, 1.0, 0.1), row(4, 2.0, 0.009), row(8, 4.0, 0.004), row(6, 5.0, 0.005)),
        row(1, 0.5, 0.001, contained=0.25),
    )
    rows = [better, lost, worse, good, cheap]
    assert choice(rows, 0.01) is good
    assert choice(rows, 0.2) is cheap
    assert choice(rows, 0.0001) is None
    assert front([cheap, good, better, worse]) == [cheap, good, better]
    beaten_in_one = row(6, 5.0, 0.005, gradient=0.001)  # a better gradient than any cheaper one has
    assert beaten_in_one in front([cheap, good, better, beaten_in_one])
    many = [row(n, float(n), 1.0 / n) for n in range(1, 41)]
    shown = thin(many, many[17])
    assert len(shown) == 10 and many[17] in shown and shown[0] is many[0] and shown[-1] is many[-1]


def test_a_stiff_spring_fails_at_its_known_step(tmp_path):
    """Of x'' = -w^2 x semi-implicit Euler with step h has 1 / (1 - (h w / 2)^2) times the true energy at most: twice
    where h w = sqrt(2), which for 300/s are 3.5 substeps of 1/60 s."""
    spring = 300.0**2 / 3  # times the inertia of a rod of 1 m and 1 kg, 1/3, is 300^2
    stiff = PENDULUM.format(joint=f'name="swing" stiffness="{spring}"', motor=MOTOR)
    (path := tmp_path / "stiff.xml").write_text(stiff)
    model = mujoco.MjModel.from_xml_path(str(path))
    inertia = model.body_inertia[1][1] + 0.25
    task = subject(str(path))
    motion = Motion(diffsim.make(task, 4, seed=0, contact="soft", substeps=16), None)
    motion.qpos[:] += 0.01
    assert 3 < math.sqrt(spring / inertia) / 60 / math.sqrt(2) < 4
    assert first_failure(motion, "substeps", Integration(substeps=16)) == "3 (energy)"
    assert first_failure(motion, "speed of a joint (1/s)", Integration(substeps=16)) == "-"


def test_the_command_prints_the_front_and_writes_all_rows(pendulum, tmp_path, capsys):
    main(["tune", str(pendulum), "--contact", "soft", "--states", "4", "--error", "0.02", "--extremes",
          "--csv", str(tmp_path / "rows.csv")])  # fmt: skip
    out = capsys.readouterr().out
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    chosen = next(line for line in out.splitlines() if line.startswith("->"))
    assert len(rows) > 12 and all(float(each["us with gradient"]) > 0 for each in rows)
    enough = [each for each in rows if float(each["state 0.5 s"]) <= 0.02]
    best = next(each for each in enough if f"  {each['setting']}  " in chosen)
    assert float(best["us with gradient"]) == min(float(each["us with gradient"]) for each in enough)
    assert "speed of a joint (1/s)" in out and "drop" not in out
    assert "pendulum.xml meets no ground: no contact is measured" in out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["nobody"], "unknown task 'nobody'"),
        (["PENDULUM", "--error", "0"], "must be"),
        (["PENDULUM", "--checkpoint", "ant.pt"], "ant.pt is a checkpoint of ant, not of"),
        (["IDLE"], "idle.xml has no actuators, so there is no action to differentiate in"),
        (["missing.xml"], "no such file: missing.xml"),
        (["PENDULUM", "--device", "tpu"], "unknown device 'tpu'"),
        (["PENDULUM", "--states", "0"], "--states is 0, must be an integer of at least 1"),
    ],
)
def test_bad_input_is_one_line(flags, message, pendulum, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ant.pt").write_bytes((POLICIES / "ant.pt").read_bytes())
    (idle := tmp_path / "idle.xml").write_text(PENDULUM.format(joint='name="swing"', motor=""))
    known = {"PENDULUM": str(pendulum), "IDLE": str(idle)}
    assert message in refusal(lambda: main(["tune", *(known.get(word, word) for word in flags)]), capsys)


def test_an_interrupt_leaves_what_was_measured(pendulum, monkeypatch, capsys):
    """Before the default's turn, too: then no row is compared with it, and nothing more is measured."""
    errors, calls = Reference.errors, []

    def interrupted(self, truth):
        calls.append(self)
        if len(calls) > 2:
            raise KeyboardInterrupt
        return errors(self, truth)

    monkeypatch.setattr(Reference, "errors", interrupted)
    main(["tune", str(pendulum), "--contact", "soft", "--states", "4"])
    out = capsys.readouterr().out
    assert "stopped after 2 settings" in out and "take --contact soft --substeps" in out
    assert "default" not in out
