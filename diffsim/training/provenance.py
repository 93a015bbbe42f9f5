"""Which robot a policy was trained on: a hash of what the simulator reads of an MJCF file."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import numpy as np

from diffsim.robot.scene import Scene

# Fields of a compiled model, by the beginning of their names; names and colours are not simulated.
FIELDS = {
    "actuator_": "trntype trnid gear group gaintype gainprm biastype biasprm dyntype dynprm ctrllimited ctrlrange "
    "forcelimited forcerange lengthrange",
    "body_": "parentid pos quat mass inertia ipos iquat gravcomp",
    "dof_": "armature damping frictionloss solref solimp",
    "exclude_": "signature",
    "geom_": "type bodyid dataid pos quat size contype conaffinity condim priority friction solmix solref solimp "
    "margin gap fluid",
    "jnt_": "type bodyid pos axis stiffness limited range margin solref solimp actfrclimited actfrcrange actgravcomp",
    "key_": "qpos",
    "mesh_": "vert",
    "numeric_": "data",
    "pair_": "geom1 geom2 dim friction solref solreffriction solimp margin gap",
    "qpos": "0 _spring",
    "site_": "bodyid pos",
    "tendon_": "limited range stiffness damping frictionloss",
    "wrap_": "type objid prm",
}
OPTIONS = "gravity wind density viscosity impratio cone integrator disableflags enableflags disableactuator"


def fingerprint(scene: Scene) -> str:
    """Return 16 hexadecimal digits that change with the robot, in numbers of float32: platforms differ beyond them."""
    model = scene.mj_model
    values = [getattr(model, prefix + name) for prefix, names in FIELDS.items() for name in names.split()]
    values += [getattr(model.opt, name) for name in OPTIONS.split()]
    if "site" in scene.features:  # elsewhere sites have no orientation, and old checkpoints keep their hash
        values.append(model.site_quat)
    return hashlib.sha256(b"".join(np.asarray(value, np.float32).tobytes() for value in values)).hexdigest()[:16]


def compare(trained: str | None, scene: Scene) -> None:
    """Print one line if the robot's file has changed since a checkpoint, unless that is too old to have one."""
    if trained not in (None, fingerprint(scene)):
        print(f"{Path(sys.argv[0]).name}: the robot's file has changed since the training", file=sys.stderr)
