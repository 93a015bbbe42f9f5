"""Drive a robot from a browser: its policy acts in this simulator, live, as keys, gamepads and the mouse command.

Python's own web server shows the page of view/web.py. Each picture comes to it as an event of a stream, and what its
user asks for goes back as a POST. Several pages show one robot, which follows the latest command.
"""

from __future__ import annotations

import functools
import ipaddress
import json
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
import torch
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.robot.types import Array
from diffsim.tasks import Task
from diffsim.tasks.locomotion import Locomotion
from diffsim_cli.drive import web
from diffsim_robots.imitation.tracking import Tracking
from diffsim_robots.joystick import Joystick

KEYS = {
    Joystick: "arrows or gamepad: walk, turn · Q, E: sideways · ",
    Locomotion: "left, right or gamepad: turn · ",
    Task: "",
}
ALWAYS = "shift + drag: pull · enter: restart"
TURN = 0.3  # rad/s by which a key turns the way of a robot that otherwise runs straight on; at 1 rad/s the ant falls
STIFFNESS, MAX_PULL = 20.0, 19.62  # N/kg per m of the mouse's pull, and N/kg: twice the weight
SILENCE = 10.0  # s after which a page that takes no more pictures is given up
LONGEST = 1000  # bytes of what a page asks for


class Wish(NamedTuple):
    """A wish of a page's user."""

    move: tuple[float, ...] = (0.0, 0.0, 0.0)  # forward, left, turn to the left, each in [-1, 1] of the most
    pull: tuple[float, ...] = ()  # a body's number, and the point (3,) to which it is pulled, if any
    restart: bool = False  # a new episode


def parse(said: dict[str, Any], bodies: int) -> Wish:
    """Raises ValueError, TypeError, OverflowError or KeyError if it is no wish."""
    wish = Wish(tuple(map(float, said["move"])), tuple(map(float, said["pull"] or ())), said["restart"] is True)
    if len(wish.move) != 3 or not all(map(math.isfinite, (*wish.move, *wish.pull))):
        raise ValueError("a move has three finite numbers")
    if wish.pull and (len(wish.pull) != 4 or wish.pull[0] not in range(1, bodies)):
        raise ValueError("a pull has a body and a point")
    return wish


class Pilot:
    """A policy that acts on one environment, made with forces, as it is commanded.

    A policy of Joystick gets the command that it was trained for. One of Locomotion, which runs along x, gets the state
    as it looks from a frame that a command turns. One of Tracking plays its clip again and again.
    """

    def __init__(self, env: DiffEnv, policy: Callable[[Tensor], Tensor]) -> None:
        self.env, self._policy = env, policy
        env.episode_length = 2**62  # until the robot falls
        if isinstance(env.task, Tracking):
            env.stochastic_init, env.episode_length = False, int(env.task.motions[1][0])
        self._mass, self._places = float(env.scene.mj_model.body_mass.sum()), np.zeros((env.scene.nbody, 3))
        self.restart()

    def restart(self) -> None:
        self.env.reset()
        self._heading, self._action = 0.0, torch.zeros(1, self.env.scene.nu)

    @torch.no_grad()
    def step(self, wish: Wish) -> dict[str, str]:
        """A control step; the picture of it, see web.encode."""
        env = self.env
        env.sim.forces = torch.as_tensor(self._forces(wish), dtype=env.dtype)[None]
        action = self._action = self._policy(self._see(np.clip(wish.move, -1.0, 1.0))).clamp(-1.0, 1.0)
        _, _, terminated, truncated, _ = env.step(action)
        states = env.qpos, env.task.ghost(env.memory)
        shown = [state[0].double().numpy() for state in states if state is not None]
        poses, track = web.poses(env.scene.mj_model, *shown)
        self._places = poses[0, :, :3]
        if bool(terminated | truncated):
            self._heading, self._action = 0.0, torch.zeros_like(self._action)
        return web.encode(env.scene.mj_model, poses, track, action[0].numpy())

    def _see(self, move: Array) -> Tensor:
        env, task = self.env, self.env.task
        if isinstance(task, Joystick):
            command = torch.as_tensor(move * task.robot.command, dtype=env.dtype)[None]
            env.memory = torch.cat((command, env.memory[:, 3:]), dim=1)
        if not isinstance(task, Locomotion):
            return env.observe(env.qpos, env.qvel, self._action)
        self._heading += TURN * float(move[2]) * env.control_dt
        qpos = env.qpos if task.ground is None else task.ground.lower(env.qpos)
        return task.observe(*turned(-self._heading, qpos, env.qvel), self._action)

    def _forces(self, wish: Wish) -> Array:
        """(nbody, 6) of a pull, as Simulator.forces has them."""
        forces = np.zeros((self.env.scene.nbody, 6))
        if wish.pull:
            body, *point = wish.pull
            way = point - self._places[int(body)]
            strength = min(STIFFNESS, MAX_PULL / max(float(np.linalg.norm(way)), 1e-9))
            forces[int(body), :3] = self._mass * strength * way
        return forces


def turned(angle: float, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
    """A state of a robot with a free root, turned about the world's z axis by an angle [rad]."""
    c, s, a, b = math.cos(angle), math.sin(angle), math.cos(angle / 2), math.sin(angle / 2)
    plane = torch.tensor([[c, s], [-s, c]], dtype=qpos.dtype)
    w, x, y, z = qpos[:, 3:7].unbind(1)
    quat = torch.stack((a * w - b * z, a * x - b * y, a * y + b * x, a * z + b * w), dim=1)
    return (
        torch.cat((qpos[:, :2] @ plane, qpos[:, 2:3], quat, qpos[:, 7:]), dim=1),
        torch.cat((qvel[:, :2] @ plane, qvel[:, 2:]), dim=1),
    )


class Stage:
    """State that pages and simulation share: the number of pages, the latest wish and the latest picture."""

    def __init__(self) -> None:
        self.changed, self.pages, self.wish, self.restart = threading.Condition(), 0, Wish(), False
        self._picture, self._number = "", 0

    def ask(self, wish: Wish) -> None:
        with self.changed:
            self.wish, self.restart = wish, self.restart or wish.restart

    def show(self, picture: dict[str, str]) -> None:
        with self.changed:
            self._picture, self._number = json.dumps(picture), self._number + 1
            self.changed.notify_all()

    def watch(self) -> Generator[str, None, None]:
        """Each picture, except those that come while a page is busy with another. One that leaves wishes no more."""
        with self.changed:
            self.pages, seen = self.pages + 1, self._number
            self.changed.notify_all()
        try:
            while True:
                with self.changed:
                    while self._number == seen:
                        self.changed.wait()
                    seen, picture = self._number, self._picture
                yield picture
        finally:
            with self.changed:
                self.pages, self.wish = self.pages - 1, Wish()


def is_here(host: str, own: str) -> bool:
    """Tell whether a request's Host is an address, or a name of this machine: others could lead any web page here."""
    with suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        return name in ("localhost", own.lower(), socket.gethostname().lower()) or bool(ipaddress.ip_address(name))
    return False


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], OSError):  # of a page that is closed
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    timeout = SILENCE

    def __init__(self, stage: Stage, page: bytes, bodies: int, host: str, *connection: Any) -> None:
        self._stage, self._page, self._bodies, self._host = stage, page, bodies, host
        super().__init__(*connection)

    def parse_request(self) -> bool:
        """Only this machine's own page may ask: other pages name their origin, or lead their own name here."""
        if not super().parse_request():
            return False
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if not is_here(host, self._host):
            self.send_error(403, "take the address that drive has printed, or start it with --host and your name")
        elif origin and origin.partition("://")[2] != host:
            self.send_error(403, "only the page itself may ask")
        else:
            return True
        return False

    def do_GET(self) -> None:
        if self.path == "/":
            self._answer("text/html; charset=utf-8", self._page)
        elif self.path == "/stream":
            self._answer("text/event-stream")
            with closing(self._stage.watch()) as pictures:
                for picture in pictures:
                    self.wfile.write(f"data: {picture}\n\n".encode())
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        try:
            length = int(self.headers["Content-Length"])
            wish = parse(json.loads(self.rfile.read(length if 0 <= length <= LONGEST else 0)), self._bodies)
        except (KeyError, OverflowError, RecursionError, TypeError, ValueError):
            return self.send_error(400)
        self._stage.ask(wish)
        self._answer("text/plain")

    def _answer(self, kind: str, content: bytes = b"") -> None:
        self.send_response(200)
        for header, value in (("Content-Type", kind), ("Cache-Control", "no-store")):
            self.send_header(header, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        pass


def serve(env: DiffEnv, policy: Callable[[Tensor], Tensor], caption: str, host: str, port: int) -> None:
    """Show a page where a robot can be driven, until Ctrl-C. While no page is open, the robot waits.

    Raises:
        OSError: nothing can listen at host and port, in one line.
    """
    stage, scene, name, due = Stage(), env.scene, env.task.name, 0.0
    motion = web.describe(scene, env.control_dt, env.task.ghost(env.memory) is not None)
    motion["live"] = next(text for kind, text in KEYS.items() if isinstance(env.task, kind)) + ALWAYS
    page = web.fill_page(motion, name, caption).encode()
    handler = functools.partial(Handler, stage, page, scene.nbody, host)
    with Server((host, port), handler, bind_and_activate=False) as server, suppress(KeyboardInterrupt):
        try:
            server.server_bind()
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise OSError(f"cannot listen on {host}:{port}: {why}; choose another --host or --port") from error
        pilot = Pilot(env, policy)
        pilot.step(Wish())  # compiles; a visitor before would only wait
        server.server_activate()
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(f"http://{host}:{server.server_port} drives {name}; Ctrl-C ends it", flush=True)
        while True:  # pictures, each at its time
            with stage.changed:
                while not stage.pages:
                    stage.changed.wait()
                wish, restart, stage.restart = stage.wish, stage.restart, False
            if restart:
                pilot.restart()
            stage.show(pilot.step(wish))
            now = time.perf_counter()
            due = max(due + env.control_dt, now - 0.1)  # late: go on from here
            time.sleep(max(0.0, due - now))
