"""The joystick tasks: what they observe, remember and reward, and that a robot follows its servos as in MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from scenes import task_scene

import diffsim
from diffsim.env import DiffEnv
from diffsim.tasks import TASKS
from diffsim_robots.common import FREQUENCY_OF_PUSHES, score
from diffsim_robots.joystick import NEAR, SLIP, SPIN, Joystick

NAMES = "go1", "go2", "g1"
REAL = torch.float64


def task_of(name: str) -> Joystick:
    task = TASKS[name](dtype=REAL)
    assert isinstance(task, Joystick)
    return task


def some(task: Joystick, count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, task.num_random, dtype=REAL, generator=generator)


@pytest.mark.parametrize("name", NAMES)
def test_robots_are_their_files(name: str) -> None:
    """Joints in order, the keyframe, hips, the length of legs, and feet on the ground."""
    task, model = task_of(name), task_scene(name).mj_model
    robot, data = task.robot, mujoco.MjData(model)
    assert [model.joint(j).name.removesuffix("_joint") for j in range(1, model.njnt)] == list(robot.joints)
    np.testing.assert_allclose(model.key("home").qpos, [0, 0, robot.height, 1, 0, 0, 0, *robot.home])
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    feet = [g for g in range(1, model.ngeom) if model.geom_contype[g]]
    lowest = data.geom_xpos[feet, 2].min() - model.geom_size[feet[0], 0]
    assert abs(lowest) < 0.02
    for leg in robot.legs:
        pitch = model.joint(f"{leg.joints[0]}_joint")
        foot = data.geom_xpos[[g for g in feet if model.geom_bodyid[g] > pitch.bodyid[0]], :][0]
        hip = data.xanchor[pitch.id]
        assert abs(hip[2] - foot[2] - robot.length) < 0.1
        assert np.linalg.norm(hip[:2] - leg.place) < 0.06
    for joint, point in zip(task._feet.joint.view(len(robot.legs), -1)[:, -1].tolist(), task._feet.point, strict=True):
        body = model.jnt_bodyid[1 + joint]
        spheres = [g for g in feet if model.geom_bodyid[g] == body]  # the point is in the middle under them
        under = data.geom_xpos[spheres].mean(0) - (0, 0, model.geom_size[spheres[0], 0])
        np.testing.assert_allclose(
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ point[:, 0].numpy(), under, atol=1e-12
        )
    low, high = model.actuator_ctrlrange.T
    joints = model.actuator_trnid[:, 0]
    home = np.array(robot.home)[joints - 1]
    assert (low < home).all() and (home < high).all()  # the reference can be asked for


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_moves_the_feet_as_commanded(name: str) -> None:
    """In the middle of a stance each foot goes backward at the command's speed, sideways and in turns, too."""
    task, model = task_of(name), task_scene(name).mj_model
    data, step = mujoco.MjData(model), 1e-4
    for command in ([0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.5]):
        for leg in task.robot.legs:
            pitch = model.joint(f"{leg.joints[0]}_joint")
            foot = next(
                g for g in range(model.ngeom) if model.geom_contype[g] and model.geom_bodyid[g] > pitch.bodyid[0]
            )
            places = []
            for time in (-step, step):  # the stance's middle is three quarters through the leg's cycle
                clock = torch.tensor([0.75 - leg.phase + time * task.robot.cycle], dtype=REAL)
                joints = task.reference(torch.tensor(command, dtype=REAL), clock)
                data.qpos[:] = np.concatenate(([0, 0, 1, 1, 0, 0, 0], joints))
                mujoco.mj_kinematics(model, data)
                places.append(data.geom_xpos[foot].copy())
            vx, vy, turn = command
            expected = -np.array((vx - turn * leg.place[1], vy + turn * leg.place[0]))
            speed = (places[1] - places[0])[:2] / (2 * step)
            assert np.linalg.norm(speed - expected) < 0.25 * np.linalg.norm(expected) + 0.02


@pytest.mark.parametrize("name", NAMES)
def test_feet_are_where_mujoco_has_them(name: str, rng: np.random.Generator) -> None:
    """Their heights and velocities along the ground, of a robot that lies and moves in any way."""
    task, model = task_of(name), task_scene(name).mj_model
    data, legs = mujoco.MjData(model), len(task.robot.legs)
    for _ in range(5):
        turn = rng.standard_normal(4)
        joints = np.array(task.robot.home) + 0.3 * rng.standard_normal(model.nu)
        data.qpos[:] = np.concatenate(([0.1, 0.2, 0.15], turn / np.linalg.norm(turn), joints))
        data.qvel[:] = rng.standard_normal(model.nv)
        mujoco.mj_forward(model, data)
        qpos, qvel, still = torch.tensor(data.qpos), torch.tensor(data.qvel), torch.zeros(model.nu, dtype=REAL)
        obs = task.observe_with(qpos, qvel, still, torch.zeros(task.num_memory, dtype=REAL))
        for k, joint in enumerate(task._feet.joint.view(legs, -1)[:, -1].tolist()):
            foot = model.jnt_bodyid[1 + joint]
            point = data.xpos[foot] + data.xmat[foot].reshape(3, 3) @ task._feet.point[k, :, 0].numpy()
            mujoco.mj_jac(model, data, jacobian := np.zeros((3, model.nv)), None, point, foot)
            along = (jacobian @ data.qvel)[:2]
            near = np.exp(-((max(point[2], 0.0) / NEAR) ** 2))
            np.testing.assert_allclose(obs[k - 2 * legs], point[2] - task._rest[k], atol=1e-12)
            np.testing.assert_allclose(obs[k - legs], near * np.log1p(along @ along / SLIP), atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_lifts_its_feet_and_does_not_slip(name: str) -> None:
    """At 0.5 m/s, with the root at the height at which its lowest foot stands."""
    task, legs, count = task_of(name), len(task_of(name).robot.legs), 200
    clock = torch.arange(count, dtype=REAL).unsqueeze(1) / count
    memory = torch.cat((torch.tensor([0.5, 0, 0], dtype=REAL).expand(count, 3), clock), 1)
    memory = torch.cat((memory, torch.zeros(count, task.num_memory - 4, dtype=REAL)), 1)
    joints = task.reference(memory[:, :3], clock)
    rates = task.reference(memory[:, :3], clock + 1e-5) - task.reference(memory[:, :3], clock - 1e-5)
    root = task._start[:7].expand(count, 7).clone()
    root[:, 2] -= (root[:, 2:3] + task._feet.places(joints)[..., 2] - task._rest).min(1).values
    forward = torch.tensor([0.5, 0, 0, 0, 0, 0], dtype=REAL).expand(count, 6)
    qvel = torch.cat((forward, rates / 2e-5 * task.robot.cycle), 1)
    obs = task.observe_with(torch.cat((root, joints), 1), qvel, joints, memory)
    error, slip = obs[:, -2 * legs : -legs], obs[:, -legs:]
    swing = (2 * torch.pi * (clock + task._phases)).sin() > 0
    assert error.square().mean().sqrt() < 0.3 * task.robot.lift
    assert (slip * ~swing).mean() < 0.5 * np.log1p(0.1**2 / SLIP) and slip.max() > 0


def test_actions_come_late_and_the_robot_is_pushed() -> None:
    """By as much as the memory says, which is drawn; without disturbances what enters a step is what was asked."""
    task, n = task_of("go2"), 12
    memory = task.begin(some(task, 400))
    qvel, actions = torch.rand(400, 18, dtype=REAL), torch.rand(3, 400, n, dtype=REAL)
    same = task.disturb(qvel, action := actions[0], memory)
    assert same[0] is qvel and same[1] is action
    task.disturbances = {**task.disturbances, "latency": (0.5, 2.0), "push": (0.2, 0.4)}
    noise = torch.rand(3, 400, task.num_noise, dtype=REAL, generator=torch.Generator().manual_seed(1))
    noise[1, :, -3], noise[1, 0, -3] = 0.0, 1.0  # all are pushed, except one
    memory = task.begin(some(task, 400))
    late = memory[:, -6:-5]
    assert 0.5 <= late.min() < 0.51 and 1.99 < late.max() <= 2
    for action, drawn in zip(actions[:2], noise, strict=False):
        memory = task.remember(memory, action, drawn)
    pushed, given = task.disturb(qvel, actions[2], memory)
    kick = pushed - qvel
    assert torch.equal(memory[:, -6:-5], late) and (kick[0] == 0).all() and (kick[:, 2:] == 0).all()
    sizes = kick[1:].norm(dim=1)
    assert 0.2 <= sizes.min() < 0.21 and 0.39 < sizes.max() <= 0.4 and kick[1:, :2].mean(0).abs().max() < 0.05
    weights = torch.cat([(1 - (late - k).abs()).clamp(min=0) for k in range(3)], 1)
    torch.testing.assert_close(given, (weights.T.unsqueeze(2) * actions.flip(0)).sum(0))
    often = [task.remember(memory, actions[0], torch.rand(400, task.num_noise, dtype=REAL))[:, -2:] for _ in range(200)]
    share = (torch.stack(often) != 0).any(-1).double().mean()
    assert share == pytest.approx(task.control_dt * FREQUENCY_OF_PUSHES, rel=0.2)


def test_robots_are_pulled_steadily() -> None:
    """In a direction of each episode, and about the vertical axis by as much as it says."""
    task = task_of("go2")
    task.disturbances = {**task.disturbances, "pull": (0.2, 0.4)}
    memory, qvel = task.begin(some(task, 400)), torch.rand(400, 18, dtype=REAL)
    for drawn in torch.rand(5, 400, task.num_noise, dtype=REAL):
        pulled, _ = task.disturb(qvel, torch.zeros(400, 12, dtype=REAL), memory)
        change = (pulled - qvel) / task.control_dt
        memory = task.remember(memory, torch.zeros(400, 12, dtype=REAL), drawn)
        size = change[:, :2].norm(dim=1)
        assert 0.2 <= size.min() < 0.21 and 0.39 < size.max() <= 0.4 and change[:, :2].mean(0).abs().max() < 0.05
        spin = change[:, 5] / (SPIN * size)
        assert -1 <= spin.min() < -0.95 and 0.95 < spin.max() <= 1
    assert change[:, 2:5].abs().max() < 1e-12 and change[:, 6:].abs().max() < 1e-12


def test_gradients_pass_the_disturbances() -> None:
    """A command that comes a control step late moves the robot in the next one."""
    env = diffsim.make("go2", 4, seed=3, horizon=3)
    env.task.disturbances = {**env.task.disturbances, "latency": (1.0, 1.0), "push": (0.5, 0.5)}
    env.reset(seed=3)
    actions = torch.zeros(3, 4, 12).requires_grad_()
    states = [(env.step(action), env.qvel)[1] for action in actions.unbind()]
    states[0].sum().backward(retain_graph=True)
    assert actions.grad is not None and (actions.grad == 0).all()
    states[2].sum().backward()
    assert (actions.grad[:2].abs().sum(2) > 0).all() and (actions.grad[2] == 0).all()


def test_memory_holds_command_clock_actions_and_noise() -> None:
    task, n = task_of("go2"), 12
    memory = task.begin(some(task, 500))
    assert (memory[:, :3].abs() <= task._most).all() and (memory[:, 4:] == 0).all()
    assert 0.02 < (memory[:, :3] == 0).all(1).double().mean() < 0.25  # some stand
    noise = torch.full((500, task.num_noise), 0.75, dtype=REAL)
    noise[::2, 7] = 0.0  # a new command for every second robot
    noise[:, :3] = 1.0
    a, b = torch.rand(500, n, dtype=REAL), torch.rand(500, n, dtype=REAL)
    after = task.remember(task.remember(memory, a, noise), b, noise)
    assert torch.equal(after[1::2, :3], memory[1::2, :3])
    torch.testing.assert_close(after[::2, :3], task._most.expand(250, 3))
    torch.testing.assert_close(after[:, 3], (memory[:, 3] + 2 * 0.02 * task.robot.cycle) % 1.0)
    assert torch.equal(after[:, 4 : 4 + n], b) and torch.equal(after[:, 4 + n : 4 + 2 * n], a)
    torch.testing.assert_close(after[:, 4 + 2 * n : -6], (0.5 * task._noise).expand(500, -1))
    assert (after[:, -6:] == 0).all()  # no latency, no pull, no push


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_the_observation_are_what_they_are_called(name: str) -> None:
    """Of a robot whose x is the world's y: velocity and gravity are in its frame; the noise is the actor's alone."""
    task, n = task_of(name), len(TASKS[name].robot.joints)  # type: ignore[attr-defined]
    qpos, qvel = torch.rand(3, 7 + n, dtype=REAL), torch.rand(3, 6 + n, dtype=REAL)
    qpos[:, 3:7] = np.sqrt(0.5) * torch.tensor([1.0, 0, 0, 1])
    velocity = torch.stack((qvel[:, 1], -qvel[:, 0], qvel[:, 2]), 1)
    memory = torch.rand(3, task.num_memory, dtype=REAL)
    command, clock, last, before, noise, _ = memory.split((3, 1, n, n, 9 + 2 * n, 6), dim=-1)
    obs = task.named(task.observe_with(qpos, qvel, last, memory))
    names, sizes = zip(*task.obs_parts, strict=True)
    down, joints = torch.tensor([0, 0, -1.0], dtype=REAL).expand(3, 3), qpos[:, 7:] - task._home
    sensed = dict(zip(names[:5], (velocity, qvel[:, 3:6], down, joints, 0.1 * qvel[:, 6:]), strict=True))
    rest = dict(actions=last, command=command, height=qpos[:, 2:3], action_change=last - before)
    rest |= dict(clock_sin=(2 * torch.pi * clock).sin(), clock_cos=(2 * torch.pi * clock).cos())
    rest |= dict(joints_from_reference=qpos[:, 7:] - task.reference(command, clock))
    rest |= {f"true_{part}": value for part, value in sensed.items()}
    rest |= {part: sensed[part] + each for part, each in zip(sensed, noise.split(sizes[:5], dim=-1), strict=True)}
    feet = obs.pop("feet_from_reference"), obs.pop("feet_slip")  # see the tests of them
    assert feet[0].shape == feet[1].shape == (3, len(task.robot.legs))
    if name == "g1":
        left, right = task._feet.places(qpos[:, 7:]).unbind(1)
        rest["feet_apart"] = (left - right)[:, 1:2]
    assert obs.keys() == rest.keys() and sum(sizes[:9]) == task.actor_dim
    for part, value in rest.items():
        torch.testing.assert_close(obs[part], value)
    assert names[:5] == ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel_x0.1")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_lost_on_the_reference(name: str) -> None:
    """Of a robot that stands as commanded; tilting or sinking ends the episode."""
    task, n = task_of(name), len(task_of(name).robot.joints)
    memory = task.begin(some(task, 1))
    memory[:, :3] = 0.0
    qpos, qvel = task._start[None, : 7 + n].clone(), torch.zeros(1, 6 + n, dtype=REAL)
    action = torch.zeros(1, n, dtype=REAL)

    def observed(change: str = "", index: int = 0, by: float = 0.0) -> torch.Tensor:
        parts = {"qpos": qpos.clone(), "qvel": qvel.clone(), "memory": memory.clone()}
        if change:
            parts[change][:, index] += by
        return task.observe_with(parts["qpos"], parts["qvel"], action, parts["memory"])

    np.testing.assert_allclose(task.reward(observed(), action), task.weights["alive"], atol=1e-9)
    assert not task.terminated(observed())
    assert task.terminated(observed("qpos", 2, -0.5 * task.robot.height)) and task.terminated(observed("qpos", 4, 1.5))
    assert score(torch.tensor(0.0), 1.0) == 0 and score(torch.tensor(3.0), 1.0) == np.log(4.0).astype(np.float32)


@pytest.mark.parametrize("name", ["go2", "g1"])
def test_each_term_of_the_reward(name: str) -> None:
    """What it costs that one number of the critic's part is off; a G1's feet may be far apart, and not too near."""
    task, n, legs, d = task_of(name), len(task_of(name).robot.joints), len(task_of(name).robot.legs), 0.1
    names, sizes = zip(*task.obs_parts, strict=True)
    begin = dict(zip(names, np.cumsum((0, *sizes)), strict=False))
    best = torch.zeros(task.obs_dim, dtype=REAL)
    best[begin["height"]] = task.robot.height
    speed, yaw, tilt, calm = 0.5 * np.log1p(d**2 / 0.03), np.log1p(d**2 / 0.03) / 4, np.log1p(d**2 / 0.1), d**2 / 4
    expected = {"command": (speed, speed, yaw), "true_base_lin_vel": (speed, speed, 0.5 * np.log1p(d**2 / 0.5))}
    expected |= {"true_base_ang_vel": (0.2 * np.log1p(calm), 0.2 * np.log1p(calm), yaw)}
    expected |= {"true_projected_gravity": (0.4 * tilt, 0.4 * tilt, 0.0), "height": (0.2 * np.log1p(d**2 / 0.01),)}
    expected |= {"action_change": (-task.weights["action_rate"] * np.log1p(d**2 / n / 0.2),) * n}
    expected |= {"joints_from_reference": (1.2 * np.log1p(d**2 / 0.05) / n,) * n}
    expected |= {"feet_from_reference": (0.4 * np.log1p(d**2 / 0.0004) / legs,) * legs, "feet_slip": (0.15 * d / legs,)}
    if name == "g1":
        best[begin["feet_apart"]] = task.robot.apart + d
        expected["feet_apart"] = (0.0,)
        near = best.clone()
        near[begin["feet_apart"]] = task.robot.apart - d
        np.testing.assert_allclose(task.weights["alive"] - task.reward(near, near), np.log1p(d**2 / 0.003))
    for part, costs in expected.items():
        for k, cost in enumerate(costs):
            off = best.clone()
            off[begin[part] + k] += d
            np.testing.assert_allclose(
                task.weights["alive"] - task.reward(off, off), cost, atol=1e-12, err_msg=f"{part} {k}"
            )


def test_a_weight_of_zero_switches_a_term_off() -> None:
    """And no other one; all of them sum up to the reward."""
    task = task_of("g1")
    obs = torch.rand(5, task.obs_dim, dtype=REAL, generator=torch.Generator().manual_seed(0))
    terms, reward = task.reward_terms(obs, obs), task.reward(obs, obs)
    assert terms.keys() == task.weights.keys() and all(term.any() for term in terms.values())
    torch.testing.assert_close(sum(terms.values()), reward)
    for name, term in terms.items():
        task.weights = type(task).weights | {name: 0.0}
        torch.testing.assert_close(task.reward(obs, obs), reward - term)


def test_memory_goes_with_the_episode() -> None:
    """It is carried from step to step, detached and restored with the state, and begins anew with an episode."""
    env = diffsim.make("go2", 8, seed=3, horizon=4, max_episode_steps=3)
    obs, _ = env.reset(seed=3)
    first, actions = env.memory.clone(), torch.rand(3, 8, 12).requires_grad_()
    for action in actions[:2].unbind():
        _, reward, _, _, _ = env.step(action)
    reward.sum().backward()
    assert (actions.grad[0].abs() > 0).any()  # the second reward sees the first action
    saved = env.state_dict()
    assert env.detach().grad_fn is None and env.memory.grad_fn is None
    with torch.no_grad():
        obs, reward, _, truncated, info = env.step(actions[2])
    assert truncated.all() and (env.memory[:, 4:28] == 0).all() and not torch.equal(env.memory[:, :3], first[:, :3])
    twin = DiffEnv(env.task, env.scene, 8, horizon=4, max_episode_steps=3)
    twin.load_state_dict(saved)
    twin.detach()
    with torch.no_grad():
        _, again, _, _, told = twin.step(actions[2])
    assert torch.equal(told["final_obs"], info["final_obs"]) and torch.equal(again, reward)
    env.stochastic_init = False
    begun, _ = env.reset()
    assert (begun[:, 45:48] == 0).all()  # commands of zero


@pytest.mark.parametrize("name", NAMES)
def test_the_image_follows_the_mirrored_command(name: str) -> None:
    """With its clock half a cycle ahead it sees the image and gains the same; its motors turn its image's joints."""
    task, model, n = task_of(name), task_scene(name).mj_model, 8
    generator, mirror = torch.Generator().manual_seed(0), task.mirror
    qpos, qvel = task.reset(some(task, n))
    qpos[:, :7] += torch.randn(n, 7, dtype=REAL, generator=generator) * torch.tensor([1.0] * 3 + [0.3] * 4)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    action, last, before = torch.randn(3, n, model.nu, dtype=REAL, generator=generator)
    command, clock = (
        torch.randn(n, 3, dtype=REAL, generator=generator),
        torch.rand(n, 1, dtype=REAL, generator=generator),
    )
    noise, none = torch.randn(n, 9 + 2 * model.nu, dtype=REAL, generator=generator), torch.zeros(n, 6, dtype=REAL)
    memory = torch.cat((command, clock, last, before, noise, none), dim=1)
    turned = command * torch.tensor([1.0, -1.0, -1.0]), (clock + 0.5) % 1.0
    sensed = mirror.obs(torch.cat((noise, torch.zeros(n, task.obs_dim - noise.shape[1], dtype=REAL)), 1))
    image = torch.cat((*turned, *map(mirror.action, (last, before)), sensed[:, : noise.shape[1]], none), dim=1)
    obs = task.observe_with(qpos, qvel, action, memory)
    seen = task.observe_with(mirror.qpos(qpos), mirror.qvel(qvel), mirror.action(action), image)
    torch.testing.assert_close(seen, mirror.obs(obs), rtol=0, atol=1e-12)
    torch.testing.assert_close(task.reward(seen, mirror.action(action)), task.reward(obs, action), rtol=0, atol=1e-12)

    low, high = torch.tensor(model.actuator_ctrlrange.T)
    joints = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    targets = torch.zeros(2, n, model.nq, dtype=REAL)
    for target, asked in zip(targets, (action, mirror.action(action)), strict=True):
        target[:, joints] = (low + high) / 2 + (high - low) / 2 * asked
    torch.testing.assert_close(targets[1], mirror.qpos(targets[0]), rtol=0, atol=1e-12)
