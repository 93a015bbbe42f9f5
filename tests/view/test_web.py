"""The page draws in a browser what MuJoCo's kinematics say, and needs nothing from elsewhere."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import diffsim
from diffsim.robot.mjcf import load_scene
from diffsim.view import render, web

ASSETS = Path(diffsim.__file__).parent / "assets"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def motion_of(task: str, steps: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Arguments of write_page: configurations and activations at random."""
    scene = load_scene(ASSETS / f"{task}.xml")
    qpos = scene.qpos0 + rng.normal(scale=0.1, size=(steps, scene.nq))
    return scene, qpos, 1 / 60, rng.uniform(-1, 1, size=(steps, scene.nu))


def data_of(page: Path) -> dict[str, Any]:
    found = re.search(r'id="motion">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found
    return json.loads(found[1])


def numbers(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


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
        orbit, data = render.orbit(model), mujoco.MjData(model)
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
