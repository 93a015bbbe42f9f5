"""What goes wrong in one environment stays there, and what the caller does wrong is said in one line."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import BALL, acting_states, free_states, parse, task_scene

import diffsim
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

BAD, GOOD = 2, [0, 1, 3, 4]


def leaves(*arrays, dtype=torch.float32):
    return [torch.tensor(x, dtype=dtype, requires_grad=True) for x in arrays]


def step_and_gradients(sim, states):
    inputs = leaves(*states)
    sim.rewind()
    outputs = sim.step(*inputs)
    gradients = torch.autograd.grad([output.sum() for output in outputs], inputs)
    return [x.detach() for x in outputs], list(gradients)


BALLS = BALL.replace('mass="2"/>', 'mass="2"/> <body> <joint type="ball" stiffness="1"/> <geom size="0.1"/> </body>')


@pytest.mark.unoptimized
@pytest.mark.parametrize(
    ("joint", "length", "spring"),
    [
        *((k, length, 1) for k in (0, 1) for length in (0.0, 1e-20, 1e20)),
        pytest.param(1, 1e20, 0, marks=pytest.mark.slow),
    ],
)
def test_quaternions_without_a_direction_are_contained(joint, length, spring, rng):
    """Lengths from 1e-10 to 1e10 are normalised. A zero one's gradient was NaN, far ones became the identity."""
    scene = parse(BALLS.replace('stiffness="1"', f'stiffness="{spring}"'))
    states, sim = [x.astype(np.float32) for x in free_states(scene, 5, rng)], Simulator(scene, 5)
    quaternions = states[0][:, scene.quaternion_adr[joint] :][:, :4]
    quaternions[[0, 1]] *= np.array([[1e-10], [1e10]], np.float32)
    outputs, gradients = step_and_gradients(sim, states)
    assert not sim.nonfinite.any()
    quaternions[BAD] *= length
    bad_outputs, bad_gradients = step_and_gradients(sim, states)
    assert sim.nonfinite.tolist() == [False, False, True, False, False]
    for value, expected in zip(bad_outputs + bad_gradients, outputs + gradients, strict=True):
        assert value.isfinite().all() and torch.equal(value[GOOD], expected[GOOD])
    assert torch.equal(bad_outputs[0][BAD], torch.tensor(states[0][BAD]))
    assert all((gradient[BAD] == 0).all() for gradient in bad_gradients)


INTEGRATIONS = Integration("soft", 8), Integration("soft", 8, implicit=True), Integration("mujoco", 4)
BATCHES = [  # environments, and how wide a kernel's blocks are
    *((16, 16, torch.float32), (17, 16, torch.float32), (8, 8, torch.float32)),
    *((5, None, torch.float32), (3, None, torch.float64), (33, None, torch.float32)),
]
DISTURBANCES = [  # what of an environment gets which value
    *(("qvel", 0, np.nan), ("qvel", -1, np.inf), ("qvel", slice(None), 9e4), ("qvel", slice(None), 1e30)),
    *(("qpos", -1, np.nan), ("qpos", 1, -100.0), ("ctrl", slice(None), np.nan), ("ctrl", slice(None), 1e30)),
    *(("forces", 1, 1e30), ("forces", 1, 1e8), ("factors", [0, 4], 1e30), ("factors", 6, 0.0)),
    *(("factors", 6, 1e30), ("factors", 7, 1e30)),
]


def four_steps(sim, given):
    """States, gradients and what was contained of four steps and their backward pass, a row for each environment."""
    inputs = {name: x.clone().requires_grad_() for name, x in given.items() if name != "factors"}
    sim.factors, sim.forces = given["factors"], inputs["forces"]
    state, states, lost = (inputs["qpos"], inputs["qvel"]), [], []
    sim.nonfinite_gradients.zero_()
    sim.rewind()
    for _ in range(4):
        states += (state := sim.step(*state, inputs["ctrl"]))
        lost.append(sim.nonfinite.clone())
    weights = torch.arange(1.0, sim.num_envs + 1, dtype=sim.dtype).unsqueeze(1)  # each environment has its own
    gradients = torch.autograd.grad((torch.cat(states, 1) * weights).sum(), list(inputs.values()))
    parts = [x.detach() for x in states], [x.flatten(1) for x in gradients], [torch.stack(lost, 1).int()]
    return [*(torch.cat(each, 1) for each in parts), sim.nonfinite_gradients.clone()]


@pytest.mark.slow
@pytest.mark.parametrize("integration", INTEGRATIONS, ids=str)
def test_numbers_that_nothing_has_stay_in_their_environment(integration):
    """The first, the middle or the last of a batch gets them: the others' states, gradients, flags and counts are bit
    for bit those without it. Its own states are finite, unless they began otherwise, and its gradients, too."""
    env, drawn = diffsim.make("hopper", 33, seed=3), torch.Generator().manual_seed(0)
    for n, block, dtype in BATCHES:
        sim = Simulator(env.scene, n, integration, 1 / 60, 4, dtype=dtype, block=block, factors=True, forces=True)
        ctrl = 2 * torch.rand(n, env.scene.nu, generator=drawn) - 1
        parts = dict(qpos=env.qpos[:n], qvel=env.qvel[:n], ctrl=ctrl, factors=sim.factors, forces=sim.forces)
        given = {name: part.to(dtype) for name, part in parts.items()}
        expected = four_steps(sim, given)
        for what, where, value in DISTURBANCES:
            for k in (0, n // 2, n - 1):
                (tensor := given[what].clone())[k][where] = value
                found, others = four_steps(sim, given | {what: tensor}), torch.arange(n) != k
                assert all(torch.equal(x[others], y[others]) for x, y in zip(found, expected, strict=True))
                assert found[1][k].isfinite().all()
                assert found[0][k].isfinite().all() or what in ("qpos", "qvel") and not np.isfinite(value)


def test_a_speed_that_nothing_has_is_contained():
    """Finite, but its square is not far from the end of float32: a task or a network would make inf and NaN of it."""
    scene = parse(BALL)
    sim = Simulator(scene, 3, dtype=torch.float64)
    qpos, qvel = torch.tensor([[0.0, 0, 5, 1, 0, 0, 0]]).repeat(3, 1).double(), torch.zeros(3, 6).double()
    qvel[1:, 0] = torch.tensor([0.99e5, 1.01e5])
    sim.step(qpos, qvel, torch.zeros(3, 0).double())
    assert sim.nonfinite.tolist() == [False, False, True]


@pytest.mark.parametrize("name", diffsim.TASKS)
def test_what_is_not_contained_has_finite_observations_and_rewards(name):
    env = diffsim.make(name, num_envs=1, horizon=1)
    qpos, qvel = env.qpos.clone().requires_grad_(), torch.full_like(env.qvel, 1e5).requires_grad_()
    action = torch.ones(1, env.scene.nu, requires_grad=True)
    obs = env.observe(qpos, qvel, action)
    reward = env.task.reward(obs, action)
    assert obs.isfinite().all() and reward.isfinite().all()
    gradients = torch.autograd.grad(obs.sum() + reward.sum(), [qpos, qvel, action], materialize_grads=True)
    assert all(gradient.isfinite().all() for gradient in gradients)


def rollout(name, velocity=None, steps=4):
    """Observations, rewards and gradients of a few steps; one environment starts with the given velocity."""
    env = diffsim.make(name, num_envs=5, seed=3, horizon=steps, threads=2)
    if velocity is not None:
        qvel = env.qvel.clone()
        qvel[BAD, -1] = velocity
        env.set_state(env.qpos, qvel)
    generator = torch.Generator().manual_seed(0)
    actions = [torch.randn(5, env.scene.nu, generator=generator).tanh().requires_grad_() for _ in range(steps)]
    history = [env.step(action) for action in actions]
    total = sum(obs.sum() + reward.sum() + info["final_obs"].sum() for obs, reward, _, _, info in history)
    return history, torch.stack(torch.autograd.grad(total, actions)), env


@pytest.mark.parametrize("name", ["cartpole", "hopper", "ant"])
def test_environment_that_blows_up_is_reset_and_counted(name):
    history, gradients, _ = rollout(name)
    bad_history, bad_gradients, env = rollout(name, velocity=1e30)
    for step, (record, bad_record) in enumerate(zip(history, bad_history, strict=True)):
        assert bad_record[4]["nonfinite"].tolist() == [False, False, step == 0, False, False]
        assert not record[4]["nonfinite"].any()
        for x, y in zip(record[:4], bad_record[:4], strict=True):
            torch.testing.assert_close(y[GOOD], x[GOOD], rtol=0, atol=0)
        torch.testing.assert_close(bad_record[4]["final_obs"][GOOD], record[4]["final_obs"][GOOD], rtol=0, atol=0)
        assert bad_record[0].isfinite().all()
    obs, reward, terminated, truncated, info = bad_history[0]
    assert reward[BAD] == 0 and terminated[BAD] and not truncated[BAD]
    assert info["_final_obs"][BAD] and info["_episode"][BAD] and info["episode"]["l"][BAD] == 1
    assert obs[BAD].abs().max() < 100  # a start state
    assert env.episode_step[BAD] == 3

    torch.testing.assert_close(bad_gradients[:, GOOD], gradients[:, GOOD], rtol=0, atol=0)
    assert (bad_gradients[1:, BAD] != 0).any() and (gradients[0, BAD] != 0).any()
    assert bad_gradients.isfinite().all()
    # The old episode's last action shows in its last observation, where the task has it there, and nowhere else.
    shown = 1.0 if name == "ant" else 0.0
    torch.testing.assert_close(bad_gradients[0, BAD], torch.full_like(gradients[0, BAD], shown), rtol=0, atol=0)


# The caller's mistakes


@pytest.mark.parametrize(
    "message, arguments",
    [
        ("num_envs.*0.*at least 1", dict(num_envs=0)),
        ("num_envs is 2.5.*integer", dict(num_envs=2.5)),
        ("horizon.*0", dict(horizon=0)),
        ("threads.*0", dict(threads=0)),
        ("max_episode_steps is 0", dict(max_episode_steps=0)),
        ("max_episode_steps .* at most 4611686018427387904", dict(max_episode_steps=2**63)),
        ("substeps.*0", dict(substeps=0)),
        ("substeps is 2.0.*integer", dict(substeps=2.0)),
        ("substeps is 2147483648, must be at most 1000000", dict(substeps=2**31)),  # of which int32 made none
        ("horizon times substeps is 2148000000, must be at most", dict(substeps=10**6, horizon=2148)),
        ("unknown contact 'hard'; choose from soft, mujoco", dict(contact="hard")),
        *((f"implicit is {x!r}, must be True or False", dict(implicit=x)) for x in (1, "yes")),
        ("implicit is True, but only soft contact has", dict(contact="mujoco", implicit=True)),
        *((f"tolerance is {x!r}, must lie between 0 and 1", dict(tolerance=x)) for x in (0, 1.0, np.nan, "a", True)),
        (r"terrain has shape \(\), must be \(K, 2\)", dict(name="hopper", terrain=20.0)),
        ("penalty constant mu is 'a'", dict(name="hopper", penalty={"mu": "a"})),
        (r"penalty constant k_n is 1e\+39", dict(name="hopper", penalty={"k_n": 1e39})),  # infinite in the kernels
        *(("control_dt is", dict(control_dt=x)) for x in (0.0, -1.0, np.nan, np.inf, "a")),
        ("control steps of 0.01667 s, not 0.01", dict(name="humanoid_imitation", control_dt=0.01)),
        ("float16.*float32.*float64", dict(dtype=torch.float16)),
        ("dtype is None.*float32.*float64", dict(dtype=None)),
        ("tpu.*cpu", dict(device="tpu")),
        ("device 'None'; choose cpu", dict(device=None)),
    ],
)
def test_make_refuses(message, arguments):
    with pytest.raises(ValueError, match=message) as error:
        diffsim.make(**({"name": "cartpole", "num_envs": 2} | arguments))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "action, message",
    [
        (torch.zeros(2, 4), r"action.*\(2, 4\).*\(2, 3\)"),
        (torch.zeros(3), r"action.*\(3,\).*\(2, 3\)"),
        (torch.zeros(1, 3), r"action.*\(1, 3\).*\(2, 3\)"),
        (torch.zeros(2, 3, dtype=torch.float64), "action.*float64.*float32"),
        (torch.zeros(2, 3, dtype=torch.int64), "action.*int64.*float32"),
        (torch.zeros(2, 3, device="meta"), "action.*meta.*cpu"),
        (np.zeros((2, 3), np.float32), "action.*ndarray.*Tensor"),
        (torch.tensor([[0.0, 0.0, 0.0], [0.0, torch.nan, 0.0]]), "action.*NaN.*1"),
    ],
)
def test_step_refuses(action, message):
    env = diffsim.make("hopper", num_envs=2, seed=0)
    qpos, obs = env.qpos.clone(), env.detach()
    with pytest.raises(ValueError, match=message):
        env.step(action)
    torch.testing.assert_close(env.qpos, qpos, rtol=0, atol=0)
    assert (env.episode_step == 0).all() and torch.equal(env.detach(), obs)


def test_simulator_and_set_state_refuse():
    with pytest.raises(ValueError, match="scene is a str, must be a Scene: load_scene reads one"):
        Simulator("ant.xml", num_envs=1)
    env = diffsim.make("hopper", num_envs=2, seed=0)
    good = dict(qpos=torch.zeros(2, 6), qvel=torch.zeros(2, 6), ctrl=torch.zeros(2, 3))
    for name, value in good.items():
        for wrong in (torch.zeros(2, 7), value[:1], value.double()):
            with pytest.raises(ValueError, match=name):
                env.sim.step(**good | {name: wrong})
            if name != "ctrl":
                with pytest.raises(ValueError, match=name):
                    env.set_state(*[*(good | {name: wrong}).values()][:2])
    with pytest.raises(ValueError, match="qvel.*finite"):
        env.set_state(env.qpos, env.qvel * torch.inf)


def test_horizon_is_a_limit_of_differentiable_steps_only():
    env = diffsim.make("cartpole", num_envs=2, horizon=2, seed=0)
    action = torch.zeros(2, 1, requires_grad=True)
    for _ in range(2):
        with torch.no_grad():
            for _ in range(5):
                env.step(action)
        env.step(action)
        _, reward, *_ = env.step(action)
        reward.sum().backward()
        with pytest.raises(RuntimeError, match=r"horizon of 2 .*detach\(\)"):
            env.step(action)
        env.detach()


def test_overwritten_checkpoint_is_noticed(rng):
    scene = task_scene("hopper")
    sim = Simulator(scene, 2, horizon=2)
    states = leaves(*acting_states(scene, 2, rng))
    first, second = (sim.step(*states)[0].sum() for _ in range(2))
    with pytest.raises(RuntimeError, match=r"horizon of 2 .*rewind\(\)"):
        sim.step(*states)
    sim.rewind()
    third = sim.step(*states)[0].sum()
    expected = torch.autograd.grad(second, states)
    torch.testing.assert_close(torch.autograd.grad(third, states), expected, rtol=0, atol=0)
    with pytest.raises(RuntimeError, match="overwritten.*2.*horizon"):
        torch.autograd.grad(first, states)


def test_steps_without_gradient_and_jacobians_leave_checkpoints_alone(rng):
    """Jacobians take the next one of a rollout, for as long as they need it."""
    scene = task_scene("hopper")
    sim = Simulator(scene, 2, horizon=2)
    states = leaves(*acting_states(scene, 2, rng))
    total = sim.step(*states)[0].sum()
    expected = torch.autograd.grad(total, states, retain_graph=True)
    with torch.no_grad():
        sim.step(*(x + 0.1 for x in states))
    with torch.inference_mode():
        A, B = sim.jacobians(*states)
    torch.testing.assert_close(torch.autograd.grad(total, states, retain_graph=True), expected, rtol=0, atol=0)
    total = total + sim.step(*states)[0].sum()  # in the same rollout
    again = torch.autograd.grad(total, states)
    torch.testing.assert_close(again, tuple(2 * x for x in expected), rtol=0, atol=0)
    torch.testing.assert_close(A[:, :6].sum(1), torch.cat(expected[:2], 1), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(B[:, :6].sum(1), expected[2], rtol=1e-4, atol=1e-4)
