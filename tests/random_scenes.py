"""Random MJCF of nearly all that is simulated. A structure has one set of compiled kernels, whatever its numbers."""

from __future__ import annotations

import random
from collections.abc import Sequence

SHAPES, DRAWN = ("sphere", "capsule", "box"), ("sphere", "capsule", "box", "cylinder", "ellipsoid")
SERVOS = "motor", "position", "damped position", "velocity", "general"


def words(*values: float) -> str:
    return " ".join(f"{value:.6g}" for value in values)


class RandomScene:
    """Draws a structure, and numbers for it; `text` is the MJCF.

    Attributes:
        structure, numbers: what draws them. The structure decides which elements and attributes are there.
    """

    def __init__(self, structure: int, numbers: int = 0) -> None:
        self.structure, self.numbers = random.Random(structure), random.Random(1000 * structure + numbers)
        self.bodies, self.geoms, self.sites = list[str](), list[str](), list[str]()  # geoms that may touch
        self.joints = list[tuple[str, str]]()  # names and types
        one_of, often, between = self.structure.choice, self.often, self.numbers.uniform
        self.implicit, self.lossy, self.positive = often(0.67), often(0.3), often(0.7)
        ground, free = often(0.55), often(0.6)
        world = self.ground() * ground + self.obstacle() * often(0.2)
        for tree in range(one_of([1, 1, 1, 2, 2, 3])):
            root = one_of(["free", "free", "joint"]) if free or tree else one_of(["free", "joint", "fixed"])
            joints = one_of([0, 0, 1, 2, 3] if tree else [1, 2, 3, 4, 6, 8, 11])
            self.left = joints if root == "free" else max(joints, 1)
            world += self.body(root, words(between(-0.1, 0.1) + 0.22 * tree, between(-0.1, 0.1), between(0.1, 0.4)), 0)
        contact, equality = self.contact(), self.equality()
        tendons, actuators = self.drives()
        self.text = f"""<mujoco>
  <compiler {one_of(["", 'autolimits="true"', 'eulerseq="zyx"', 'inertiafromgeom="true"', 'balanceinertia="true"'])}/>
  {self.option()}
  <default>
    <geom {one_of(["", 'density="700"', f'solref="{words(between(0.01, 0.03), 1)}"', 'condim="3" friction="0.8"'])}/>
    <joint {one_of(["", 'damping="0.1"', 'armature="0.01"'])}/>
  </default>
  <worldbody>{world}</worldbody> <contact>{contact}</contact> <equality>{equality}</equality>
  <tendon>{tendons}</tendon> <actuator>{actuators}</actuator>
</mujoco>"""

    # Draws -----------------------------------------------------------------------------------------------------------

    def often(self, part: float) -> bool:
        return self.structure.random() < part

    def maybe(self, part: float, text: str) -> str:
        return f" {text}" if self.often(part) else ""

    def some(self, low: float, high: float, count: int = 1) -> str:
        return words(*(self.numbers.uniform(low, high) for _ in range(count)))

    def vector(self, size: float = 1.0) -> str:
        return self.some(-size, size, 3)

    def quaternion(self) -> str:
        """Of another length than 1."""
        length = self.numbers.uniform(0.3, 3)
        return words(*(length * self.numbers.gauss(0, 1) for _ in range(4)))

    def solref(self) -> str:
        if self.positive:
            return f"{self.some(0.01, 0.05)} {self.some(0.6, 1.3)}"
        return f"{self.some(-5000, -500)} {self.some(-100, -10)}"

    def solimp(self) -> str:
        ends = f"{self.some(0.7, 0.92)} {self.some(0.93, 0.98)} {self.some(0.0005, 0.01)} {self.some(0.3, 0.7)}"
        return f"{ends} {self.numbers.choice([1, 2, 3])}"

    # Elements --------------------------------------------------------------------------------------------------------

    def option(self) -> str:
        one_of, maybe = self.structure.choice, self.maybe
        flags = maybe(0.15, 'eulerdamp="disable"') + maybe(0.15, 'filterparent="disable"')
        flags += maybe(0.1, 'refsafe="disable"')
        gravity = "0 0 -9.81" if self.often(0.7) else self.vector(9)
        impratio = self.some(0.5, 8) if self.often(0.25) else "1"
        fluid = not self.implicit and self.often(0.15)
        more = f'density="{self.some(1, 50)}" viscosity="{self.some(0, 0.2)}"' * fluid
        solver = 'tolerance="1e-15" ls_tolerance="1e-12" iterations="500" ls_iterations="100"'
        return (
            f'<option timestep="{one_of([0.001, 0.002, 0.003, 0.005])}" cone="{one_of(["pyramidal", "elliptic"])}" '
            f'integrator="{"implicitfast" if self.implicit else "Euler"}" gravity="{gravity}" impratio="{impratio}" '
            f"{solver} {more}><flag{flags}/></option>"
        )

    def ground(self) -> str:
        law = self.structure.choice(["", f'friction="{self.some(0.3, 1.2)}"', 'condim="1"'])
        height = self.structure.choice(["0", self.some(-0.5, 0.5)])
        return f'<geom name="floor" type="plane" size="0 0 1" pos="0 0 {height}" {law}/>'

    def obstacle(self) -> str:
        place = f'pos="{self.some(-0.1, 0.1, 2)} {self.some(0, 0.1)}" euler="{self.vector(40)}"'
        return f'<geom type="{self.structure.choice(SHAPES)}" size="{self.some(0.05, 0.2, 3)}" {place}/>'

    def geom(self) -> str:
        one_of, maybe, some, r = self.structure.choice, self.maybe, self.some, 0.05
        touches, name = self.often(0.75), f"g{len(self.geoms)}"
        kind = one_of(SHAPES if touches else DRAWN)
        text = f'type="{kind}" size="{some(0.4 * r, r, 3)}"'
        if kind == "capsule" and self.often(0.4):
            text = f'type="capsule" size="{some(0.3 * r, 0.7 * r)}" fromto="{self.vector(r)} {self.vector(r)}"'
        else:
            text += f' pos="{self.vector(r)}"' + maybe(0.7, f'quat="{self.quaternion()}"')
        text += one_of([f' mass="{some(0.05, 2)}"', f' density="{some(300, 3000)}"', ""])
        if not touches:
            return f'<geom {text} contype="0" conaffinity="0"/>'
        self.geoms.append(name)
        text += maybe(0.3, f'friction="{some(0.1, 1.5)}"') + maybe(0.2, f'margin="{some(0, 0.01)}"')
        text += maybe(0.1, f'gap="{some(0, 0.005)}"') + maybe(0.25, f'solref="{self.solref()}"')
        text += maybe(0.25, f'solimp="{self.solimp()}"') + maybe(0.15, f'priority="{one_of([1, 2])}"')
        text += maybe(0.15, f'solmix="{some(0.1, 3)}"') + maybe(0.25, 'condim="1"')
        text += maybe(0.1, one_of(['contype="2" conaffinity="2"', 'contype="3" conaffinity="1"']))
        return f'<geom name="{name}" {text}/>'

    def joint(self, kinds: Sequence[str]) -> str:
        kind, name, maybe, some = self.structure.choice(kinds), f"j{len(self.joints)}", self.maybe, self.some
        self.joints.append((name, kind))
        text = f'name="{name}" type="{kind}"' + maybe(0.7, f'pos="{self.vector(0.05)}"')
        if kind != "ball":
            size, ref = 57.0 if kind == "hinge" else 0.2, 0.0
            text += f' axis="{self.vector()}"'
            if self.often(0.25):
                ref = self.numbers.uniform(-0.5, 0.5) * size
                text += f' ref="{ref:.6g}"'
            if self.often(0.4):
                low, high = (self.numbers.uniform(0.02, 1) * size for _ in range(2))
                text += f' range="{words(ref - low, ref + high)}"' + maybe(0.3, f'margin="{some(0, 0.05)}"')
                text += maybe(0.3, f'solreflimit="{self.solref()}"') + maybe(0.3, f'solimplimit="{self.solimp()}"')
            text += maybe(0.3, f'springref="{some(-size, size)}"')
            text += maybe(0.05, f'actuatorfrcrange="{some(-5, -0.5)} {some(0.5, 5)}"')
        text += maybe(0.4, f'stiffness="{some(0.1, 20)}"') + maybe(0.5, f'damping="{some(0.01, 2)}"')
        text += maybe(0.4, f'armature="{some(0.001, 0.1)}"')
        if self.lossy and self.often(0.5):
            text += f' frictionloss="{some(0.01, 2)}"' + maybe(0.3, f'solreffriction="{self.solref()}"')
        return f"<joint {text}/>"

    def free_joint(self) -> str:
        more = f'armature="{self.some(0.001, 0.2)}" damping="{self.some(0.01, 1)}"'
        return self.structure.choice(["<freejoint/>"] * 3 + [f'<joint type="free" {more}/>'])

    def inertial(self) -> str:
        text = f'pos="{self.vector(0.03)}" mass="{self.some(0.1, 3)}"'
        if self.often(0.5):
            return f'<inertial {text} fullinertia="{self.some(0.01, 0.02, 3)} {self.some(-0.003, 0.003, 3)}"/>'
        return f'<inertial {text} diaginertia="{self.some(0.01, 0.02, 3)}" quat="{self.quaternion()}"/>'

    def body(self, root: str, place: str, depth: int) -> str:
        one_of, often, name = self.structure.choice, self.often, f"b{len(self.bodies)}"
        self.bodies.append(name)
        text = self.free_joint() if root == "free" else ""
        if root == "joint":
            number = one_of([1, 1, 1, 2, 3]) if self.left > 2 else 1
            kinds = ("hinge", "hinge", "hinge", "slide", "ball") if number == 1 else ("hinge", "slide")
            text += "".join(self.joint(kinds) for _ in range(number))
            self.left -= number
        text += "".join(self.geom() for _ in range(one_of([1, 1, 2])))
        text += self.inertial() if often(0.15) else ""
        if often(0.6):
            self.sites.append(f"s{len(self.sites)}")
            text += f'<site name="{self.sites[-1]}" pos="{self.vector(0.1)}" quat="{self.quaternion()}"/>'
        for _ in range(one_of([1, 1, 2, 2, 3]) if depth < 6 else 0):
            if self.left > 0:
                at = words(*(self.numbers.choice([-1, 1]) * self.numbers.uniform(0.08, 0.2) for _ in range(3)))
                welded = not often(0.9)
                text += self.body("welded" if welded else "joint", at, depth + 1)
        more = one_of(["", f'quat="{self.quaternion()}"', 'euler="10 50 -20"'])
        more += self.maybe(0.06, f'gravcomp="{self.some(0.2, 1.5)}"')
        return f'<body name="{name}" pos="{place}" {more}>{text}</body>'

    def contact(self) -> str:
        text, sample = "", self.structure.sample
        if len(self.bodies) > 2 and self.often(0.3):
            a, b = sample(self.bodies, 2)
            text += f'<exclude body1="{a}" body2="{b}"/>'
        if len(self.geoms) > 2 and self.often(0.25):
            (a, b), friction = sample(self.geoms, 2), self.some(0.2, 1)
            law = f'condim="{self.structure.choice([1, 3])}" friction="{friction} {friction}"'
            law += f' margin="{self.some(0, 0.02)}"' + self.maybe(0.5, f'solref="{self.solref()}"')
            text += f'<pair geom1="{a}" geom2="{b}" {law}/>'
        return text

    def equality(self) -> str:
        text, one_of, sample = "", self.structure.choice, self.structure.sample
        scalar = [name for name, kind in self.joints if kind != "ball"]
        for _ in range(one_of([1, 1, 2, 3]) if self.often(0.5) else 0):
            kind, ends = one_of(["joint", "connect", "weld", "connect sites", "weld sites"]), ""
            law = self.maybe(0.4, f'solref="{self.solref()}"') + self.maybe(0.3, f'solimp="{self.solimp()}"')
            if kind == "joint" and scalar:
                chosen = sample(scalar, 2) if len(scalar) > 1 and self.often(0.7) else scalar[:1]
                ends = " ".join(f'joint{k}="{name}"' for k, name in enumerate(chosen, 1))
                coefs = f"{self.some(-0.2, 0.2)} {self.some(-1, 1)} {self.some(-0.3, 0.3)} {self.some(-0.1, 0.1, 2)}"
                ends += f' polycoef="{coefs}"'
            elif kind in ("connect", "weld"):
                chosen = sample(self.bodies, 1 if self.often(0.25) else min(2, len(self.bodies)))
                ends = " ".join(f'body{k}="{name}"' for k, name in enumerate(chosen, 1))
                if kind == "connect" or self.often(0.4):
                    ends += f' anchor="{self.vector(0.1)}"'
                if kind == "weld":
                    ends += self.maybe(0.5, f'torquescale="{self.some(0.3, 2)}"')
                    ends += self.maybe(0.4, f'relpose="{self.vector(0.2)} {self.quaternion()}"')
            elif kind.endswith("sites") and len(self.sites) > 1:
                a, b = sample(self.sites, 2)
                ends = f'site1="{a}" site2="{b}"'
            text += f"<{kind.split()[0]} {ends}{law}/>" if ends else ""
        return text

    def drives(self) -> tuple[str, str]:
        """Fixed tendons, and actuators on joints, tendons and at sites."""
        scalar, tendons, actuators = [name for name, kind in self.joints if kind != "ball"], "", ""
        one_of, often, some = self.structure.choice, self.often, self.some
        names = [f"t{k}" for k in range(one_of([1, 2]) if len(scalar) > 1 and often(0.3) else 0)]
        for name in names:
            joints = self.structure.sample(scalar, one_of(range(1, 1 + min(3, len(scalar)))))
            parts = "".join(f'<joint joint="{joint}" coef="{some(-1, 1)}"/>' for joint in joints)
            tendons += f'<fixed name="{name}">{parts}</fixed>'
        for name, kind in self.joints:
            if often(0.5):
                what = "motor" if kind == "ball" else one_of(SERVOS)
                gear = some(-3, 3) if often(0.5) else "1"
                if kind == "ball":
                    gear = one_of([f"{some(-2, 2)} 0 0", f"0 {some(0.1, 2)} 0", f"0 0 {some(0.1, 2)}"])
                limit = self.maybe(0.25, f'forcerange="{some(-3, -0.3)} {some(0.3, 3)}"') * (kind != "ball")
                actuators += self.actuator(what, f'joint="{name}" gear="{gear}"{limit}')
        for name in names:
            if often(0.8):
                what = one_of(["motor", "position", "damped position", "velocity"])
                actuators += self.actuator(what, f'tendon="{name}" gear="{some(0.3, 2)}"')
        for name in self.sites:
            if often(0.2):
                actuators += self.actuator("motor", f'site="{name}" gear="{self.vector()} {self.vector()}"')
        return tendons, actuators

    def actuator(self, kind: str, where: str) -> str:
        one_of, some = self.structure.choice, self.some
        limits = f'ctrlrange="{some(-2, -0.5)} {some(0.5, 2)}"', f'ctrlrange="{some(0.1, 0.5)} {some(0.6, 2)}"', ""
        law = {
            "position": f'kp="{some(1, 30)}"',
            "damped position": f'kp="{some(1, 30)}" '
            + one_of([f'kv="{some(0.05, 2)}"', *[f'dampratio="{some(0.1, 1.5)}"'] * ("joint" in where)]),
            "velocity": f'kv="{some(0.05, 2)}"',
            "general": f'biastype="affine" gainprm="{some(1, 9)}" biasprm="{some(-3, 3)} {some(-9, 0)} {some(-1, 0)}"',
        }.get(kind, "")
        return f"<{kind.split()[-1]} {where} {law} {one_of(limits)}/>"
