"""The page draws in a browser what MuJoCo's kinematics say, and needs nothing from elsewhere."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import diffsim
from diffsim import terrain
from diffsim.robot.mjcf import load_scene
from diffsim.view import render, web

ASSETS = Path(diffsim.__file__).parent / "assets"
TETRA = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]) / 4
MESHES = f"""<mujoco>
  <asset>
    <mesh name="tetra" vertex="{" ".join(map(str, TETRA.ravel()))}"/>
    <hfield name="hills" nrow="3" ncol="4" size="2 1 0.5 0.1" elevation="0 0 0 0 0 1 0.5 0 0 0 0 0"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="hills" pos="0 5 0"/>
    <body pos="0 0 2"><freejoint/>
      <camera mode="trackcom" pos="0 -4 1" xyaxes="1 0 0 0 1 4"/>
      <geom type="mesh" mesh="tetra" pos="0.1 0.2 0.3" euler="0 0 90" rgba="0.9 0.2 0.1 1"/>
      <geom type="mesh" mesh="tetra" pos="0 0 -1"/>
      <geom type="mesh" mesh="tetra" group="3"/>
    </body>
  </worldbody>
</mujoco>"""


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


HOSTILE = '</title><script>fail("$motion")</script>'


@pytest.mark.parametrize("task", ["cartpole", "humanoid", "humanoid_mtu"])
def test_the_page_holds_the_motion_and_nothing_from_elsewhere(task, tmp_path, rng):
    scene, qpos, dt, ctrl = motion_of(task, 600, rng)
    page = web.write_page(tmp_path / "new" / "page.html", scene, qpos, dt, ctrl, title=HOSTILE, caption="return $title")
    text = page.read_text()
    assert page.stat().st_size < 1e6 and "http" not in text and "import(" not in text and "src=" not in text
    assert "<title>&lt;/title&gt;&lt;script&gt;fail(&quot;$motion&quot;)&lt;/script&gt;</title>" in text
    assert "<span>return $title</span>" in text and text.count("<script") == 2
    motion, model = data_of(page), scene.mj_model
    poses = numbers(motion["poses"], "<f4").reshape(motion["frames"], model.nbody, 7)
    data, step = mujoco.MjData(model), 14
    assert motion["frames"] == 600 and motion["dt"] == dt and motion["ground"] == [[0, 0], [1, 0]]
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


def test_muscles_pass_where_mujoco_has_them(rng):
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


def test_a_long_motion_keeps_fewer_frames():
    scene = load_scene(ASSETS / "humanoid.xml")
    motion = web.describe(scene, np.zeros((4000, scene.nq)), 1 / 60)
    assert 1000 < motion["frames"] < 4000 and motion["frames"] * motion["dt"] == pytest.approx(4000 / 60, abs=0.1)


def test_a_ghost_has_bodies_of_its_own() -> None:
    scene = load_scene(ASSETS / "ant.xml")
    qpos, ghost = np.tile(scene.mj_model.qpos0, (3, 1)), np.tile(scene.mj_model.qpos0, (5, 1))
    ghost[:, 0] += 2.0
    plain, both = web.describe(scene, qpos, 0.1), web.describe(scene, qpos, 0.1, None, ghost)
    bodies, own = scene.nbody, len(plain["geoms"])
    assert (both["robot"], both["bodies"], both["frames"]) == (bodies, 2 * bodies, 3)
    assert both["geoms"][:own] == plain["geoms"] and both["track"] == plain["track"]
    others = both["geoms"][own:]
    assert [geom["body"] - bodies for geom in others] == [geom["body"] for geom in plain["geoms"] if geom["body"]]
    assert all(0 < geom["rgba"][3] < 1 for geom in others)
    poses = numbers(both["poses"], "<f4").reshape(3, 2 * bodies, 7)
    np.testing.assert_array_equal(poses[:, :bodies], numbers(plain["poses"], "<f4").reshape(3, bodies, 7))
    np.testing.assert_allclose(poses[:, bodies + 1 :, 0], poses[:, 1:bodies, 0] + 2.0, atol=1e-6)


def motion_of_model(model: mujoco.MjModel, *profiles: np.ndarray, qpos: Any = None) -> dict[str, Any]:
    scene: Any = SimpleNamespace(mj_model=model, terrain=profiles or None)
    return web.describe(scene, [model.qpos0 if qpos is None else qpos], 0.1)


def mesh_of(motion: dict[str, Any], number: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3)."""
    mesh = motion["meshes"][number]
    places, faces = (numbers(mesh[name], "<u2").reshape(-1, 3) for name in ("vertices", "faces"))
    return mesh["origin"] + mesh["step"] * places, faces


def test_meshes_and_height_fields_lie_where_the_file_has_them():
    """MuJoCo moves a mesh's frame to its centre of mass; the file's numbers are the ones of before."""
    model = mujoco.MjModel.from_xml_string(MESHES)
    motion = motion_of_model(model)
    hills, red, grey = motion["geoms"]
    assert [geom["type"] for geom in motion["geoms"]] == 3 * ["mesh"] and motion["ground"] is None
    assert hills["mesh"] != red["mesh"] == grey["mesh"] and len(motion["meshes"]) == 2
    turned = TETRA @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x to y
    for geom, expected in ((red, turned + (0.1, 0.2, 0.3)), (grey, TETRA - (0, 0, 1))):
        vertices, faces = mesh_of(motion, geom["mesh"])
        mujoco.mju_quat2Mat(rotation := np.empty(9), np.array(geom["quat"]))
        found = geom["pos"] + vertices @ rotation.reshape(3, 3).T
        assert sorted(found.round(3).tolist()) == sorted(expected.round(3).tolist())
        a, b, c = (found[faces[:, k]] for k in range(3))
        outward = np.cross(b - a, c - a)
        assert len(faces) == 4 and ((outward * (a - expected.mean(0))).sum(1) > 0).all()
    vertices, faces = mesh_of(motion, hills["mesh"])
    heights = {(round(x, 2), round(y, 2)): round(z, 3) for x, y, z in vertices.tolist()}
    assert len(heights) == 12 and len(faces) == 12 and hills["pos"] == [0, 5, 0]
    assert {place: z for place, z in heights.items() if z} == {(-0.67, 0): 0.5, (0.67, 0): 0.25}
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2  # seen from above
    assert areas.min() > 0 and areas.sum() == pytest.approx(8, rel=1e-3)


def test_fine_meshes_keep_their_shape_and_a_page_its_size():
    polar, round_ = np.meshgrid(np.linspace(0, np.pi, 300), np.linspace(0, 2 * np.pi, 700), indexing="ij")
    ball = np.stack([np.sin(polar) * np.cos(round_), np.sin(polar) * np.sin(round_), np.cos(polar)], -1).reshape(-1, 3)
    corner = np.arange(len(ball)).reshape(300, 700)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    faces = np.stack([a, b, c, a, c, d], 1).reshape(-1, 3)
    meshes = web._meshes([(ball, faces), (0.1 * TETRA, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))])
    vertices, kept = mesh_of({"meshes": meshes}, 0)
    size = sum(len(mesh[name]) * 3 / 4 for mesh in meshes for name in ("vertices", "faces"))
    assert web.MESH_BYTES / 2 < size <= web.MESH_BYTES + 8 and len(kept) > 20_000
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.001
    a, b, c = (vertices[kept[:, k]] for k in range(3))
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * np.pi, rel=0.01)  # the volume: no holes
    assert len(mesh_of({"meshes": meshes}, 1)[1]) == 4


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


@pytest.mark.slow
@pytest.mark.parametrize("task", ["ant", "humanoid_mtu", "meshes on hills"])
def test_a_browser_draws_the_page(task, browser, tmp_path, rng):
    from PIL import Image

    if task in ("ant", "humanoid_mtu"):
        motion = motion_of(task, 120, rng)
    else:
        model, hills = mujoco.MjModel.from_xml_string(MESHES), terrain.rough(1)
        motion = SimpleNamespace(mj_model=model, terrain=[hills]), np.tile(model.qpos0, (120, 1)), 1 / 60
    path = web.write_page(tmp_path / "page.html", *motion, title=HOSTILE, caption=HOSTILE)
    path.write_text(path.read_text().replace("</body>", TOUCH))
    page = browser.open(path.as_uri())
    page.call("Emulation.setDeviceMetricsOverride", width=480, height=400, deviceScaleFactor=1, mobile=False)
    page.wait("typeof page === 'object' && (page.touched || page.error)")
    assert page.evaluate("[page.error ?? '', document.title]") == ["", HOSTILE]
    if "hills" in task:
        heights = page.evaluate("[-99, 1.5, 2, 7.3, 49, 999].map(x => height(below(x), x))")
        np.testing.assert_allclose(heights, np.interp([-99, 1.5, 2, 7.3, 49, 999], *hills.T), atol=1e-4)
    page.screenshot(tmp_path / "shot.png")
    assert {url for url in page.requests() if not url.startswith("data:")} == {path.as_uri()}
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB")).astype(int)[:340]
    reddish = picture[..., 0] - picture[..., 2] > 60  # the ant, muscles at work, or a mesh
    assert 0.002 < reddish.mean() < 0.5
    sky, ground = picture[2, 240], picture[330].mean(0)
    assert sky.min() > 200 and (ground < sky - 5).all()
