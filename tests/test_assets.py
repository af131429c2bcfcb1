"""The judge of files is judged: its reader beside trimesh, its light, its normal maps, its alpha and its counts."""

import base64
import dataclasses
import io
import json

import numpy as np
import PIL.Image
import pytest
import trimesh

from benchmarks import asset_files, asset_scenes, assets, path_tracing
from jaxprt import files
from jaxprt.scene import Camera

traced = pytest.mark.skipif(not path_tracing.available(), reason="drjit finds no LLVM of version 17 or newer")
CORNER = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)  # seen from +z
FACE = np.array([[0, 1, 2], [0, 2, 3]])
PLACE = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)  # v is down


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.gltf"
    asset_files.write_small(path)
    return path


def edited(path, change):
    """Changes the JSON of a file in place."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def triangles(surfaces):
    return np.concatenate([surface.position[surface.face] for surface in surfaces])


def test_triangles_stand_where_trimesh_has_them(small):
    def tilt(document):
        document["nodes"] += [{"children": [0, 1], "rotation": [0.1, 0.3, 0.2, 0.927], "translation": [1, 2, 3]}]
        document["scenes"][0]["nodes"] = [2]

    edited(small, tilt)
    ours = triangles(asset_files.read(small))
    theirs = trimesh.load_scene(small, process=False).to_mesh().triangles
    assert len(ours) == len(theirs)
    for mine in ours:  # from any corner on, in the same direction
        assert min(np.abs(np.roll(theirs, n, 1) - mine).max((1, 2)).min() for n in range(3)) < 1e-5


def test_normals_point_to_the_front_after_any_transform(small):
    edited(small, lambda document: document["nodes"][0].update(scale=[-1, 2, 0.5], rotation=[0, 0.6, 0, 0.8]))
    ball = next(surface for surface in asset_files.read(small) if surface.normal is not None)
    a, b, c = (ball.position[ball.face[:, corner]] for corner in range(3))
    flat = np.cross(b - a, c - a)
    whole = np.linalg.norm(flat, axis=1) > 1e-6
    assert (np.sum(flat * ball.normal[ball.face].mean(1), -1)[whole] > 0).all()


def test_sparse_and_normalized_accessors_follow_the_specification(small):
    def change(document):
        index, value = np.array([2], "<u2").tobytes(), np.array([[9, 8, 7]], "<f4").tobytes()
        content = np.array([0, 255, 51], np.uint8).tobytes() + b"\0" + index + b"\0\0" + value
        address = "data:;base64," + base64.b64encode(content).decode()
        document["buffers"].append({"byteLength": len(content), "uri": address})
        first = len(document["bufferViews"])
        for offset, length in ((0, 3), (4, 2), (8, 12)):
            document["bufferViews"].append({"buffer": 1, "byteOffset": offset, "byteLength": length})
        document["accessors"] += [
            {"bufferView": first, "componentType": 5121, "normalized": True, "count": 3, "type": "SCALAR"},
            {"componentType": 5126, "count": 4, "type": "VEC3"},
        ]
        indices, values = {"bufferView": first + 1, "componentType": 5123}, {"bufferView": first + 2}
        document["accessors"][-1]["sparse"] = {"count": 1, "indices": indices, "values": values}

    edited(small, change)
    file = asset_files.GltfFile(small)
    count = len(file.json["accessors"])
    np.testing.assert_allclose(file.accessor(count - 2)[:, 0], [0, 1, 0.2])
    np.testing.assert_array_equal(file.accessor(count - 1), [[0, 0, 0], [0, 0, 0], [9, 8, 7], [0, 0, 0]])


def test_tangents_follow_nodes_and_webp_replaces_other_images(small):
    stream = io.BytesIO()
    PIL.Image.new("RGB", (2, 2), (255, 0, 0)).save(stream, "WEBP", lossless=True)

    def change(document):
        address = "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode()
        document["images"].append({"uri": address})
        document["textures"][0]["extensions"] = {"EXT_texture_webp": {"source": 1}}
        content = np.tile(np.array([0, 0, 1, 1], "<f4"), (4, 1)).tobytes()
        document["buffers"].append({"byteLength": 64, "uri": "data:;base64," + base64.b64encode(content).decode()})
        document["bufferViews"].append({"buffer": 1, "byteLength": 64})
        view = len(document["bufferViews"]) - 1
        document["accessors"].append({"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC4"})
        document["meshes"][1]["primitives"][0]["attributes"]["TANGENT"] = len(document["accessors"]) - 1

    edited(small, change)
    by_color = {surface.color is None: surface for surface in asset_files.read(small)}
    np.testing.assert_allclose(by_color[True].material.base_map.image, np.tile([1, 0, 0], (2, 2, 1)))
    # The node scales z by -1. That mirrors the tangent and swaps the side of the bitangent.
    np.testing.assert_allclose(by_color[False].tangent, np.tile([0, 0, -1, -1], (4, 1)))


def test_strips_and_fans_wind_one_way():
    index = np.array([3, 1, 4, 0, 5])
    np.testing.assert_array_equal(asset_files._triangles(index, 5), [[3, 1, 4], [1, 0, 4], [4, 0, 5]])
    np.testing.assert_array_equal(asset_files._triangles(index, 6), [[1, 4, 3], [4, 0, 3], [0, 5, 3]])


def test_objs_have_a_surface_for_each_material_and_v_down(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\nKs .5 .5 .5\nNs 6\nnewmtl wall\nKd .2 .3 .4\nd .5\n")
    lines = ["mtllib a.mtl", *("v {} {} {}".format(*corner) for corner in CORNER), "vt .25 .25", "vt 1 0", "vt 1 1"]
    path = tmp_path / "a.obj"
    path.write_text("\n".join([*lines, "usemtl red", "f 1/1 2/2 3/3", "usemtl wall", "f -4 -2 -1", ""]))
    red, wall = asset_files.read(path)
    np.testing.assert_allclose(red.texture[0][:3], [[0.25, 0.75], [1, 1], [1, 0]])
    np.testing.assert_allclose(wall.position[wall.face[0]], CORNER[[0, 2, 3]])
    np.testing.assert_allclose(wall.normal[wall.face[0]], np.tile([0, 0, 1.0], (3, 1)))
    assert red.material.roughness == pytest.approx(0.5**0.5)  # alpha = sqrt(2 / (6 + 2))
    assert not wall.material.opaque
    assert wall.material.alpha == 0.5


def test_compressed_and_empty_files_are_unreadable(small, tmp_path):
    empty = tmp_path / "empty.obj"
    empty.write_text("v 0 0 0\n")
    edited(small, lambda document: document.update(extensionsUsed=["EXT_meshopt_compression"]))
    for path, reason in ((empty, "no triangles"), (small, "EXT_meshopt_compression")):
        with pytest.raises(asset_files.UnreadableError, match=reason):
            asset_files.read(path)


def test_the_summary_counts_files_of_which_nothing_warned():
    line = {"case": "a", "error": 0.04, "seconds": 1.0, "bytes": 1, "loaded": True, "warnings": []}
    lines = [
        *(line, line | {"case": "b", "error": 0.3}, line | {"case": "c", "error": 0.2, "warnings": ["alpha"]}),
        line | {"case": "f", "error": 0.9, "warnings": ["clear coat"], "unjudged": ["KHR_materials_clearcoat"]},
        {"case": "d", "error": None, "seconds": 1.0, "bytes": 1, "loaded": False, "refused": "no"},
        {"case": "e", "error": None, "seconds": 1.0, "bytes": 1, "loaded": False, "refused": "no", "unreadable": "no"},
    ]
    total = assets.summary(lines)
    names = ("files", "valid", "loaded", "judged", "partly", "above", "silent")
    assert [total[key] for key in names] == [6, 5, 4, 3, 1, 2, 1]
    assert total["error"] == pytest.approx(0.2)
    assert total["silent_files"] == ["b"]


def quad(**material):
    options = {"metallic": 0.0, "roughness": 1.0, "specular": 0.0} | material
    normal = np.tile([0, 0, 1.0], (4, 1))
    return asset_files.Surface(CORNER, FACE, normal, {0: PLACE}, None, asset_files.Material(**options))


@pytest.fixture
def picture(tmp_path):
    """Radiance and coverage in the middle of a picture, by light of some texels of a file."""

    def render(surfaces, texels, *, model="gltf", samples=1024, eye=(0.0, 0.0, 4.0)):
        radiance = np.zeros((16, 32, 3), np.float32)
        radiance[texels] = 1.0
        path = tmp_path / "light.exr"
        files.write_exr(path, radiance)
        camera = Camera(eye, [0, 0, 0], [0, 1, 0], 0.1, 4, 4)
        view = asset_scenes.View(surfaces, path, camera, model=model)
        return view.picture(samples, 1).mean((0, 1)), [side.mean() for side in view.sides()]

    return render


EVERYWHERE = slice(None), slice(None)
RIGHT, LEFT = (slice(None), slice(0, 16)), (slice(None), slice(16, 32))  # +x and -x: a quarter of the width is +x
ABOVE, BELOW = (slice(0, 8), slice(None)), (slice(8, 16), slice(None))


@traced
@pytest.mark.parametrize("model", asset_scenes.MODELS)
def test_a_white_surface_in_even_light_is_as_bright_as_the_light(picture, model):
    roughness = {"roughness": 0.5} if model == "principled" else {}  # at which its base is nearly Lambert's
    (radiance, *_, coverage), sides = picture([quad(**roughness)], EVERYWHERE, model=model)
    assert radiance == pytest.approx(1, abs=0.02 if model == "gltf" else 0.1)
    assert (coverage, *sides) == (1, 0, 0)


@traced
def test_the_judge_reflects_light_as_often_as_asked(tmp_path):
    upright = CORNER @ [[0, 0, 1], [0, 1, 0], [-1, 0, 0]] + [1, 0, 1]
    wall = asset_files.Surface(upright, FACE, None, {}, None, quad().material)
    path, camera = tmp_path / "light.exr", Camera([0.0, 0.0, 4.0], [0, 0, 0], [0, 1, 0], 0.1, 4, 4)
    files.write_exr(path, np.ones((16, 32, 3), np.float32))
    found = []
    for bounces in (0, 1, 39):
        request = {"camera": camera, "samples": 2048, "model": "gltf", "bounces": bounces}
        total, blocks, _ = assets.rendered([quad(), wall], path, request, np.zeros((4, 4, 4)), None)
        found.append(total[..., 0].mean() / blocks)
    once = asset_scenes.View([quad(), wall], path, camera, model="gltf", bounces=1).picture(4096, 3)[..., 0].mean()
    direct, one, many = found
    assert one == pytest.approx(once, rel=0.01)
    assert one > 1.05 * direct
    assert many > 1.02 * one


@traced
def test_the_sides_of_a_light_file_are_those_of_the_conventions(picture):
    turned = CORNER[:, [2, 1, 0]] * [1, 1, -1]  # towards +x
    surface = quad()
    surface = asset_files.Surface(turned, FACE, np.tile([1.0, 0, 0], (4, 1)), {}, None, surface.material)
    assert picture([surface], RIGHT, eye=(4.0, 0.0, 0.0))[0][0] == pytest.approx(1, abs=0.02)


@traced
@pytest.mark.parametrize(
    ("mirrored", "tangent"), [(False, None), (True, None), (True, (1, 0, 0, 1)), (False, (0, -1, 0, -1))]
)
def test_normal_maps_tilt_towards_red_and_green(picture, mirrored, tangent):
    # Light of a quarter sphere: half of the normal's part to its side, and half of its part along the surface's normal.
    place = PLACE * [-1, 1] + [1, 0] if mirrored else PLACE
    ways = ([0.6, 0, 0.8], RIGHT, LEFT), ([0, 0.6, 0.8], ABOVE, BELOW)
    if tangent == (0, -1, 0, -1):  # red is down, and green, to the right of that, is left
        ways = ([0.6, 0, 0.8], BELOW, ABOVE), ([0, 0.6, 0.8], LEFT, RIGHT)
    for way, bright, dark in ways:
        image = np.broadcast_to((np.array(way) + 1) / 2, (4, 4, 3)).astype(np.float32)
        surface = quad(normal_map=asset_files.Map(image))
        given = None if tangent is None else np.tile(np.array(tangent, float), (4, 1))
        surface = dataclasses.replace(surface, texture={0: place}, tangent=given)
        if mirrored and tangent is None and way[0]:
            bright, dark = dark, bright
        values = [picture([surface], side)[0][0] for side in (bright, dark)]
        np.testing.assert_allclose(values, [0.7, 0.2], atol=0.02)


@traced
def test_alpha_covers_and_lets_light_through(picture):
    roof = CORNER * [9, 9, 1] + [0, 0, 6]  # between the surface and its light, behind the eye
    over = asset_files.Surface(roof, FACE, -quad().normal, {0: PLACE}, None, quad(alpha=0.25, opaque=False).material)
    shaded = picture([quad(), over], EVERYWHERE, samples=4096)[0][0]
    assert 0.7 < shaded < 0.85
    half = picture([quad(alpha=0.5, opaque=False)], EVERYWHERE)[0]
    np.testing.assert_allclose(half, 0.5, atol=0.03)
    for alpha, coverage in ((0.6, 1), (0.4, 0)):
        assert picture([quad(alpha=alpha, opaque=False, cutoff=0.5)], EVERYWHERE)[0][3] == coverage


@traced
def test_backs_are_black_unless_the_file_says_two_sides(picture):
    behind = (0.0, 0.0, -4.0)
    for two, radiance in ((False, 0), (True, 1)):
        values, (backs, undefined) = picture([quad(double_sided=two)], EVERYWHERE, eye=behind)
        assert values[0] == pytest.approx(radiance, abs=0.02)
        assert (backs, undefined) == (0 if two else 1, 0)


@traced
def test_normals_that_look_away_from_the_front_are_told(picture):
    normal = np.tile([0.6, 0, -0.8], (4, 1))
    surface = asset_files.Surface(CORNER, FACE, normal, {}, None, quad().material)
    assert picture([surface], EVERYWHERE, samples=1)[1] == [0, 1]


@traced
def test_surfaces_that_emit_are_seen_and_shine_on_others(picture):
    lamp = quad(emissive=np.array([2.0, 1.0, 0.5]), base_color=np.zeros(3))
    values, _ = picture([lamp], (slice(0, 0), slice(None)))
    np.testing.assert_allclose(values, [2, 1, 0.5, 1], rtol=1e-3)
    panel = CORNER * [9, 9, 1] + [0, 0, 6]  # behind the eye, towards the surface
    above = asset_files.Surface(panel, FACE[:, ::-1], None, {0: PLACE}, None, lamp.material)
    share = picture([quad(), above], (slice(0, 0), slice(None)), samples=4096)[0]
    # The form factor of a square of half the edge a in the distance c, for a = 9 and c = 6.
    part = 9 / np.hypot(9, 6)
    factor = 4 / np.pi * part * np.arctan(part)
    np.testing.assert_allclose(share[:3], factor * np.array([2, 1, 0.5]), rtol=0.03)
