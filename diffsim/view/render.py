"""Pictures and videos of a scene, drawn by MuJoCo from its qpos."""

from __future__ import annotations

import copy
import itertools
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.scene import Array, Scene

Frame = NDArray[np.uint8]  # (height, width, 3)

AT_REST, FULL_FORCE = np.array([0.25, 0.4, 0.85, 1.0]), np.array([0.95, 0.15, 0.1, 1.0])  # colours of a muscle
GROUND = np.array([0.75, 0.77, 0.81, 1.0], dtype=np.float32)
DRAWN_END, DRAWN_SIZE = 50.0, (5.0, 0.05)  # m: of an endless segment of a terrain; half width and half thickness
SHADOW, FLATNESS = np.array([0.37, 0.39, 0.42, 1.0], dtype=np.float32), 1e-3
VIDEO_SIZE = (480, 352)  # pixels; the encoder wants multiples of 16
VIDEO_FPS = 30.0  # at most
VIDEO_SECONDS = 10.0  # how much of an episode is filmed
LARGEST = 4096  # pixels of a side of a picture
BLOCK = 16  # pixels; libx264 pads the sides of a picture to multiples of it
REMEDY = "no OpenGL to draw with: apt install libegl1 libgl1 libgl1-mesa-dri (or your system's EGL and Mesa)"


class Renderer:
    """Draws a scene, one configuration at a time.

    Args:
        scene: what is drawn.
        width, height: of a frame in pixels.
        camera: name of a camera of the MJCF; by default "track", or one that follows the robot if there is none.
        fast: no antialiasing, coarser shapes, shadows on the floor alone; by default where OpenGL runs on the CPU. An
            ant takes 15 ms of one core instead of 300.

    Raises:
        ValueError: the MJCF has no such camera, or a side is not between 1 and 4096 pixels.
        RuntimeError: the machine has no OpenGL, with the remedy.
    """

    def __init__(
        self, scene: Scene, width: int = 640, height: int = 480, camera: str | None = None, fast: bool | None = None
    ) -> None:
        self.model, self._material = drawable(scene)
        self._terrain = scene.terrain
        self.width, self.height = check_size(width, height)
        self._view, size = _camera(self.model, camera), self.model.vis.global_
        size.offwidth, size.offheight = width, height
        self._window = _gl_context(width, height)
        self._fast = _is_software() if fast is None else fast
        if self._fast:
            lower_quality(self.model)
        self._data, self._option, self._perturb = mujoco.MjData(self.model), mujoco.MjvOption(), mujoco.MjvPerturb()
        self._scene, self._area = mujoco.MjvScene(self.model, maxgeom=10_000), mujoco.MjrRect(0, 0, width, height)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] &= not self._fast
        self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)

    def draw(self, qpos: ArrayLike, ctrl: ArrayLike | None = None, profile: int = 0) -> Frame:
        """The frame (height, width, 3) of one configuration qpos (nq,).

        Args:
            ctrl: (nu,) in [-1, 1]; colours muscles by their activation, blue at rest, red at full force.
            profile: of which environment's terrain, if each has its own.
        """
        model, data = self.model, self._data
        data.qpos[:] = _check("qpos", qpos, model.nq)
        if ctrl is not None:
            colour_muscles(model, _check("ctrl", ctrl, model.nu))
        # All that a picture depends on, without the contacts and matrices of mj_forward.
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_tendon):
            stage(model, data)
        self._window.make_current()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, self._perturb, self._view, everything, self._scene)
        if self._terrain is not None:
            add_terrain(self._scene, self._terrain[profile % len(self._terrain)], self._material)
        elif self._fast:
            _add_shadows(model, data, self._scene)
        mujoco.mjr_render(self._area, self._scene, self._context)
        frame = np.empty((self.height, self.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(frame, None, self._area, self._context)
        return np.ascontiguousarray(frame[::-1])  # OpenGL's first row is the lowest

    def draw_all(self, qpos: ArrayLike, ctrl: ArrayLike | None = None) -> Iterator[Frame]:
        """The frames of configurations qpos (T, nq), with ctrl (T, nu), one after the other."""
        qpos = _check("qpos", qpos, len(np.atleast_1d(qpos)), self.model.nq)
        colours = itertools.repeat(None) if ctrl is None else _check("ctrl", ctrl, len(qpos), self.model.nu)
        return map(self.draw, qpos, colours)

    def close(self) -> None:
        """Free what OpenGL holds; a second call does nothing."""
        if self._window is not None:
            self._window.make_current()
            self._context.free()
            self._window.free()
            self._window = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _check(name: str, value: ArrayLike, *shape: int) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    return array


def drawable(scene: Scene) -> tuple[mujoco.MjModel, int]:
    """A copy of a scene's model, without planes if there is a terrain, and the material of the first plane, or -1."""
    model = copy.copy(scene.mj_model)
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    material = int(model.geom_matid[planes[0]]) if len(planes) else -1
    if scene.terrain is not None:
        model.geom_matid[planes], model.geom_rgba[planes] = -1, 0.0
    return model, material


def slabs(profile: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Boxes whose upper faces are the segments of a profile (K, 2): half sizes (3,), centre (3,), rotation (3, 3)."""
    for k, (start, end) in enumerate(itertools.pairwise(profile)):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        if k == 0:
            start, length = start - DRAWN_END * along, length + DRAWN_END
        if k == len(profile) - 2:
            length += DRAWN_END
        t, n = np.array([along[0], 0.0, along[1]]), np.array([-along[1], 0.0, along[0]])
        size = np.array([length / 2, *DRAWN_SIZE])
        centre = np.array([start[0], 0.0, start[1]]) + size[0] * t - size[2] * n
        yield size, centre, np.stack([t, [0.0, 1.0, 0.0], n], 1)


def add_terrain(scene: mujoco.MjvScene, profile: Array, material: int) -> None:
    """Add a terrain (K, 2) to what is drawn, of this material of the model, or plain if it is -1."""
    for size, centre, rotation in itertools.islice(slabs(profile), scene.maxgeom - scene.ngeom):
        box = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(box, mujoco.mjtGeom.mjGEOM_BOX, size, centre, rotation.ravel(), GROUND)
        box.matid = material
        scene.ngeom += 1


def lower_quality(model: mujoco.MjModel) -> None:
    """What draws a model several times as fast where OpenGL runs on the CPU: no antialiasing, coarser shapes."""
    quality = model.vis.quality
    quality.shadowsize, quality.offsamples = 1024, 0
    quality.numslices, quality.numstacks, quality.numquads = 16, 8, 1


def activations(model: mujoco.MjModel, ctrl: ArrayLike) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The tendons (m,) of a model's muscles, and their activation (..., m) in [0, 1] by ctrl (..., nu) in [-1, 1]."""
    muscles = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)
    force = np.asarray(ctrl, dtype=np.float64)[..., muscles].clip(-1, 1)
    return model.actuator_trnid[muscles, 0], (force + 1) / 2


def colour_muscles(model: mujoco.MjModel, ctrl: ArrayLike) -> None:
    """Colour the tendons of a model by the activation of their muscles, ctrl (nu,) in [-1, 1]."""
    tendons, force = activations(model, ctrl)
    model.tendon_rgba[tendons] = np.outer(force, FULL_FORCE) + np.outer(1 - force, AT_REST)


def _camera(model: mujoco.MjModel, name: str | None) -> mujoco.MjvCamera:
    names, view = [model.camera(i).name for i in range(model.ncam)], mujoco.MjvCamera()
    if name is not None and name not in names:
        raise ValueError(f"no camera {name!r} in this scene; it has: {', '.join(names) or 'none'}")
    if name is None and "track" not in names:
        mujoco.mjv_defaultFreeCamera(model, view)
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, min(1, model.nbody - 1)
    else:
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, names.index(name or "track")
    return view


def orbit(model: mujoco.MjModel) -> dict[str, Any]:
    """Where the MJCF's first camera stands relative to what it follows, as the orbit about a point that it looks at."""
    if not model.ncam:
        return {"yaw": -math.pi / 2, "pitch": 0.3, "distance": 3 * model.stat.extent, "aim": [0, 0, 0], "fovy": 0.8}
    # mode="trackcom": the camera keeps its place relative to the centre of mass, and its direction.
    place, back = model.cam_poscom0[0], model.cam_mat0[0].reshape(3, 3)[:, 2]
    distance = float(place @ back)
    yaw, pitch, fovy = math.atan2(back[1], back[0]), math.asin(back[2]), math.radians(float(model.cam_fovy[0]))
    return {"yaw": yaw, "pitch": pitch, "distance": distance, "aim": (place - distance * back).tolist(), "fovy": fovy}


def _add_shadows(model: mujoco.MjModel, data: mujoco.MjData, scene: mujoco.MjvScene) -> None:
    """Add flat dark copies of a scene's shapes, projected along the first light onto the floor.

    MuJoCo's own shadows cost twice as much as all the rest where OpenGL runs on the CPU.
    """
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if not (len(planes) and model.nlight and data.light_xdir[0, 2] < 0):
        return
    floor, sun = model.geom_pos[planes[0], 2] + 2 * FLATNESS, data.light_xdir[0]
    project = np.eye(3) - np.outer(sun, (0, 0, 1)) / sun[2]
    project[2, 2] = FLATNESS  # a singular matrix has no normals
    for shape in [scene.geoms[k] for k in range(scene.ngeom)]:
        if shape.objtype != mujoco.mjtObj.mjOBJ_GEOM or shape.type == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        shadow = scene.geoms[scene.ngeom]
        place = project @ (shape.pos - (0, 0, floor)) + (0, 0, floor)
        mujoco.mjv_initGeom(shadow, shape.type, shape.size, place, (project @ shape.mat).ravel(), SHADOW)
        shadow.size[:] = shape.size  # which it takes for that of a model, written in another order
        scene.ngeom += 1


# Videos ---------------------------------------------------------------------------------------------------------------


def film(
    path: str | os.PathLike[str],
    scene: Scene,
    qpos: ArrayLike,
    control_dt: float,
    ctrl: ArrayLike | None = None,
    size: tuple[int, int] = VIDEO_SIZE,
) -> Path:
    """Film qpos (T, nq) and ctrl (T, nu), a row per control step [s], at true speed with at most 30 frames/s.

    See save_video; size is width and height in pixels.
    """
    check_video(path, size)
    stride = max(1, math.ceil(1 / (VIDEO_FPS * control_dt) - 1e-6))
    shown = None if ctrl is None else np.asarray(ctrl)[::stride]
    with Renderer(scene, *size) as renderer:
        return save_video(path, renderer.draw_all(np.asarray(qpos)[::stride], shown), 1 / (stride * control_dt))


def save_video(path: str | os.PathLike[str], frames: Iterable[Frame], fps: float) -> Path:
    """Write frames (height, width, 3) as .mp4 (H.264) or .gif, which plays at true speed; returns the file.

    Raises:
        ValueError: no frames, another suffix, or an mp4 whose width or height is not a multiple of 16.
        OSError: the file cannot be written.
        RuntimeError: there is no encoder.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    path = check_video(path, first.shape[1::-1])
    with whole_file(path) as part:
        _encode(part, itertools.chain([first], frames), fps, "x".join(map(str, first.shape[1::-1])))
    return path


def check_size(width: int, height: int) -> tuple[int, int]:
    """The size of a picture; raises ValueError unless it can be drawn."""
    if not (0 < width <= LARGEST and 0 < height <= LARGEST):
        raise ValueError(f"width and height of a picture are 1 to {LARGEST} pixels, not {width} x {height}")
    return width, height


def check_video(path: str | os.PathLike[str], size: Sequence[int] = VIDEO_SIZE) -> Path:
    """The path, if a video of this name and size can be encoded here; raises what save_video does."""
    path, (width, height) = Path(path), check_size(*size)
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"a video ends in .mp4 or .gif, not {path.suffix!r}")
    if path.suffix == ".mp4" and (width % BLOCK or height % BLOCK):
        raise ValueError(f"width and height of an .mp4 are multiples of {BLOCK}; {width} x {height} are not")
    _ffmpeg()
    return path


def _ffmpeg() -> str:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise RuntimeError("no ffmpeg to write videos: pip install --force-reinstall imageio-ffmpeg") from error


def _encode(path: Path, frames: Iterable[Frame], fps: float, size: str) -> None:
    """As imageio_ffmpeg.write_frames does, which neither sees that ffmpeg fails nor keeps what it says."""
    if path.suffix == ".gif":  # its delays are hundredths of a second, and browsers want at least two of them
        stride = math.ceil(fps / 50 - 1e-6)
        frames, fps = itertools.islice(frames, 0, None, stride), fps / stride
        target = "-lavfi split[a][b];[a]palettegen[colours];[b][colours]paletteuse=dither=none -loop 0"
    else:  # faststart: browsers begin to play before they have loaded all of it
        target = "-vcodec libx264 -pix_fmt yuv420p -crf 15 -preset veryfast -movflags +faststart"
    source = f"-f rawvideo -pix_fmt rgb24 -s {size} -r {Fraction(fps).limit_denominator()} -i -"
    command = [_ffmpeg(), "-y", "-v", "error", *source.split(), *target.split(), os.fspath(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin
        with suppress(BrokenPipeError):  # why, stderr says
            for frame in frames:
                ffmpeg.stdin.write(frame.tobytes())
        said = ffmpeg.communicate()[1].decode(errors="replace").strip().rpartition("\n")[2]
    if ffmpeg.returncode:
        raise OSError(f"ffmpeg fails: {said or f'exit status {ffmpeg.returncode}'}")


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A file to write, which takes the place of path once it is complete. If writing fails, path stays as it was.

    Raises:
        OSError: path is no regular file, or cannot be written; its message names path.
    """
    path = Path(path).resolve()
    part = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        if path.exists() and not path.is_file():
            raise OSError("it is no regular file")
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, path)
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            part.unlink()


# OpenGL ---------------------------------------------------------------------------------------------------------------


def check_opengl() -> str:
    """What draws pictures here, e.g. "llvmpipe (LLVM 15.0.6, 256 bits)"; raises RuntimeError with the remedy."""
    context = _gl_context(16, 16)
    try:
        return _gl_renderer()
    finally:
        context.free()


def check_display() -> bool:
    """Whether OpenGL runs on the CPU in a window that can be opened here.

    It leaves EGL alone: a process that has used both EGL and a window crashes at its end.

    Raises:
        RuntimeError: there is no display, or it knows no OpenGL.
    """
    import glfw

    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    with warnings.catch_warnings():  # GLFW warns instead of raising
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise RuntimeError(f"display {display} does not answer" if display else "there is no display")
        glfw.window_hint(glfw.VISIBLE, 0)
        window = glfw.create_window(16, 16, "diffsim", None, None)
        if not window:
            raise RuntimeError(f"display {display} has no OpenGL")
        glfw.make_context_current(window)
        software = _is_software()
        glfw.destroy_window(window)
        glfw.default_window_hints()
    return software


def _gl_context(width: int, height: int) -> Any:
    """A current OpenGL context of MuJoCo's, from MUJOCO_GL or, on Linux, EGL; raises RuntimeError with the remedy."""
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    platform = os.environ.get("PYOPENGL_PLATFORM", "egl").lower()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        raise RuntimeError(f"MUJOCO_GL={wanted} forbids to draw: unset it")
    if sys.platform != "linux":
        module, remedy = "mujoco", "no OpenGL to draw with"
    elif wanted == "osmesa":
        module = "mujoco.osmesa"
        remedy = "MUJOCO_GL=osmesa, but OSMesa is not there: unset MUJOCO_GL, or apt install libosmesa6"
    elif wanted in ("glfw", "glx"):
        module, remedy = "mujoco.glfw", f"MUJOCO_GL={wanted}, but no display is there: unset MUJOCO_GL"
    else:
        module = "mujoco.egl"
        remedy = REMEDY if platform == "egl" else f"PYOPENGL_PLATFORM={platform} excludes EGL: unset it"
    os.environ.setdefault("EGL_LOG_LEVEL", "fatal")  # Mesa prints its search for drivers otherwise
    try:
        if module == "mujoco.glfw":
            check_display()
        context = import_module(module).GLContext(width, height)
        context.make_current()
    except Exception as error:  # each of them fails in its own ways, AttributeError among them
        raise RuntimeError(remedy) from error
    return context


def _gl_renderer() -> str:
    from OpenGL.GL import GL_RENDERER, glGetString

    return glGetString(GL_RENDERER).decode()


def _is_software() -> bool:
    """Whether the current OpenGL runs on the CPU."""
    return any(software in _gl_renderer() for software in ("llvmpipe", "softpipe", "swrast"))
