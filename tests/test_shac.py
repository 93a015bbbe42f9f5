"""SHAC's parts against plain reference implementations, and the script as its users run it."""

from __future__ import annotations

import csv
import json
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_derivatives, assert_refuses, assert_refuses_a_missing_gpu, assert_same
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import diffsim
import shac
from diffsim import evaluation

GAMMA, LAM = 0.97, 0.9
# Ten windows of cartpole with a time-out in the eighth, and an evaluation on the way.
SMALL = "--env cartpole --num-envs 3 --iterations 10 --eval-every 4 --eval-episodes 3 --quiet".split()


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["shac.py"])


def random_window(rng: np.random.Generator, horizon: int = 12, num_envs: int = 50, obs_dim: int = 3) -> shac.Window:
    """Rewards and observations at random; a fifth of the steps ends an episode, by termination or by time-out."""
    size = (horizon, num_envs)
    kind = rng.choice(3, size=size, p=(0.8, 0.1, 0.1))
    real = [torch.tensor(rng.normal(size=s), requires_grad=True) for s in ((*size, obs_dim), (*size, obs_dim), size)]
    terminated, truncated = torch.tensor(kind == 1), torch.tensor(kind == 2)
    return shac.Window(*real, terminated, truncated, *[torch.zeros(size)] * 3)


@pytest.mark.parametrize("lam", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("horizon", [1, 12])
def test_td_lambda_is_equation_7(rng: np.random.Generator, lam: float, horizon: int) -> None:
    window = random_window(rng, horizon)
    reward, done = window.reward.detach().numpy(), window.done.numpy()
    value = rng.normal(size=reward.shape)
    expected = np.zeros_like(reward)
    for i in range(reward.shape[1]):
        for t in range(horizon):
            n = next((k for k in range(1, horizon - t) if done[t + k - 1, i]), horizon - t)  # steps to the end
            returns = [
                sum(GAMMA**step * reward[t + step, i] for step in range(k)) + GAMMA**k * value[t + k - 1, i]
                for k in range(1, n + 1)
            ]
            expected[t, i] = (1 - lam) * sum(lam ** (k - 1) * returns[k - 1] for k in range(1, n))
            expected[t, i] += lam ** (n - 1) * returns[n - 1]
    result = shac.td_lambda(window.reward.detach(), torch.tensor(value), window.done, GAMMA, lam)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("horizon", [1, 12])
def test_actor_loss_and_its_gradient_are_those_of_a_loop(rng: np.random.Generator, horizon: int) -> None:
    window = random_window(rng, horizon)
    critic = shac.mlp(3, (8,), 1, orthogonal=True).double()
    normalise = shac.Normaliser(3).double()
    normalise.update(torch.tensor(rng.normal(1.0, 3.0, size=(100, 3))))

    loss = torch.zeros((), dtype=torch.float64)
    for i in range(window.reward.shape[1]):
        discount = 1.0
        for t in range(horizon):
            loss = loss - discount * window.reward[t, i]
            discount *= GAMMA
            timed_out = window.truncated[t, i] or (t == horizon - 1 and not window.terminated[t, i])
            if timed_out:  # the episode, or the window; a terminated one has no value
                loss = loss - discount * critic(normalise(window.next_obs[t, i]))[0]
            if window.terminated[t, i] or window.truncated[t, i]:
                discount = 1.0
    loss = loss / window.reward.numel()

    result = shac.actor_loss(window.reward, shac.next_values(critic, normalise, window), window.done, GAMMA)
    torch.testing.assert_close(result, loss)
    inputs = window.reward, window.next_obs
    torch.testing.assert_close(torch.autograd.grad(result, inputs), torch.autograd.grad(loss, inputs))


def test_observation_statistics_are_those_of_all_data(rng: np.random.Generator) -> None:
    normalise = shac.Normaliser(4)
    windows = [rng.normal((0, 5, -100, 1e-3), (1, 10, 0.1, 1e-3), size=(8, 6, 4)) for _ in range(20)]
    probe = torch.randn(5, 4)
    torch.testing.assert_close(normalise(probe), probe)  # nothing seen yet
    for window in windows:
        normalise.update(torch.tensor(window, dtype=torch.float32))
    data = np.concatenate(windows).reshape(-1, 4)
    np.testing.assert_allclose(normalise.mean, data.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(normalise.var, data.var(0), rtol=1e-3)
    expected = (probe.double() - torch.tensor(data.mean(0))) / torch.tensor(data.var(0) + 1e-5).sqrt()
    torch.testing.assert_close(normalise(probe).double(), expected, rtol=1e-3, atol=1e-3)


def test_gradient_of_the_actor_loss_is_its_finite_difference() -> None:
    """The paper's Fig. 11: policy weights one at a time, of ants that run out of time, fall, and do neither."""
    torch.manual_seed(0)
    env = diffsim.make("ant", num_envs=3, seed=0, horizon=8, dtype=torch.float64)
    args = shac.Args(actor_hidden=(16,), critic_hidden=(16,))
    actor, normalise = (part.double() for part in shac.build(args, env))
    critic = shac.mlp(37, (16,), 1, orthogonal=True).double()
    with torch.no_grad():
        for _ in range(2):
            normalise.update(shac.collect(env, actor, normalise, actor.sample_noise(8, 3)).obs)
    env.episode_step[1] = env.episode_length - 4
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    qpos[2, 2], qvel[2, 2] = 0.4, -6.0
    env.set_state(qpos, qvel)
    start = env.state_dict()
    noise = torch.randn(8, 3, 8, dtype=torch.float64)

    def loss() -> torch.Tensor:
        env.load_state_dict(start)
        window = shac.collect(env, actor, normalise, actor.log_std.exp() * noise)
        assert window.truncated.any(0).tolist() == [False, True, False]
        assert window.terminated.any(0).tolist() == [False, False, True]
        return shac.actor_loss(window.reward, shac.next_values(critic, normalise, window), window.done, GAMMA)

    places = (("mean.0.weight", 40), ("mean.2.bias", 3), ("mean.3.weight", 7), ("log_std", 2))
    assert_derivatives(dict(actor.named_parameters()), loss, places, rel=5e-6)


def test_clipped_adam_is_adam_after_clipping_and_skips_bad_gradients() -> None:
    torch.manual_seed(0)
    args = shac.Args(betas=(0.7, 0.95), max_grad_norm=0.5)
    ours = shac.mlp(3, (5,), 1, orthogonal=False)
    theirs = shac.mlp(3, (5,), 1, orthogonal=False)
    theirs.load_state_dict(ours.state_dict())
    optimizer = shac.ClippedAdam(ours, args)
    optimizer.lr.fill_(1e-2)
    reference = torch.optim.Adam(theirs.parameters(), lr=1e-2, betas=args.betas)
    for scale in (1.0, 1e-3, float("nan"), 10.0, float("inf"), 1e9, 1.0):
        inputs = torch.randn(20, 3)
        before = optimizer.vector.clone()
        norm = optimizer.step(scale * ours(inputs).square().mean())
        if norm < 1e6:
            reference.zero_grad()
            (scale * theirs(inputs).square().mean()).backward()
            torch.testing.assert_close(norm, torch.nn.utils.clip_grad_norm_(theirs.parameters(), 0.5))
            reference.step()
        else:
            torch.testing.assert_close(optimizer.vector, before, rtol=0, atol=0)
        for p, q in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(p, q)
    assert optimizer.skipped == 3


# The script -----------------------------------------------------------------------------------------------------------


def run(directory: Path, *arguments: object) -> dict[str, Any]:
    """Trains in directory; returns the checkpoint."""
    shac.main([*map(str, arguments), "--run-dir", str(directory)])
    return torch.load(directory / "checkpoint.pt", weights_only=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("trained")
    run(directory, *SMALL)
    return directory


@pytest.fixture(scope="module")
def checkpoint(trained: Path) -> dict[str, Any]:
    return torch.load(trained / "checkpoint.pt", weights_only=True)


def test_same_seed_same_weights_other_seed_others(checkpoint: dict[str, Any], tmp_path: Path) -> None:
    same = run(tmp_path / "same", *SMALL, "--threads", 1)
    other = run(tmp_path / "other", *SMALL, "--seed", 2, "--stop-after", 1)
    for part in ("actor", "critic", "target", "normalise", "actor_optimizer", "critic_optimizer", "ranks"):
        assert_same(same[part], checkpoint[part])
    for name, weight in other["actor"].items():
        if name.endswith("weight") and weight.ndim == 2:
            assert not torch.equal(weight, checkpoint["actor"][name])


@pytest.mark.parametrize("how", ["stop-after", "signal"])
def test_resume_continues_bitwise(
    checkpoint: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    path = tmp_path / "checkpoint.pt"
    if how == "stop-after":
        run(tmp_path, *SMALL, "--stop-after", 5)
    else:
        evaluate = shac.evaluate

        def interrupted(*arguments: Any) -> Any:
            signal.raise_signal(signal.SIGTERM)
            return evaluate(*arguments)

        monkeypatch.setattr(shac, "evaluate", interrupted)
        with pytest.raises(SystemExit) as exit:
            run(tmp_path, *SMALL)
        monkeypatch.undo()
        assert exit.value.code == 128 + signal.SIGTERM
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert torch.load(path, weights_only=True)["iteration"] == 5
    with (tmp_path / "progress.csv").open("a") as file:  # of iterations after the checkpoint, as a crash leaves them
        file.write("9,999,9.9" + "," * 10 + "\n")
    shac.main(["--resume", str(path)])
    resumed = torch.load(path, weights_only=True)
    for name in checkpoint.keys() - {"seconds"}:
        assert_same(resumed[name], checkpoint[name])
    with (tmp_path / "progress.csv").open() as file:
        assert [int(row["iteration"]) for row in csv.DictReader(file)] == list(range(1, 11))


def test_files_of_a_run(trained: Path) -> None:
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["actor_lr"] == 1e-2 and arguments["num_envs"] == 3 and arguments["substeps"] == 4
    with (trained / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["control_steps"]) for row in rows] == [3 * 32 * k for k in range(1, 11)]
    assert [bool(row["eval_return"]) for row in rows] == [k in (4, 8, 10) for k in range(1, 11)]
    assert [row["length"] for row in rows] == [""] * 7 + ["240.0"] * 3
    assert all(float(row["skipped"]) == float(row["nonfinite"]) == 0 for row in rows)
    events = EventAccumulator(str(trained))
    events.Reload()
    expected = (
        "charts/episodic_return charts/episodic_length charts/SPS losses/actor losses/critic grad/norm sim/nonfinite"
    )
    expected += " time/sim_forward time/sim_backward time/critic time/total eval/return"
    assert set(expected.split()) <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("grad/norm")] == [3 * 32 * k for k in range(1, 11)]
    assert not list(trained.glob("*.tmp"))


def test_learning_rates_decay_linearly(trained: Path, tmp_path: Path, checkpoint: dict[str, Any]) -> None:
    last = 1e-2 + (1e-5 - 1e-2) * 9 / 10
    assert checkpoint["actor_optimizer"]["adam"]["param_groups"][0]["lr"].item() == pytest.approx(last)


def test_evaluate(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (trained / "checkpoint.pt").read_bytes()
    evaluate = ["--evaluate", str(trained / "checkpoint.pt")]
    shac.main(evaluate)
    same = capsys.readouterr().out
    with (trained / "progress.csv").open() as file:
        final = float(list(csv.DictReader(file))[-1]["eval_return"])
    assert same.startswith(f"cartpole, 3 episodes: return median {final:.1f}, mean ")
    shac.main([*evaluate, "--substeps", "16", "--eval-episodes", "4"])
    finer = capsys.readouterr().out
    assert finer.startswith("cartpole, 4 episodes: return median ")
    assert (trained / "checkpoint.pt").read_bytes() == before


def test_accuracy_and_penalty_are_stored_and_can_be_replaced(tmp_path: Path) -> None:
    fast, accurate = (diffsim.TASKS["cartpole"].integration(name) for name in ("fast", "accurate"))
    checkpoint = run(tmp_path, *SMALL, "--accuracy", "fast", "--penalty", "k_limit=50", "mu=0.5", "--stop-after", 1)
    saved = checkpoint["args"]
    assert (saved["accuracy"], saved["integrator"], saved["substeps"]) == ("fast", fast.integrator, fast.substeps)

    def simulator(*arguments: str) -> diffsim.Simulator:
        args, _ = shac.parse(["--evaluate", str(tmp_path / "checkpoint.pt"), *arguments])
        return shac.make_env(args, 1, 1).sim

    sim = simulator()
    assert sim.integration == fast
    assert (sim.scene.k_limit, sim.scene.mu) == (50.0, 0.5)
    sim = simulator("--accuracy", "accurate")
    assert sim.integration == accurate
    sim = simulator("--substeps", "16", "--integrator", "semi_implicit", "--penalty", "k_limit=100")
    assert (sim.integration, sim.scene.k_limit) == (("semi_implicit", 16, 0.0), 100.0)


def test_evaluation_counts_first_episodes_only() -> None:
    """Against a loop over each environment's own rewards, for ants that fall at different times."""
    torch.manual_seed(0)
    env = diffsim.make("ant", num_envs=4, horizon=1, threads=1)
    actor, normalise = shac.build(shac.Args(actor_hidden=(8,)), env)
    result = shac.evaluate(env, lambda obs: actor(normalise(obs)))
    obs, _ = env.reset(seed=evaluation.SEED)
    total, length, ended = [0.0] * 4, [0] * 4, [False] * 4
    start, stop = env.qpos[:, 0].tolist(), env.qpos[:, 0].tolist()
    with torch.no_grad():
        while not all(ended):
            x = env.qpos[:, 0].tolist()
            obs, reward, terminated, truncated, _ = env.step(actor(normalise(obs)))
            for i in range(4):
                if not ended[i]:
                    total[i], length[i], stop[i] = total[i] + reward[i].item(), length[i] + 1, x[i]
                    ended[i] = bool(terminated[i] or truncated[i])
    np.testing.assert_allclose(result.returns, total, rtol=1e-4)
    assert result.lengths.tolist() == length
    speed = (sum(stop) - sum(start)) / ((sum(length) - 4) / 60)
    assert result.speed == pytest.approx(speed, rel=1e-4)


@pytest.mark.parametrize(
    "arguments",
    [
        "--num-envs 1 --horizon 1",
        "--num-envs 3 --horizon 5 --critic-minibatches 7 --deterministic-policy --general-hyperparameters",
        "--num-envs 2 --integrator implicit --substeps 2 --eval-every 2 --threads 1",
    ],
)
def test_unusual_settings_train(arguments: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = run(tmp_path, "--env-id", "cartpole", *arguments.split(), "--iterations", 3, "--eval-episodes", 1)
    assert checkpoint["iteration"] == 3 and checkpoint["actor_optimizer"]["skipped"] == 0
    assert all(weight.isfinite().all() for name, weight in checkpoint["critic"].items())
    if "general" in arguments:
        assert checkpoint["args"]["target_alpha"] == 0.995 and checkpoint["args"]["actor_hidden"] == (256, 128)
        assert checkpoint["args"]["iterations"] == 3 and checkpoint["args"]["num_envs"] == 3
    out = capsys.readouterr().out
    assert "3/3" in out and "it/s" in out and "left" in out and "return median" in out


def test_without_critic_only_the_rewards_of_the_window_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loss, next_values = shac.actor_loss, []

    def recorded(reward: torch.Tensor, next_value: torch.Tensor, *rest: Any) -> torch.Tensor:
        next_values.append(next_value)
        return loss(reward, next_value, *rest)

    monkeypatch.setattr(shac, "actor_loss", recorded)
    without = run(tmp_path / "without", *SMALL, "--no-critic", "--stop-after", 2)
    assert len(next_values) == 2 and not any(value.any() for value in next_values)
    assert not without["critic_optimizer"]["adam"]["state"]  # never stepped
    assert_same(without["critic"], without["target"])
    run(tmp_path / "with", *SMALL, "--stop-after", 1)
    assert next_values[2].any()


def test_a_bad_gradient_is_seen_counted_and_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loss, calls = shac.actor_loss, []

    def sometimes_large(*arguments: Any) -> torch.Tensor:
        calls.append(1)
        return loss(*arguments) * (1e12 if len(calls) == 2 else 1.0)

    monkeypatch.setattr(shac, "actor_loss", sometimes_large)
    checkpoint = run(tmp_path, *SMALL, "--stop-after", 3)
    assert checkpoint["actor_optimizer"]["skipped"] == 1
    assert checkpoint["actor_optimizer"]["adam"]["state"][0]["step"] == 2
    assert "skipped 1 updates" in capsys.readouterr().out


def test_help_names_every_flag(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        shac.main(["--help"])
    assert exit.value.code == 0
    out = capsys.readouterr().out
    flags = (
        "env env-id seed device iterations num-envs horizon substeps integrator eval-every save-every run-dir resume"
    )
    flags += " evaluate capture-video track quiet deterministic-policy general-hyperparameters threads actor-lr gamma"
    flags += " accuracy penalty"
    for flag in flags.split():
        assert f"--{flag}" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env anty", "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant, humanoid"),
        ("--num-envs 0", "num_envs"),
        ("--horizon 0", "horizon"),
        ("--substeps 0", "substeps"),
        ("--penalty k_n", "--penalty takes pairs like k_n=1e5, not 'k_n'"),
        ("--penalty kn=1e5", "unknown penalty constant 'kn'"),
        ("--iterations 0", "--iterations must be at least 1, not 0"),
        ("--device nonsense", "nonsense"),
        ("--run-dir {file}", "cannot write to run directory {file}: Not a directory"),
        ("--run-dir {file}/deeper", "cannot write to run directory {file}/deeper: Not a directory"),
        ("--run-dir {trained}", "{trained} holds another run's checkpoint.pt"),
        ("--resume {file}.pt", "no such checkpoint: {file}.pt"),
        ("--resume {file}", "{file} is not a whole checkpoint of shac.py"),
        ("--evaluate {truncated}", "{truncated} is not a whole checkpoint of shac.py"),
        ("--evaluate {foreign}", "{foreign} is not a whole checkpoint of shac.py"),
        (
            "--resume {elsewhere} --device cpu --iterations 20",
            "{elsewhere} was trained on cuda:0, which cpu cannot continue",
        ),
        ("--evaluate {trained}/checkpoint.pt --env ant", "has --env cartpole, not ant"),
        ("--resume {trained}/checkpoint.pt --num-envs 4", "has --num-envs 3, not 4"),
        ("--resume {trained}/checkpoint.pt", "is at iteration 10 already"),
        ("--resume {file} --evaluate {file}", "--resume and --evaluate exclude each other"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: str, message: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refuses(shac, arguments, message, trained, tmp_path, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none() -> None:
    assert_refuses_a_missing_gpu(shac)


def test_track_without_wandb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)  # import fails
    with pytest.raises(SystemExit) as exit:
        run(tmp_path / "run", *SMALL, "--track")
    assert exit.value.code == 2 and "pip install wandb" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
