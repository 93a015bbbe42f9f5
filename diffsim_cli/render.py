"""Pictures and videos of a scene, drawn by MuJoCo from its qpos."""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.elements import muscles
from diffsim.robot.scene import Scene
from diffsim.robot.types import Array
from diffsim.tasks.base import ASSETS

Frame = NDArray[np.uint8]  # (height, width, 3)
Arrow = tuple[Sequence[float], NDArray[np.float32]]  # a horizontal velocity [m/s] in world axes, and its colour

AT_REST, FULL_FORCE = np.array([0.25, 0.4, 0.85, 1.0]), np.array([0.95, 0.15, 0.1, 1.0])  # colours of a muscle
LOOKS = ASSETS / "looks"  # meshes that are drawn in place of a robot's primitives; tools/looks.py writes them
GROUND = np.array([0.75, 0.77, 0.81, 1.0], dtype=np.float32)
GHOST = np.array([0.2, 0.6, 0.3, 0.35], dtype=np.float32)
RED, BLUE = np.array([[0.84, 0.24, 0.16, 1.0], [0.16, 0.4, 0.84, 1.0]], dtype=np.float32)  # of arrows
DRAWN_END, DRAWN_SIZE = 50.0, (5.0, 0.05)  # m: of an endless segment of a terrain; half width and half thickness
SOFTWARE = "llvmpipe", "softpipe", "swrast"  # OpenGL that runs on the CPU
VIDEO_SIZE = (480, 352)  # pixels; the encoder wants multiples of 16
VIDEO_FPS = 30.0  # at least, of tasks with as many control steps
LARGEST = 4096  # pixels of a side of a picture
BLOCK = 16  # pixels; libx264 pads the sides of a picture to multiples of it
# faststart: browsers begin to play before they have loaded all of it
MP4 = dict(codec="libx264", output_params="-crf 15 -preset veryfast -movflags +faststart".split())
PALETTE = "split[a][b];[a]palettegen[colours];[b][colours]paletteuse=dither=none"
GIF = dict(codec="gif", pix_fmt_out="pal8", output_params=["-lavfi", PALETTE, "-loop", "0"])


class Renderer(AbstractContextManager["Renderer"]):
    """Draws a scene, one configuration at a time, as the camera "track" of the MJCF sees it, or one that follows.

    Where OpenGL runs on the CPU, shapes and shadows are coarser: an ant takes 40 ms of one core instead of 170. Sides
    are between 1 and 4096 pixels.

    Raises:
        ValueError: another size.
        RuntimeError: the machine has no OpenGL, with the remedy.
    """

    def __init__(self, scene: Scene, width: int = VIDEO_SIZE[0], height: int = VIDEO_SIZE[1]) -> None:
        check_size(width, height)
        self.model, self._material = model, _ = drawable(scene)
        self._terrain, self._data = scene.terrain, mujoco.MjData(model)
        if any(name in check_opengl() for name in SOFTWARE):  # no antialiasing, coarser shapes and shadows
            quality = model.vis.quality
            quality.offsamples, quality.numslices, quality.numstacks, quality.numquads = 0, 16, 8, 1
            quality.shadowsize = 1024
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._renderer = mujoco.Renderer(model, height, width)
        self._camera: Any = "track"
        if "track" not in (model.camera(i).name for i in range(model.ncam)):
            follow(model, camera := mujoco.MjvCamera())
            self._camera = camera

    def draw(
        self,
        qpos: ArrayLike,
        ctrl: ArrayLike | None = None,
        profile: int = 0,
        ghost: ArrayLike | None = None,
        arrows: Sequence[Arrow] = (),
    ) -> Frame:
        """The frame (height, width, 3) of one configuration qpos (nq,).

        Args:
            ctrl: (nu,) in [-1, 1]; colours muscles by their activation, blue at rest, red at full force.
            profile: of which environment's terrain, if each has its own.
            ghost: another configuration (nq,) of the robot, which is drawn transparent.
            arrows: velocities beside the robot.
        """
        self._data.qpos[:] = qpos
        if ctrl is not None:
            tendons, force = activations(self.model, ctrl)
            self.model.tendon_rgba[tendons] = np.outer(force, FULL_FORCE) + np.outer(1 - force, AT_REST)
        # All that a picture depends on, without the contacts and matrices of mj_forward.
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_tendon):
            stage(self.model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        if self._terrain is not None:
            add_terrain(self._renderer.scene, self._terrain[profile % len(self._terrain)], self._material)
        for arrow in arrows:
            point(self._renderer.scene, self._data.xpos[1], arrow)
        if ghost is not None:
            self._data.qpos[:] = ghost
            mujoco.mj_kinematics(self.model, self._data)
            scene, kind = self._renderer.scene, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
            first = scene.ngeom
            mujoco.mjv_addGeoms(self.model, self._data, mujoco.MjvOption(), mujoco.MjvPerturb(), kind, scene)
            for geom in scene.geoms[first : scene.ngeom]:
                geom.rgba = GHOST
        return self._renderer.render()

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._renderer.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def drawable(scene: Scene) -> tuple[mujoco.MjModel, int]:
    """A copy of a scene's model, without planes if there is a terrain, and the material of the first plane, or -1.

    It has light everywhere: without a sun, a file's lamp leaves dark what walks away from it.
    """
    model = dressed(scene) or copy.copy(scene.mj_model)
    if (model.light_type != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL).all():
        model.vis.headlight.ambient, model.vis.headlight.diffuse = 0.5, 0.5
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    model.geom_rgba[planes[model.geom_matid[planes] >= 0]] = 1.0  # a robot's default colour does not tint the floor
    material = int(model.geom_matid[planes[0]]) if len(planes) else -1
    if scene.terrain is not None:
        model.geom_matid[planes], model.geom_rgba[planes] = -1, 0.0
    return model, material


def dressed(scene: Scene) -> mujoco.MjModel | None:
    """A model of the same bodies and joints with the robot's looks and our floor and sky, or None if it needs neither.

    A file with a skybox or a textured floor keeps its own.
    """
    path = Path(scene.path)
    looks = LOOKS / f"{path.stem}.npz"
    worn = looks.is_file() and (path.parent == ASSETS or not path.is_file())  # or a task's change of that robot
    path = ASSETS / f"{path.stem}.xml" if worn else path
    bare = not scene.mj_model.ntex and (scene.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any()
    if not worn and not (bare and path.is_file()):
        return None
    spec = mujoco.MjSpec.from_file(str(path))
    if worn:
        wear(spec, np.load(looks))
    else:
        stage = mujoco.MjSpec.from_file(str(ASSETS / "stage.xml"))
        for texture in stage.textures:
            how = {name: getattr(texture, name) for name in ("type", "builtin", "rgb1", "rgb2", "width", "height")}
            spec.add_texture(name=f"stage {texture.name}", **how)
        floor = spec.add_material(name="stage floor", texrepeat=[0.5, 0.5], texuniform=True)
        floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "stage checker"
        for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]:
            geom.material = floor.name
    model = spec.compile()
    return model if (model.nq, model.nbody) == (scene.mj_model.nq, scene.mj_model.nbody) else None


def wear(spec: mujoco.MjSpec, parts: Any) -> None:
    """Give bodies the meshes of a file of LOOKS in place of their geoms: "<body> <r> <g> <b> <a>", then v or f."""
    labels = sorted({label[:-2] for label in parts})
    for geom in [geom for geom in spec.geoms if geom.parent.name in {label.split()[0] for label in labels}]:
        spec.delete(geom)
    for label in labels:
        body, *rgba = label.split()
        corners = {"uservert": parts[f"{label} v"].astype(float).ravel(), "userface": parts[f"{label} f"].ravel()}
        spec.add_mesh(name=label, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, **corners)
        how: Any = dict(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=label, contype=0, conaffinity=0, mass=0)
        spec.body(body).add_geom(**how, rgba=[float(x) for x in rgba])


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


def point(scene: mujoco.MjvScene, root: Array, arrow: Arrow) -> None:
    """Add an arrow beside a root at a place (3,), 0.4 m long for 1 m/s."""
    way, rgba = np.array((*arrow[0], 0.0)), arrow[1]
    if (speed := float(np.linalg.norm(way))) == 0.0:
        return
    geom, start = scene.geoms[scene.ngeom], root + (0.25 / speed) * way + (0.0, 0.0, 0.2)
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.02, start, start + 0.4 * way)
    scene.ngeom += 1


def activations(model: mujoco.MjModel, ctrl: ArrayLike) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The tendons (m,) of a model's muscles, and their activation (..., m) in [0, 1] by ctrl (..., nu) in [-1, 1]."""
    pulling = np.flatnonzero(muscles(model))
    force = np.asarray(ctrl, dtype=np.float64)[..., pulling].clip(-1, 1)
    return model.actuator_trnid[pulling, 0], (force + 1) / 2


def orbit(model: mujoco.MjModel) -> dict[str, Any]:
    """Compute the place of the MJCF's first camera relative to what it follows, as an orbit about what it looks at.

    Without one, or if the robot carries it, where the robot, in its start pose, fills half of the picture.
    """
    carried = (model.cam_mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED) & (model.body_weldid[model.cam_bodyid] > 0)
    if not model.ncam or carried[0]:
        return {"yaw": -math.pi / 2, "pitch": 0.5, "distance": 1.6 * _size(model), "aim": [0, 0, 0], "fovy": 0.8}
    # mode="trackcom": the camera keeps its place relative to the centre of mass, and its direction.
    place, back = model.cam_poscom0[0], model.cam_mat0[0].reshape(3, 3)[:, 2]
    distance = float(place @ back)
    yaw, pitch, fovy = math.atan2(back[1], back[0]), math.asin(back[2]), math.radians(float(model.cam_fovy[0]))
    return {"yaw": yaw, "pitch": pitch, "distance": distance, "aim": (place - distance * back).tolist(), "fovy": fovy}


def _size(model: mujoco.MjModel) -> float:
    """The diagonal of all that moves, m; MuJoCo's extent has the floor in it."""
    mujoco.mj_kinematics(model, data := mujoco.MjData(model))
    moves = model.body_weldid[model.geom_bodyid] > 0
    place, radius = data.geom_xpos[moves], model.geom_rbound[moves, None]
    return float(np.linalg.norm((place + radius).max(0) - (place - radius).min(0))) if len(place) else 1.0


def follow(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
    """Let a camera go along with the robot, where `orbit` says."""
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, min(1, model.nbody - 1)
    place = orbit(model)
    camera.azimuth, camera.elevation = math.degrees(place["yaw"] + math.pi), -math.degrees(place["pitch"])
    camera.distance = place["distance"]


# Videos ---------------------------------------------------------------------------------------------------------------


def film(
    path: str | os.PathLike[str],
    scene: Scene,
    qpos: ArrayLike,
    control_dt: float,
    ctrl: ArrayLike | None = None,
    size: tuple[int, int] = VIDEO_SIZE,
    ghost: ArrayLike | None = None,
) -> Path:
    """Film qpos (T, nq), ctrl (T, nu) and ghost (T, nq), a row per control step [s], at true speed: of every
    k-th row, with the largest whole k that leaves 30 frames/s or more.

    See save_video; size is width and height in pixels.
    """
    check_video(path, size)
    stride = max(1, math.floor(1 / (VIDEO_FPS * control_dt) + 1e-6))
    others = (itertools.repeat(None) if each is None else np.asarray(each)[::stride] for each in (ctrl, ghost))
    with Renderer(scene, *size) as renderer:
        rows = zip(np.asarray(qpos)[::stride], *others, strict=False)
        frames = (renderer.draw(q, c, ghost=g) for q, c, g in rows)
        return save_video(path, frames, 1 / (stride * control_dt))


def save_video(path: str | os.PathLike[str], frames: Iterable[Frame], fps: float) -> Path:
    """Write frames (height, width, 3) as .mp4 (H.264) or .gif, which plays at true speed; returns the file.

    Raises:
        ValueError: no frames, another suffix, or an mp4 whose width or height is not a multiple of 16.
        OSError: the file cannot be written.
        RuntimeError: there is no encoder.
    """
    import imageio_ffmpeg

    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    size, frames, target = first.shape[1::-1], itertools.chain([first], frames), MP4
    path = check_video(path, size)
    if path.suffix == ".gif":  # its delays are hundredths of a second, and browsers want at least two of them
        stride = math.ceil(fps / 50 - 1e-6)
        frames, fps, target = itertools.islice(frames, 0, None, stride), fps / stride, GIF
    with whole_file(path) as part:
        options: dict[str, Any] = target | dict(quality=None, macro_block_size=1, ffmpeg_log_level="fatal")
        try:
            with closing(imageio_ffmpeg.write_frames(part, size, fps=fps, **options)) as encoder:
                encoder.send(None)
                count = sum(encoder.send(frame) is None for frame in frames)
            whole = imageio_ffmpeg.count_frames_and_secs(part)[0] == count  # ffmpeg's own errors are not seen
        except (OSError, RuntimeError) as error:
            raise OSError("ffmpeg fails, or the disk is full") from error
        if not whole:
            raise OSError("ffmpeg fails, or the disk is full")
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
    import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return path


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


@functools.cache
def check_opengl() -> str:
    """Name what draws pictures here, e.g. "llvmpipe (LLVM 15.0.6, 256 bits)"; raises RuntimeError with the remedy.

    MUJOCO_GL chooses the OpenGL before MuJoCo is imported. Without it, on Linux, it is EGL, which needs no display.
    """
    wanted = os.environ.get("MUJOCO_GL")
    os.environ.setdefault("EGL_LOG_LEVEL", "fatal")  # Mesa prints its search for drivers otherwise
    with suppress(ImportError):  # torch.optim imports it; the process crashes if it comes after Mesa's LLVM
        import_module("triton")
    try:
        if sys.platform == "linux" and not wanted:
            sys.modules[mujoco.Renderer.__module__].gl_context.GLContext = import_module("mujoco.egl").GLContext
        with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16):
            from OpenGL.GL import GL_RENDERER, glGetString

            return glGetString(GL_RENDERER).decode()
    except Exception as error:  # each OpenGL fails in its own ways, AttributeError among them
        remedy = f"unset MUJOCO_GL={wanted}" if wanted else "apt install libegl1 libgl1 libgl1-mesa-dri"
        raise RuntimeError(f"no OpenGL to draw with: {remedy} (or your system's EGL and Mesa)") from error
