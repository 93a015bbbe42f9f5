"""The window of render_mode "human" and of view.py, without a display: what it shows, its keys, and what pushes do."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

import diffsim
import view
from diffsim.view import render, screen
from diffsim.view.screen import Window

TORSO = 1
ABOVE = torch.tensor([[0.0, 2.0, 0, 0, 0, 0]])  # a hopper that touches nothing


class Viewer:
    """What mujoco.viewer.launch_passive returns; it closes after some pictures."""

    def __init__(self, model: Any, data: Any, key_callback: Callable[[int], None], **_: Any) -> None:
        self.data, self.press, self.pictures, self.shown = data, key_callback, 1000, list[Any]()
        self.cam, self.perturb, self.user_scn = mujoco.MjvCamera(), mujoco.MjvPerturb(), mujoco.MjvScene(model, 1000)

    def lock(self) -> AbstractContextManager[None]:
        return nullcontext()

    def sync(self) -> None:
        self.pictures -= 1
        self.shown.append(self.data.qpos.copy())

    def is_running(self) -> bool:
        return self.pictures > 0

    def close(self) -> None:
        self.pictures = 0


@pytest.fixture(autouse=True)
def viewers(monkeypatch: pytest.MonkeyPatch) -> list[Viewer]:
    """All windows that were opened."""
    opened = list[Viewer]()

    def launch(*arguments: Any, **options: Any) -> Viewer:
        opened.append(Viewer(*arguments, **options))
        return opened[-1]

    monkeypatch.setattr(render, "check_display", lambda: True)
    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    return opened


@pytest.fixture(scope="module")
def env() -> diffsim.DiffEnv:
    return diffsim.make("hopper", 1, horizon=1, forces=True)


@pytest.fixture
def window(env: diffsim.DiffEnv) -> Window:
    env.sim.forces.zero_()
    return Window(env.scene, env.control_dt)


def still(obs: torch.Tensor) -> torch.Tensor:
    return torch.zeros(1, 3)


def pull(viewer: Viewer, model: mujoco.MjModel, distance: float) -> None:
    """Drag the torso along x with the mouse."""
    mouse, scene = viewer.perturb, mujoco.MjvScene(model, 100)
    mouse.select, mouse.active = TORSO, int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, viewer.data, mujoco.MjvOption(), mouse, mujoco.MjvCamera(), everything, scene)
    mujoco.mjv_initPerturb(model, viewer.data, scene, mouse)
    mouse.refselpos[0] += distance


def test_human_follows_the_first_environment(viewers: list[Viewer]) -> None:
    env = gymnasium.make_vec("diffsim/Hopper-numpy-v0", num_envs=2, render_mode="human")
    assert not viewers
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((2, 3)))
    (viewer,) = viewers
    assert len(viewer.shown) == 4 and env.render() is None and viewer.cam.trackbodyid == TORSO
    np.testing.assert_allclose(viewer.shown[3], env.env.qpos[0])
    env.close()
    assert not viewer.is_running()


def test_human_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> bool:
        raise RuntimeError("there is no display")

    monkeypatch.setattr(render, "check_display", none)
    with pytest.raises(RuntimeError, match="there is no display; take 'rgb_array'"):
        gymnasium.make("diffsim/Hopper-v0", render_mode="human").reset()


def test_the_policy_acts_until_the_window_is_closed(env: diffsim.DiffEnv, viewers: list[Viewer]) -> None:
    def act(obs: torch.Tensor) -> torch.Tensor:
        viewers[0].pictures = min(viewers[0].pictures, 3)
        return still(obs)

    view.play(env, act, seed=1)
    assert env.episode_step.item() == 3 and len(viewers[0].shown) == 3
    np.testing.assert_allclose(viewers[0].shown[2], env.qpos[0])
    assert viewers[0].data.time == pytest.approx(3 * env.control_dt) and not env.sim.forces.any()


def test_the_mouse_pulls_the_simulated_robot(env: diffsim.DiffEnv, viewers: list[Viewer]) -> None:
    """With the force of MuJoCo's window, but at most twice the weight."""
    most = screen.MAX_PULL * 9.81 * env.scene.mj_model.body_mass.sum()
    for distance in (0.0, 0.05, 100.0):

        def act(obs: torch.Tensor, distance: float = distance) -> torch.Tensor:
            viewer, taken = viewers[-1], env.episode_step.item()
            if taken == 0:
                env.set_state(ABOVE, torch.zeros(1, 6))
            if taken == 1 and distance:
                pull(viewer, env.scene.mj_model, distance)
            viewer.pictures = min(viewer.pictures, 3)
            return still(obs)

        view.play(env, act, seed=1)
        forces = env.sim.forces[0].clone()
        assert (forces[:TORSO] == 0).all() and (forces[TORSO + 1 :] == 0).all()
        if distance == 0.0:
            assert not forces.any() and env.qvel[0, 0].abs() < 0.01
        elif distance == 0.05:
            assert 0 < forces[TORSO, 0] < most and 0.01 < env.qvel[0, 0]
            slow = env.qvel[0, 0].item()
        else:
            assert forces[TORSO, :3].norm() == pytest.approx(most, rel=1e-5) and env.qvel[0, 0] > slow


@torch.no_grad()
def test_an_arrow_gives_the_whole_robot_its_speed(env: diffsim.DiffEnv, window: Window, viewers: list[Viewer]) -> None:
    viewers[0].press(262)
    window.show(ABOVE[0])
    env.reset(seed=1)
    env.set_state(ABOVE, torch.zeros(1, 6))
    env.sim.forces = torch.as_tensor(window.forces(), dtype=torch.float32)[None]
    impulse = env.sim.forces[0] * env.control_dt
    np.testing.assert_allclose(impulse[:, 0], screen.PUSH * env.scene.mj_model.body_mass, rtol=1e-5)
    assert not impulse[:, 1:].any() and not window.forces().any()  # for one control step
    env.step(still(ABOVE))
    assert 0.8 < env.qvel[0, 0] < 1.0  # its root has damping and armature


def test_keys_do_what_the_help_says(window: Window, viewers: list[Viewer]) -> None:
    def press(*keys: int) -> None:
        for key in keys:
            viewers[0].press(key)
        window.show(ABOVE[0])

    press(265, 999)
    assert (window.forces()[:, 1] > 0)[TORSO:].all() and not window.paused and not window.restart
    press(*[screen.EQUALS] * 9)
    assert window.speed == screen.SPEEDS[-1]
    press(*[screen.MINUS] * 9)
    assert window.speed == screen.SPEEDS[0]
    press(*[screen.EQUALS] * 9)
    press(screen.ENTER)
    assert window.restart
    viewers[0].pictures, before = 3, len(viewers[0].shown)
    press(screen.SPACE)  # the same picture, until it is closed
    assert window.paused and len(viewers[0].shown) == before + 3
