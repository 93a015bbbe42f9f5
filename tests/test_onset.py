"""The onset of MuJoCo's contacts: MuJoCo with other numbers, gradients of differences, and what evaluates without."""

from __future__ import annotations

import json
from functools import partial

import mujoco
import numpy as np
import pytest
import test_constraint
import torch
from learners import run
from scenes import acting_states, task_scene
from test_constraint import SLOW, H, check_gradients, in_mujoco, mujoco_model, step, tree_states
from test_pairs import (
    check_gradients_of_touching,
    model_as_it_is,
    needs_drift,
    needs_manifolds,
    solid_states,
    solids,
    tangled,
)

import diffsim
import shac
from diffsim.parameters import ParametricSimulator
from diffsim.robot.constants import constrained, soften
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.training import Evaluation, evaluation, graph, load_policy
from diffsim.training import parse as parse_flags
from diffsim_cli.watch import make_policy_env

enough_passes = test_constraint.enough_passes
ONSET = 0.02  # m
PYRAMIDS = [pytest.param("elliptic"), pytest.param("pyramidal", marks=SLOW)]


def softer(solimp, start=0.015, onset=ONSET):
    """solimp with no larger start and no smaller width."""
    return [min(solimp[0], start), solimp[1], max(solimp[2], onset), *solimp[3:]]


def changed(model, start=0.015, onset=ONSET):
    """A model whose geoms have such a solimp, which is that of their contacts if all geoms have the same."""
    assert (model.geom_solimp == model.geom_solimp[0]).all() and not model.npair
    model.geom_solimp[:] = softer(model.geom_solimp[0], start, onset)
    return model


def steps_of(model, states, change):
    """qvel after a step of MuJoCo's, whose contacts get another solimp after its own mixing."""
    m, data, ends = model, mujoco.MjData(model), []
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, [-1.0, 1.0]).T
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    for qpos, qvel, ctrl in zip(*states, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
        mujoco.mj_fwdPosition(m, data)
        for contact in data.contact:
            contact.solimp = change(contact.solimp)
        mujoco.mj_makeConstraint(m, data)
        mujoco.mj_projectConstraint(m, data)
        for stage in (mujoco.mj_fwdVelocity, mujoco.mj_fwdActuation, mujoco.mj_fwdAcceleration):
            stage(m, data)
        mujoco.mj_fwdConstraint(m, data)
        (mujoco.mj_Euler if m.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER else mujoco.mj_implicit)(m, data)
        ends.append(data.qvel.copy())
    return np.array(ends)


def errors(found, expected, states):
    """The largest error of each state's velocities, relative to their change."""
    return abs(found - expected).max(1) / (1e-3 + abs(expected - states[1]).max(1))


def check_mixed(scene, states, model, enough):
    """Compare a step with MuJoCo's, whose contacts are softer after mixing, and not with other numbers."""
    _, qvel, residual = step(scene, states, onset=ONSET)
    assert residual.max() < 1e-10
    np.testing.assert_allclose(steps_of(model, states, np.array), in_mujoco(scene, *states, model=model)[1], atol=1e-9)
    found = errors(qvel, steps_of(model, states, softer), states)
    assert found.max() < enough and np.median(found) < 1e-10
    for wrong in ({"start": 1.0}, {"onset": 0.021}, {"onset": 0.0}, {"start": 0.016}):
        others = steps_of(model, states, partial(softer, **wrong))
        assert errors(qvel, others, states).max() > 1e-5, wrong


@pytest.mark.parametrize("name", ["hopper", "ant", pytest.param("humanoid", marks=SLOW)])
def test_steps_are_those_of_the_changed_model(name, rng):
    """One and eight, pressed into the ground."""
    scene = task_scene(name)
    states = acting_states(scene, 32, rng)
    for substeps in (1, 8):
        _, qvel, residual = step(scene, states, substeps, onset=ONSET)
        assert residual.max() < 1e-10

        def mujocos(**numbers):
            return in_mujoco(scene, *states, substeps=substeps, model=changed(mujoco_model(scene), **numbers))[1]  # noqa: B023

        assert errors(qvel, mujocos(), states).max() < 1e-8
        for wrong in ({"start": 0.9}, {"onset": 0.021}, {"start": 0.016}):
            assert errors(qvel, mujocos(**wrong), states).max() > 1e-5, wrong


@pytest.mark.parametrize("seed", [0, 1])
def test_contacts_on_the_ground_are_softer_after_mixing(seed, rng):
    """Of both cones, priorities and weights; limits and dry friction keep the file's numbers."""
    scene, states = tree_states("floating", seed, 64, rng)
    states[0][:, 2] += 0.04 * rng.random(64)  # to where contacts begin
    check_mixed(scene, states, mujoco_model(scene), 1e-8)


@needs_drift
@pytest.mark.parametrize("cone", PYRAMIDS)
def test_spheres_and_capsules_touch_each_other_more_softly(cone, rng):
    """One pair has numbers of its own; a <connect> keeps the file's."""
    scene, states = tangled("floating", cone, 0, 16, rng)
    check_mixed(scene, states, model_as_it_is(scene), 1e-6)


@needs_manifolds
@pytest.mark.parametrize("cone", PYRAMIDS)
def test_boxes_touch_each_other_more_softly(cone, rng):
    scene = solids(cone, 0)
    states = solid_states(scene, 32, rng)
    check_mixed(scene, states, model_as_it_is(scene), 1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_gradient_is_that_of_differences(seed, rng):
    scene, states = tree_states("floating", seed, 16, rng)
    check_gradients(scene, states, rng, onset=ONSET)


def test_gradient_through_touching_parts_is_that_of_differences(rng):
    scene, states = tangled("floating", "elliptic", 0, 96, rng)
    check_gradients_of_touching(scene, states, rng, onset=ONSET)


def test_what_is_soft_already_stays():
    """Menagerie's feet rise over 22 mm; a contact is nowhere stiffer than the file's."""
    scene = task_scene("go2")
    file, soft, softest = (constrained(scene, H, True, onset).constraints.contact for onset in (0.0, 0.022, 0.03))
    np.testing.assert_array_equal(file[:, 5:8], np.tile([0.015, 0.9999, 0.022], (4, 1)))
    assert (soft == file).all() and (softest[:, 7] == 0.03).all() and (np.delete(softest - file, 7, 1) == 0).all()
    mine, default = np.array([0.001, 0.9, 0.05, 0.4, 3.0]), np.array([0.9, 0.95, 0.001, 0.5, 2.0])
    np.testing.assert_array_equal(soften(mine, ONSET), mine)
    np.testing.assert_array_equal(soften(default, ONSET), [0.015, 0.95, 0.02, 0.5, 2.0])
    np.testing.assert_array_equal(soften(np.array([0.5, 0.9, 0.05, 0.4, 3.0]), ONSET), [0.015, 0.9, 0.05, 0.4, 3.0])
    np.testing.assert_array_equal(soften(default, 0.0), default)


def rollout(sim, states, rewound=True):
    """State and gradient of two control steps."""
    leaves = [torch.tensor(x, dtype=sim.dtype, requires_grad=True) for x in states]
    if rewound:
        sim.rewind()
    qpos, qvel = sim.step(*sim.step(*leaves), leaves[2])
    return qpos.detach(), *torch.autograd.grad(qpos.square().sum() + qvel.square().sum(), leaves)


def alike(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_an_onset_changes_without_other_kernels(rng):
    """In both directions bitwise as if it had been there from the start; 0 is the file."""
    scene, how = task_scene("hopper"), Integration("mujoco", 2)
    states = acting_states(scene, 8, rng)
    sim, fresh, file = (Simulator(scene, 8, x, horizon=2) for x in (how, how._replace(onset=ONSET), how))
    first, kernels = rollout(sim, states), [dict(x._launcher._kernels) for x in (sim, fresh)]
    assert kernels[0] == kernels[1]
    sim.set_onset(ONSET)
    assert sim.integration == sim.options.integration == fresh.integration
    soft = rollout(sim, states)
    assert alike(soft, rollout(fresh, states)) and not any(torch.equal(*each) for each in zip(soft, first, strict=True))
    sim.set_onset(0)
    assert alike(rollout(sim, states), first) and alike(rollout(file, states), first)
    assert dict(sim._launcher._kernels) == kernels[0]


def test_earlier_steps_have_no_adjoint_after_a_change(rng):
    scene = task_scene("hopper")
    qpos, qvel, ctrl = (torch.tensor(x).float() for x in acting_states(scene, 8, rng))
    sim = Simulator(scene, 8, Integration("mujoco", 2))
    end = sim.step(qpos, qvel, ctrl.requires_grad_())[0]
    sim.set_onset(ONSET)
    with pytest.raises(RuntimeError, match="overwritten"):
        end.sum().backward()


@pytest.mark.unoptimized
def test_an_onset_and_parameters_change_together(rng):
    """Whichever comes first: a contact keeps the inverse weight of other masses."""
    scene = task_scene("hopper")
    states, how = acting_states(scene, 8, rng), Integration("mujoco", 2, onset=ONSET)
    ends = []
    for given, later in ((how, how), (how._replace(onset=0.0), how), (how, how._replace(onset=0.0))):
        sim = ParametricSimulator(scene, 8, given, horizon=2)
        sim.parameters = {"mass": 1.2 * sim.parameters["mass"]}
        sim.set_onset(later.onset)
        with torch.no_grad():
            ends.append(torch.cat(sim.step(*(torch.tensor(x).float() for x in states)), 1))
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


@pytest.mark.gpu
def test_a_captured_graph_follows():
    """Bitwise as eager steps."""
    found = []
    for captured in (True, False):
        env = diffsim.make("ant", 16, "cuda", seed=0, horizon=4, contact="mujoco")
        action = torch.zeros(4, 16, env.scene.nu, device="cuda", requires_grad=True)

        def collect(env=env, action=action):
            env.detach()
            reward = torch.stack([env.step(each)[1] for each in action.unbind()])
            return reward.detach(), torch.autograd.grad(reward.sum(), action)[0]

        call, ends = graph.capture(collect, "cuda", env) if captured else collect, []
        for onset in (0.0, 0.04, 0.01, 0.0):
            env.sim.set_onset(onset)
            for _ in range(4):
                ends += [x.clone() for x in call()]
        found.append(ends)
    assert alike(*found)


# Flags, and evaluations -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [-0.01, 1.01, np.nan, np.inf, True, "0.02"])
def test_a_bad_onset_is_refused(value):
    message = "onset is .*, must be 0 to 1 m on MuJoCo's contact, and 0 on soft contact"
    sim = Simulator(task_scene("hopper"), 1, Integration("mujoco", 1))
    with pytest.raises(ValueError, match=message):
        sim.set_onset(value)
    with pytest.raises(ValueError, match=message):
        diffsim.make("hopper", 1, contact="mujoco", onset=value)
    assert sim.integration.onset == 0.0
    with pytest.raises(ValueError, match=message):
        Simulator(task_scene("hopper"), 1).set_onset(ONSET)


def test_soft_contact_has_no_onset():
    for words, message in (
        ("--onset 0.02 0", "--onset is for --contact mujoco, and the contact is soft"),
        ("--contact mujoco --onset 0 -1", "--onset must be in [0, 1], not -1.0"),
        ("--contact mujoco --onset nan 0", "--onset must be finite, not nan"),
    ):
        with pytest.raises(ValueError) as error:
            parse_flags(shac.Args, ["--env", "ant", *words.split()])
        assert str(error.value) == message
    assert parse_flags(shac.Args, "--env go2 --onset 0.03 0".split()).onset == (0.03, 0.0)  # whose contact is MuJoCo's


def test_training_has_the_onset_and_evaluation_has_not(tmp_path, monkeypatch, capsys):
    """At a run's end, with --evaluate and to watch; resumed, too."""
    made, make = [], diffsim.make

    def recorded(*args, **options):
        made.append(options.get("onset", 0.0))
        return make(*args, **options)

    monkeypatch.setattr(diffsim, "make", recorded)
    monkeypatch.setattr(Evaluation, "compared", True)
    words = "--env cartpole --contact mujoco --onset 0.02 0.02 --device cpu --num-envs 4 --horizon 4 --iterations 3"
    state = run(shac, tmp_path, *words.split(), "--eval-episodes", 2, "--quiet", stop_after=2)
    assert [*state["args"]["onset"]] == [0.02, 0.02] and made[0] == 0.02 and 0.02 not in made[1:]
    made.clear()
    run(shac, tmp_path, "--resume", tmp_path, "--quiet")
    assert made == [0.02, 0.0, 0.0, 0.02]  # to train, to evaluate, with finer substeps, and what training has seen
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("the training's last onset")]
    written = json.loads((tmp_path / "evaluation.json").read_text())
    made.clear()
    shac.main(["--evaluate", str(tmp_path)])
    assert made == [0.0, 0.0, 0.02] and json.loads((tmp_path / "evaluation.json").read_text()) == written
    assert line in capsys.readouterr().out
    assert line.startswith(f"the training's last onset of 0.02 m: return median {written['onset']['return']:.1f}, ")
    made.clear()
    shac.main(["--evaluate", str(tmp_path), "--contact", "soft"])
    assert made == [0.0, 0.0] and "the training's last onset" not in capsys.readouterr().out
    assert make_policy_env(load_policy(tmp_path), 1).sim.integration.onset == made[2] == 0.0
    with pytest.raises(SystemExit):
        shac.main(["--evaluate", str(tmp_path), "--onset", "0.01", "0.01"])
    assert "--onset (0.02, 0.02), which cannot change to (0.01, 0.01)" in capsys.readouterr().err


def test_the_onset_goes_from_the_first_to_the_last_also_after_a_resume(tmp_path, monkeypatch):
    told = list[float]()
    monkeypatch.setattr(Simulator, "set_onset", lambda sim, metres: told.append(metres))
    words = "--env cartpole --contact mujoco --onset 0.03 0.01 --device cpu --num-envs 4 --horizon 4 --iterations 40"
    few = "--critic-iterations 1 --eval-every 0 --eval-episodes 1 --save-every 0 --quiet"
    run(shac, tmp_path, *words.split(), *few.split(), stop_after=15)
    assert told == pytest.approx([0.03, 0.025])
    run(shac, tmp_path, "--resume", tmp_path, stop_after=25)
    assert told[2:] == pytest.approx([0.025, 0.02])  # what the stage began with, then the next one
    told.clear()
    run(shac, tmp_path / "same", *words.replace("0.01", "0.03").split(), *few.split(), stop_after=15)
    assert not told


def test_what_is_retained_of_the_return_with_the_onset(monkeypatch, capsys):
    monkeypatch.setattr(Evaluation, "compared", True)

    def result(value, **_):
        return Evaluation(torch.full((3,), value), *[torch.zeros(3)] * 4, None, 0.1)

    def measure(args, onset=0.0):
        return result(200.0 if onset else 99.0)

    args = shac.Args(contact="mujoco", onset=(0.05, 0.03), substeps=4)
    found = evaluation.compare(args, result(100.0), measure)
    assert found["onset"] == {"metres": 0.03, "return": 200.0, "kept": 0.5}
    assert found["finer"] == {"substeps": 16, "return": 99.0, "kept": 0.99}
    assert capsys.readouterr().out.splitlines() == [
        "16 substeps: return median 99.0, 99.0% retained in 3 episodes",
        "the training's last onset of 0.03 m: return median 200.0, 50.0% retained without in 3 episodes; less than "
        "97%: train with a smaller --onset",
    ]
    assert evaluation.compare(shac.Args(substeps=4), result(100.0), measure).keys() == {"finer"}


@pytest.mark.parametrize(
    ("own", "finer", "share", "warning"),
    [
        (100.0, 97.5, "97.5%", ""),
        (100.0, 102.5, "102.5%", ""),
        (100.0, 96.0, "96.0%", "; less than 97%"),
        (100.0, 104.0, "104.0%", "; more than 103%"),
        (100.0, -1.0, "-1.0%", "; less than 97%"),
        (-100.0, -98.0, "102.0%", ""),  # costs
        (-100.0, -110.0, "90.9%", "; less than 97%"),
        (-100.0, -50.0, "200.0%", "; more than 103%"),
        (-100.0, 50.0, "inf%", "; more than 103%"),
        (0.0, 0.0, "100.0%", ""),
        (0.0, 1.0, "inf%", "; more than 103%"),
    ],
)
def test_a_return_that_gains_by_accuracy_is_told_as_one_that_loses(own, finer, share, warning, monkeypatch, capsys):
    monkeypatch.setattr(Evaluation, "compared", True)

    def result(value):
        return Evaluation(torch.full((5,), value), *[torch.zeros(5)] * 4, None, 0.1)

    def told(evaluated):
        evaluation.compare(args, result(evaluated), lambda args, onset=0.0: result(own if onset else finer))
        return capsys.readouterr().out.splitlines()

    args = shac.Args(contact="mujoco", onset=(0.05, 0.03), substeps=4)
    remedy = warning and f"{warning}: train with more substeps"
    assert told(own)[0] == f"16 substeps: return median {finer:.1f}, {share} retained in 5 episodes{remedy}"
    remedy = warning and f"{warning}: train with a smaller --onset"
    assert told(finer)[1] == (
        f"the training's last onset of 0.03 m: return median {own:.1f}, {share} retained without in 5 episodes{remedy}"
    )


def test_checkpoints_without_an_onset_load(tmp_path):
    """From before the flag was there."""
    run(shac, tmp_path, *"--env cartpole --device cpu --num-envs 4 --horizon 4 --iterations 1 --quiet".split())
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    del state["args"]["onset"]
    torch.save(state, tmp_path / "checkpoint.pt")
    assert parse_flags(shac.Args, ["--resume", str(tmp_path), "--iterations", "2"]).onset == (0.0, 0.0)
    shac.main(["--evaluate", str(tmp_path), "--run-dir", str(tmp_path / "new")])
