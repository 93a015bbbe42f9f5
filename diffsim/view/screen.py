"""Screen: what `render_mode` makes of the configurations of an environment, frames or a window."""

from __future__ import annotations

import copy
import os
import sys
import threading
import time
import warnings
from typing import Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Scene
from diffsim.view.render import Renderer, add_terrain, hide_planes

RenderMode = Literal["rgb_array", "human"]
FRAME_SIZE = (480, 352)  # width and height in pixels; video encoders want multiples of 16
Frames = tuple[NDArray[np.uint8], ...]  # each (height, width, 3)
# What works here, as tools try whatever an environment declares: a window needs a display.
DISPLAY = sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())
RENDER_MODES = ["rgb_array", "human"] if DISPLAY else ["rgb_array"]


class Screen:
    """Shows configurations of a scene.

    Args:
        scene: what is shown.
        mode: "rgb_array" returns frames; "human" shows the first configuration in MuJoCo's window, where the mouse
            moves the camera.
        fps: frames per second of the window, which waits for its time.

    Raises:
        ValueError: another mode.
    """

    def __init__(self, scene: Scene, mode: RenderMode, fps: float) -> None:
        if mode not in get_args(RenderMode):
            raise ValueError(f"unknown render_mode {mode!r}; choose from {', '.join(get_args(RenderMode))}")
        self.mode = mode
        self._scene, self._fps = scene, fps
        self._renderer: Renderer | None = None
        self._window: Any = None
        self._due = 0.0  # when the window may show the next frame, on time.perf_counter's clock

    def show(self, qpos: NDArray[np.floating[Any]]) -> Frames | None:
        """Frames of the configurations qpos (N, nq), or None once the first one is in the window.

        Raises:
            RuntimeError: the machine has no OpenGL, or no display for a window.
        """
        if self.mode == "rgb_array":
            if self._renderer is None:
                self._renderer = Renderer(self._scene, *FRAME_SIZE)
            return tuple(self._renderer.draw(row, profile=k) for k, row in enumerate(qpos))
        if self._window is None:
            self._open()
        with self._window.lock():
            self._data.qpos[:] = qpos[0]
            mujoco.mj_forward(self._model, self._data)
        time.sleep(max(0.0, self._due - time.perf_counter()))
        self._due = time.perf_counter() + 1 / self._fps
        self._window.sync()  # does nothing once the user has closed it
        return None

    def close(self) -> None:
        """Free what draws, and close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        if self._window is not None:
            self._window.close()
            for thread in self._threads:  # which still draw, and would crash a program that ends meanwhile
                thread.join()
            self._window = None

    def _open(self) -> None:
        import glfw
        import mujoco.viewer

        with warnings.catch_warnings():  # GLFW warns where it should raise
            warnings.simplefilter("ignore")
            ready = glfw.init()
        if not ready:
            raise RuntimeError("render_mode 'human' opens a window, but there is no display; take 'rgb_array'")
        self._model = copy.copy(self._scene.mj_model)
        material = hide_planes(self._model) if self._scene.terrain is not None else -1
        self._data = mujoco.MjData(self._model)
        others = {*threading.enumerate()}
        self._window = mujoco.viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = {*threading.enumerate()} - others
        with self._window.lock():
            self._window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            self._window.cam.trackbodyid = min(1, self._model.nbody - 1)
            if self._scene.terrain is not None:
                add_terrain(self._window.user_scn, self._scene.terrain[0], material)
