"""Pictures and videos of a scene, drawn by MuJoCo from a sequence of qpos."""

from __future__ import annotations

import copy
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .scene import Scene

AT_REST, FULL_FORCE = np.array([0.25, 0.4, 0.85, 1.0]), np.array([0.95, 0.15, 0.1, 1.0])  # colours of a muscle


def render_frames(
    scene: Scene | str | os.PathLike[str],
    qpos: ArrayLike,
    width: int = 640,
    height: int = 480,
    camera: str = "track",
    ctrl: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Draw a scene, or an MJCF file, in each of the configurations qpos (T, nq), seen from a camera of the MJCF.

    With ctrl (T, nu) in [-1, 1], muscles are coloured by their activation: blue at rest, red at full force.

    Returns:
        Frames (T, height, width, 3).

    Raises:
        ValueError: qpos or ctrl has another shape, or the MJCF has no such camera.
        RuntimeError: the machine has no OpenGL.
    """
    model = copy.copy(scene.mj_model) if isinstance(scene, Scene) else mujoco.MjModel.from_xml_path(os.fspath(scene))
    qpos = np.asarray(qpos, dtype=np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq:
        raise ValueError(f"qpos must have shape (T, {model.nq}), not {qpos.shape}")
    muscles = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)
    activation = np.zeros((len(qpos), model.nu)) if ctrl is None else (np.asarray(ctrl, dtype=np.float64) + 1) / 2
    if activation.shape != (len(qpos), model.nu):
        raise ValueError(f"ctrl must have shape ({len(qpos)}, {model.nu}), not {activation.shape}")
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera not in cameras:
        raise ValueError(f"no camera {camera!r} in this scene; it has: {', '.join(cameras) or 'none'}")
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, cameras.index(camera)

    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data, option, perturb = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvPerturb()
    frames = np.empty((len(qpos), height, width, 3), dtype=np.uint8)
    window = _gl_context(width, height)
    try:
        window.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        picture, area = mujoco.MjvScene(model, maxgeom=10_000), mujoco.MjrRect(0, 0, width, height)
        for frame, q, a in zip(frames, qpos, activation[:, muscles, None].clip(0, 1), strict=True):
            data.qpos[:] = q
            if ctrl is not None:
                model.tendon_rgba[model.actuator_trnid[muscles, 0]] = a * FULL_FORCE + (1 - a) * AT_REST
            mujoco.mj_forward(model, data)
            mujoco.mjv_updateScene(model, data, option, perturb, view, mujoco.mjtCatBit.mjCAT_ALL, picture)
            mujoco.mjr_render(area, picture, context)
            mujoco.mjr_readPixels(frame, None, area, context)
        context.free()
    finally:
        window.free()
    return np.ascontiguousarray(frames[:, ::-1])  # OpenGL's first row is the lowest


def save_video(path: str | os.PathLike[str], frames: NDArray[np.uint8], fps: float = 60.0) -> Path:
    """Write frames (T, height, width, 3) as .mp4, or as .gif where imageio-ffmpeg is not installed.

    Returns:
        The file written; its suffix is .gif if an .mp4 could not be.

    Raises:
        ValueError: no frames, or another suffix.
        ModuleNotFoundError: imageio is not installed.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"a video ends in .mp4 or .gif, not {path.suffix!r}")
    if len(frames) == 0:
        raise ValueError("a video needs at least one frame")
    if find_spec("imageio") is None:
        raise ModuleNotFoundError('videos need imageio: pip install "gymnasium[mujoco]"')
    import imageio.v2 as imageio

    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        path = path.with_suffix(".gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        stride = max(1, round(fps / 30))  # browsers show at most 50 frames/s of a gif
        imageio.mimsave(path, list(frames[::stride]), duration=1000 * stride / fps, loop=0)
    else:
        imageio.mimsave(path, list(frames), fps=fps)
    return path


def _gl_context(width: int, height: int) -> Any:
    """MuJoCo's OpenGL context, EGL on a machine without a display.

    MuJoCo chooses one from MUJOCO_GL when it is first imported, which is too early for us to set that variable.
    """
    try:
        if sys.platform == "linux" and not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
            from mujoco.egl import GLContext

            return GLContext(width, height)
        return mujoco.GLContext(width, height)
    except (AttributeError, ImportError, RuntimeError) as error:
        raise RuntimeError(
            "MuJoCo finds no OpenGL to draw with: install libegl1, or libosmesa6 and set MUJOCO_GL=osmesa"
        ) from error
