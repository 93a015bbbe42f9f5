"""Simulator: a batch of environments of one scene, and what may be asked of it."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import torch

from diffsim.robot.constraint import check_soft, constrained
from diffsim.robot.scene import FACTORS, Scene
from diffsim.sim.integration import Integration, check_count, is_real
from diffsim.sim.launcher import Launcher, check_memory
from diffsim.sim.options import Options
from diffsim.sim.stepper import ExtrapolatedStepper, State, Stepper


class Simulator:
    """A batch of independent copies of one scene, stepped by control steps of equal length.

    Holds the checkpoints of up to `horizon` differentiable control steps in a ring: a backward pass must come before
    its steps are overwritten (asserted). Steps that need no gradient store nothing.

    Args:
        scene: what is simulated; a terrain of one profile for all copies, or of one for each.
        num_envs: number of copies N.
        integration: integrator, substeps and theta.
        control_dt: seconds of one control step.
        horizon: differentiable control steps that can be alive at once.
        **options: device, dtype, threads, factors, forces, block, division: see Options.

    Raises:
        ValueError: an argument out of range, with what is allowed.

    Attributes:
        factors: (N, 8) multipliers of the scene's constants, at first ones, columns in the order of scene.FACTORS:
            constants of contact and of all limits, mass and inertia of all links (not armature), force of all motors
            and muscles. Change it in place or assign another tensor; a
            step uses those of its call and is differentiable in them. (N, 0) without the argument.
        forces: (N, nbody, 6) external force (N) and torque (N m) on each body, in world axes at its centre of mass, at
            first zero: MuJoCo's xfrc_applied, with the rows of scene.mj_model's bodies. What acts on the world or on a
            body that is fixed to it has no effect. Constant over a control step; to be changed like factors, and a
            step is differentiable in them too. (N, 0, 6) without the argument.
        nonfinite: (N,) bool, environments whose last step left the finite numbers, or passed 1e5 m/s or rad/s. Their
            state is returned as it was before that step, its gradient is zero; other environments are not touched.
        residual: (N,) how far the last pass of the integrator mujoco moved the acceleration, relative to its norm + 1,
            in that substep of the last step where it is largest; zeros with other integrators.
        nonfinite_gradients: (N,) int32, how many adjoints of control steps were not finite, and were set to zero.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        integration: Integration = Integration(),
        control_dt: float = 1 / 60,
        horizon: int = 1,
        **options: Any,
    ) -> None:
        if not isinstance(scene, Scene):
            raise ValueError(f"scene is a {type(scene).__name__}, must be a Scene: load_scene reads one from a file")
        num_envs, horizon = check_count("num_envs", num_envs), check_count("horizon", horizon)
        if not is_real(control_dt) or not 0 < control_dt < math.inf:
            raise ValueError(f"control_dt is {control_dt!r}, must be positive seconds")
        if scene.terrain is not None and len(scene.terrain) not in (1, num_envs):
            raise ValueError(f"terrain has {len(scene.terrain)} profiles, must have 1 or one for each of {num_envs}")
        self.options = Options(integration, **options).check()
        self.scene, self.num_envs, self.control_dt, self.horizon = scene, num_envs, control_dt, horizon
        self.integration, self.dtype = self.options.integration, self.options.dtype
        self.device = torch.device(self.options.device)
        self.nq, self.nv, self.nu = scene.nq, scene.nv, scene.nu
        width, bodies = len(FACTORS) if self.options.factors else 0, scene.nbody if self.options.forces else 0
        numbers = (horizon + 1) * (scene.nq + scene.nv + scene.nu + width + 6 * bodies)
        check_memory("states and actions", num_envs, numbers * self.dtype.itemsize, self.device)
        if self.integration.integrator == "mujoco":
            scene = constrained(scene, control_dt / self.integration.substeps)
        else:
            check_soft(scene)
        launcher = Launcher(scene, num_envs, self.options)
        stepper = ExtrapolatedStepper if self.integration.integrator == "extrapolated" else Stepper
        self._stepper = stepper(launcher, self.integration, control_dt, horizon)
        self.nonfinite_gradients = launcher.nonfinite_gradients
        self._factors = torch.ones(num_envs, width, dtype=self.dtype, device=self.device)
        self._forces = torch.zeros(num_envs, bodies, 6, dtype=self.dtype, device=self.device)

    @property
    def nonfinite(self) -> torch.Tensor:
        return self._stepper.nonfinite

    @property
    def residual(self) -> torch.Tensor:
        return self._stepper.residual

    @property
    def factors(self) -> torch.Tensor:
        return self._factors

    @factors.setter
    def factors(self, value: torch.Tensor) -> None:
        self.check_tensor("factors", value, self._factors.shape[1])
        self.check_factors(value)
        self._factors = value

    @property
    def forces(self) -> torch.Tensor:
        return self._forces

    @forces.setter
    def forces(self, value: torch.Tensor) -> None:
        self.check_tensor("forces", value, *self._forces.shape[1:])
        self.check_forces(value)
        self._forces = value

    def step(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> State:
        """Advance all environments by one control step, differentiable in its arguments, `factors` and `forces`.

        Args:
            qpos: (N, nq) MuJoCo's generalised positions; quaternions wxyz, normalised here.
            qvel: (N, nv) MuJoCo's generalised velocities; of a free joint the linear one in the world's frame, the
                angular one in the body's.
            ctrl: (N, nu) one number per motor, [-1, 1] over its control range, constant over the step, not clipped.

        Returns:
            qpos, qvel after the step, of the same shapes.

        Raises:
            ValueError: an argument of the wrong shape, dtype or device; on the CPU, factors or forces that were changed
                in place to what is not allowed.
        """
        for name, value, width in (("qpos", qpos, self.nq), ("qvel", qvel, self.nv), ("ctrl", ctrl, self.nu)):
            self.check_tensor(name, value, width)
        if self.device.type == "cpu":  # a GPU's would have to be waited for
            if self._factors.shape[1]:
                self.check_factors(self._factors)
            if self._forces.shape[1]:
                self.check_forces(self._forces)
        return self._stepper.step(qpos, qvel, ctrl, self._factors, self._forces.flatten(1))

    def rewind(self) -> None:
        """Let the next differentiable step use the first checkpoint: the start of a new window."""
        self._stepper.rewind()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a simulator, and so an environment, cannot be pickled or copied, because it holds compiled kernels: make "
            "another one, and load the environment's state_dict() into it"
        )

    def check_tensor(self, name: str, value: torch.Tensor, *size: int) -> None:
        """Raise ValueError unless value is a (num_envs, *size) tensor of the simulator's dtype on its device."""
        if not isinstance(value, torch.Tensor):
            raise ValueError(f"{name} is a {type(value).__name__}, must be a torch.Tensor")
        wanted, bodies = (self.num_envs, *size), "bodies, " * (len(size) - 1)
        if tuple(value.shape) != wanted:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, must be {wanted} (environments, {bodies}numbers each)"
            )
        if value.dtype != self.dtype:
            raise ValueError(f"{name} has dtype {value.dtype}, must be {self.dtype}")
        if value.device != self.device:
            raise ValueError(f"{name} is on {value.device}, must be on {self.device}")

    def check_factors(self, factors: torch.Tensor) -> None:
        """Raise ValueError unless all (N, len(FACTORS) or 0) are finite and not negative, and what divides positive."""
        bad = ~((factors >= 0) & (factors < math.inf))
        if factors.shape[1] and self.integration.integrator == "mujoco":
            divisors = [FACTORS.index(name) for name in ("k_n", "k_d", "k_limit")]
            bad[:, divisors] |= factors[:, divisors] == 0
        if bool(bad.any()):
            env, column = bad.nonzero()[0].tolist()
            raise ValueError(
                f"the factor of {FACTORS[column]} is {factors[env, column].item()} in environment {env}; factors must "
                "be finite and not negative, with the integrator mujoco those of k_n, k_d and k_limit positive"
            )

    def check_forces(self, forces: torch.Tensor) -> None:
        """Raise ValueError unless all (N, nbody or 0, 6) are finite."""
        if not bool(torch.isfinite(forces).all()):
            env, body, column = (~torch.isfinite(forces)).nonzero()[0].tolist()
            name = self.scene.mj_model.body(body).name or f"number {body}"
            raise ValueError(
                f"{'force' if column < 3 else 'torque'} {'xyz'[column % 3]} on body {name} is "
                f"{forces[env, body, column].item()} in environment {env}; forces must be finite"
            )
