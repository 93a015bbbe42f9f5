"""Train a network to bring a cart to any goal without dropping its pole: the physics is a layer of the network.

    python examples/learned_controller.py

The loss is the squared distance to the goal over two seconds, and its gradient reaches the weights through every step
of the simulation. No reward, no critic and no exploration noise are needed.
"""

from importlib.resources import files

import torch
import tyro
from torch import Tensor, nn

import diffsim

STEPS = 120  # control steps of 1/60 s


def drive(sim: diffsim.Simulator, network: nn.Module, goal: Tensor) -> tuple[Tensor, Tensor]:
    """qpos and qvel (STEPS, N, 2) from an upright pole at x = 0, under the network; goals (N, 1) [m]."""
    qpos, qvel = 0.1 * torch.randn(2, sim.num_envs, 2)
    path = []
    for _ in range(STEPS):
        x, angle = qpos.split(1, dim=1)
        ctrl = network(torch.cat((x - goal, angle.sin(), angle.cos() - 1, qvel), dim=1))
        qpos, qvel = sim.step(qpos, qvel, ctrl.tanh())
        path.append(torch.stack((qpos, qvel)))
    qpos, qvel = torch.stack(path, dim=1)
    return qpos, qvel


def train(num_envs: int = 32, iterations: int = 150, seed: int = 0) -> list[float]:
    """The final distance to the goal [m], averaged over the environments, in each iteration."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    scene = diffsim.load_scene(str(files("diffsim") / "assets" / "cartpole.xml"))
    sim = diffsim.Simulator(scene, num_envs, diffsim.Integration(substeps=4), horizon=STEPS)
    network = nn.Sequential(nn.Linear(5, 32), nn.Tanh(), nn.Linear(32, 1))
    adam = torch.optim.Adam(network.parameters(), lr=0.01)
    distances = []
    for iteration in range(iterations):
        sim.rewind()
        goal = 2 * torch.rand(num_envs, 1) - 1
        qpos, qvel = drive(sim, network, goal)
        x, angle = qpos.unbind(-1)
        loss = ((x - goal.T).square() + 5 * (1 - angle.cos()) + 0.01 * qvel.square().sum(-1)).mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)  # a falling pole multiplies gradients as it does errors
        adam.step()
        distances.append((x[-1] - goal[:, 0]).abs().mean().item())
        if iteration % 15 == 0:
            fallen = (angle[-1].cos() < 0.9).float().mean()
            print(f"iteration {iteration}: {distances[-1]:.3f} m from the goal, {fallen:.0%} of the poles have fallen")
    print(f"after {iterations} iterations: {distances[-1]:.3f} m from the goal")
    return distances


if __name__ == "__main__":
    tyro.cli(train)
