"""Contact model of a simulator, and the onset of its contacts, which may change while kernels and CUDA graphs stay."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
import warp as wp

from diffsim.kernels.thread.model import model_of
from diffsim.robot.constraint import IMPEDANCE, check_soft, constrained
from diffsim.robot.scene import Scene
from diffsim.sim.integration import Integration
from diffsim.sim.launcher import Launcher

if TYPE_CHECKING:
    from diffsim.sim.simulator import Simulator


def with_contact(scene: Scene, how: Integration, control_dt: float, dtype: torch.dtype) -> Scene:
    """Return a copy with MuJoCo's constraints, or the scene itself on soft contact.

    Raises:
        SceneError: the contact model does not support the scene.
    """
    if how.contact == "mujoco":
        return constrained(scene, control_dt / how.substeps, dtype == torch.float32, how.onset)
    check_soft(scene)
    return scene


def rewrite(launcher: Launcher, scene: Scene, names: Iterable[str], columns: slice = slice(None)) -> None:
    """Copy arrays of a scene with the same kernels, or their columns, to where the kernels read them."""
    model = model_of(scene, launcher._division, launcher.spec.dtype, "cpu")
    for name in names:
        if (array := getattr(launcher._model, name, None)) is not None:
            wp.to_torch(array)[..., columns].copy_(wp.to_torch(getattr(model, name))[..., columns])


def set_onset(self: Simulator, metres: float) -> None:
    """Let contacts begin over another length from the next step on, see Integration.onset; 0: as in the file.

    Nothing is compiled anew, and captured CUDA graphs follow. Earlier steps have no adjoint any more.

    Raises:
        ValueError: soft contact, or a length out of range.
    """
    how = self.integration._replace(onset=metres).check()
    if how.contact == "mujoco":
        scene = with_contact(self.scene, how, self.control_dt, self.dtype)
        rewrite(self._launcher, scene, ("contact_params", "row_params"), IMPEDANCE)
    self.integration, self.options = how, self.options._replace(integration=how)
    self._versions = [version + 1 for version in self._versions]
