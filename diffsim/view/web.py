"""A motion as one web page, which plays in any browser without network access; the page itself is assets/web.html."""

from __future__ import annotations

import base64
import html
import json
import math
import os
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffsim.robot.scene import Scene
from diffsim.view.render import GROUND
from diffsim.view.slabs import slabs

MAX_BYTES = 700_000  # of poses; what is longer keeps every second control step, or fewer
HIDDEN_GROUP = 3  # geoms from this group on are not drawn, as in MuJoCo


def write_page(
    path: str | os.PathLike[str],
    scene: Scene,
    qpos: ArrayLike,
    control_dt: float,
    ctrl: ArrayLike | None = None,
    title: str = "",
    caption: str = "",
) -> Path:
    """Write a page that plays qpos (T, nq), with muscles coloured by ctrl (T, nu) in [-1, 1].

    Args:
        path: of the .html.
        scene: what moves. Meshes are drawn as their boxes, muscles straight from point to point.
        qpos, ctrl: one row per control step of control_dt seconds.
        title, caption: text of the page; a caption may have several lines.

    Raises:
        ValueError: another suffix.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(f"a page ends in .html, not {path.suffix!r}")
    motion = json.dumps(describe(scene, qpos, control_dt, ctrl)).replace("<", "\\u003c")
    page = (files("diffsim") / "assets" / "web.html").read_text(encoding="utf-8")
    for name, text in (("$title", html.escape(title)), ("$caption", html.escape(caption)), ("$motion", motion)):
        page = page.replace(name, text)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path


def describe(scene: Scene, qpos: ArrayLike, control_dt: float, ctrl: ArrayLike | None = None) -> dict[str, Any]:
    """What the page draws: shapes once, and of every frame the pose of each body and the activation of each muscle."""
    model = scene.mj_model
    qpos = np.asarray(qpos, dtype=np.float64)
    stride = 1 + qpos.shape[0] * model.nbody * 28 // MAX_BYTES
    poses, track = _poses(model, qpos[::stride])
    muscles = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)
    force = np.zeros((len(poses), len(muscles)))
    if ctrl is not None:
        force = (np.asarray(ctrl, dtype=np.float64)[::stride, muscles].clip(-1, 1) + 1) / 2
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    return {
        "dt": stride * control_dt,
        "frames": len(poses),
        "bodies": model.nbody,
        "floor": float(model.geom_pos[planes[0], 2]) if len(planes) and scene.terrain is None else None,
        "geoms": [_geom(model, k) for k in range(model.ngeom) if _is_drawn(model, k)] + _terrain(scene),
        "muscles": [_muscle(model, model.actuator_trnid[k, 0]) for k in muscles],
        "camera": orbit(model),
        "poses": _base64(poses.astype("<f4")),
        "track": _base64(track.astype("<f4")),
        "activation": _base64((force * 255).round().astype(np.uint8)),
    }


def _poses(model: mujoco.MjModel, qpos: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(T, nbody, 7) position and quaternion wxyz of each body, and (T, 3) what the camera follows.

    That is the centre of mass of the body that carries the camera, at its mean height, so that the picture keeps still.
    """
    data, carrier = mujoco.MjData(model), model.cam_bodyid[0] if model.ncam else min(1, model.nbody - 1)
    poses, track = np.empty((len(qpos), model.nbody, 7)), np.empty((len(qpos), 3))
    for t, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        poses[t, :, :3], poses[t, :, 3:], track[t] = data.xpos, data.xquat, data.subtree_com[carrier]
    track[:, 2] = track[:, 2].mean()
    return poses, track


def _is_drawn(model: mujoco.MjModel, geom: int) -> bool:
    plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
    return not plane and model.geom_group[geom] < HIDDEN_GROUP and _rgba(model, geom)[3] > 0


def _rgba(model: mujoco.MjModel, geom: int) -> NDArray[np.float32]:
    material = model.geom_matid[geom]
    return model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]


def _geom(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return {
        "type": kind if kind in ("sphere", "capsule", "ellipsoid", "cylinder") else "box",
        "body": int(model.geom_bodyid[geom]),
        "size": _rounded(model.geom_size[geom]),
        "pos": _rounded(model.geom_pos[geom]),
        "quat": _rounded(model.geom_quat[geom]),
        "rgba": _rounded(_rgba(model, geom)),
    }


def _terrain(scene: Scene) -> list[dict[str, Any]]:
    """The first profile, of boxes on the world."""
    boxes = []
    for size, centre, rotation in [] if scene.terrain is None else slabs(scene.terrain[0]):
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, rotation.ravel())
        places = {"size": _rounded(size), "pos": _rounded(centre), "quat": _rounded(quat)}
        boxes.append({"type": "box", "body": 0, **places, "rgba": _rounded(GROUND)})
    return boxes


def _muscle(model: mujoco.MjModel, tendon: int) -> dict[str, Any]:
    """Its half width and its path: body and point in the body's frame, of each site that it passes."""
    first = model.tendon_adr[tendon]
    steps = range(first, first + model.tendon_num[tendon])
    sites = [model.wrap_objid[k] for k in steps if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_SITE]
    points = [[int(model.site_bodyid[k]), *_rounded(model.site_pos[k])] for k in sites]
    return {"width": float(model.tendon_width[tendon]), "points": points}


def orbit(model: mujoco.MjModel) -> dict[str, Any]:
    """Where the MJCF's first camera stands relative to what it follows, as the orbit about a point that it looks at."""
    if not model.ncam:
        return {"yaw": -math.pi / 2, "pitch": 0.3, "distance": 3 * model.stat.extent, "aim": [0, 0, 0], "fovy": 0.8}
    # mode="trackcom": the camera keeps its place relative to the centre of mass, and its direction.
    place, back = model.cam_poscom0[0], model.cam_mat0[0].reshape(3, 3)[:, 2]
    distance = float(place @ back)
    return {
        "yaw": math.atan2(back[1], back[0]),
        "pitch": math.asin(back[2]),
        "distance": distance,
        "aim": _rounded(place - distance * back),
        "fovy": math.radians(float(model.cam_fovy[0])),
    }


def _rounded(values: ArrayLike) -> list[float]:
    return [round(float(value), 5) for value in np.asarray(values)]


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(array.tobytes()).decode()
