"""Pushes of benchmarks/robustness.py on systems whose answers are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import robustness
import torch
from common import Case, parse
from learners import refusal
from scenes import parse as scene_of
from tables import read_csv
from torch import Tensor

import diffsim
from diffsim import Clip, DiffEnv, Integration, read_clip
from diffsim.tasks import Task
from diffsim.training import SavedPolicy
from diffsim.training.evaluation import SEED

POLICIES = Path(diffsim.__file__).parent / "policies"
# A puck of 2 kg in space, and a cart of 3 kg from which a pendulum of 2 kg hangs.
PUCK = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody> <body> <freejoint/> <geom size=".1" mass="2"/> </body> </worldbody>
</mujoco>"""
CART = """
<mujoco>
  <worldbody>
    <body name="cart"> <joint type="slide" axis="1 0 0"/> <geom size=".1" mass="3"/>
      <body name="bob"> <joint type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 -1" mass="2" diaginertia="1e-6 1e-6 1e-6"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
FAST = 0.7  # m/s


class Puck(Task):
    """Falls where it is faster than FAST along x or y."""

    name, obs_dim, num_random = "puck", 2, 0
    start = spread = ()

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        return torch.eye(7)[3].expand(*rand.shape[:-1], -1), torch.zeros(*rand.shape[:-1], 6)

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        return qvel[..., :2]

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return obs[..., 0]

    def terminated(self, obs: Tensor) -> Tensor:
        return obs.abs().amax(-1) > FAST


def pucks() -> robustness.Walkers:
    scene = scene_of(PUCK)
    env = DiffEnv(Puck(), scene, 1, integration=Integration(substeps=4))
    qpos = torch.tensor(scene.qpos0).float().expand(3, -1)
    state = robustness.State(qpos, torch.zeros(3, 6), torch.zeros(3, 0), torch.zeros(3, dtype=torch.int64))
    return robustness.Walkers(env, lambda obs: torch.zeros(len(obs), 0), 1, state)


def test_a_push_gives_a_free_body_its_impulse() -> None:
    force = torch.tensor([[3.0, 0.0, 0.0], [0.0, -5.0, 0.0], [1.0, 2.0, 3.0]])
    states = [step.state for step in pucks().walk(0.2, force, 6)]
    assert len(states) == 12
    for k, state in enumerate(states, 1):
        torch.testing.assert_close(state.qvel[:, :3], force * min(k, 6) / 60 / 2)


def test_the_smallest_push_is_found() -> None:
    """The one that accelerates 2 kg to FAST in 0.1 s: 14 N; and it falls in the push's last step."""
    walkers = pucks()

    def fallen(newtons: float) -> float:
        force = torch.tensor(robustness.DIRECTIONS["sideways"]) * newtons
        return float((walkers.endure(1.0, force.expand(3, 3), 6) < 60).double().mean())

    for first in (1.0, 500.0):
        assert 14 <= robustness.smallest(fallen, first) <= 14 * (1 + robustness.TOLERANCE)
    forces = torch.tensor([[13.9, 0, 0], [14.1, 0, 0], [100.0, 0, 0]])
    assert walkers.endure(1.0, forces, 6).tolist() == [60, 5, 0]


def test_what_nothing_fells() -> None:
    pushes = list[float]()

    def fallen(newtons: float) -> float:
        pushes.append(newtons)
        return 0.49

    assert robustness.smallest(fallen, 3.0) == math.inf
    assert max(pushes) == 3.0 * robustness.MOST


def test_a_cube_meets_the_mass_behind_the_trunk() -> None:
    """Neither cart nor bob resists a push on the other one: the rod between them is upright."""
    scene = scene_of(CART)
    qvel = torch.tensor([[4.0, 0.0], [-1.0, 0.0]])
    state = robustness.State(torch.zeros(2, 2), qvel, torch.zeros(2, 0), torch.zeros(2, 0))
    hit = robustness.target(scene, state, 1)
    np.testing.assert_allclose(hit.mass, 3.0, rtol=1e-5)
    np.testing.assert_allclose(hit.velocity, [4.0, -1.0])
    np.testing.assert_allclose(robustness.target(scene, state, 2).mass, 2.0, rtol=1e-5)
    # Of 6 kg against 3 at 5 m/s together: all of it moves on at 4 - 10 / 3 m/s. The other one is out of reach.
    np.testing.assert_allclose(robustness.impulse(hit, 6.0, 1.0, 0.0), [-10.0, 0.0], rtol=1e-5)
    np.testing.assert_allclose(robustness.impulse(hit, 6.0, 1.0, 1.0), [-20.0, 0.0], rtol=1e-5)


class Clock(Puck):
    """Observes the time, which starts anywhere within 100 control steps, and falls at 190."""

    num_random = num_memory = 1

    def begin(self, rand: Tensor) -> Tensor:
        return (100 * rand).floor()

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        return memory + 1

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        return torch.cat((memory, qvel[..., :1]), -1)

    def terminated(self, obs: Tensor) -> Tensor:
        return obs[..., 0] == 190


def test_a_task_keeps_its_memory() -> None:
    """Robots start at the phases of an evaluation, and are pushed at those that they have reached."""
    env, seen = DiffEnv(Clock(), scene_of(PUCK), 7, integration=Integration(substeps=4)), list[Tensor]()

    def policy(obs: Tensor) -> Tensor:
        seen.append(obs[:, 0].long())
        return torch.zeros(len(obs), 0)

    first = env.reset(seed=SEED)[0][:, 0].long()
    state = robustness.walking(env, policy, 1)
    assert torch.equal(torch.stack(seen), first + torch.arange(240)[:, None])
    reached = first + torch.randint(120, 241, (7,), generator=torch.Generator().manual_seed(SEED))
    steps = state.memory[:, 0].long()
    assert torch.equal(steps, reached[reached < 190]) and 0 < len(steps) < 7
    walkers = robustness.Walkers(env, policy, 1, state)
    for _ in range(2):  # a push after the other
        seen.clear()
        walkers.endure(0.1, torch.zeros(3), 1)
        assert torch.equal(torch.stack(seen), steps + torch.arange(6)[:, None])


def test_the_command_writes_pushes_and_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = "--num-envs 7 --after 1 --masses 2 --output".split()
    for _ in range(2):  # the second time over the rows of the first
        robustness.main(parse(robustness.Args, None, [str(POLICIES / "hopper.pt"), *flags, str(tmp_path)]))
    (row,) = read_csv(tmp_path / "robustness.csv")
    assert row["body"] == "torso" and row["robots"] == "7" and row["unpushed"] == "0"
    force = float(row["forward N"])
    assert "sideways N" not in row and float(row["forward m/s"]) == pytest.approx(force * 0.1 / 15.8, rel=0.01)
    curves = read_csv(tmp_path / "robustness_curves.csv")
    pushes, (cube,) = ([line for line in curves if (line["test"] == "cube") == is_cube] for is_cube in (False, True))
    assert [float(line["level"]) for line in pushes] == robustness.MULTIPLES.tolist()
    assert [float(line["impulse"]) for line in pushes] == pytest.approx(0.1 * force * robustness.MULTIPLES, rel=0.01)
    assert float(pushes[0]["survived"]) == 1 and float(pushes[3]["survived"]) <= 0.5
    assert [float(line["m/s"]) for line in pushes] == pytest.approx(0.1 * force / 15.8 * robustness.MULTIPLES, rel=0.02)
    assert 0 <= float(cube["steps"]) <= 60 and float(cube["impulse"]) > 0
    assert (tmp_path / "robustness.png").stat().st_size > 5_000
    line = f"| hopper | shac | soft | 15.8 | 1 | {row['forward N']} |  | {row['forward m/s']} |  |"
    assert line in capsys.readouterr().out
    other = row | {"checkpoint": "policies/hopper__2", "seed": "2", "forward N": "7", "learner": "shac"}
    (joined,) = robustness.table([other, row])
    assert (joined["seed"], joined["forward N"]) == ("1, 2", f"{row['forward N']}, 7")
    assert len(robustness.table([row | {"learner": "sapo"}, row])) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "of what? give a checkpoint"),
        ("cartpole.pt", "was trained on cartpole, which stands on no ground"),
        ("half_cheetah.pt", "was trained on half_cheetah, whose episodes do not end with a fall"),
        ("hopper.pt --body hat", "--body: the robot has no 'hat'; choose from torso, thigh, leg, foot"),
    ],
)
def test_what_cannot_be_pushed_over(arguments: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    args = parse(robustness.Args, None, arguments.split())
    args.checkpoints = tuple(POLICIES / path for path in args.checkpoints)
    assert message in refusal(lambda: robustness.main(args), capsys)


def test_a_motion_that_ends_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its end would count as a fall. A loop is welcome."""
    args = parse(robustness.Args, None, ["imitation.pt"])
    for clip in (whole := read_clip("humanoid_run")), Clip("once", whole.qpos, loop=False):
        env = diffsim.make("humanoid_imitation", 1, clip=clip)
        case = Case("run", Path("imitation.pt"), SavedPolicy(torch.nn.Sequential(), "shac", {}, 1), env)
        monkeypatch.setattr(robustness, "load_case", lambda *_, case=case: case)
        if clip.loop:
            assert robustness.load(args.checkpoints[0], args) == (case, 1)
    line = refusal(lambda: robustness.main(args), capsys)
    assert "imitation.pt tracks a motion that ends, and with it the episode: train with a loop" in line
