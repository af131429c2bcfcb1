"""glTF with transfer in vertex attributes: valid, readable by others, and relit by three.js as by jaxprt."""

import dataclasses
import functools
import http.server
import json
import os
import pathlib
import shutil
import struct
import subprocess
import threading

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from jaxprt import view
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin
from jaxprt.sphere import cubemap, harmonics

EXAMPLE = pathlib.Path(__file__).parents[2] / "examples/three_prt.html"
DEGREE, SIZE = 3, 16
VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((report) => {
  console.log(JSON.stringify(report.issues));
});
"""
# Renders into floats: linear radiance, and alpha where there is a surface.
RENDER = """async ({ eye, target, angle, edge }) => {
  const { THREE, renderer, scene, camera } = window;
  renderer.setAnimationLoop(null);
  scene.background = null;
  renderer.setClearColor(0, 0);
  const buffer = new THREE.WebGLRenderTarget(edge, edge, { type: THREE.FloatType });
  const seen = new THREE.PerspectiveCamera(angle, 1, 0.1, 100);
  seen.position.set(...eye);
  seen.lookAt(...target);
  renderer.setRenderTarget(buffer);
  renderer.render(scene, seen);
  const data = new Float32Array(4 * edge * edge);
  renderer.readRenderTargetPixels(buffer, 0, 0, edge, edge, data);
  return Array.from(data);
}"""


@pytest.fixture(scope="module")
def light():
    """A colored light of harmonics up to degree 3."""
    coefficient = np.random.default_rng(3).normal(size=((DEGREE + 1) ** 2, 3)) / 3
    coefficient[0] = [3.0, 2.5, 2.0]
    value = harmonics.evaluate(cubemap.direction(size=SIZE), degree=DEGREE) @ jnp.asarray(coefficient, jnp.float32)
    return Environment(value)


@pytest.fixture(scope="module")
def relit():
    """A textured and a plain matte ball over a matte ground, all of which shadow each other."""
    ball = builtin.sphere(rings=12, sectors=24)
    coordinate = np.asarray(ball.position)[:, :2] / 2 + 0.5
    painted = dataclasses.replace(ball, texture=coordinate)
    beside = eqx.tree_at(lambda mesh: mesh.position, ball, ball.position + np.array([2.2, 0.3, 0.0], np.float32))
    ground = builtin.plane(cells=12)
    ground = eqx.tree_at(lambda mesh: mesh.position, ground, ground.position * 3 - np.array([0, 1, 0], np.float32))
    matte = {"metallic": 0.0, "specular": 0.0}
    image = np.random.default_rng(1).uniform(0.2, 0.9, (4, 4, 3)).astype(np.float32)
    parts = [
        Part("textured", painted, TexturedMaterial(base_color_texture=Texture(image), **matte)),
        Part("red", beside, TexturedMaterial(base_color=(0.7, 0.2, 0.1), **matte)),
        Part("ground", ground, TexturedMaterial(base_color=(0.4, 0.5, 0.4), **matte)),
    ]
    camera = Camera([2.5, 2.5, 6.0], [0.5, -0.2, 0.0], [0.0, 1.0, 0.0], 0.8, 128, 128)
    scene = Scene(parts, cameras=[camera])
    return prt.precompute(scene, refine=False, system="lobe", size=SIZE, progress=False)


@pytest.fixture(scope="module")
def path(relit, light, tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "prt.glb"
    view.export_gltf(relit, path, environments={"soft": light})
    return path


@pytest.fixture(scope="session")
def node_modules():
    """The folder of packages of npm that JAXPRT_NODE_MODULES names; tests of it are skipped without."""
    folder = pathlib.Path(os.environ.get("JAXPRT_NODE_MODULES", ""))
    for name in ("three", "gltf-validator"):
        if not (folder / name / "package.json").exists():
            pytest.skip(
                f"JAXPRT_NODE_MODULES must name a folder of npm with {name}: `npm install three gltf-validator`"
            )
    return folder.resolve()


def content(path):
    """The header of a GLB file, and a function that returns the rows of an accessor."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    head = json.loads(data[20 : 20 + length])
    kinds = {5126: "<f4", 5125: "<u4", 5122: "<i2"}

    def rows(number):
        accessor = head["accessors"][number]
        start = 28 + length + head["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = kinds[accessor["componentType"]]
        values = np.frombuffer(data, kind, width * accessor["count"], start).reshape(-1, width)
        return values / 32767 if accessor.get("normalized") else values

    return head, rows


def test_attributes_times_the_light_are_the_diffuse_radiance(path, relit, light):
    head, rows = content(path)
    about = head["asset"]["extras"]["prt"]
    assert (about["degree"], about["attributes"]) == (3, ["_PRT_0", "_PRT_1", "_PRT_2", "_PRT_3"])
    coefficient = np.array(about["lights"]["soft"])
    np.testing.assert_allclose(coefficient, harmonics.project(light.radiance, degree=3), atol=1e-5)
    true = np.asarray(relit.radiance(light, eye=relit.camera.eye))
    start = 0
    for mesh, part in zip(head["meshes"], relit.scene.parts, strict=True):
        primitive = mesh["primitives"][0]
        transfer = np.concatenate([rows(primitive["attributes"][name]) for name in about["attributes"]], 1)
        count = len(part.mesh.position)
        if part.name != "textured":
            found = transfer @ coefficient * np.asarray(part.material.base_color)
            # The light's file has texels, in which its harmonics are constant.
            assert np.linalg.norm(found - true[start : start + count]) < 0.01 * np.linalg.norm(true)
        start += count


def test_transfer_of_matrices_is_that_of_vectors(relit, tmp_path):
    glossy = TexturedMaterial(base_color=(0.6, 0.2, 0.1), metallic=0.0, roughness=0.5)
    parts = [dataclasses.replace(part, material=glossy) for part in relit.scene.parts]
    made = prt.precompute(Scene(parts), refine=False, system=prt.relit.Harmonics(DEGREE), size=SIZE, progress=False)
    view.export_gltf(made, tmp_path / "glossy.glb", degree=2)
    view.export_gltf(relit, tmp_path / "matte.glb", degree=2)
    found, true = (content(tmp_path / name) for name in ("glossy.glb", "matte.glb"))
    first, second = (
        np.concatenate([rows(mesh["primitives"][0]["attributes"]["_PRT_0"]) for mesh in head["meshes"]])
        for head, rows in (found, true)
    )
    # Matrices of degree 3 leave out the fourth band of the cosine.
    assert np.linalg.norm(first - second) < 0.05 * np.linalg.norm(second)
    with pytest.raises(ValueError, match="degree must be at most 3, that of the transfer of part 'textured', got 4"):
        view.export_gltf(made, tmp_path / "a.glb", degree=4)


def test_others_read_the_file_and_jaxprt_its_materials(path, relit):
    read, again = trimesh.load(path, process=False), prt.load_scene(path)
    assert sorted(read.geometry) == sorted(relit.scene.names)
    assert [part.name for part in again.parts] == list(relit.scene.names)
    for part, other in zip(relit.scene.parts, again.parts, strict=True):
        mesh = read.geometry[part.name]
        np.testing.assert_allclose(mesh.vertices, part.mesh.position, atol=1e-6)
        facing = np.sum(mesh.face_normals * np.asarray(part.mesh.normal)[mesh.faces].sum(1), 1)
        assert np.all(facing[mesh.area_faces > 1e-6] > 0)
        assert mesh.vertex_attributes["_PRT_3"].shape == (len(mesh.vertices), 4)
        for name in ("base_color", "metallic", "roughness", "specular"):
            np.testing.assert_allclose(getattr(other.material, name), getattr(part.material, name), atol=1e-6)
    original, textured = relit.scene.parts[0], again.parts[0]
    images = (part.material.base_color_texture.image for part in (textured, original))
    np.testing.assert_allclose(*images, atol=5e-3)
    np.testing.assert_allclose(textured.mesh.texture, original.mesh.texture, atol=1e-6)


def test_baked_colors_are_radiance_and_the_file_says_so(relit, light, tmp_path):
    path, eye = tmp_path / "piece.glb", jnp.asarray([3.0, 1.0, 2.0])
    exposure = view.export_baked(relit, path, light, eye=eye)
    true = np.maximum(np.asarray(relit.radiance(light, eye=eye)), 0)
    found = trimesh.load(path, process=False)
    assert sorted(found.geometry) == sorted(f"{name}, baked for one light and one view" for name in relit.scene.names)
    head, rows = content(path)
    assert head["asset"]["extras"] == {"baked": True, "eye": [3.0, 1.0, 2.0], "exposure": exposure}
    assert head["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    color = np.concatenate([rows(mesh["primitives"][0]["attributes"]["COLOR_0"]) for mesh in head["meshes"]])
    np.testing.assert_allclose(exposure * color, true, rtol=1e-5, atol=1e-6)
    assert color.max() <= 1
    for name, mesh in found.geometry.items():
        part = relit.scene[name.partition(",")[0]]
        facing = np.sum(mesh.face_normals * np.asarray(part.mesh.normal)[mesh.faces].sum(1), 1)
        assert np.all(facing[mesh.area_faces > 1e-6] > 0)


def test_validator_of_khronos_has_no_objections(path, node_modules):
    environment = os.environ | {"NODE_PATH": str(node_modules)}
    done = subprocess.run(
        [shutil.which("node") or "node", "-e", VALIDATE, str(path)], env=environment, capture_output=True, check=True
    )
    issues = json.loads(done.stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


@pytest.fixture
def served(path, node_modules):
    """Address of the example beside the file and three.js."""
    folder = path.parent
    shutil.copy(EXAMPLE, folder)
    if not (folder / "node_modules").exists():
        (folder / "node_modules").symlink_to(node_modules)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/three_prt.html"
    server.shutdown()
    server.server_close()


def test_three_js_relights_the_file_as_jaxprt_does(browser, served, relit, light):
    tab, camera = browser.new_page(), relit.camera
    told = []
    tab.on("pageerror", lambda error: told.append(str(error)))
    tab.goto(f"{served}?scene=prt.glb")
    tab.wait_for_function("() => window.scene")
    shot = {"eye": np.asarray(camera.eye).tolist(), "target": np.asarray(camera.target).tolist(), "edge": camera.width}
    for degrees in (0, 90):
        tab.evaluate(
            "(value) => { const turn = document.getElementById('turn'); turn.value = value; turn.oninput(); }", degrees
        )
        data = tab.evaluate(RENDER, shot | {"angle": float(np.degrees(camera.field_of_view))})
        found = np.array(data).reshape(camera.height, camera.width, 4)[::-1]
        turn = view.stages.about(np.radians(degrees))
        rotated = prt.scene.environment.rotate(light, turn)
        true = np.asarray(relit.picture(rotated, samples=1, shadows="vertices"))
        shown = (found[..., 3] > 0.5) & (np.asarray(relit.coverage(samples=1)) > 0.5)
        assert shown.mean() > 0.3
        off = np.linalg.norm((found[..., :3] - true)[shown], axis=1)
        # A few pixels at edges see another part.
        assert np.quantile(off, 0.98) < 0.02 * np.linalg.norm(true[shown], axis=1).mean()
    assert not told
    tab.close()


def test_a_file_without_transfer_is_told(browser, served, path, relit, light):
    view.export_baked(relit, path.with_name("baked.glb"), light)
    tab = browser.new_page()
    tab.goto(f"{served}?scene=baked.glb")
    tab.wait_for_function("() => document.getElementById('message').textContent")
    assert tab.text_content("#message") == (
        "baked.glb: the file must have transfer in vertex attributes, from jaxprt export --format gltf"
    )
    tab.close()


def test_what_a_file_cannot_hold_is_refused(relit, light, tmp_path):
    for export in (view.export_gltf, functools.partial(view.export_baked, environment=light)):
        with pytest.raises(ValueError, match=r"path must end in \.glb, .* got '.*a\.gltf'"):
            export(relit, tmp_path / "a.gltf")
    with pytest.raises(ValueError, match="degree must be between 0 and 5, got 6"):
        view.export_gltf(relit, tmp_path / "a.glb", degree=6)
    assert not list(tmp_path.iterdir())
