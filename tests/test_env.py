"""DiffEnv as gymnasium knows it, and what a learner may rely on."""

from __future__ import annotations

import contextlib
import copy
import multiprocessing
import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from scenes import task_scene
from torch.autograd import forward_ad

import diffsim
from diffsim.numpy_env import NumpyVectorEnv
from diffsim.tasks import TASKS


def random_actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(steps, env.num_envs, env.scene.nu, generator=generator, dtype=env.dtype) - 1


def assert_same(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0)


def records(env, actions):
    """Everything that the steps return, stacked over time."""
    steps = [env.step(action) for action in actions]
    columns = {name: torch.stack([s[k] for s in steps]) for k, name in enumerate(("obs", "reward", "end", "timeout"))}
    for key in ("final_obs", "_final_obs", "nonfinite"):
        columns[key] = torch.stack([s[4][key] for s in steps])
    for key in "rlt":
        columns[key] = torch.stack([s[4]["episode"][key] for s in steps])
    return {name: column.detach() for name, column in columns.items()}


@pytest.mark.parametrize("name", TASKS)
def test_spaces(name):
    env = diffsim.make(name, num_envs=3, seed=0)
    sizes = env.task.obs_dim, env.scene.nu
    assert (env.single_observation_space.shape, env.single_action_space.shape) == (sizes[:1], sizes[1:])
    assert env.observation_space.shape == (3, sizes[0]) and env.action_space.shape == (3, sizes[1])
    assert (env.single_action_space.low == -1).all() and (env.single_action_space.high == 1).all()
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP and isinstance(env, gymnasium.vector.VectorEnv)
    obs, info = env.reset(seed=1)
    assert info == {} and obs.dtype == torch.float32 and obs.isfinite().all()
    assert obs.numpy() in env.observation_space
    assert env.episode_length == TASKS[name].episode_length and env.control_dt == TASKS[name].control_dt


def test_episodes_end_restart_and_are_counted():
    """SAME_STEP autoreset and the statistics, against a loop that does them by hand."""
    env = diffsim.make("hopper", num_envs=6, seed=2)
    obs, _ = env.reset(seed=2)
    returns, lengths, ends = np.zeros(6), np.zeros(6, int), 0
    for action in random_actions(env, 150):
        before = env.qpos.clone()
        with torch.no_grad():
            obs, reward, terminated, truncated, info = env.step(action)
        returns, lengths = returns + reward.numpy(), lengths + 1
        done = (terminated | truncated).numpy()
        np.testing.assert_array_equal(terminated, info["final_obs"][:, 0] < -0.45)
        assert not truncated.any()
        np.testing.assert_array_equal(info["_final_obs"], done)
        np.testing.assert_array_equal(info["_episode"], done)
        np.testing.assert_allclose(info["episode"]["r"][done], returns[done], rtol=1e-5)
        np.testing.assert_array_equal(info["episode"]["l"][done], lengths[done])
        np.testing.assert_allclose(info["episode"]["t"][done], lengths[done] / 60, rtol=1e-6)
        assert_same(obs[~done], info["final_obs"][~done])
        # A new episode starts upright and near the origin; the old one went on from where it was.
        assert (obs[done, 0].abs() <= 0.05).all() and (env.qpos[done].abs() <= 0.05).all()
        assert (env.qpos[~done] - before[~done]).abs().max() < 1
        assert_same(obs[:, :5], env.qpos[:, 1:])
        assert_same(obs[:, 5:], env.qvel)
        np.testing.assert_array_equal(env.episode_step, np.where(done, 0, lengths))
        returns[done], lengths[done], ends = 0, 0, ends + done.sum()
    assert ends >= 6


def test_statistics_are_sums_since_they_were_taken():
    env = diffsim.make("cartpole", num_envs=3, horizon=1, max_episode_steps=4)
    env.reset(seed=0)
    expected = {"episodes": 0.0, "return": 0.0, "length": 0.0, "nonfinite": 1.0, "nonfinite_gradients": 3.0}
    with torch.no_grad():
        for step, action in enumerate(random_actions(env, 10)):
            if step == 1:  # thrown out of the finite numbers, it ends and starts anew
                env.qvel = torch.where(torch.tensor([[True], [False], [False]]), torch.inf, env.qvel)
            info = env.step(action)[-1]
            ended = info["_episode"]
            expected["episodes"] += ended.sum().item()
            expected["return"] += info["episode"]["r"][ended].sum().item()
            expected["length"] += info["episode"]["l"][ended].sum().item()
    env.sim.nonfinite_gradients += 1
    taken = env.take_statistics()
    assert expected["episodes"] == 7
    assert {name: value.item() for name, value in taken.items()} == pytest.approx(expected)
    assert not any(value.any() for value in env.take_statistics().values())


def test_early_termination_can_be_off():
    """A robot that lies goes on; one whose simulation blows up does not."""
    env = diffsim.make("hopper", num_envs=2, early_termination=False, seed=0)
    env.set_state(torch.full((2, 6), -0.6), torch.tensor([[0.0], [1e30]]).repeat(1, 6))
    with torch.no_grad():
        obs, _, terminated, _, info = env.step(torch.zeros(2, 3))
    assert (info["final_obs"][:, 0] < -0.45).all()
    assert terminated.tolist() == info["nonfinite"].tolist() == [False, True]
    assert_same(obs[0], info["final_obs"][0])


def test_seed_decides_everything():
    def run(seed, reset_seed=None):
        env = diffsim.make("hopper", num_envs=3, seed=seed)
        if reset_seed is not None:
            env.reset(seed=reset_seed)
        with torch.no_grad():
            return records(env, random_actions(env, 100))

    first = run(4)
    assert first["_final_obs"].any()
    for again in (run(4), run(9, reset_seed=4)):
        # reset draws once more than construction does, so only the seed given last counts.
        assert all(torch.equal(x, again[key]) for key, x in first.items())
    assert not torch.equal(first["obs"], run(5)["obs"])
    assert not torch.equal(diffsim.make("hopper", num_envs=1).qpos, diffsim.make("hopper", num_envs=1).qpos)


def test_reset_begins_a_window_and_keeps_its_seed():
    env = diffsim.make("hopper", num_envs=3, seed=2, horizon=2)
    actions = random_actions(env, 3).requires_grad_()
    env.step(actions[0])
    assert env.np_random_seed == 2
    _, info = env.reset(seed=np.int64(5))
    assert info == {} and env.episode_step.tolist() == [0, 0, 0] and env.np_random_seed == 5
    assert_same(env.qpos, diffsim.make("hopper", num_envs=3, seed=5).qpos)
    env.step(actions[1])
    (gradient,) = torch.autograd.grad(env.step(actions[2])[0].sum(), actions)  # of a rollout of two
    assert (gradient[0] == 0).all() and (gradient[1:] != 0).any()


@pytest.mark.parametrize(
    "arguments, message",
    [
        *((dict(options=options), "but reset takes none") for options in (5, {"mask": True})),
        *(
            (dict(seed=seed), "must be one integer of 64 bits, which seeds all")
            for seed in (True, 1.5, "a", [1, 2], 10**30)
        ),
    ],
)
def test_reset_refuses(arguments, message):
    env = diffsim.make("hopper", num_envs=2, seed=np.int64(3))
    qpos = env.qpos.clone()
    with pytest.raises(ValueError, match=message):
        env.reset(**arguments)
    assert_same(env.qpos, qpos)


LAYOUTS = {
    r"action is torch.sparse_coo \(4, 1\) torch.float32 cpu, must be": torch.Tensor.to_sparse,
    r"action is torch.sparse_csr \(4, 1\) torch.float32 cpu, must be": torch.Tensor.to_sparse_csr,
    "action is nested, must be": lambda dense: torch.nested.nested_tensor([*dense]),
    "action is torch.jagged nested, must be": lambda dense: torch.nested.nested_tensor([*dense], layout=torch.jagged),
}


@pytest.mark.parametrize("message", LAYOUTS)
@pytest.mark.filterwarnings("ignore")  # torch's, about its layouts
def test_actions_of_other_layouts_are_refused(message):
    env = diffsim.make("cartpole", num_envs=4, seed=0)
    with pytest.raises(ValueError, match=rf"{message} a torch.Tensor of \(4, 1\) torch.float32 cpu"):
        env.step(LAYOUTS[message](torch.zeros(4, 1)))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
def test_a_forked_child_has_threads_of_its_own():
    env, actions = diffsim.make("hopper", num_envs=40, seed=1, threads=2), torch.zeros(40, 3)
    with torch.no_grad():
        env.step(actions)
        saved, expected = env.state_dict(), env.step(actions)[0]

        def step():
            env.load_state_dict(saved)
            assert_same(env.step(actions)[0], expected)

        child = multiprocessing.get_context("fork").Process(target=step)
        child.start()
        child.join(60)
    hangs = child.is_alive()
    child.kill()
    assert not hangs and child.exitcode == 0


def test_no_grad_takes_the_same_steps():
    for name in ("hopper", "ant"):
        envs = [diffsim.make(name, num_envs=3, seed=1, horizon=16) for _ in range(2)]
        actions = random_actions(envs[0], 16)
        with torch.no_grad():
            plain = records(envs[0], actions)
        recorded = records(envs[1], actions.clone().requires_grad_())
        for key, value in plain.items():
            assert_same(value, recorded[key])
        assert not envs[0].qpos.requires_grad and envs[1].qpos.requires_grad


def test_no_gradient_crosses_a_reset():
    env = diffsim.make("hopper", num_envs=2, seed=0, horizon=2)
    qpos = env.qpos.clone()
    qpos[1, 1:3] = torch.tensor([-0.6, 1.5])  # has fallen on its face
    env.set_state(qpos, env.qvel)
    action = torch.zeros(2, 3, requires_grad=True)
    obs, _, terminated, _, info = env.step(action)
    later, reward, _, _, _ = env.step(torch.zeros(2, 3))
    assert terminated.tolist() == [False, True]
    (through,) = torch.autograd.grad(obs.sum() + later.sum() + reward.sum(), action, retain_graph=True)
    (final,) = torch.autograd.grad(info["final_obs"].sum(), action)
    assert (through[0] != 0).all() and (through[1] == 0).all()
    assert (final != 0).all()


def test_set_state():
    env = diffsim.make("ant", num_envs=2, seed=0)
    qpos, qvel = ((x + change).requires_grad_() for x, change in ((env.qpos, 0.1), (env.qvel, -0.1)))
    with torch.no_grad():
        env.step(torch.ones(2, 8))
    obs = env.set_state(qpos, qvel)
    assert_same(env.qpos, qpos)
    assert_same(env.qvel, qvel)
    assert_same(obs, env.task.observe(qpos, qvel, torch.zeros(2, 8)))
    assert env.episode_step.tolist() == [1, 1]
    _, reward, _, _, info = env.step(torch.ones(2, 8))
    with torch.no_grad():
        expected = env.task.observe(*env.sim.step(qpos, qvel, torch.ones(2, 8)), torch.ones(2, 8))
    assert_same(info["final_obs"].detach(), expected)
    assert all((g != 0).any() for g in torch.autograd.grad(reward.sum(), [qpos, qvel]))


def test_what_a_caller_has_is_his_own():
    """In-place changes of observations, and of tensors that were set or loaded, do not reach the environment."""
    env = diffsim.make("hopper", num_envs=3, seed=0)
    given, state = [x.clone() for x in (env.qpos, env.qvel)], env.state_dict()
    calls = {
        "reset": lambda: env.reset(seed=1)[0],
        "step": lambda: env.step(torch.zeros(3, 3))[0],
        "detach": env.detach,
        "set_state": lambda: env.set_state(*given),
        "load_state_dict": lambda: env.load_state_dict(state) or state["obs"],
    }
    for name, call in calls.items():
        obs = call()
        before = env.state_dict()
        for tensor in (
            obs,
            *given,
            *(x for x in state.values() if isinstance(x, torch.Tensor) and x.is_floating_point()),
        ):
            tensor.sub_(1)
        for key, value in env.state_dict().items():
            assert key == "task" or torch.equal(value, before[key]), (name, key)
        assert torch.equal(env.detach(), before["obs"]), name


@contextlib.contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize("name", TASKS)
def test_torchs_modes_and_defaults_do_not_matter(name, monkeypatch):
    """Of dtype, device, autocast and inference_mode, in which an environment is made, reset and stepped."""
    if name not in ("hopper", "go1"):  # the kernels are the same
        monkeypatch.setattr(diffsim.Simulator, "advance", lambda _, qpos, qvel, ctrl: (qpos, qvel + 0.01 * ctrl.sum()))

    def run():
        env = diffsim.make(name, num_envs=2, seed=0, horizon=2)
        start = env.reset(seed=1)[0]
        action = torch.full((2, env.scene.nu), 0.3, dtype=torch.float32, device="cpu", requires_grad=True)
        obs, reward, *_ = env.step(action)
        return env, (start, obs, reward), action

    env, expected, action = run()
    (expected_grad,) = torch.autograd.grad(expected[2].sum(), action)
    modes = default_dtype(torch.bfloat16), torch.device("meta"), torch.autocast("cpu", torch.bfloat16)
    for mode in (*modes, torch.inference_mode()):
        with mode:
            env, found, leaf = run()
        for value, wanted in zip(found, expected, strict=True):
            assert_same(value, wanted)
        if found[2].requires_grad:
            found[2].sum().backward()
            assert_same(leaf.grad, expected_grad)
        env.detach()
        env.step(action)[1].sum().backward()  # it can be trained from


def test_a_state_of_another_kind_is_refused():
    """walker and half_cheetah have equally many numbers."""
    base = dict(name="half_cheetah", num_envs=3, dtype=torch.float32)
    env, others = diffsim.make(**base, seed=1), (dict(name="walker"), dict(num_envs=4), dict(dtype=torch.float64))
    qpos = env.qpos.clone()
    theirs = "task is walker; ", r"qpos is \(4, 9\) torch.float32; ", r"qpos is \(3, 9\) torch.float64; "
    for arguments, message in zip(others, theirs, strict=True):
        with pytest.raises(ValueError, match=f"the state's {message}this environment's is"):
            env.load_state_dict(diffsim.make(**base | arguments).state_dict())
    with pytest.raises(ValueError, match="the state has qpos; that of an environment has task, qpos"):
        env.load_state_dict({"qpos": qpos})
    assert_same(env.qpos, qpos)


def along(function, x, tangent):
    """The derivative by forward mode, without torch.func."""
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(function(forward_ad.make_dual(x, tangent))).tangent


DERIVATIVES = {
    "create_graph": lambda f, x: torch.autograd.grad(f(x), x, create_graph=True),
    "is_grads_batched": lambda f, x: torch.autograd.grad(f(x).expand(2), x, torch.eye(2), is_grads_batched=True),
    "forward mode": lambda f, x: along(f, x.detach(), torch.ones_like(x)),
    "forward over reverse": lambda f, x: along(lambda x: torch.autograd.grad(f(x.requires_grad_()), x)[0], x, x + 1),
    "a dual loss": lambda f, x: along(lambda w: torch.autograd.grad(f(x) * w, x)[0], torch.ones(()), torch.ones(())),
    "jvp": lambda f, x: torch.func.jvp(f, (x.detach(),), (torch.ones_like(x),)),
    "vmap": lambda f, x: torch.func.vmap(f)(x.detach().expand(3, *x.shape)),
    **{name: (lambda f, x, name=name: getattr(torch.func, name)(f)(x)) for name in ("grad", "jacrev", "jacfwd")},
}


@pytest.mark.parametrize("kind", DERIVATIVES)
def test_other_derivatives_than_backward_are_refused(kind):
    """By the simulator and by the environment, in words that say what to take; and nothing has changed."""
    env = diffsim.make("hopper", num_envs=2, horizon=2)
    qpos, action = env.qpos, torch.zeros(2, 3)
    message = (
        "first derivative only, so no create_graph"
        if kind == "create_graph"
        else "supports backward.*Simulator.jacobians"
    )
    for step in (lambda a: env.step(a)[1].sum(), lambda a: env.sim.step(qpos, env.qvel.detach(), a)[1].sum()):
        env.sim.step(qpos, env.qvel.detach(), action)  # a first one prepares its kernels
        env.detach()
        with pytest.raises(RuntimeError, match=message) as error:
            DERIVATIVES[kind](step, action.clone().requires_grad_())
        assert "\n" not in str(error.value)
    if kind not in ("create_graph", "is_grads_batched", "a dual loss"):
        assert_same(env.qpos, qpos)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_environments_cannot_be_copied(copied):
    env = diffsim.make("cartpole", num_envs=2)
    for thing in (env, env.sim, NumpyVectorEnv(env)):
        with pytest.raises(TypeError, match=r"cannot be pickled or copied.*state_dict\(\)"):
            copied(thing)
    assert_same(copy.deepcopy(env.state_dict())["qpos"], env.qpos)


def test_counts_are_integers():
    counts = dict(num_envs=np.int64(2), horizon=np.int32(3), substeps=np.uint8(8), threads=np.int64(2))
    env = diffsim.make("hopper", **counts, max_episode_steps=np.int64(2), seed=0)
    reward = sum(env.step(action)[1] for action in random_actions(env, 3).requires_grad_())
    reward.sum().backward()
    assert env.episode_step.tolist() == [1, 1] and type(env.num_envs) is int
    for name in counts:
        with pytest.raises(ValueError, match=f"{name} is True, must be an integer"):
            diffsim.make("hopper", **{"num_envs": 2, name: True})


def test_more_than_memory(monkeypatch):
    scene, env = task_scene("hopper"), diffsim.make("hopper", num_envs=2, horizon=2000, substeps=10**6)
    monkeypatch.setattr(torch, "zeros", None)  # nothing is allocated
    for make in (partial(diffsim.make, "hopper"), partial(diffsim.Simulator, scene)):
        with pytest.raises(
            ValueError,
            match="100,000,000,000: the states and actions of a horizon of .* steps would take .* GiB, but cpu has",
        ):
            make(num_envs=10**11)
    with pytest.raises(ValueError, match="num_envs is 2: the checkpoints would take .* GiB, .* enough for 0 environ"):
        env.step(torch.full((2, 3), 0.0, requires_grad=True))


def test_control_steps_of_another_length():
    """One of three times the length and as many more substeps is three of the task's own."""
    ends = []
    for count, substeps in ((6, 4), (2, 12)):
        env = diffsim.make("cartpole", 2, dtype=torch.float64, substeps=substeps, control_dt=0.1 / count, seed=0)
        assert env.single_observation_space.dtype == np.float64
        with torch.no_grad():
            for _ in range(count):
                obs, reward, *_ = env.step(torch.full((2, 1), 0.3, dtype=torch.float64))
        assert obs.dtype == reward.dtype == torch.float64
        ends.append(env.qpos.clone())
    torch.testing.assert_close(ends[0], ends[1])
    assert env.control_dt == 0.05 and env.metadata["render_fps"] == 20
