"""Driving: commands reach the policy, pages the robot, and nobody who leaves or talks nonsense disturbs the others."""

from __future__ import annotations

import base64
import functools
import http.client
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from learners import PATH, refusal

import diffsim
from diffsim.robot.mjcf import load_scene
from diffsim.tasks.ant import Ant
from diffsim.tasks.base import ASSETS
from diffsim.training import load_policy
from diffsim_cli import commands as command
from diffsim_cli.drive import serve as drive
from diffsim_cli.drive.serve import Handler, Pilot, Server, Stage, Wish
from diffsim_cli.watch import make_policy_env
from diffsim_robots.terrain import step, uneven

PAGE = b"<p>the page</p><script>act()</script>"


# The pages' side, without a simulation --------------------------------------------------------------------------------


@pytest.fixture
def stage():
    shared = Stage()
    with Server(("127.0.0.1", 0), functools.partial(Handler, shared, PAGE, 3, "robot.lan")) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield shared, server.server_port
        server.shutdown()


def connect(port: int) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/stream")
    return connection, connection.getresponse()


def wait(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def news(stream: http.client.HTTPResponse) -> str:
    line, blank = stream.readline(), stream.readline()
    assert line.startswith(b"data: ") and blank == b"\n"
    return line[6:-1].decode()


def ask(port: int, body: object, **headers: str) -> int:
    words = body if isinstance(body, str) else json.dumps(body)
    return request(
        port, "POST", "/ask", words, headers={name.replace("_", "-"): x for name, x in headers.items()}
    ).status


def request(port: int, *words: str, **more: Any) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request(*words, **more)
    return connection.getresponse()


def test_two_pages_see_all_and_the_latest_command_counts_until_a_page_leaves(stage, capfd):
    shared, port = stage
    (first, one), (_, two) = connect(port), connect(port)
    wait(lambda: shared.pages == 2)
    assert ask(port, {"move": [0, 0, -1], "pull": [2, 0, 0, 1], "restart": True}) == 200
    assert ask(port, {"move": [1, 0, 0], "pull": None, "restart": False}) == 200
    assert shared.wish == Wish((1, 0, 0)) and shared.restart
    shared.show({"poses": "x"})
    assert news(one) == news(two) == '{"poses": "x"}'
    one.close()
    first.close()

    def left() -> bool:  # the server finds out as it sends
        shared.show({"poses": "y" * 1000})
        return shared.pages == 1

    wait(left)
    assert shared.wish == Wish() and news(two).startswith('{"poses": "y')
    assert capfd.readouterr().err == ""


GOOD = {"move": [0, 0, 1], "pull": None, "restart": False}


@pytest.mark.parametrize(
    "said",
    [
        *("", "{", "[]", "null", "[" * 900, {"move": [0, 0, 1]}),
        *(GOOD | {"move": move} for move in ([0, 0], [0, 0, math.nan], ["a", 0, 0], None, [1e400, 0, 0])),
        *(GOOD | {"pull": pull} for pull in ([0, 1, 1, 1], [3, 1, 1, 1], [1.5, 1, 1, 1], [1, 1], [1, 1, 1, math.inf])),
    ],
)
def test_nonsense_changes_nothing(stage, said):
    shared, port = stage
    assert ask(port, said) == 400 and shared.wish == Wish() and not shared.restart


def test_only_the_page_itself_asks(stage):
    shared, port = stage
    own = f"127.0.0.1:{port}"
    for host, origin, status in (
        (own, f"http://{own}", 200),
        *(
            (f"{name}:{port}", f"http://{name}:{port}", 200)
            for name in ("localhost", "[::1]", "robot.lan", "ROBOT.lan")
        ),
        (own, "http://elsewhere.org", 403),
        (own, "null", 403),
        # A name of another page that its owner has led to this machine: DNS rebinding.
        *((f"{name}:{port}", f"http://{name}:{port}", 403) for name in ("elsewhere.org", "127.0.0.1.elsewhere.org")),
        *((name, f"http://{name}", 403) for name in ("", "[::1", "localhost.elsewhere.org", "127.0.0.1@elsewhere.org")),
    ):
        shared.ask(Wish())
        assert ask(port, GOOD, Host=host, Origin=origin) == status, (host, origin)
        assert shared.wish == (Wish((0, 0, 1)) if status == 200 else Wish())
        assert [request(port, "GET", path, headers={"Host": host}).status for path in ("/", "/no")] == (
            [403, 403] if status == 403 and host != own else [200, 404]
        )


@pytest.mark.parametrize("length", [-1, -(10**30), 1001, 10**9, "", "many"])
def test_a_length_that_is_none_is_not_waited_for(stage, length):
    """Content-Length: -1 was read without end."""
    assert ask(stage[1], GOOD, Content_Length=str(length)) == 400


# The robot's side -----------------------------------------------------------------------------------------------------


def test_a_turned_robot_looks_the_same_to_itself(rng):
    """What the ant's task observes does not depend on where its way leads, if state and way turn alike."""
    task = Ant(dtype=torch.float64)
    task._target = torch.tensor([1e12, 0.0], dtype=torch.float64)  # else the way turns a little as the robot moves
    scene = load_scene(ASSETS / "ant.xml")
    qpos, qvel = (torch.tensor(rng.normal(size=(5, n))) for n in (scene.nq, scene.nv))
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    there = drive.turned(0.7, qpos, qvel)
    speed = torch.linalg.vecdot(qvel[:, :2], torch.tensor([[math.cos(-0.7), math.sin(-0.7)]]).double())
    before, after = task.observe(qpos, qvel, qvel[:, 6:]), task.observe(*there, qvel[:, 6:])
    columns = [0, *range(11, 28)]  # height, joints and rates, up
    torch.testing.assert_close(before[:, columns], after[:, columns])
    torch.testing.assert_close(after[:, 5], speed)
    back = drive.turned(-0.7, *there)
    torch.testing.assert_close(back[0], qpos)
    torch.testing.assert_close(back[1], qvel)
    quarter, _ = drive.turned(math.pi / 2, torch.eye(1, 15, dtype=torch.float64) + torch.eye(15)[3:4], qvel[:1])
    torch.testing.assert_close(quarter[0, :2], torch.tensor([0.0, 1.0]).double())
    torch.testing.assert_close(quarter[0, 3:7], torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]).double())


def fly(pilot: Pilot, seconds: float, wish: Wish) -> np.ndarray:
    """Where the robot is after a time, x, y, and how much it has turned."""
    for _ in range(round(seconds / pilot.env.control_dt)):
        pilot.step(wish)
    w, x, y, z = pilot.env.qpos[0, 3:7].tolist()
    return np.array([*pilot.env.qpos[0, :2].tolist(), math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))])


@pytest.mark.slow
def test_each_command_moves_the_robot_its_way():
    saved = load_policy(command.shipped("go2"))
    with command.quick_kernels():
        pilot = Pilot(make_policy_env(saved, 1, forces=True), saved.network)
        for k, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)):
            pilot.restart()
            start = fly(pilot, 0.5, Wish())
            moved = fly(pilot, 1.5, Wish(tuple(sign * np.eye(3)[k]))) - start
            assert sign * moved[k] > (0.9, 0.5, 0.9)[k] and np.abs(np.delete(moved, k)).max() < 0.4, (k, sign, moved)
        pilot.restart()
        start = fly(pilot, 0.5, Wish())
        moved = fly(pilot, 0.2, Wish(pull=(1, *(start[:2] + (0, 3)), 0.3))) - start  # it soon falls, and begins anew
        assert moved[1] > 0.2, "pulled to the left"


@pytest.mark.unoptimized
def test_a_clip_is_played_from_its_beginning_beside_its_ghost_and_again_after_its_end() -> None:
    env = diffsim.make("g1_track:g1_jazz_walk", 1, forces=True)
    bodies, pilot = env.scene.nbody, Pilot(env, lambda obs: torch.zeros(len(obs), 29))
    assert env.memory[0, 0] == 0 and env.episode_length == int(env.task.motions[1])  # type: ignore[attr-defined]
    picture = pilot.step(Wish())
    poses = np.frombuffer(base64.b64decode(picture["poses"]), "<f4").reshape(2, bodies, 7)
    np.testing.assert_allclose(poses[0, 1:, :3], poses[1, 1:, :3], atol=0.05)
    np.testing.assert_allclose(poses[1, 1, :3], env.task.reference(env.memory)[0][0, :3], atol=1e-5)  # type: ignore[attr-defined]
    env.episode_step[:] = env.episode_length - 1
    pilot.step(Wish())
    assert env.memory[0, 0] == 0 and env.episode_step == 0


def test_a_turned_robot_on_terrain_has_its_height_over_it() -> None:
    env = diffsim.make("ant", 1, seed=1, terrain=step(0.3, -5.0), forces=True)
    pilot = Pilot(env, lambda obs: torch.zeros(1, 8))
    torch.testing.assert_close(pilot._see(np.zeros(3)), env.observe(env.qpos, env.qvel, torch.zeros(1, 8)))
    assert pilot._see(np.array([0.0, 0.0, 1.0]))[0, 0] == pytest.approx(float(env.qpos[0, 2]) - 0.3)


@pytest.mark.slow
def test_the_ant_turns_to_where_it_is_sent():
    saved, ends = load_policy(command.shipped("ant")), []
    with command.quick_kernels():
        pilot = Pilot(make_policy_env(saved, 1, forces=True), saved.network)
        for turn in (0.0, 1.0, -1.0):
            pilot.env.generator.manual_seed(1)
            pilot.restart()
            fly(pilot, 2.0, Wish())
            fly(pilot, 1.5, Wish((0, 0, turn)))
            ends.append(fly(pilot, 1.0, Wish())[:2])
    straight, left, right = ends
    assert min(x for x, _ in ends) > 15 and left[1] > straight[1] + 1 and right[1] < straight[1] - 1, ends


# The command ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("drive nothing", "unknown task 'nothing': choose from cartpole, hopper"),
        ("drive go1", "no policy for go1 is shipped; there are: "),
        ("drive go1 --checkpoint {go2}", "go2.pt is a checkpoint of go2, not of go1"),
        ("drive go1:rough=20 --checkpoint {go2}", "a policy that was trained on go2, not on go1:rough=20"),
        ("drive go2:rough=50", "'rough=50': the steepest slope must be above 0 and at most 45 degrees"),
        (
            "drive go2 --port {taken}",
            "cannot listen on 127.0.0.1:{taken}: Address already in use; choose another",
        ),
        ("drive go2 --port 70000", "cannot listen on 127.0.0.1:70000: "),
        ("drive go2 --host nowhere.invalid", "cannot listen on nowhere.invalid:8080: "),
    ],
)
def test_mistakes_are_one_line(arguments, message, stage, capsys):
    names = {"go2": str(command.shipped("go2")), "taken": stage[1]}
    assert message.format(**names) in refusal(lambda: command.main(arguments.format(**names).split()), capsys)


def test_visitors_are_accepted_when_the_kernels_stand(monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def visit(self: Pilot, wish: Wish) -> dict[str, str]:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), timeout=5)
        visits.append(wish)
        raise KeyboardInterrupt

    visits = list[Wish]()
    monkeypatch.setattr(Pilot, "step", visit)
    drive.serve(diffsim.make("cartpole", 1, forces=True), lambda obs: torch.zeros(1, 1), "", "127.0.0.1", port)
    assert len(visits) == 1


def test_options_of_the_task_and_of_the_training_count(tmp_path, monkeypatch):
    state, served = torch.load(command.shipped("go2"), weights_only=True), []
    torch.save(state | {"args": state["args"] | {"env": "go2:rough=10"}}, path := tmp_path / "checkpoint.pt")
    monkeypatch.setattr(drive, "serve", lambda env, *_: served.append(env.scene.terrain))
    for words in ("go2", "go2:rough=20", f"go2 --checkpoint {path}", f"go2:rough=20 --checkpoint {path}"):
        command.main(["drive", *words.split()])
    plane, *hills = served
    assert plane is None
    for terrain, slope in zip(hills, (20.0, 10.0, 20.0), strict=True):
        np.testing.assert_array_equal(terrain, uneven(slope, 1))


@pytest.mark.slow
def test_a_browser_drives(browser):
    words = [sys.executable, "-m", "diffsim", "drive", "go2", "--port", "0"]
    options = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | PATH)
    driven = subprocess.Popen(words, **options)
    try:
        assert driven.stdout and driven.stderr
        address = driven.stdout.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")
        page, other = browser.open(address), browser.open(address)
        for each in (page, other):
            each.wait("Number(page.drawn) > 2")
        start = page.evaluate("track[3]")
        page.key("ArrowUp", True)
        assert page.wait(f"track[3] > {start} + 0.5 && track[3]") < start + 5
        assert other.wait(f"track[3] > {start} + 0.5")
        other.key("ArrowDown", True)  # the latest command counts
        time.sleep(1)
        back = page.evaluate("track[3]")
        assert page.wait(f"track[3] < {back} - 0.3 && track[3]") < back
        other.close()  # with its key down
        time.sleep(1)
        rest = page.evaluate("track[3]")
        time.sleep(2)
        assert abs(page.evaluate("track[3]") - rest) < 0.3
        page.key("ArrowUp", False)
        page.mouse("Pressed", 400, 300, button="right", clickCount=1)
        page.mouse("Moved", 500, 100, button="right", buttons=2)
        page.wait("asked.includes('\"pull\":[')")
        assert page.evaluate("pull.to[2]") > 0.3
        page.mouse("Released", 500, 100, button="right", clickCount=1)
        page.wait("asked.includes('\"pull\":null')")
        page.key("Enter", True)
        page.wait(f"track[3] < {start} + 0.4")
        assert page.evaluate("page.error || ''") == ""
        assert {url.removeprefix(address) for url in page.requests()} <= {"/", "/stream", "/ask", "data:,"}
        driven.send_signal(signal.SIGINT)
        assert driven.wait(30) == 0
        page.wait("!byId('error').hidden")
        said = [line for line in driven.stderr.read().splitlines() if "compiling" not in line]
        assert said == []
    finally:
        driven.kill()
