"""Screen: what `render_mode` makes of an environment's configurations, frames or a window; and the window itself."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, get_args

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.env import Frames, RenderMode
from diffsim.robot.scene import Scene
from diffsim.view import render

SPEEDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)
PUSH = 1.0  # m/s that a key gives to the whole robot
MAX_PULL = 2.0  # of the mouse, in weights of the robot
GRAVITY = 9.81  # m/s^2
ARROWS = {262: (1, 0, 0), 263: (-1, 0, 0), 264: (0, -1, 0), 265: (0, 1, 0)}  # keys of GLFW: right, left, down, up
SPACE, ENTER, MINUS, EQUALS = 32, 257, 45, 61


class Screen:
    """Shows a scene: "rgb_array" returns frames, "human" has the first in a Window; raises ValueError for others."""

    def __init__(self, scene: Scene, mode: RenderMode, fps: float) -> None:
        if mode not in get_args(RenderMode):
            raise ValueError(f"unknown render_mode {mode!r}; choose from {', '.join(get_args(RenderMode))}")
        self._scene, self._mode, self._fps = scene, mode, fps
        self._drawer: Any = None  # a Renderer or a Window

    def show(self, qpos: NDArray[np.floating[Any]]) -> Frames | None:
        """Frames of qpos (N, nq), or None once the first is in the window; raises RuntimeError if nothing can draw."""
        if self._mode == "rgb_array":
            self._drawer = self._drawer or render.Renderer(self._scene, *render.VIDEO_SIZE)
            return tuple(self._drawer.draw(row, profile=k) for k, row in enumerate(qpos))
        try:
            self._drawer = self._drawer or Window(self._scene, 1 / self._fps)
        except RuntimeError as error:
            raise RuntimeError(f"render_mode 'human' opens a window, but {error}; take 'rgb_array'") from error
        self._drawer.show(qpos[0])
        return None

    def close(self) -> None:
        """Free what draws, and close the window, if there is one."""
        if self._drawer is not None:
            self._drawer.close()
            self._drawer = None


class Window:
    """MuJoCo's window on a scene, which shows pictures at true speed and knows how keys and the mouse push the robot.

    Pictures are control_dt [s] of simulation apart.

    Attributes:
        speed, paused: of the pictures; keys change them.
        restart: whether enter asked for a new episode; to be set to False once it has begun.

    Raises:
        RuntimeError: there is no display, or it knows no OpenGL.
    """

    def __init__(self, scene: Scene, control_dt: float) -> None:
        software = render.check_display()
        import mujoco.viewer

        self.model, material = model, _ = render.drawable(scene)
        if software:
            render.lower_quality(model)
        self.data = mujoco.MjData(model)
        self.speed, self.paused, self.restart = 1.0, False, False
        self._control_dt, self._due = control_dt, time.perf_counter()
        self._keys: deque[int] = deque()  # pressed, not yet heeded
        self._push = np.zeros(3)  # N s on each kg, of the keys
        others = {*threading.enumerate()}
        self._handle = mujoco.viewer.launch_passive(
            model, self.data, key_callback=self._keys.append, show_left_ui=False, show_right_ui=False
        )
        self._threads = {*threading.enumerate()} - others
        with self._handle.lock():
            camera, orbit = self._handle.cam, render.orbit(model)
            camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, min(1, model.nbody - 1)
            camera.azimuth, camera.elevation = np.degrees((orbit["yaw"] + np.pi, -orbit["pitch"]))
            camera.distance = orbit["distance"]
            if scene.terrain is not None:
                render.add_terrain(self._handle.user_scn, scene.terrain[0], material)

    @property
    def is_open(self) -> bool:
        return self._handle.is_running()

    def show(self, qpos: ArrayLike, qvel: ArrayLike = 0.0, ctrl: ArrayLike | None = None) -> None:
        """Show a state, qpos (nq,) and qvel (nv,), until the next one is due; while paused, until space is pressed.

        Muscles are coloured by ctrl (nu,) in [-1, 1].
        """
        with self._handle.lock():
            self.data.qpos[:], self.data.qvel[:] = qpos, qvel
            self.data.time += self._control_dt
            if ctrl is not None:
                render.colour_muscles(self.model, ctrl)
            mujoco.mj_forward(self.model, self.data)
        waiting = True
        while waiting and self.is_open:
            self._handle.sync()
            self._heed_keys()
            now = time.perf_counter()
            self._due = max(self._due + self._control_dt / self.speed, now - 0.1)  # late: go on from here
            time.sleep(max(0.0, self._due - now))
            waiting = self.paused

    def forces(self) -> NDArray[np.float64]:
        """(nbody, 6) by which keys and mouse push in the next control step, as Simulator.forces has them."""
        mass, mouse = self.model.body_mass, self._handle.perturb
        with self._handle.lock():
            self.data.xfrc_applied[:] = 0
            if mouse.select > 0 and mouse.active:
                mujoco.mjv_applyPerturbForce(self.model, self.data, mouse)
            forces = self.data.xfrc_applied.copy()
        pull = np.linalg.norm(forces[mouse.select, :3])  # limited: a robot that runs away is not torn back
        forces *= min(1.0, MAX_PULL * GRAVITY * mass.sum() / max(pull, 1e-9))
        forces[:, :3] += np.outer(mass, self._push / self._control_dt)
        self._push = np.zeros(3)
        return forces

    def close(self) -> None:
        self._handle.close()
        for thread in self._threads:
            thread.join(5)  # the viewer's own crashes if the process ends before it does

    def _heed_keys(self) -> None:
        while self._keys:
            key = self._keys.popleft()
            if key in ARROWS:
                self._push = self._push + np.multiply(PUSH, ARROWS[key])
            elif key == SPACE:
                self.paused = not self.paused
            elif key == ENTER:
                self.restart = True
            elif key in (MINUS, EQUALS):
                place = SPEEDS.index(self.speed) + (1 if key == EQUALS else -1)
                self.speed = SPEEDS[min(max(place, 0), len(SPEEDS) - 1)]
                print(f"speed {self.speed:g}")
