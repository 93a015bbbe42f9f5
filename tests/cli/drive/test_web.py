"""The page draws in a browser what MuJoCo's kinematics say, and needs nothing from elsewhere."""

from __future__ import annotations

import base64
import json
import re
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from diffsim.robot.mjcf import load_scene
from diffsim.tasks.base import ASSETS
from diffsim_cli import render
from diffsim_cli.drive import web
from diffsim_robots import terrain

TETRA = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]) / 4
MESHES = f"""<mujoco>
  <asset>
    <mesh name="tetra" vertex="{" ".join(map(str, TETRA.ravel()))}"/>
  </asset>
  <worldbody>
    <body pos="0 0 2"><freejoint/>
      <camera mode="trackcom" pos="0 -4 1" xyaxes="1 0 0 0 1 4"/>
      <geom type="mesh" mesh="tetra" pos="0.1 0.2 0.3" euler="0 0 90" rgba="0.9 0.2 0.1 1"/>
      <geom type="mesh" mesh="tetra" pos="0 0 -1"/>
      <geom type="mesh" mesh="tetra" group="3"/>
    </body>
  </worldbody>
</mujoco>"""


def numbers(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


HOSTILE = '</title><script>fail("$motion")</script>'


@pytest.mark.parametrize("task", ["cartpole", "humanoid", "humanoid_mtu"])
def test_the_page_has_all_shapes_and_nothing_from_elsewhere(task):
    scene = load_scene(ASSETS / f"{task}.xml")
    text = web.fill_page(web.describe(scene, 1 / 60), HOSTILE, "return $title")
    assert "http" not in text and "import(" not in text and "src=" not in text
    assert "<title>&lt;/title&gt;&lt;script&gt;fail(&quot;$motion&quot;)&lt;/script&gt;</title>" in text
    assert "<span>return $title</span>" in text and text.count("<script") == 2
    found = re.search(r'id="motion">(.*?)</script>', text, re.DOTALL)
    assert found
    motion, model = json.loads(found[1]), scene.mj_model
    assert motion["dt"] == 1 / 60 and motion["ground"] == [[0, 0], [1, 0]]
    assert len(motion["geoms"]) == model.ngeom - 1  # all but the floor
    assert {geom["type"] for geom in motion["geoms"]} <= {"sphere", "capsule", "ellipsoid", "cylinder", "box"}
    assert len(motion["muscles"]) == (152 if task == "humanoid_mtu" else 0)


@pytest.mark.parametrize("task", ["cartpole", "humanoid_mtu"])
def test_a_picture_has_the_poses_of_mujoco(task, rng):
    scene = load_scene(ASSETS / f"{task}.xml")
    model, qpos, ctrl = scene.mj_model, scene.qpos0 + rng.normal(scale=0.1, size=scene.nq), rng.uniform(-1, 1, scene.nu)
    places, track = web.poses(model, qpos, scene.qpos0)
    picture, data = web.encode(model, places, track, ctrl), mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    poses = numbers(picture["poses"], "<f4").reshape(2, model.nbody, 7)
    np.testing.assert_allclose(poses[0, :, :3], data.xpos, atol=1e-5)
    np.testing.assert_allclose(poses[0, :, 3:], data.xquat, atol=1e-6)
    np.testing.assert_allclose(numbers(picture["track"], "<f4"), data.subtree_com[model.cam_bodyid[0]], atol=1e-5)
    muscles = 152 if task == "humanoid_mtu" else 0
    activation = numbers(picture["activation"], "u1") / 255
    np.testing.assert_allclose(activation, (ctrl[:muscles] + 1) / 2, atol=0.002)


def test_muscles_pass_where_mujoco_has_them(rng):
    scene = load_scene(ASSETS / "humanoid_mtu.xml")
    motion, model = web.describe(scene, 1 / 60), scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = scene.qpos0 + rng.normal(scale=0.1, size=scene.nq)
    mujoco.mj_forward(model, data)
    for tendon, muscle in enumerate(motion["muscles"]):
        path = [data.xpos[b] + data.xmat[b].reshape(3, 3) @ p for b, *p in muscle["points"]]
        first = data.ten_wrapadr.ravel()[tendon]
        expected = data.wrap_xpos.reshape(-1, 3)[first : first + len(path)]
        np.testing.assert_allclose(path, expected, atol=2e-5)


def test_the_orbit_is_the_camera_of_the_file():
    for task in ("ant", "hopper", "humanoid"):
        model = load_scene(ASSETS / f"{task}.xml").mj_model
        orbit, data = render.orbit(model), mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        yaw, pitch, distance = (orbit[name] for name in ("yaw", "pitch", "distance"))
        back = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
        eye = data.subtree_com[model.cam_bodyid[0]] + orbit["aim"] + distance * back
        np.testing.assert_allclose(eye, data.cam_xpos[0], atol=1e-4)
        np.testing.assert_allclose(back, data.cam_xmat[0].reshape(3, 3)[:, 2], atol=1e-6)


def test_a_ghost_has_bodies_of_its_own() -> None:
    scene = load_scene(ASSETS / "ant.xml")
    plain, both = web.describe(scene, 0.1), web.describe(scene, 0.1, ghost=True)
    bodies, own = scene.nbody, len(plain["geoms"])
    assert (both["robot"], both["bodies"]) == (bodies, 2 * bodies) and both["geoms"][:own] == plain["geoms"]
    others = both["geoms"][own:]
    assert [geom["body"] - bodies for geom in others] == [geom["body"] for geom in plain["geoms"] if geom["body"]]
    assert all(0 < geom["rgba"][3] < 1 for geom in others)


def scene_of(model: mujoco.MjModel, *profiles: np.ndarray) -> Any:
    return SimpleNamespace(mj_model=model, terrain=profiles or None, path="")


def test_meshes_lie_where_the_file_has_them():
    """MuJoCo moves a mesh's frame to its centre of mass; the file's numbers are the ones of before."""
    motion = web.describe(scene_of(mujoco.MjModel.from_xml_string(MESHES)), 0.1)
    red, grey = motion["geoms"]
    assert [geom["type"] for geom in motion["geoms"]] == 2 * ["mesh"] and motion["ground"] is None
    assert red["mesh"] == grey["mesh"] and len(motion["meshes"]) == 1
    turned = TETRA @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x to y
    for geom, expected in ((red, turned + (0.1, 0.2, 0.3)), (grey, TETRA - (0, 0, 1))):
        mesh = motion["meshes"][geom["mesh"]]
        vertices, faces = (numbers(mesh[n], kind).reshape(-1, 3) for n, kind in (("vertices", "<f4"), ("faces", "<u4")))
        mujoco.mju_quat2Mat(rotation := np.empty(9), np.array(geom["quat"]))
        found = geom["pos"] + vertices @ rotation.reshape(3, 3).T
        assert sorted(found.round(3).tolist()) == sorted(expected.round(3).tolist())
        a, b, c = (found[faces[:, k]] for k in range(3))
        outward = np.cross(b - a, c - a)
        assert len(faces) == 4 and ((outward * (a - expected.mean(0))).sum(1) > 0).all()


PICTURE = """<script>
class EventSource { constructor() { setTimeout(() => this.onmessage({ data: JSON.stringify(PICTURE) })); } }
</script>"""
TOUCH = """<script>
setTimeout(() => {
  const canvas = document.querySelector("canvas");
  canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 100, cancelable: true }));
  canvas.dispatchEvent(new PointerEvent("pointermove", { buttons: 1, movementX: 50, movementY: 20 }));
  canvas.dispatchEvent(new MouseEvent("dblclick"));
  requestAnimationFrame(() => { document.documentElement.dataset.touched = "yes"; });
}, 200);
</script></body>"""


@pytest.mark.slow
@pytest.mark.parametrize("task", ["ant", "humanoid_mtu", "meshes on hills"])
def test_a_browser_draws_the_page(task, browser, tmp_path):
    from PIL import Image

    if task in ("ant", "humanoid_mtu"):
        scene: Any = load_scene(ASSETS / f"{task}.xml")
    else:
        hills = terrain.rough(1)
        scene = scene_of(mujoco.MjModel.from_xml_string(MESHES), hills)
    model = scene.mj_model
    picture = web.encode(model, *web.poses(model, model.qpos0), np.ones(model.nu))
    text = web.fill_page(web.describe(scene, 1 / 60), HOSTILE, HOSTILE).replace("</body>", TOUCH)
    path = tmp_path / "page.html"
    path.write_text(text.replace("<body>", "<body>" + PICTURE.replace("PICTURE", json.dumps(picture))))
    page = browser.open(path.as_uri())
    page.call("Emulation.setDeviceMetricsOverride", width=480, height=400, deviceScaleFactor=1, mobile=False)
    page.wait("typeof page === 'object' && (page.touched && page.drawn || page.error)")
    assert page.evaluate("[page.error ?? '', document.title]") == ["", HOSTILE]
    if "hills" in task:
        heights = page.evaluate("[-99, 1.5, 2, 7.3, 49, 999].map(x => height(below(x), x))")
        np.testing.assert_allclose(heights, np.interp([-99, 1.5, 2, 7.3, 49, 999], *hills.T), atol=1e-4)
    page.screenshot(tmp_path / "shot.png")
    own = {path.as_uri(), path.with_name("ask").as_uri()}  # which drive's server answers
    assert {url for url in page.requests() if not url.startswith("data:")} == own
    shot = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB")).astype(int)[:340]
    reddish = shot[..., 0] - shot[..., 2] > 60  # the ant, muscles at work, or a mesh
    assert 0.002 < reddish.mean() < 0.5
    sky, ground = shot[2, 240], shot[330].mean(0)
    assert sky.min() > 200 and (ground < sky - 5).all()
