"""Screen: what `render_mode` makes of an environment's configurations, frames or a window."""

from __future__ import annotations

import threading
import time
import warnings
from typing import Any, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.env import Frames, RenderMode
from diffsim.robot.scene import Scene
from diffsim.view import render


class Screen:
    """Shows a scene: "rgb_array" returns frames, "human" shows the first in MuJoCo's window, at fps per second.

    Raises:
        ValueError: another mode.
    """

    def __init__(self, scene: Scene, mode: RenderMode, fps: float) -> None:
        if mode not in get_args(RenderMode):
            raise ValueError(f"unknown render_mode {mode!r}; choose from {', '.join(get_args(RenderMode))}")
        self._scene, self._mode, self._dt, self._due = scene, mode, 1 / fps, 0.0
        self._drawer: Any = None  # a Renderer or a window
        self._threads = set[threading.Thread]()  # of the window

    @property
    def is_open(self) -> bool:
        """Whether the window, if there was one, has not been closed."""
        return self._mode == "rgb_array" or self._drawer is None or self._drawer.is_running()

    def show(self, qpos: NDArray[np.floating[Any]]) -> Frames | None:
        """Frames of qpos (N, nq), or None once the first is in the window; raises RuntimeError if nothing can draw."""
        if self._mode == "rgb_array":
            self._drawer = self._drawer or render.Renderer(self._scene, *render.VIDEO_SIZE)
            return tuple(self._drawer.draw(row, profile=k) for k, row in enumerate(qpos))
        self._drawer = self._drawer or self._open()
        with self._drawer.lock():
            self._data.qpos[:] = qpos[0]
            mujoco.mj_forward(self._model, self._data)
        self._drawer.sync()
        now = time.perf_counter()
        self._due = max(self._due + self._dt, now - 0.1)  # late: go on from here
        time.sleep(max(0.0, self._due - now))
        return None

    def close(self) -> None:
        """Free what draws, and close the window, if there is one."""
        if self._drawer is not None:
            self._drawer.close()
            self._drawer = None
            for thread in self._threads:
                thread.join(5)  # the window's crashes if the process ends before it does

    def _open(self) -> Any:
        import glfw
        import mujoco.viewer

        with warnings.catch_warnings():  # GLFW warns, and the viewer would end the process
            warnings.simplefilter("ignore")
            if not glfw.init():
                raise RuntimeError("render_mode 'human' opens a window, but there is no display; take 'rgb_array'")
        self._model, material = render.drawable(self._scene)
        self._data, self._due = mujoco.MjData(self._model), time.perf_counter()
        others = {*threading.enumerate()}
        window = mujoco.viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = {*threading.enumerate()} - others
        with window.lock():
            render.follow(self._model, window.cam)
            if self._scene.terrain is not None:
                render.add_terrain(window.user_scn, self._scene.terrain[0], material)
        return window
