"""Simulator: a batch of environments of one scene, whose control steps are nodes of torch's graph."""

from __future__ import annotations

import functools
import math
from typing import Any, NoReturn

import torch
import warp as wp
from torch.autograd.forward_ad import unpack_dual

from diffsim.robot.constants import IMPEDANCE, check_soft, constrained
from diffsim.robot.scene import FACTORS, Scene
from diffsim.sim.integration import Integration, check_count, is_real
from diffsim.sim.launcher import Launcher, check_memory
from diffsim.sim.modes import in_plain_mode
from diffsim.sim.options import Options
from diffsim.sim.tangent import Tangent
from diffsim.sim.window import Window

DIVISORS = [FACTORS.index(name) for name in ("k_n", "k_d", "k_limit")]  # that MuJoCo's contact has positive
PASSES = 30  # of Newton's method in a substep, at most, as measured in docs/physics.md
BACKWARD_ONLY = (
    "a simulated step supports backward() and torch.autograd.grad only, for one gradient at a time: no "
    "torch.func, forward mode or is_grads_batched; Simulator.jacobians has the Jacobians of a batch"
)
State = tuple[torch.Tensor, torch.Tensor]  # qpos (N, nq), qvel (N, nv)


class Simulator:
    """A batch of independent copies of one scene, stepped by control steps of equal length.

    Example:
        scene = diffsim.load_scene("robot.xml")
        sim = diffsim.Simulator(scene, 16, diffsim.Integration("mujoco", 8), control_dt=0.02, horizon=2)
        qpos, qvel = torch.tensor(scene.qpos0).float().repeat(16, 1), torch.zeros(16, scene.nv)
        ctrl = torch.zeros(16, scene.nu, requires_grad=True)              # in [-1, 1]
        for _ in range(2):
            qpos, qvel = sim.step(qpos, qvel, ctrl)
        qvel.sum().backward()
        sim.rewind()                                                      # the next rollout

    Up to `horizon` differentiable control steps make a rollout, and `rewind` begins the next one. A backward pass must
    run before the next rollout overwrites its steps, otherwise it raises RuntimeError.

    Args:
        scene: the robot and its ground; a terrain has one profile for all copies, or one for each.
        num_envs: number of copies N.
        integration: contact model and substeps.
        control_dt: seconds of one control step.
        horizon: largest number of differentiable control steps in a rollout.
        **options: device, dtype, threads, factors, forces, block, division: see Options.

    Raises:
        ValueError: an argument out of range, with what is allowed.

    Attributes:
        factors: (N, 8) multipliers of the scene's constants, initially ones. Columns as in scene.FACTORS: constants of
            contact and of limits; mass and inertia of all links, without armature; force of motors and muscles. Change
            it in place or assign another tensor. A step uses the values at its call. A factor has no gradient: use
            ParametricSimulator.parameters. (N, 0) without factors=True.
        forces: (N, nbody, 6) external force [N] and torque [N m] on each body in world axes at its centre of mass,
            initially zero, constant over a control step: MuJoCo's xfrc_applied, with rows as in scene.mj_model. Used
            like factors, but a step is differentiable in them. Forces on the world and on bodies fixed to it have no
            effect. (N, 0, 6) without forces=True.
        nonfinite: (N,) bool, environments whose last step failed, see docs/physics.md. They keep the state from before
            it, with zero gradient. Other environments do not change.
        residual: (N,) largest residual of Newton's method in the last step, see docs/physics.md. Zeros on soft contact.
        unconverged: (N,) int32, number of control steps so far that ended with a residual above the tolerance.
        nonfinite_gradients: (N,) int32, number of control steps so far whose adjoint was not finite and was set to 0.
    """

    @in_plain_mode
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
        check_count("horizon times substeps", horizon * self.options.integration.substeps, most=2**31 - 1)
        self.scene, self.num_envs, self.control_dt, self.horizon = scene, num_envs, control_dt, horizon
        self.integration, self.dtype = self.options.integration, self.options.dtype
        self.device = torch.device(self.options.device)
        self.nq, self.nv, self.nu = scene.nq, scene.nv, scene.nu
        n, how, hard = num_envs, self.integration, self.integration.contact == "mujoco"
        width, bodies = scene.parameters or len(FACTORS) * self.options.factors, scene.nbody * self.options.forces
        # One buffer for qpos, qvel, ctrl, factors and forces side by side: torch copies it in one operation, and the
        # kernels see its parts. Each slot keeps those of its step; the last one serves steps without gradient.
        self._widths, slots = (scene.nq, scene.nv, scene.nu, width, 6 * bodies), horizon + 1
        self._end_widths = scene.nq, scene.nv + hard  # with constraints a column for the residual
        kept = f"states and actions of a horizon of {horizon:,} steps"
        check_memory(kept, n, slots * sum(self._widths) * self.dtype.itemsize, self.device)
        self._launcher = Launcher(self._with_contact(scene, how), n, self.options)
        self._factors, self._forces = self._zeros(n, width) + 1, self._zeros(n, bodies, 6)
        self._start, self._g_start = self._zeros(slots, n, sum(self._widths)), self._zeros(n, sum(self._widths))
        self._end, self._g_end = self._zeros(n, sum(self._end_widths)), self._zeros(n, scene.nq + scene.nv)
        self._nonfinite = self._zeros(slots, n, dtype=torch.bool)
        self.nonfinite_gradients, self.unconverged = self._zeros(2, n, dtype=torch.int32)
        self._rows: Any = None  # what backward needs of each substep, of all slots
        self._commands: dict[tuple[str, int], list[wp.Launch]] = {}
        self._window, self._last = Window(horizon), horizon  # slot of the last step

    def _zeros(self, *size: int, dtype: torch.dtype | None = None) -> torch.Tensor:
        return torch.zeros(size, dtype=dtype or self.dtype, device=self.device)

    @functools.cached_property
    def tangent(self) -> Tangent:
        """Return the tangent space of its scene's states."""
        return Tangent(self.scene, self.device, self.dtype)

    @property
    def nonfinite(self) -> torch.Tensor:
        """Return (N,) bool, true if the last step was not finite or out of bounds, and was undone; see the class."""
        return self._nonfinite[self._last]

    @property
    def residual(self) -> torch.Tensor:
        """Return (N,) the largest residual of Newton's method in the last step's substeps; zeros on soft contact."""
        return self._end[:, self.nq + self.nv :].sum(1)

    @property
    def factors(self) -> torch.Tensor:
        """Return multipliers (N, 8) of constants, columns as in scene.FACTORS; (N, 0) without factors=True."""
        return self._factors

    @factors.setter
    def factors(self, value: torch.Tensor) -> None:
        self._refuse_gradient(value)
        self._factors = self._check_given("factors", value, *self._factors.shape[1:])

    @property
    def forces(self) -> torch.Tensor:
        """Return force [N] and torque [N m] (N, nbody, 6) on each body, world axes; (N, 0, 6) without forces=True."""
        return self._forces

    @forces.setter
    def forces(self, value: torch.Tensor) -> None:
        self._forces = self._check_given("forces", value, *self._forces.shape[1:])

    def set_onset(self, metres: float) -> None:
        """Let contacts begin over another length from the next step on, see Integration.onset; 0: as in the file.

        Nothing is compiled anew, and captured CUDA graphs follow. Earlier steps have no adjoint any more.

        Raises:
            ValueError: soft contact, or a length out of range.
        """
        how = self.integration._replace(onset=metres).check()
        if how.contact == "mujoco":
            scene = self._with_contact(self.scene, how)
            self._launcher.rewrite(scene, ("contact_params", "row_params"), IMPEDANCE)
        self.integration, self.options = how, self.options._replace(integration=how)
        self._window.forget()

    def _with_contact(self, scene: Scene, how: Integration) -> Scene:
        """Return a copy with MuJoCo's constraints, or the scene itself on soft contact, if it supports the scene."""
        if how.contact == "mujoco":
            return constrained(scene, self.control_dt / how.substeps, self.dtype == torch.float32, how.onset)
        check_soft(scene)
        return scene

    def step(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> State:
        """Advance all environments by one control step, differentiable in its arguments and `forces`.

        Args:
            qpos: (N, nq) MuJoCo's generalised positions; quaternions wxyz, which need not have unit length.
            qvel: (N, nv) MuJoCo's generalised velocities; a free joint's linear velocity is in the world frame, its
                angular velocity in the body's.
            ctrl: (N, nu) one number per motor, [-1, 1] over its control range, constant over the step, not clipped.

        Returns:
            qpos, qvel after the step, of the same shapes.

        Raises:
            ValueError: an argument of the wrong shape, dtype or device; factors that require grad; on the CPU, factors
                or forces that were changed in place to what is not allowed.
            RuntimeError: a differentiable step in a full rollout.
        """
        for name, value, width in zip(("qpos", "qvel", "ctrl"), (qpos, qvel, ctrl), self._widths, strict=False):
            self.check_tensor(name, value, width)
        return self.advance(qpos, qvel, ctrl)

    def advance(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> State:
        """Do what `step` does, without checks of shape, dtype and device."""
        self._refuse_gradient(self._factors)
        if self.device.type == "cpu":  # on a GPU the check would wait for the device
            for name, given in (("factors", self._factors), ("forces", self._forces)):
                if given.shape[1]:
                    self._check_given(name, given, *given.shape[1:])
        start = (qpos, qvel, ctrl, self._factors, self._forces.flatten(1))
        if torch.is_grad_enabled() and any(part.requires_grad for part in start):
            both = ControlStep.apply(self, self._window.take(), *start)
        else:
            both = self._forward(self.horizon, *start)
        end: State = both.split(self._widths[:2], dim=1)
        return end

    def _forward(self, slot: int, *start: torch.Tensor) -> torch.Tensor:
        """Return the state (N, nq + nv) after one control step from start = (qpos, qvel, ctrl, factors, forces)."""
        torch.cat([part.detach() for part in start], dim=1, out=self._start[slot])
        self._last = slot
        self._launcher.launch(self._command("forward", slot))
        return self._end[:, : self.nq + self.nv].clone()

    @in_plain_mode
    def jacobians(
        self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute A (N, 2 nv, 2 nv) and B (N, 2 nv, nu) of a step: dx' = A dx + B dctrl, in 2 nv backward passes.

        x is qpos, then qvel, and differences of qpos are those of MuJoCo's mjd_transitionFD: a rotation changes by a
        rotation vector in the body's frame. Arguments are as for `step`. The rollout must have room for a step. Rows of
        `nonfinite` environments are zero.
        """
        leaves, used = [part.detach().clone().requires_grad_() for part in (qpos, qvel, ctrl)], self._window.used
        with torch.enable_grad():
            end = torch.cat(self.step(*leaves), dim=1)
        cotangents = self.tangent.left_inverse(end.detach()).unbind(1)
        rows = [torch.autograd.grad(end, leaves, row, retain_graph=True) for row in cotangents]
        self._window.used = used
        g_qpos, g_qvel, B = (torch.stack(part, dim=1) for part in zip(*rows, strict=True))
        return torch.cat((g_qpos, g_qvel), dim=2) @ self.tangent.basis(torch.cat(leaves[:2], dim=1).detach()), B

    def rewind(self) -> None:
        """Begin a new rollout of differentiable steps."""
        self._window.used = 0

    def _command(self, kernel: str, slot: int) -> list[wp.Launch]:
        key = (kernel, slot)
        if key not in self._commands:
            self._commands[key] = self._launcher.command(kernel, self._inputs(kernel, slot))
        return self._commands[key]

    def _inputs(self, kernel: str, slot: int) -> list[Any]:
        record, how = slot < self.horizon, self.integration
        if record and self._rows is None:
            self._rows = self._launcher.checkpoints(self.horizon * how.substeps)
        rows = self._rows if record else self._launcher.checkpoints(0)
        row0 = slot * how.substeps if record else 0
        batch, gradients = (
            self._launcher.batch([*start.split(self._widths, dim=1), *end.split(widths, dim=1)])
            for start, end, widths in (
                (self._start[slot], self._end, self._end_widths),
                (self._g_start, self._g_end, self._widths[:2]),
            )
        )
        real, nonfinite = self._launcher.spec.dtype, wp.from_torch(self._nonfinite[slot])
        scalars = [real(self.control_dt / how.substeps), how.substeps]
        missed, blown_up = wp.from_torch(self.unconverged), wp.from_torch(self.nonfinite_gradients)
        if kernel == "forward":
            return [*scalars, PASSES, real(how.tolerance), batch, int(record), row0, rows, nonfinite, missed]
        return [*scalars, row0, rows, batch, nonfinite, gradients, blown_up]

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a simulator, and so an environment, cannot be pickled or copied, because it holds compiled kernels: make "
            "another one, and load the environment's state_dict() into it"
        )

    def check_tensor(self, name: str, value: torch.Tensor, *size: int) -> None:
        """Raise ValueError unless value is a (num_envs, *size) tensor of the simulator's dtype on its device."""
        found: tuple[object, ...] = (type(value).__name__,)
        if isinstance(value, torch.Tensor):
            refuse_transforms(value)
            found = ("nested",) if value.is_nested else (tuple(value.shape), value.dtype, value.device)
            found = found if value.layout == torch.strided else (value.layout, *found)
        if found != (wanted := ((self.num_envs, *size), self.dtype, self.device)):
            have, must = (" ".join(map(str, each)) for each in (found, wanted))
            raise ValueError(f"{name} is {have}, must be a torch.Tensor of {must}")

    def _refuse_gradient(self, factors: torch.Tensor) -> None:
        """Raise ValueError if factors require grad; a scene's parameters, which are in their place, may."""
        if isinstance(factors, torch.Tensor) and factors.requires_grad and not self.scene.parameters:
            raise ValueError("factors require grad, but a factor has no gradient: use ParametricSimulator.parameters")

    def _check_given(self, name: str, value: torch.Tensor, *size: int) -> torch.Tensor:
        """Raise ValueError unless factors or forces are finite, and factors not negative, divisors positive."""
        self.check_tensor(name, value, *size)
        bad = ~torch.isfinite(value)
        if name == "factors":
            bad |= value < 0
            if self._launcher.spec.constrained and size[0]:
                bad[:, DIVISORS] |= value[:, DIVISORS] == 0
        if not bool(bad.any()):
            return value
        place = tuple(bad.nonzero()[0].tolist())
        rest = " and not negative, on MuJoCo's contact those of k_n, k_d and k_limit positive"
        must = f"must be finite{rest if name == 'factors' else ''}"
        raise ValueError(f"{name}[{', '.join(map(str, place))}] is {value[place].item()}; {name} {must}")


def refuse_transforms(value: torch.Tensor) -> None:
    """Raise RuntimeError under a transform of torch.func, and for a tangent of forward mode: no kernel sees either."""
    if torch._C._are_functorch_transforms_active() or unpack_dual(value).tangent is not None:
        raise RuntimeError(BACKWARD_ONLY)


class ControlStep(torch.autograd.Function):
    """Maps qpos, qvel, ctrl, factors, forces to qpos and qvel side by side; a slot keeps the arguments."""

    @staticmethod
    def forward(ctx: Any, sim: Simulator, slot: int, *start: torch.Tensor) -> torch.Tensor:
        ctx.sim, ctx.slot, ctx.version = sim, slot, sim._window.version(slot)
        return sim._forward(slot, *start)

    @staticmethod
    def backward(ctx: Any, g_end: torch.Tensor) -> tuple[Any, ...]:
        refuse_transforms(g_end)
        if torch.is_grad_enabled():  # create_graph=True; without this, second derivatives would lack their larger part
            raise RuntimeError(
                "a simulated step has a first derivative only, so no create_graph=True: take finite differences of it"
            )
        sim = ctx.sim
        sim._window.check(ctx.slot, ctx.version)
        try:
            sim._g_end.copy_(g_end)
        except RuntimeError as error:  # is_grads_batched
            raise RuntimeError(BACKWARD_ONLY) from error
        sim._launcher.launch(sim._command("backward", ctx.slot))
        return (None, None, *sim._g_start.clone().split(sim._widths, dim=1))
