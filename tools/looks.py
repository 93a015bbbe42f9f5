"""Write diffsim/assets/looks: what pictures show of Unitree's robots in place of the primitives that are simulated.

    pip install fast-simplification
    python tools/looks.py mujoco_menagerie

The visual meshes of MuJoCo Menagerie, one for each body and colour, with few triangles and in the body's frame.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import tyro
from tyro.conf import Positional

from diffsim.tasks.base import ASSETS
from diffsim_cli.render import LOOKS

# Trunks, whose files stored copies of Menagerie lack: place of the centre, half of length, width and height [m].
WHITE = 1.0, 1.0, 1.0, 1.0
TRUNKS = {"go1": ("trunk", 0.02, (0.25, 0.07, 0.058)), "go2": ("base", 0.04, (0.27, 0.07, 0.06))}
ROBOTS = {"go1": "unitree_go1/go1.xml", "go2": "unitree_go2/go2.xml", "g1": "unitree_g1/g1.xml"}
TRIANGLES = 22_000  # of a robot
SMALLEST = 0.03  # m, the diagonal of a piece, such as a screw's head, below which it is left out


def without_missing_files(path: Path) -> mujoco.MjModel:
    """The compiled file, without meshes that are not there and their geoms."""
    spec = mujoco.MjSpec.from_file(str(path))
    names = {mesh.name or Path(mesh.file).stem: path.parent / "assets" / mesh.file for mesh in spec.meshes}
    missing = {name for name, file in names.items() if not file.is_file()}
    for geom in [geom for geom in spec.geoms if geom.meshname in missing]:
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if (mesh.name or Path(mesh.file).stem) in missing]:
        spec.delete(mesh)
    return spec.compile()


def parts(model: mujoco.MjModel) -> dict[tuple[str, tuple[float, ...]], tuple[np.ndarray, np.ndarray]]:
    """Vertices in the body's frame and triangles, by body and colour, of all meshes that are only drawn."""
    found: dict[tuple[str, tuple[float, ...]], tuple[np.ndarray, np.ndarray]] = {}
    for g in range(model.ngeom):
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH or model.geom_contype[g] or model.geom_conaffinity[g]:
            continue
        mesh, turn = model.geom_dataid[g], np.empty(9)
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        mujoco.mju_quat2Mat(turn, model.geom_quat[g])
        vertices = vertices @ turn.reshape(3, 3).T + model.geom_pos[g]
        rgba = model.mat_rgba[model.geom_matid[g]] if model.geom_matid[g] >= 0 else model.geom_rgba[g]
        key = model.body(model.geom_bodyid[g]).name, tuple(np.round(rgba, 3).tolist())
        before, triangles = found.get(key, (np.empty((0, 3)), np.empty((0, 3), int)))
        found[key] = np.concatenate((before, vertices)), np.concatenate((triangles, faces + len(before)))
    return found


def large_pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with equal vertices welded, without small pieces."""
    vertices, index = np.unique(vertices.astype(np.float32).round(5), axis=0, return_inverse=True)
    faces, piece = index.reshape(-1)[faces].astype(np.int32), np.arange(len(vertices))
    while True:  # each vertex takes the least number of its triangles until nothing changes
        least, before = piece[faces].min(1), piece.copy()
        for corner in range(3):
            np.minimum.at(piece, faces[:, corner], least)
        piece = piece[piece]
        if (piece == before).all():
            break
    low, high = np.full((len(vertices), 3), np.inf), np.full((len(vertices), 3), -np.inf)
    np.minimum.at(low, piece, vertices)
    np.maximum.at(high, piece, vertices)
    large = np.linalg.norm(high - low, axis=1)[piece] >= SMALLEST
    used, faces = np.unique(faces[large[faces].all(1)], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32)


def rounded_box(half: tuple[float, float, float], rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A superellipsoid (x/a)^4 + (y/b)^4 + (z/c)^4 = 1: for the trunks, whose files Menagerie's snapshots lack."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    directions = np.stack((np.cos(polar), np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)), -1)
    points = directions / (directions**4).sum(-1, keepdims=True) ** 0.25 * half
    k = np.arange((rings - 1) * 2 * rings).reshape(rings - 1, -1)[:, :-1].ravel()
    right, below = k + 1, k + 2 * rings
    faces = np.concatenate((np.stack((k, below, right), 1), np.stack((right, below, below + 1), 1)))
    return points.reshape(-1, 3), faces.astype(np.int32)


def surface(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def main(menagerie: Positional[Path]) -> None:
    """Args:
    menagerie: a clone of https://github.com/google-deepmind/mujoco_menagerie
    """
    from fast_simplification import simplify

    for name, file in ROBOTS.items():
        own = {body.name for body in mujoco.MjSpec.from_file(str(ASSETS / f"{name}.xml")).bodies}
        found = {key: part for key, part in parts(without_missing_files(menagerie / file)).items() if key[0] in own}
        found = {key: large_pieces(*part) for key, part in found.items()}
        if name in TRUNKS:
            body, centre, half = TRUNKS[name]
            found.pop((body, WHITE), None)  # letters on the trunk
            vertices, faces = rounded_box(half)
            found[body, (0.75, 0.77, 0.8, 1.0)] = vertices + (centre, 0.0, 0.0), faces
        sizes = {key: surface(*part) ** 0.5 for key, part in found.items()}
        arrays: dict[str, np.ndarray] = {}
        for (body, rgba), (vertices, faces) in found.items():
            count = round(TRIANGLES * sizes[body, rgba] / sum(sizes.values()))
            if count < len(faces):
                vertices, faces = simplify(vertices, faces, target_count=count, agg=3)
            label = f"{body} {' '.join(f'{x:g}' for x in rgba)}"
            arrays[f"{label} v"], arrays[f"{label} f"] = vertices.astype(np.float16), faces.astype(np.uint16)
        LOOKS.mkdir(exist_ok=True)
        np.savez_compressed(path := LOOKS / f"{name}.npz", **arrays)  # type: ignore[arg-type]
        print(f"{path}: {len(found)} meshes, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    tyro.cli(main)
