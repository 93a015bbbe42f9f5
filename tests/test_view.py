"""view.py: the page draws in a browser what MuJoCo's kinematics say, pushes are impulses, mistakes are one line."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import diffsim
import view
from diffsim.robot.mjcf import load_scene
from diffsim.training import load_policy
from diffsim.view import render, web

ASSETS = Path(diffsim.__file__).parent / "assets"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["view.py"])


def motion_of(task: str, steps: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Arguments of write_page: configurations and activations at random."""
    env = diffsim.make(task, 1)
    qpos = env.qpos.numpy() + rng.normal(scale=0.1, size=(steps, env.scene.nq))
    return env.scene, qpos, env.control_dt, rng.uniform(-1, 1, size=(steps, env.scene.nu))


def data_of(page: Path) -> dict[str, Any]:
    found = re.search(r'id="motion">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found
    return json.loads(found[1])


def numbers(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


# The page -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["cartpole", "humanoid", "humanoid_mtu"])
def test_the_page_holds_the_motion_and_nothing_from_elsewhere(
    task: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    scene, qpos, dt, ctrl = motion_of(task, 600, rng)
    page = web.write_page(tmp_path / "new" / "page.html", scene, qpos, dt, ctrl, title="a <b> & c", caption="return 1")
    text = page.read_text()
    assert page.stat().st_size < 1e6 and "http" not in text and "import(" not in text and "src=" not in text
    assert "<title>a &lt;b&gt; &amp; c</title>" in text
    motion, model = data_of(page), scene.mj_model
    poses = numbers(motion["poses"], "<f4").reshape(motion["frames"], model.nbody, 7)
    data, step = mujoco.MjData(model), 14
    assert motion["frames"] == 600 and motion["dt"] == dt and motion["floor"] == 0
    data.qpos[:] = qpos[step]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(poses[step, :, :3], data.xpos, atol=1e-5)
    np.testing.assert_allclose(poses[step, :, 3:], data.xquat, atol=1e-6)
    assert len(motion["geoms"]) == model.ngeom - 1  # all but the floor
    assert {geom["type"] for geom in motion["geoms"]} <= {"sphere", "capsule", "ellipsoid", "cylinder", "box"}
    muscles = len(motion["muscles"])
    assert muscles == (152 if task == "humanoid_mtu" else 0)
    activation = numbers(motion["activation"], "u1").reshape(600, muscles) / 255
    np.testing.assert_allclose(activation, (ctrl[:, :muscles] + 1) / 2, atol=0.002)


def test_muscles_pass_where_mujoco_has_them(rng: np.random.Generator) -> None:
    scene, qpos, dt, _ = motion_of("humanoid_mtu", 1, rng)
    motion, model = web.describe(scene, qpos, dt), scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    mujoco.mj_forward(model, data)
    for tendon, muscle in enumerate(motion["muscles"]):
        path = [data.xpos[b] + data.xmat[b].reshape(3, 3) @ p for b, *p in muscle["points"]]
        first = data.ten_wrapadr.ravel()[tendon]
        expected = data.wrap_xpos.reshape(-1, 3)[first : first + len(path)]
        np.testing.assert_allclose(path, expected, atol=2e-5)


def test_the_orbit_is_the_camera_of_the_file() -> None:
    for task in ("ant", "hopper", "humanoid"):
        model = load_scene(ASSETS / f"{task}.xml").mj_model
        orbit, data = web.orbit(model), mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        yaw, pitch, distance = (orbit[name] for name in ("yaw", "pitch", "distance"))
        back = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
        eye = data.subtree_com[model.cam_bodyid[0]] + orbit["aim"] + distance * back
        np.testing.assert_allclose(eye, data.cam_xpos[0], atol=1e-4)
        np.testing.assert_allclose(back, data.cam_xmat[0].reshape(3, 3)[:, 2], atol=1e-6)


def test_a_long_motion_keeps_fewer_frames() -> None:
    scene = load_scene(ASSETS / "humanoid.xml")
    motion = web.describe(scene, np.zeros((4000, scene.nq)), 1 / 60)
    assert 1000 < motion["frames"] < 4000 and motion["frames"] * motion["dt"] == pytest.approx(4000 / 60, abs=0.1)


TOUCH = """<script>
const key = name => dispatchEvent(new KeyboardEvent("keydown", { key: name, cancelable: true }));
setTimeout(() => {
  for (const name of [" ", "ArrowRight", "ArrowLeft", "ArrowUp", "ArrowDown", "q"]) key(name);
  const canvas = document.querySelector("canvas");
  canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 100, cancelable: true }));
  canvas.dispatchEvent(new PointerEvent("pointermove", { buttons: 1, movementX: 50, movementY: 20 }));
  canvas.dispatchEvent(new MouseEvent("dblclick"));
  document.querySelector("#play").click();
  requestAnimationFrame(() => { document.documentElement.dataset.touched = "yes"; });
}, 200);
</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("task", ["ant", "humanoid_mtu"])
def test_a_browser_draws_the_page(task: str, tmp_path: Path, rng: np.random.Generator) -> None:
    from PIL import Image

    page = web.write_page(tmp_path / "page.html", *motion_of(task, 120, rng), title=task)
    page.write_text(page.read_text().replace("</body>", TOUCH))
    quiet = "quic background-networking component-update sync".split()
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--no-first-run"]
    flags += [f"--disable-{name}" for name in quiet]
    flags += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=480,400", "--virtual-time-budget=1000"]
    command = [str(CHROMIUM), *flags, f"--screenshot={tmp_path / 'shot.png'}", "--dump-dom", page.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    opening = re.search(r"<html[^>]*>", result.stdout)
    assert opening and "data-error" not in opening[0], result.stderr
    assert 'data-drawn="' in opening[0] and "data-touched" in opening[0]
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB")).astype(int)[:340]
    reddish = picture[..., 0] - picture[..., 2] > 60  # the ant, or muscles at work
    assert 0.002 < reddish.mean() < 0.5
    sky, ground = picture[2, 240], picture[330].mean(0)
    assert sky.min() > 200 and (ground < sky - 5).all()


# The window -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> view.Window:
    monkeypatch.setattr(render, "check_display", lambda: False)
    env = diffsim.make("ant", 1)
    return view.Window(env, torch.nn.Linear(env.task.obs_dim, env.scene.nu), seed=1)


@torch.no_grad()
def test_a_push_gives_the_whole_robot_its_speed(window: view.Window) -> None:
    env, mouse = window.env, mujoco.MjvPerturb()
    window.copy_state()

    def momentum() -> np.ndarray:
        window.copy_state()
        mujoco.mj_subtreeVel(window.model, window.data)
        return window.data.subtree_linvel[view.ROBOT].copy()

    before, qpos = momentum(), env.qpos.clone()
    window.push([], mouse)
    np.testing.assert_array_equal(momentum(), before)
    window.push([(1, 0, 0), (0, -1, 0)], mouse)
    np.testing.assert_allclose(momentum() - before, [view.PUSH, -view.PUSH, 0], atol=1e-4)
    assert torch.equal(env.qpos, qpos)
    torch.testing.assert_close(window.obs, env.task.observe(env.qpos, env.qvel, window.action))


@torch.no_grad()
def test_the_mouse_pulls_towards_its_place_with_bounded_force(window: view.Window) -> None:
    window.copy_state()
    model, data, scene = window.model, window.data, mujoco.MjvScene(window.model, 100)
    mouse, everything, changes = mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_ALL, []
    mouse.select, mouse.active = view.ROBOT, int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
    for distance in (0.1, 100.0):
        window.copy_state()
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), mouse, mujoco.MjvCamera(), everything, scene)
        mujoco.mjv_initPerturb(model, data, scene, mouse)
        mouse.refselpos[1] += distance
        before = window.env.qvel[0, 1].item()
        window.push([], mouse)
        changes.append(window.env.qvel[0, 1].item() - before)
    assert 0 < changes[0] < changes[1]
    heaviest = 9.81 * view.MAX_PULL * window.env.control_dt  # what the robot would gain if it were rigid
    assert heaviest < changes[1] < 3 * heaviest


@torch.no_grad()
def test_keys_do_what_the_help_says(window: view.Window) -> None:
    start = window.env.qpos.clone()
    window.keys.extend([262, 265, 999])
    assert window.heed_keys() == [(1, 0, 0), (0, 1, 0)] and not window.keys
    window.keys.append(view.SPACE)
    window.heed_keys()
    assert window.paused
    window.keys.extend([view.SPACE, *[view.MINUS] * 9])
    window.heed_keys()
    assert not window.paused and window.speed == view.SPEEDS[0]
    window.keys.extend([view.EQUALS] * 9)
    window.heed_keys()
    assert window.speed == view.SPEEDS[-1]
    window.step()
    assert window.data.time == pytest.approx(window.env.control_dt) and (window.data.qpos != start.numpy()[0]).any()
    window.keys.append(view.ENTER)
    window.heed_keys()
    assert window.env.episode_step.item() == 0


def test_the_window_simulates_until_it_is_closed(window: view.Window, monkeypatch: pytest.MonkeyPatch) -> None:
    class Lock:
        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

    class Handle(SimpleNamespace):
        frames = 3

        def is_running(self) -> bool:
            return self.frames > 0

        def sync(self) -> None:
            self.frames -= 1

        def __enter__(self) -> Handle:
            return self

        def __exit__(self, *_: object) -> None: ...

    handle = Handle(cam=mujoco.MjvCamera(), perturb=mujoco.MjvPerturb(), lock=Lock)
    launch = SimpleNamespace(launch_passive=lambda *_, **__: handle)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", launch)
    monkeypatch.setattr(mujoco, "viewer", launch, raising=False)
    window.run()
    assert window.env.episode_step.item() == 3 and handle.cam.trackbodyid == view.ROBOT


# The command ----------------------------------------------------------------------------------------------------------


def test_video_page_and_curves_of_a_run(tiny_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        render.check_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))
    outputs = [tmp_path / name for name in ("a.mp4", "a.html", "a.png")]
    options = ["--seconds", "0.5", "--episodes", "3", "--size", "64", "48", "--substeps", "2"]
    flags = [word for pair in zip(("--video", "--web", "--plot"), map(str, outputs), strict=True) for word in pair]
    view.main([str(tiny_run / "checkpoint.pt"), *flags, *options])
    assert all(path.stat().st_size > 1000 for path in outputs)
    assert data_of(outputs[1])["frames"] == 30
    printed = capsys.readouterr().out
    assert "cartpole, shac.py, iteration 2, 3 episodes: return median" in printed
    assert all(str(path) in printed for path in outputs)


def test_substeps_are_those_of_the_training_unless_given(tiny_run: Path) -> None:
    from diffsim.training import make_policy_env

    saved = load_policy(tiny_run / "checkpoint.pt")
    assert make_policy_env(saved, 1).sim.integration.substeps == saved.args["substeps"]
    assert make_policy_env(saved, 1, substeps=7).sim.integration.substeps == 7


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("{run}", "nothing to show: give --video, --web, --viewer or --plot"),
        ("--web {new}/a.html", "of what? give a checkpoint or the directory of a run"),
        ("{new}/nothing.pt --web {new}/a.html", "no such checkpoint: {new}/nothing.pt"),
        ("{run}/progress.csv --web {new}/a.html", "{run}/progress.csv is not a whole checkpoint"),
        ("{run} --web {new}/a.htm", "--web: a page ends in .html, not '.htm'"),
        ("{run} --video {new}/a.avi", "--video: a video ends in .mp4 or .gif, not '.avi'"),
        ("{run} --video {new}/a.mp4 --size 100 100", "--video: width and height of an .mp4 are multiples of 16"),
        ("{run} --web {new}/a.html --seconds 0", "--seconds, --episodes, --substeps and --size must be positive"),
        ("{run} {run} --web {new}/a.html", "--video, --web and --viewer show one checkpoint; several are for --plot"),
        ("{run} --viewer --web {new}/a.html", "--viewer goes without --video and --web"),
        ("{run} --web {run}/progress.csv/a.html", "File exists"),
        ("{new} --plot {new}/a.png", "no such file: {new}/progress.csv; --plot takes directories of runs"),
        ("{run} --plot {new}/a.xyz", "xyz"),
        ("{run} --viewer", "--viewer: display :77 does not answer; --web and --video need none"),
    ],
)
def test_mistakes_are_one_line(
    arguments: str,
    message: str,
    tiny_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    places = {"run": tiny_run, "new": tmp_path}
    with pytest.raises(SystemExit) as exit:
        view.main(arguments.format(**places).split())
    error = capsys.readouterr().err
    assert exit.value.code == 2 and error.startswith("view.py: ") and error.count("\n") == 1
    assert message.format(**places) in error
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_missing_matplotlib_is_one_line(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit):
        view.main([str(tiny_run), "--plot", str(tmp_path / "a.png")])
    assert capsys.readouterr().err == "view.py: --plot needs matplotlib: pip install matplotlib\n"


def test_curves_of_several_runs(tiny_run: Path, tmp_path: Path) -> None:
    empty = tmp_path / "gaps"
    empty.mkdir()
    (empty / "progress.csv").write_text("iteration,control_steps,seconds,return,eval_return\n1,10,0.5,,\n2,20,1,3,4\n")
    columns = view.read_progress(empty / "progress.csv")
    np.testing.assert_array_equal(columns["return"], [np.nan, 3])
    view.main([str(tiny_run), str(empty), "--plot", str(tmp_path / "new" / "a.svg")])
    text = (tmp_path / "new" / "a.svg").read_text()
    assert "<svg" in text
