"""ParametricSimulator: masses, inertias, friction, damping, armature and gains of a robot as tensors with gradients.

    sim = ParametricSimulator(scene, num_envs, integration, control_dt, horizon)
    mass = sim.parameters["mass"].requires_grad_()
    sim.parameters = {"mass": mass}                   # what is not named keeps the file's values
    qpos, qvel = sim.step(qpos, qvel, ctrl)           # differentiable in mass, too

All environments have the same parameters. The steps are those of the changed MjModel after mj_setConst: its inverse
weights, and so the softness of constraints, depend on the masses.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.kernels.thread.columns import LINK, Columns
from diffsim.robot.constants import LEAST_FRICTION, LEAST_WEIGHT, constrained
from diffsim.robot.contacts import declared_pairs, ground_pairs, pair_law
from diffsim.robot.elements import at_rest, control_range, label, motors, servos
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import SceneError
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

Mask = NDArray[np.bool_]
# MuJoCo's field of each parameter, and its place there
FIELDS: dict[str, tuple[str, Any]] = {
    "mass": ("body_mass", ...),
    "com": ("body_ipos", ...),
    "inertia": ("body_inertia", ...),  # principal moments; the axes stay the file's
    "friction": ("geom_friction", np.s_[:, 0]),  # sliding friction, on MuJoCo's contact
    "damping": ("dof_damping", ...),
    "armature": ("dof_armature", ...),
    "frictionloss": ("dof_frictionloss", ...),
    "gain": ("actuator_gainprm", np.s_[:, 0]),  # of position servos also kp, of velocity servos kv
    "kv": ("actuator_biasprm", np.s_[:, 2]),  # with a minus; damping of position servos
}
# Fields of Scene and of the kernels' Model that depend on them
OF_SCENE = """mass com inertia armature damping stiffness spring_ref servo_stiffness servo_damping servo_ref gear
motor_bias""".split()
OF_MODEL = [*OF_SCENE, "contact_params", "limit_params", "joint_loss", "row_params"]
UNSUPPORTED = {"drag": "a fluid", "gravcomp": "gravity compensation", "muscle": "tendons", "tendon": "fixed tendons"}
UNSUPPORTED |= {"site": "actuators at sites"}


class _Robot:
    """Reads and writes the parameters of an MjModel, and maps them to the columns of kernels/thread/columns.py.

    Attributes:
        file: the file's parameters, in float64.
        free: for each, which elements may differ from the file's: those that the robot's motion depends on.
    """

    def __init__(self, scene: Scene, hard: bool) -> None:
        """Read a scene, which will have MuJoCo's constraints if hard."""
        self.scene, self.hard, self.first = scene, hard, 6 if scene.floating else 0
        self.m = m = scene.mj_model
        self.file = {name: torch.tensor(getattr(m, field)[place]).double() for name, (field, place) in FIELDS.items()}
        self.file["kv"] = 0.0 - self.file["kv"]
        moving = scene.body_link > (-1 if scene.floating else 0)
        self.bodies = torch.tensor(np.flatnonzero(moving))
        # Servos whose kp, whose kv is their gain
        gain, bias = m.actuator_gainprm[:, 0], m.actuator_biasprm
        self.tied = [servos(m) & (bias[:, k] == -gain) for k in (1, 2)]
        rows = constrained(scene, m.opt.timestep).pairs if hard else None
        self.touching = [scene.geom_pairs[k] for k in rows.geom_pairs] if rows else []  # of each block of two geoms
        self._read_bodies()
        self._read_actuators()
        self._read_contacts()
        self._read_rows()
        dofs, rough = np.arange(m.nv) >= self.first, np.zeros(m.ngeom, bool)
        rough[self.friction_geoms[self.has_friction]] = True
        self.free: dict[str, Mask] = dict.fromkeys(("mass", "com", "inertia"), moving)
        self.free |= {"friction": rough, "damping": dofs, "armature": dofs, "frictionloss": dofs & hard}
        self.free |= {"gain": motors(m) | servos(m), "kv": servos(m) & ~self.tied[1]}
        with torch.no_grad():
            self.count = len(self.columns(self.file))

    def _read_bodies(self) -> None:
        """Read the moving bodies' frames in their links and in the world, at the reference configuration."""
        scene, m, data, bodies = self.scene, self.m, at_rest(self.m), self.bodies.numpy()
        base = int(m.jnt_bodyid[0]) if scene.floating else 0
        turns, places = [data.xmat[base].reshape(3, 3)], [data.xpos[base]]
        for k in range(1, scene.nlink):
            parent = scene.parent[k]
            places.append(places[parent] + turns[parent] @ scene.position[k])
            turns.append(turns[parent] @ scene.rotation[k])
        self.link = torch.tensor(scene.body_link[bodies]).long()
        turn, place = (torch.tensor(np.array(values))[self.link] for values in (turns, places))
        self.world = torch.tensor(data.xmat[bodies].reshape(-1, 3, 3))
        self.turn = turn.mT @ self.world
        self.place = (turn.mT @ (torch.tensor(data.xpos[bodies]) - place)[:, :, None])[:, :, 0]
        axes, jacobian = np.zeros((len(bodies), 9)), np.zeros((len(bodies), 2, 3, m.nv))
        for k, body in enumerate(bodies.tolist()):
            mujoco.mju_quat2Mat(axes[k], m.body_iquat[body])
            mujoco.mj_jacBody(m, data, jacobian[k, 1], jacobian[k, 0], body)
        self.axes, self.jacobian = torch.tensor(axes).view(-1, 3, 3), torch.tensor(jacobian)
        # MuJoCo's inverse weights of degrees of freedom are means over the rotations and translations of a joint
        group = 2 * m.dof_jntid + (np.arange(m.nv) - m.jnt_dofadr[m.dof_jntid] >= 3)
        same = torch.tensor(group[:, None] == group).double()
        self.mean = same / same.sum(1, keepdim=True)

    def _read_actuators(self) -> None:
        m, (low, high) = self.m, control_range(self.m)
        self.motor_link = torch.tensor(self.scene.motor_link).long()
        axis = np.abs(m.actuator_gear[:, :3]).argmax(1) * (self.scene.ball[self.scene.motor_link] >= 0)
        gear = m.actuator_gear[np.arange(m.nu), axis]
        self.gear = torch.tensor(np.stack((gear * (high - low) / 2, gear * (high + low) / 2), 1))
        self.stiffness_of_gain, self.damping_of_gain = (torch.tensor(gear**2 * tied) for tied in self.tied)
        self.damping_of_kv = torch.tensor(gear**2 * (servos(m) & ~self.tied[1]))

    def _read_contacts(self) -> None:
        """Read the contacts with the ground, then those between bodies, in the kernels' order."""
        m, spheres = self.m, self.scene.spheres
        geoms = spheres.geom[np.argsort(spheres.link, kind="stable")].tolist() if self.hard else []
        ground = ground_pairs(m)[0][0] if geoms else 0
        touching = [*((ground, geom) for geom in geoms), *self.touching]
        pairs, has_friction = np.zeros((len(touching), 2), int), np.zeros(len(touching), bool)
        for k, (a, b) in enumerate(touching):
            declared = tuple(sorted((a, b))) in declared_pairs(m)  # with a friction of its own
            has_friction[k] = not declared and pair_law(m, a, b).condim > 1
            ahead = int(np.sign(m.geom_priority[b] - m.geom_priority[a]))
            pairs[k] = (a if ahead <= 0 else b), (b if ahead >= 0 else a)
        # The geoms whose larger friction a contact has
        self.friction_geoms, self.has_friction = torch.tensor(pairs), torch.tensor(has_friction)
        self.contact_body = torch.tensor(m.geom_bodyid[geoms]).long()

    def _read_rows(self) -> None:
        """Read which inverse weights the blocks of rows between bodies add up, in the kernels' order.

        They are those of degrees of freedom, then of the bodies' translations and of their rotations.
        """
        m, of_blocks = self.m, list[NDArray[Any]]()
        for k in np.flatnonzero(m.eq_active0).tolist():
            ends = np.array([m.eq_obj1id[k], m.eq_obj2id[k]])
            if m.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT:
                of_blocks.append(m.jnt_dofadr[ends[ends >= 0]])
                continue
            bodies = m.site_bodyid[ends] if m.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE else ends
            of_blocks.append(m.nv + bodies)
            if m.eq_type[k] == mujoco.mjtEq.mjEQ_WELD:
                of_blocks.append(m.nv + m.nbody + bodies)
        self.equalities = len(of_blocks)
        of_blocks += [m.nv + m.geom_bodyid[[a, b]] for a, b in self.touching]
        self.sums = torch.zeros(len(of_blocks), m.nv + 2 * m.nbody).double()
        for row, weights in zip(self.sums, of_blocks, strict=True):
            row[weights] = 1.0

    def _about(self, turn: Tensor, place: Tensor, values: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the bodies' centres of mass and moments of inertia in frames where they have these poses."""
        mass, com, moments = (values[name][self.bodies] for name in ("mass", "com", "inertia"))
        axes, at = turn @ self.axes, place + (turn @ com[:, :, None])[:, :, 0]
        around = torch.eye(3).to(at) * at.square().sum(1)[:, None, None] - at[:, :, None] * at[:, None, :]
        return at, axes @ torch.diag_embed(moments) @ axes.mT + mass[:, None, None] * around

    def columns(self, values: dict[str, Tensor]) -> Tensor:
        """Return the columns (count,) of the parameters, up to constants: only their derivatives are used."""
        nlink, mass, drive = self.scene.nlink, values["mass"][self.bodies, None], values["gain"]
        at, inertia = self._about(self.turn, self.place, values)
        ten = torch.cat((mass, mass * at, inertia[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]), 1)
        links = ten.new_zeros(nlink, LINK).index_add(0, self.link, ten)
        none = 0 * values["armature"], links[:0, :2], links[:0, :2]
        weight, ground, pairs = self._constraints(values) if self.hard else none
        of_dofs = torch.stack((values["armature"], values["damping"], values["frictionloss"], weight))[:, self.first :]
        servo = torch.stack(
            (self.stiffness_of_gain * drive, self.damping_of_gain * drive + self.damping_of_kv * values["kv"])
        )
        of_servos = ten.new_zeros(2, nlink).index_add(1, self.motor_link, servo)[:, 1:]
        joints = torch.nn.functional.pad(torch.cat((of_dofs, of_servos)), (1, 0)).mT
        motors = self.gear * drive[:, None]
        groups = {"links": links, "joints": joints, "motors": motors, "ground": ground, "pairs": pairs}
        return torch.cat([groups[name].flatten() for name in Columns._fields if name != "end"])

    def _constraints(self, values: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the logarithms of MuJoCo's inverse weights of degrees of freedom, and the columns of contacts with the
        ground and of rows between bodies."""
        mass, (turning, moving) = values["mass"][self.bodies, None, None], self.jacobian.unbind(1)
        at, inertia = self._about(self.world, torch.zeros_like(self.place), values)
        moving = moving + torch.linalg.cross(turning, at[:, :, None].expand_as(turning), dim=1)  # of centres of mass
        inertia = inertia - mass * (at.square().sum(1)[:, None, None] * torch.eye(3) - at[:, :, None] * at[:, None, :])
        matrix = (turning.mT @ inertia @ turning + mass * (moving.mT @ moving)).sum(0) + values["armature"].diag()
        inverse = torch.linalg.inv(matrix)
        of_dofs, fixed = self.mean @ inverse.diagonal(), torch.zeros(self.m.nbody).to(at)
        of_bodies = [
            fixed.index_put((self.bodies,), (jacobian @ inverse * jacobian).sum((1, 2)) / 3)
            for jacobian in (moving, turning)
        ]
        of_rows = self.sums @ torch.cat((of_dofs, *of_bodies))
        weights = torch.cat((of_bodies[0][self.contact_body], of_rows)).clamp(min=LEAST_WEIGHT)
        rough = values["friction"][self.friction_geoms].amax(1).clamp(min=LEAST_FRICTION) * self.has_friction
        ground, between = rough.split((len(self.contact_body), len(self.touching)))
        friction = torch.cat((ground, ground.new_zeros(self.equalities), between))
        columns = torch.stack((friction, weights.log()), 1).split((len(self.contact_body), len(self.sums)))
        return of_dofs.log(), *columns

    def model(self, values: dict[str, Tensor]) -> mujoco.MjModel:
        """Return a copy of the file's model with these parameters."""
        m = copy.copy(self.m)
        arrays = {name: value.detach().numpy() for name, value in values.items()}
        arrays["kv"] = np.where(self.free["kv"], -arrays["kv"], m.actuator_biasprm[:, 2])
        for name, (field, place) in FIELDS.items():
            getattr(m, field)[place] = arrays[name]
        for k, tied in enumerate(self.tied, 1):
            m.actuator_biasprm[tied, k] = -arrays["gain"][tied]
        moved = np.flatnonzero((m.body_ipos != self.m.body_ipos).any(1))  # such frames are no longer the body's
        m.body_sameframe[moved] = 0
        m.geom_sameframe[np.isin(m.geom_bodyid, moved)] = m.site_sameframe[np.isin(m.site_bodyid, moved)] = 0
        mujoco.mj_setConst(m, mujoco.MjData(m))
        return m

    def adjustable(self, name: str) -> Tensor:
        """Return the mask `free` in the parameter's shape; raises ValueError for an unknown name."""
        if name not in FIELDS:
            raise ValueError(f"unknown parameter {name!r}; choose from {', '.join(FIELDS)}")
        return torch.tensor(self.free[name]).view(-1, *[1] * (self.file[name].ndim - 1)).expand_as(self.file[name])

    def check(self, name: str, value: Tensor) -> Tensor:
        """Return a parameter in float64 on the CPU; raises ValueError, with what is allowed."""
        free, file = self.adjustable(name), self.file[name]
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        if shape != tuple(file.shape):
            raise ValueError(f"{name} is {shape}, must be a torch.Tensor of {tuple(file.shape)}")
        result = value.to("cpu", torch.float64)
        found = result.detach()
        rules = {"be finite": found.isfinite(), "stay the file's value": free | (found == file)}
        if name in ("mass", "inertia"):
            rules["be positive"] = (found > 0) | (file == 0)
        elif name != "com":
            rules["not be negative"] = found >= 0
        for rule, kept in rules.items():
            if not bool(kept.all()):
                place = tuple((~kept).nonzero()[0].tolist())
                raise ValueError(f"{name}[{', '.join(map(str, place))}] is {found[place].item()}, must {rule}")
        simple = torch.tensor(self.m.body_simple != 0)[:, None]
        if name == "com" and bool((fixed := simple & (found != file)).any()):
            which = label(self.m, mujoco.mjtObj.mjOBJ_BODY, int(fixed.nonzero()[0, 0]))
            raise ValueError(
                f'com of body {which} is its origin to MuJoCo, which simplifies: write <body simple="false">'
            )
        if name == "inertia" and bool((wrong := 2 * found.amax(1) > (1 + 1e-6) * found.sum(1)).any()):
            body = int(wrong.nonzero()[0])
            raise ValueError(f"inertia[{body}] is {found[body].tolist()}: a moment exceeds the sum of the two others")
        return result.where(free, file)


class ParametricSimulator(Simulator):
    """A Simulator whose steps are differentiable in the robot's constants, which are the same in all environments.

    `parameters` is the dictionary to fit: it starts with the file's values, in float64 on the CPU. Assign tensors that
    require gradients, take steps and call backward. `adjustable(name)` and `elements(name)` say which of its rows may
    change and whose they are.

    Example:
        from diffsim.parameters import ParametricSimulator
        scene = diffsim.load_scene("robot.xml")
        sim = ParametricSimulator(scene, 4, diffsim.Integration("mujoco", 8), horizon=1, dtype=torch.float64)
        mass = sim.parameters["mass"].requires_grad_()                     # (nbody,) kg
        sim.parameters = {"mass": mass}
        qpos, qvel = torch.tensor(scene.qpos0).repeat(4, 1), torch.zeros(4, scene.nv).double()
        sim.step(qpos, qvel, torch.zeros(4, scene.nu).double())[1].sum().backward()
        print(mass.grad)

    Args:
        scene: without fluid, gravity compensation, tendons and actuators at sites.
        num_envs: number of copies N of the robot.
        integration: contact model and substeps.
        *args: control_dt [s] and horizon of Simulator.
        **options: those of Simulator without factors, forces and division.

    Raises:
        SceneError: the robot has fluid, gravity compensation, tendons or actuators at sites.
        ValueError: another argument out of range, with what is allowed.
    """

    def __init__(
        self, scene: Scene, num_envs: int, integration: Integration = Integration(), *args: Any, **options: Any
    ) -> None:
        if taken := {"factors", "forces", "division"} & options.keys():
            raise ValueError(f"a ParametricSimulator has no option {', '.join(sorted(taken))}")
        if found := [what for feature, what in UNSUPPORTED.items() if feature in scene.features]:
            raise SceneError(f"{scene.name}: parameters are not supported with {', '.join(found)}")
        self._robot = _Robot(scene, hard=integration.contact == "mujoco")
        scene = dataclasses.replace(scene, parameters=self._robot.count)
        super().__init__(scene, num_envs, integration, *args, division=(1, 1), **options)
        self.parameters = {}

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Return copies of the parameters by name, in float64 on the CPU: those assigned, else the file's.

        They are MuJoCo's body_mass, body_ipos (com), body_inertia, geom_friction[:, 0], dof_damping, dof_armature,
        dof_frictionloss, actuator_gainprm[:, 0] (gain) and -actuator_biasprm[:, 2] (kv). The gain of a position servo
        is also its kp. Assign a dictionary with some of them at the start of a rollout: a simulator's or its rewind().

        Raises:
            ValueError: an unknown name, another shape, or a number that no robot can have.
            RuntimeError: after a differentiable step of the rollout.
        """
        return {name: value.detach().clone() for name, value in (self._robot.file | self._given).items()}

    @parameters.setter
    def parameters(self, values: Mapping[str, Tensor]) -> None:
        if self._window.used:
            raise RuntimeError("parameters cannot change within a rollout: call rewind() before")
        given = {name: self._robot.check(name, value) for name, value in values.items()}
        new, scene, launcher = load_scene(self._robot.model(self._robot.file | given)), self.scene, self._launcher
        scene = dataclasses.replace(scene, mj_model=new.mj_model, **{name: getattr(new, name) for name in OF_SCENE})
        scene = self._with_contact(scene, self.integration)
        if changed := scene.features ^ launcher.spec.features:
            raise ValueError(
                f"parameters: {', '.join(sorted(changed))} must be zero everywhere if and only if it is so in the "
                "file, because the kernels contain only what the file uses"
            )
        launcher.rewrite(scene, OF_MODEL)
        self._window.forget()  # earlier steps have no adjoint any more
        row = self._robot.columns(self._robot.file | given).to(self.device, self.dtype)
        self._given, self._factors = given, row.expand(self.num_envs, -1)

    def adjustable(self, name: str) -> Tensor:
        """Mark the elements of a parameter that may differ from the file's: those that the motion depends on."""
        return self._robot.adjustable(name).clone()

    def elements(self, name: str) -> list[str]:
        """Return the names of the bodies, geoms, actuators or joints that the rows of a parameter belong to."""
        m, kind = self._robot.m, FIELDS[name][0].split("_")[0].replace("dof", "joint")
        rows = m.dof_jntid.tolist() if kind == "joint" else range(len(self._robot.file[name]))
        return [label(m, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), k).replace("'", "") for k in rows]

    def jacobian(self, outputs: Tensor, x: Tensor) -> Tensor:
        """Compute derivatives (N, k, n) of each environment's outputs (N, k) in x (n,), by k backward passes.

        The parameters in use are a function of x. The outputs depend on them by the steps of this rollout alone.
        """
        rows = [torch.autograd.grad(y.sum(), self._factors, retain_graph=True)[0] for y in outputs.unbind(1)]
        row, each = self._factors[0], torch.eye(self._robot.count).to(self._factors)
        (of_columns,) = torch.autograd.grad(row, x, each, retain_graph=True, is_grads_batched=True)
        return torch.stack(rows, dim=1) @ of_columns.to(row)

    def mj_model(self) -> mujoco.MjModel:
        """Return a copy of the file's model with the parameters."""
        return self._robot.model(self.parameters)

    def _check_given(self, name: str, value: Tensor, *size: int) -> Tensor:
        """Leave out the check of factors, in whose place the columns are."""
        return value if name == "factors" else super()._check_given(name, value, *size)
