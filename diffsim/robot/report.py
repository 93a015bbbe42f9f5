"""What the simulator makes of an MJCF file: used, approximated, refused. `python -m diffsim check robot.xml`"""

from __future__ import annotations

import os
from collections.abc import Iterator

import mujoco
import numpy as np

from diffsim.robot.approximations import named
from diffsim.robot.constants import CARRIERS
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene, SceneError

# Where a constant comes from that the file does not name.
SOURCES = {
    "k_n": "mass, shared by {carriers} contact points, and solref",
    "k_d": "k_n and solref",
    "k_t": "least apparent mass of a contact point",
    "mu": "friction of the lowest geom and the ground",
    "k_limit": "inertia that each joint moves, and solreflimit",
    "d_limit": "inertia that each joint moves, and solreflimit",
}


def report(path: str | os.PathLike[str]) -> tuple[str, bool]:
    """A page of text about a file, and whether it can be simulated."""
    try:
        scene = load_scene(path)
    except SceneError as error:
        return f"Cannot be simulated.\n\n{error}", False
    sections = [
        (f"{scene.name}: can be simulated", list(_parts(scene))),
        ("constants of contact and limits", list(_constants(scene))),
        ("approximated", [f"- {sentence}" for sentence in scene.approximations]),
    ]
    return "\n\n".join("\n  ".join([title, *lines]) for title, lines in sections if lines), True


def _parts(scene: Scene) -> Iterator[str]:
    m = scene.mj_model
    moving = sorted(
        f"{np.count_nonzero(m.jnt_type == kind)} {name.removeprefix('mjJNT_').lower()}"
        for name, kind in mujoco.mjtJoint.__members__.items()
        if (m.jnt_type == kind).any()
    )
    limited = np.count_nonzero(np.isfinite(scene.upper))
    muscles = len(np.unique(scene.segment_muscle))
    shares = {"motors": scene.nu - muscles, f"muscles ({scene.muscle_model})": muscles}
    yield f"links      {scene.nlink - 1} of one degree of freedom, base {'floating' if scene.floating else 'fixed'}"
    yield f"joints     {', '.join(moving)}; {limited} limited"
    yield f"state      nq {scene.nq}, nv {scene.nv}"
    yield f"mass       {scene.mass.sum():.4g} kg"
    yield f"controls   {', '.join(f'{n} {what}' for what, n in shares.items() if n) or 'none'}"
    yield f"contact    {scene.ncontact} points" + (
        f", ground at z = {scene.ground_height:g} m" if scene.ncontact else ""
    )
    yield f"features   {', '.join(sorted(scene.features))}"


def _constants(scene: Scene) -> Iterator[str]:
    limited = np.isfinite(scene.upper)
    for name, unit in PENALTY_CONSTANTS.items():
        values = np.atleast_1d(getattr(scene, name))
        if name.endswith("_limit"):
            values = values[limited]
        if not (len(values) and (scene.ncontact or name.endswith("_limit"))):
            continue
        span = f"{values[0]:.4g}" if np.ptp(values) == 0 else f"{values.min():.4g} to {values.max():.4g}"
        source = SOURCES[name].format(carriers=min(CARRIERS, scene.ncontact))
        source = "the file" if named(scene.mj_model, name) else f"default: {source}"
        yield f"{name:8} {span:>18} {unit:25} {source}"
