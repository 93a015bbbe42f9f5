"""Swing a pole up by gradient descent on the motor's commands: no policy, no reward, no learning.

    python examples/trajectory_optimisation.py --video swing_up.gif

Several random guesses are improved at once. One backward pass gives each the gradient of its cost in all its commands.
"""

from importlib.resources import files
from pathlib import Path

import torch
import tyro
from torch import Tensor

import diffsim
from diffsim_cli.render import check_video, film

STEPS = 90  # control steps of 1/60 s


def simulate(sim: diffsim.Simulator, ctrl: Tensor) -> tuple[Tensor, Tensor]:
    """qpos and qvel (STEPS, N, 2) from the hanging pole at rest, under ctrl (STEPS, N, 1)."""
    qpos, qvel = torch.zeros(2, sim.num_envs, 2).unbind()
    qpos = qpos + torch.tensor([0.0, -torch.pi])  # cart [m], angle [rad], 0 is upright
    path = []
    for u in ctrl.tanh():  # between -1 and 1
        qpos, qvel = sim.step(qpos, qvel, u)
        path.append(torch.stack((qpos, qvel)))
    qpos, qvel = torch.stack(path, dim=1)
    return qpos, qvel


def cost(qpos: Tensor, qvel: Tensor) -> Tensor:
    """(N,) how far from upright and at rest in the last 15 steps, and a little for the way of the cart before."""
    angle_error = 1 - qpos[-15:, :, 1].cos()
    return (5 * angle_error + 0.1 * qvel[-15:].square().sum(-1)).mean(0) + 0.1 * qpos[:, :, 0].square().mean(0)


def optimise(
    guesses: int = 64, iterations: int = 200, seed: int = 0, video: Path | None = None
) -> tuple[Tensor, Tensor]:
    """The path qpos (STEPS, 2) of the best commands, and the costs (iterations, guesses) on the way to them."""
    if video:
        check_video(video)  # before the work
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    scene = diffsim.load_scene(str(files("diffsim") / "assets" / "cartpole.xml"))
    sim = diffsim.Simulator(scene, guesses, diffsim.Integration(substeps=4), horizon=STEPS)
    # Slow random waves: what one command does, the next must not undo.
    ctrl = torch.randn(STEPS // 10, guesses, 1).repeat_interleave(10, 0).mul(0.3).requires_grad_()
    adam = torch.optim.Adam([ctrl], lr=0.1)
    history = []
    for iteration in range(iterations):
        sim.rewind()
        qpos, qvel = simulate(sim, ctrl)
        costs = cost(qpos, qvel)
        adam.zero_grad()
        costs.sum().backward()  # of a sum: the guesses are independent
        adam.step()
        history.append(costs.detach())
        if iteration % 20 == 0:
            print(f"iteration {iteration}: cost median {costs.median():.3f}, best {costs.min():.3f}")
    best = qpos.detach()[:, costs.argmin()]
    angle = torch.acos(best[-1, 1].cos()).rad2deg()
    print(f"best: {angle:.1f} degrees from upright, cart at {best[-1, 0]:.2f} m")
    if video:
        film(video, scene, best, sim.control_dt, size=(320, 240))
    return best, torch.stack(history)


if __name__ == "__main__":
    try:
        tyro.cli(optimise)
    except ValueError as error:  # a video of another suffix
        raise SystemExit(str(error)) from None
