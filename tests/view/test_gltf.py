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
import tarfile
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

ROOT = pathlib.Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/three_prt.html"
DEGREE, SIZE = 3, 16
VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((report) => {
  console.log(JSON.stringify(report.issues));
});
"""
# Renders into floats: linear radiance, and alpha where there is a surface.
RENDER = """async ({ eye, target, angle, edge, name }) => {
  const { THREE, renderer } = window;
  const scene = window[name];
  renderer.setAnimationLoop(null);
  renderer.setScissorTest(false);
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


@pytest.fixture(scope="module")
def metal(relit):
    """The same scene of metal, by transfer matrices."""
    material = TexturedMaterial(base_color=(0.9, 0.8, 0.7), metallic=1.0, roughness=0.4)
    parts = [dataclasses.replace(part, material=material) for part in relit.scene.parts]
    scene = Scene(parts, cameras=relit.scene.cameras)
    return prt.precompute(scene, refine=False, system=prt.relit.Harmonics(DEGREE), size=SIZE, progress=False)


def test_transfer_of_matrices_is_that_of_vectors(relit, metal, tmp_path):
    view.export_gltf(metal, tmp_path / "glossy.glb", degree=2)
    view.export_gltf(relit, tmp_path / "matte.glb", degree=2)
    found, true = (content(tmp_path / name) for name in ("glossy.glb", "matte.glb"))
    first, second = (
        np.concatenate([rows(mesh["primitives"][0]["attributes"]["_PRT_0"]) for mesh in head["meshes"]])
        for head, rows in (found, true)
    )
    # Matrices of degree 3 leave out the fourth band of the cosine.
    assert np.linalg.norm(first - second) < 0.05 * np.linalg.norm(second)
    with pytest.raises(ValueError, match="degree must be at most 3, that of the transfer of part 'textured', got 4"):
        view.export_gltf(metal, tmp_path / "a.glb", degree=4)


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


@pytest.fixture(scope="session")
def package():
    """The package that `make three` makes of the module."""
    command = ["make", "--old-file=.venv/.setup-test", "three"]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return ROOT / f"build/jaxprt-three-{prt.__version__}.tgz"


def test_the_package_has_two_small_modules_and_needs_three_alone(package):
    with tarfile.open(package) as archive:
        sizes = {member.name: member.size for member in archive}
        file = archive.extractfile("package/package.json")
        assert file is not None
        about = json.load(file)
    modules = {"package/three.js", "package/harmonics.js"}
    assert sizes.keys() == modules | {"package/LICENSE", "package/README.md", "package/package.json"}
    assert sum(sizes[name] for name in modules) < 15_000
    assert package.stat().st_size < 15_000
    assert list(about["peerDependencies"]) == ["three"]
    assert about["version"] == prt.__version__
    assert not about.keys() & {"dependencies", "scripts"}


@pytest.fixture
def served(path, node_modules, package):
    """Address of the example beside the file, three.js and the module as it is packed."""
    folder = path.parent
    shutil.copy(EXAMPLE, folder)
    if not (folder / "node_modules").exists():
        (folder / "node_modules").mkdir()
        (folder / "node_modules/three").symlink_to(node_modules / "three")
        with tarfile.open(package) as archive:
            archive.extractall(folder / "node_modules", filter="data")
        (folder / "node_modules/package").rename(folder / "node_modules/jaxprt-three")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/three_prt.html"
    server.shutdown()
    server.server_close()


@pytest.fixture
def opened(browser, served):
    """A function that opens the example with a file. Errors of scripts and shaders fail the test."""
    tab, errors = browser.new_page(), []
    tab.set_default_timeout(180_000)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda said: "THREE." in said.text and errors.append(said.text))

    def go(name):
        tab.goto(f"{served}?scene={name}")
        tab.wait_for_function("() => window.renderer")
        return tab

    yield go
    tab.close()
    assert not errors


def drawn(tab, camera, name="scene"):
    """Linear radiance and alpha of a scene of the page."""
    shot = {key: np.asarray(getattr(camera, key)).tolist() for key in ("eye", "target")}
    angle = float(np.degrees(camera.field_of_view))
    data = tab.evaluate(RENDER, shot | {"angle": angle, "edge": camera.width, "name": name})
    return np.array(data).reshape(camera.height, camera.width, 4)[::-1]


def test_three_js_relights_the_file_as_jaxprt_does(opened, relit, light):
    tab, camera = opened("prt.glb"), relit.camera
    for degrees in (0, 90):
        tab.evaluate(
            "(value) => { const turn = document.getElementById('turn'); turn.value = value; turn.oninput(); }", degrees
        )
        found = drawn(tab, camera)
        turn = view.stages.about(np.radians(degrees))
        rotated = prt.scene.environment.rotate(light, turn)
        true = np.asarray(relit.picture(rotated, samples=1, shadows="vertices"))
        shown = (found[..., 3] > 0.5) & (np.asarray(relit.coverage(samples=1)) > 0.5)
        assert shown.mean() > 0.3
        off = np.linalg.norm((found[..., :3] - true)[shown], axis=1)
        # A few pixels at edges see another part. The environment, which is set, adds nothing to the transfer.
        assert np.quantile(off, 0.98) < 0.02 * np.linalg.norm(true[shown], axis=1).mean()


def test_a_light_of_a_texture_is_that_of_its_coefficients(opened, relit, light):
    tab, rows, columns = opened("prt.glb"), 64, 128
    latitude, longitude = np.meshgrid(
        np.pi * (0.5 - (np.arange(rows) + 0.5) / rows),
        np.pi * (1 - 2 * (np.arange(columns) + 0.5) / columns),
        indexing="ij",
    )
    across = np.cos(latitude)
    direction = np.stack([across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)], -1)
    coefficient = np.array(harmonics.project(light.radiance, degree=DEGREE))
    coefficient[0] += 2  # nowhere negative
    radiance = np.asarray(harmonics.evaluate(jnp.asarray(direction), degree=DEGREE)) @ coefficient
    assert radiance.min() > 0
    tab.evaluate("(rows) => light.set(rows)", coefficient.tolist())
    known = drawn(tab, relit.camera)[..., :3]
    for half, flip in ((False, False), (True, True)):
        picture = np.concatenate([radiance, np.ones((rows, columns, 1))], -1)
        tab.evaluate(
            """([data, half, flip]) => {
              const type = half ? THREE.HalfFloatType : THREE.FloatType;
              const values = half ? Uint16Array.from(data, THREE.DataUtils.toHalfFloat) : Float32Array.from(data);
              const texture = new THREE.DataTexture(values, 128, 64, THREE.RGBAFormat, type);
              texture.flipY = flip;
              texture.needsUpdate = true;
              light.set(texture);
            }""",
            [(picture if flip else picture[::-1]).ravel().tolist(), half, flip],
        )
        found = drawn(tab, relit.camera)[..., :3]
        assert np.linalg.norm(found - known) < 2e-3 * np.linalg.norm(known)


def test_highlights_are_darker_where_something_hides_the_light_and_else_as_they_are(opened, path, metal, light):
    view.export_gltf(metal, path.with_name("metal.glb"), environments={"soft": light})
    tab = opened("metal.glb")
    tab.evaluate("light.set(Array.from({ length: 16 }, (_, k) => [k ? 0 : 3, k ? 0 : 3, k ? 0 : 3]))")
    tab.evaluate("plain.environment = scene.environment")
    found, plain = (drawn(tab, metal.camera, name) for name in ("scene", "plain"))
    share = (found / np.maximum(plain, 1e-6))[..., 0][plain[..., 3] > 0.5]
    assert share.max() < 1.02
    assert np.quantile(share, 0.7) > 0.95
    assert np.quantile(share, 0.05) < 0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("light.set('grace')", "the light must be one of soft, got grace"),
        ("light.set([[1, 1, 1]])", "the light must have 16 coefficients, got 1"),
        ("light.set(new THREE.Texture())", "the texture must have floats or half floats"),
        (
            """import("jaxprt-three").then(({ relight }) => {
              const geometry = new THREE.BufferGeometry();
              for (let i = 0; i < 17; i++) geometry.setAttribute(`a${i}`, new THREE.Float32BufferAttribute([0], 1));
              const extras = { prt: { degree: 3, attributes: ["_PRT_0"], lights: {} } };
              relight({ scene: new THREE.Mesh(geometry, new THREE.MeshStandardMaterial()), asset: { extras } }, scene);
            })""",
            "a mesh must have at most 16 attributes of vertices, got 17: export with a smaller --degree",
        ),
    ],
)
def test_the_module_refuses_what_it_cannot_show(opened, call, message):
    tab = opened("prt.glb")
    assert message in tab.evaluate(
        f"async () => {{ try {{ await {call}; }} catch (error) {{ return error.message; }} }}"
    )


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
