"""glTF files written by hand, real ones against trimesh, and damaged ones.

Lights of glTF files, against three.js (`peers/three_poses.mjs`).
"""

import json
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import trimesh

from jaxprt import require
from jaxprt.files import images, write_png
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats.file_parts import store_channels
from jaxprt.scene.formats.gltf import MaterialReader
from jaxprt.scene.formats.gltf_file import Document
from jaxprt.scene.mesh import split
from tests.scene.formats.gltf_writer import FACE, KIND, PLACE, SQUARE, Writer, one

TURN = np.array([[0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1.0]])  # A quarter turn about z, and a shift.
PEER = json.loads((pathlib.Path(__file__).parent / "peers/three_poses.json").read_text())["lit.glb"]["lights"]
LIGHTS = "KHR_lights_punctual"


def srgb(value):
    """IEC 61966-2-1."""
    return np.where(
        np.asarray(value) <= 0.04045, np.asarray(value) / 12.92, ((np.asarray(value) + 0.055) / 1.055) ** 2.4
    )


def corners(mesh):
    return np.asarray(mesh.position)[np.asarray(mesh.face)]


@pytest.mark.parametrize("name", ["Duck", "CesiumMilkTruck", "BoxTextured"])
def test_real_files_have_the_triangles_normals_and_textures_that_trimesh_reads(data, name):
    path = data / f"scenes/{name}.glb"
    scene = load_scene(path)  # without a warning
    peer = trimesh.load_scene(path, process=False)
    found: dict[str, list] = {}
    for node in peer.graph.nodes_geometry:
        transform, key = peer.graph[node]
        geometry = peer.geometry[key]
        position = trimesh.transform_points(geometry.vertices, transform)
        normal = geometry.vertex_normals @ transform[:3, :3].T
        place = geometry.visual.uv if has_uv(geometry) else np.zeros((len(position), 2))
        row = np.concatenate([position, normal / np.linalg.norm(normal, axis=1, keepdims=True), place], 1)
        found.setdefault(geometry.visual.material.name, []).append(row[geometry.faces].reshape(-1, 24))
    assert [part.name for part in scene.parts] == list(found)
    for part in scene.parts:
        mesh, theirs = part.mesh, np.concatenate(found[part.name])
        place = mesh.texture if mesh.texture is not None else np.zeros((len(mesh.position), 2))
        ours = np.concatenate([mesh.position, mesh.normal, place], 1)[np.asarray(mesh.face)].reshape(-1, 24)
        assert len(ours) == len(theirs)
        for tree, other in ((theirs, ours), (ours, theirs)):
            assert scipy.spatial.KDTree(tree).query(other)[0].max() < 1e-4


def has_uv(geometry):
    return getattr(geometry.visual, "uv", None) is not None


def test_factors_of_a_real_file_are_exact_and_colors_of_its_texture_are_at_their_places(data):
    duck = load_scene(data / "scenes/Duck.glb").parts[0]
    truck = load_scene(data / "scenes/CesiumMilkTruck.glb")
    glass = truck["glass"].material
    np.testing.assert_array_equal(glass.base_color, np.float32([0, 0.04050629958510399, 0.021240700036287308]))
    assert (float(glass.metallic), float(glass.roughness), glass.textures) == (0, 1, ())
    assert truck["truck"].material.base_color_texture.image is truck["wheels"].material.base_color_texture.image
    peer = next(iter(trimesh.load_scene(data / "scenes/Duck.glb", process=False).geometry.values()))
    expected = srgb(peer.visual.material.to_color(peer.visual.uv)[:, :3] / 255)
    # trimesh takes the nearest texel, so that vertices on an edge in the image differ.
    difference = np.abs(np.asarray(duck.surface().base_color) - expected).max(1)
    assert np.mean(difference > 0.1) < 0.03
    assert np.median(difference) < 0.01


def interleaved(writer):
    both = np.concatenate([SQUARE, PLACE], 1).astype(np.float32)
    view = writer.view(both.tobytes(), byteStride=20)
    field = {"bufferView": view, "componentType": 5126, "count": 4}
    position = writer.add("accessors", field | {"type": "VEC3"})
    return {"POSITION": position, "TEXCOORD_0": writer.add("accessors", field | {"type": "VEC2", "byteOffset": 12})}


def sparse(writer):
    index, value = writer.view(np.array([1, 2], np.uint8).tobytes()), writer.view(SQUARE[1:3].tobytes())
    parts = {"count": 2, "indices": {"bufferView": index, "componentType": 5121}, "values": {"bufferView": value}}
    wrong = SQUARE.copy()
    wrong[1:3] = 7
    return {"POSITION": writer.accessor(wrong, sparse=parts), "TEXCOORD_0": PLACE}


def sparse_on_nothing(writer):
    index, value = writer.view(np.array([1, 2, 3], np.uint16).tobytes()), writer.view(SQUARE[1:].tobytes())
    parts = {"count": 3, "indices": {"bufferView": index, "componentType": 5123}, "values": {"bufferView": value}}
    position = writer.add("accessors", {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": parts})
    return {"POSITION": position, "TEXCOORD_0": PLACE}


def whole(kind, most):
    def build(writer):
        packed = np.zeros((4, 4), kind)  # Rows of four bytes at least.
        packed[:, :2] = PLACE * most
        view = writer.view(packed.tobytes(), byteStride=packed.itemsize * 4)
        field = {"bufferView": view, "componentType": KIND[packed.dtype.str[1:]], "count": 4, "type": "VEC2"}
        return {"TEXCOORD_0": writer.add("accessors", field | {"normalized": True})}

    return build


def quantized(writer):
    return {"POSITION": writer.accessor((SQUARE * 127).astype(np.int8), normalized=True), "TEXCOORD_0": PLACE}


def shared(writer):
    """Of eight vertices the square uses four."""
    twice, place = np.repeat(SQUARE, 2, 0), np.repeat(PLACE, 2, 0)
    return {"POSITION": twice, "TEXCOORD_0": place, "face": FACE * 2}


ENCODINGS = {"interleaved": interleaved, "sparse": sparse, "sparse on nothing": sparse_on_nothing, "shared": shared}
ENCODINGS |= {"bytes": whole(np.uint8, 255), "shorts": whole(np.uint16, 65535), "quantized": quantized}
ENCODINGS |= {"fan": lambda writer: {"TEXCOORD_0": PLACE, "face": np.arange(4, dtype=np.uint32), "mode": 6}}
ENCODINGS |= {"strip": lambda writer: {"TEXCOORD_0": PLACE, "face": np.array([1, 2, 0, 3], np.uint8), "mode": 5}}
ENCODINGS |= {"floats": lambda writer: {"TEXCOORD_0": PLACE}}


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_all_encodings_of_a_square_are_the_same_square(tmp_path, suffix):
    for name, build in ENCODINGS.items():
        writer = Writer()
        mesh = load_scene(one(writer.square(**build(writer)), writer=writer).write(tmp_path / f"a.{suffix}")).mesh
        np.testing.assert_allclose(mesh.position, SQUARE, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(mesh.texture, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=1e-6, err_msg=name)
        np.testing.assert_array_equal(mesh.normal, [[0, 0, 1]] * 4, err_msg=name)
        edge = corners(mesh)[:, 1:] - corners(mesh)[:, :1]
        np.testing.assert_allclose(np.cross(edge[:, 0], edge[:, 1]), [[0, 0, 1]] * 2, atol=1e-6, err_msg=name)


def test_nodes_are_placed_nested_mirrored_and_repeated(tmp_path, close):
    writer = Writer()
    normal = np.tile(np.float32([0.6, 0, 0.8]), (4, 1))
    tangent = np.tile(np.float32([0.8, 0, -0.6, 1]), (4, 1))
    one(writer.square(NORMAL=normal, TANGENT=tangent), writer=writer)
    half = np.sqrt(0.5)
    writer.header["scenes"] = [{"nodes": []}, {"nodes": [1, 3]}]
    writer.header["scene"] = 1
    writer.header["nodes"] = [
        {"mesh": 0, "scale": [2, 1, -3], "rotation": [half, 0, 0, half], "translation": [1, 2, 3]},
        {"matrix": TURN.T.ravel().tolist(), "children": [0, 2]},
        {"mesh": 0},
        {"mesh": 0, "scale": [1, 1, 0]},
        {"mesh": 0, "translation": [99, 99, 99]},
    ]
    part = load_scene(writer.write(tmp_path / "nodes.glb")).parts[0]
    # A quarter turn about x takes y to z and z to -y.
    own = np.array([[2, 0, 0, 1], [0, 0, 3, 2], [0, 1, 0, 3], [0, 0, 0, 1.0]])
    matrices = [TURN @ own, TURN, np.diag([1, 1, 0, 1.0])]
    every = [SQUARE @ each[:3, :3].T + each[:3, 3] for each in matrices]
    close(part.mesh.position, np.concatenate(every), tolerance=1e-6)
    assert np.linalg.det(matrices[0]) < 0
    for number, matrix in enumerate(matrices[:2]):
        outside = normal[0] @ np.linalg.inv(matrix[:3, :3])
        close(part.mesh.normal[4 * number], outside / np.linalg.norm(outside), tolerance=1e-6)
        along = matrix[:3, :3] @ tangent[0, :3]
        close(part.mesh.tangent[4 * number], along / np.linalg.norm(along), tolerance=1e-6)
        edge = np.diff(corners(part.mesh)[2 * number], axis=0)
        front = np.cross(*edge) @ (np.array([0, 0, 1]) @ np.linalg.inv(matrix[:3, :3]))
        assert front > 0  # Faces are counter-clockwise seen from outside.
    np.testing.assert_array_equal(part.handedness, [-1] * 4 + [1] * 8)
    # The node that is flattened keeps the direction of its normals.
    close(part.mesh.normal[8:], np.tile([0.0, 0, 1], (4, 1)), tolerance=1e-6)


def test_parts_are_materials_by_number_and_their_names_are_numbered(tmp_path):
    writer = Writer()
    writer.header["materials"] = [{"name": "wood"}, {"name": "unused"}, {"name": "wood"}, {}]
    shift = [SQUARE + np.float32([0, 0, i]) for i in range(5)]
    parts = [writer.square(POSITION=shift[i], material=each) for i, each in enumerate([3, 2, None, 0, 2])]
    path = one(*parts, writer=writer).write(tmp_path / "names.glb")
    scene = load_scene(path)
    assert [part.name for part in scene.parts] == ["wood", "wood 2", "material 3", "default"]
    heights = [sorted(set(np.asarray(part.mesh.position[:, 2]).tolist())) for part in scene.parts]
    assert heights == [[3], [1, 4], [0], [2]]
    for part, again in zip(scene.parts, split(load_mesh(path)), strict=True):
        np.testing.assert_array_equal(part.mesh.position, again.position)
    default = scene["default"].material
    assert (float(default.metallic), float(default.roughness), float(default.ior)) == (1, 1, 1.5)
    np.testing.assert_array_equal(default.base_color, [1, 1, 1])


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_colors_of_vertices_multiply_the_base_color_and_are_white_elsewhere(tmp_path, kind):
    most = 1 if kind == "f4" else np.iinfo(kind).max
    color = (np.array([[0, 0.2, 1, 0], [1, 1, 1, 0], [0.6, 0, 0.4, 1], [1, 0, 0, 1]]) * most).astype(kind)
    writer = Writer()
    writer.header["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1, 0.25, 0.3]}}]
    first = writer.square(material=0, COLOR_0=writer.accessor(color, normalized=kind != "f4"))
    part = load_scene(one(first, writer.square(material=0), writer=writer).write(tmp_path / "color.glb")).parts[0]
    expected = np.concatenate([color[:, :3] / most, np.ones((4, 3))]) * [0.5, 1, 0.25]
    np.testing.assert_allclose(part.surface().base_color, expected, atol=1e-6)


IMAGE = np.random.default_rng(0).integers(30, 226, (3, 2, 4)) / 255
CENTER = np.array([[0.25, 1 / 6], [0.75, 0.5], [0.25, 5 / 6], [0.75, 1 / 6]], np.float32)  # v down
TEXEL = IMAGE[[0, 1, 2, 0], [0, 1, 0, 1]]


def test_all_factors_textures_and_extensions_of_a_material_are_honored(tmp_path, close):
    writer = Writer()
    image = writer.texture(tmp_path, IMAGE)
    material = {
        "pbrMetallicRoughness": {
            **{"baseColorFactor": [0.9, 0.8, 0.7, 0.1], "metallicFactor": 0.6, "roughnessFactor": 0.5},
            **{"baseColorTexture": image, "metallicRoughnessTexture": image},
        },
        **{"emissiveFactor": [0.1, 0.2, 0.3], "emissiveTexture": image, "normalTexture": image | {"scale": 0.4}},
        "extensions": {
            "KHR_materials_emissive_strength": {"emissiveStrength": 20},
            "KHR_materials_ior": {"ior": 1.8},
            "KHR_materials_specular": {
                **{"specularFactor": 0.3, "specularTexture": image},
                **{"specularColorFactor": [2, 0.5, 1], "specularColorTexture": image},
            },
            "KHR_materials_anisotropy": {
                **{"anisotropyStrength": 0.7, "anisotropyRotation": 0.3, "anisotropyTexture": image}
            },
        },
    }
    writer.header["materials"] = [material]
    tangent = np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    tangent[2:, 3] = -1
    normal = np.tile(np.float32([0, 0, 1]), (4, 1))
    one(writer.square(material=0, TEXCOORD_0=CENTER, NORMAL=normal, TANGENT=tangent), writer=writer)
    writer.header["extensionsUsed"] = list(material["extensions"])
    found = load_scene(writer.write(tmp_path / "all.glb")).parts[0].surface()
    color, side = srgb(TEXEL[:, :3]), tangent[:, 3]
    close(found.base_color, color * [0.9, 0.8, 0.7])
    close(found.metallic, 0.6 * TEXEL[:, 2])
    close(found.roughness, 0.5 * TEXEL[:, 1])
    close(found.emissive, 20 * color * [0.1, 0.2, 0.3])
    close(found.ior, np.full(4, 1.8))
    close(found.specular, 0.3 * TEXEL[:, 3])
    close(found.specular_color, color * [2, 0.5, 1])
    close(found.anisotropy, 0.7 * TEXEL[:, 2])
    direction = 2 * TEXEL[:, 0] - 1 + 1j * (2 * TEXEL[:, 1] - 1)
    direction = direction / np.abs(direction) * np.exp(0.3j)
    close(found.direction, np.stack([direction.real, direction.imag * side], 1))
    slope = (2 * TEXEL[:, :3] - 1) * [0.4, 0.4, 1]
    slope[:, 1] *= side
    close(found.normal, slope / np.linalg.norm(slope, axis=1, keepdims=True))


def test_channels_of_an_image_are_decoded_once_and_images_of_other_materials_are_not_kept(tmp_path, monkeypatch):
    image = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)
    writer = Writer()
    first, second = writer.texture(tmp_path, image), writer.texture(tmp_path, image[::-1])
    broken = {"index": writer.add("textures", {"source": writer.add("images", {"uri": "data:,broken"})})}
    for texture in (first, second, first, broken, broken):
        writer.add("materials", {"pbrMetallicRoughness": {"metallicRoughnessTexture": texture}})
    decoded, decode = [], images.decode_image
    monkeypatch.setattr(
        images, "decode_image", lambda *args, **how: decoded.append(how["name"]) or decode(*args, **how)
    )
    needed = []
    monkeypatch.setattr(require, "memory", lambda what, size, _: needed.append((what, size)))
    reader = MaterialReader(Document(writer.write(tmp_path / "a.gltf")))
    materials = [reader.material(number) for number in range(5)]
    assert decoded == ["image 0", "image 1", "image 2, data:,broken"]
    assert ("image 1: 1 channels of 5 x 4 pixels (width x height)", 3 * 4 * 4 * 5) in needed
    assert materials[0].metallic_texture.image is materials[2].metallic_texture.image
    assert materials[3].metallic_texture is materials[4].roughness_texture is None
    np.testing.assert_allclose(materials[0].metallic_texture.image[..., 0], image[..., 2], atol=0.01)
    np.testing.assert_allclose(materials[1].roughness_texture.image[..., 0], image[::-1, :, 1], atol=0.01)


@pytest.mark.parametrize(
    ("count", "colors", "alpha"),
    [(1, [0.1] * 3, 1), (2, [0.1] * 3, 0.2), (3, [0.1, 0.2, 0.3], 1), (4, [0.1, 0.2, 0.3], 0.4)],
)
def test_channels_of_gray_images_are_equal_and_missing_alpha_is_one(count, colors, alpha):
    image = np.tile(np.arange(1, count + 1, dtype=np.float32) / 10, (2, 3, 1))
    np.testing.assert_allclose(store_channels(image, (0, 1, 2), "image"), np.tile(colors, (2, 3, 1)), rtol=1e-6)
    np.testing.assert_allclose(store_channels(image, (1,), "image"), np.full((2, 3, 1), colors[1]), rtol=1e-6)
    np.testing.assert_allclose(store_channels(image, (3,), "image"), np.full((2, 3, 1), alpha), rtol=1e-6)


def test_texture_transforms_move_either_set_of_coordinates_as_blender_does(tmp_path, close):
    writer = Writer()
    offset, angle, scale = np.array([0.1, 0.3]), 0.4, np.array([0.5, 0.7])
    moved = {"offset": offset.tolist(), "rotation": angle, "scale": scale.tolist(), "texCoord": 1}
    info = writer.texture(tmp_path, IMAGE, texCoord=0, extensions={"KHR_texture_transform": moved})
    writer.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": info}}]
    path = one(
        writer.square(material=0, TEXCOORD_0=PLACE, TEXCOORD_1=(65535 * CENTER).astype(np.uint16)), writer=writer
    ).write(tmp_path / "moved.glb")
    writer.header["accessors"][2]["normalized"] = True
    part = load_scene(writer.write(path)).parts[0]
    close(part.second, [[0, 1]] + CENTER * [[1, -1]], tolerance=1e-4)
    # glTF-Blender-IO, blender_default/texture_transform_gltf_to_blender: the offset for v up; the turn is plain.
    cosine, sine = np.cos(angle), np.sin(angle)
    shift = [offset[0] + scale[1] * sine, 1 - offset[1] - scale[1] * cosine]
    place = np.asarray(part.second) * scale @ np.array([[cosine, sine], [-sine, cosine]]) + shift
    texture = part.material.base_color_texture
    expected = texture.__class__(texture.image).at(jnp.asarray(place, jnp.float32))
    close(part.surface().base_color, expected, tolerance=1e-5)


def test_samplers_repeat_mirror_and_clamp(tmp_path):
    writer = Writer()
    info = writer.texture(tmp_path, IMAGE)
    writer.header["textures"][0]["sampler"] = writer.add("samplers", {"wrapS": 33648, "wrapT": 33071})
    writer.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": info}}]
    place = np.float32([[1.25, 9], [-0.25, -9], [2.25, 1 / 6], [-1.25, 0.5]])
    part = load_scene(one(writer.square(material=0, TEXCOORD_0=place), writer=writer).write(tmp_path / "a.glb")).parts[
        0
    ]
    expected = srgb(IMAGE[[2, 0, 0, 1], [1, 0, 0, 1], :3])
    np.testing.assert_allclose(part.surface().base_color, expected, atol=1e-5)
    writer.header["samplers"][0] = {"wrapS": 10496, "minFilter": 9728}
    with pytest.warns(UserWarning, match=r"ignored are nearest filters \(.*\), wrap mode 10496$"):
        load_scene(writer.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("mirrored", [False, True])
def test_normal_maps_without_tangents_have_them_along_the_image(tmp_path, mirrored):
    writer = Writer()
    info = writer.texture(tmp_path, np.full((2, 2, 3), [0.5, 1, 0.5]))  # The normal leans to the image's upper edge.
    writer.header["materials"] = [{"normalTexture": info}]
    # The image's upper edge is at -x, or its mirror image's.
    place = np.float32([[0, 0], [0, 1], [1, 1], [1, 0]]) * [-1 if mirrored else 1, 1]
    part = load_scene(one(writer.square(material=0, TEXCOORD_0=place), writer=writer).write(tmp_path / "a.glb")).parts[
        0
    ]
    x, y, z = np.moveaxis(np.asarray(part.surface().normal), -1, 0)
    mesh = part.mesh
    bitangent = np.cross(mesh.normal, mesh.tangent)
    world = x[:, None] * mesh.tangent + y[:, None] * bitangent + z[:, None] * mesh.normal
    np.testing.assert_allclose(world, [[-1, 0, 0]] * 4, atol=0.01)
    np.testing.assert_allclose(mesh.tangent[:, 1], -1 if mirrored else 1, atol=1e-6)


def test_cameras_stand_where_their_nodes_are(tmp_path, close):
    writer = one((writer := Writer()).square(), writer=writer)
    writer.header["cameras"] = [
        {"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 1.5, "znear": 1}},
        {"type": "orthographic", "orthographic": {}},
    ]
    writer.header["nodes"] = [
        {"mesh": 0, "children": [1]},
        {"matrix": TURN.T.ravel().tolist(), "camera": 0},
        {"camera": 1},
    ]
    writer.header["scenes"][0]["nodes"] = [0, 2]
    with pytest.warns(UserWarning, match="not supported and ignored are orthographic cameras$"):
        (camera,) = load_scene(writer.write(tmp_path / "camera.glb")).cameras
    close(camera.eye, np.array([3.0, 4, 5]))
    forward = np.asarray(camera.target - camera.eye)
    close(forward / np.linalg.norm(forward), np.array([0.0, 0, -1]), tolerance=1e-6)
    close(camera.up, np.array([-1.0, 0, 0]), tolerance=1e-6)
    assert (camera.width, camera.height, float(camera.field_of_view)) == (768, 512, pytest.approx(0.7))


def test_alpha_is_that_of_factor_texture_and_vertices(tmp_path):
    writer = Writer()
    image = np.concatenate([IMAGE[..., :3], np.full((*IMAGE.shape[:2], 1), 0.25)], -1)
    base = {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": writer.texture(tmp_path, image)}
    writer.header["materials"] = [
        {"alphaMode": "MASK", "alphaCutoff": 0.1, "doubleSided": True, "pbrMetallicRoughness": base},
        {"alphaMode": "BLEND", "pbrMetallicRoughness": base},
        {"pbrMetallicRoughness": base},
    ]
    color = np.tile(np.float32([1, 1, 1, 0.75]), (4, 1))
    one(*(writer.square(material=number, TEXCOORD_0=PLACE, COLOR_0=color) for number in range(3)), writer=writer)
    scene = load_scene(writer.write(tmp_path / "alpha.glb"))
    for part, (mode, back) in zip(
        scene.parts, [("mask", "lit"), ("blend", "hidden"), ("opaque", "hidden")], strict=True
    ):
        assert (part.material.alpha_mode, part.material.back) == (mode, back)
        if mode == "opaque":
            assert part.alpha is None
            assert part.material.alpha_texture is None
            continue
        np.testing.assert_allclose(part.alpha, 0.75, atol=1e-6)
        assert float(part.material.alpha) == 0.5
        np.testing.assert_allclose(part.material.alpha_texture.image, 64 / 255, atol=1e-6)
    writer.header["materials"][0]["alphaCutoff"] = -1
    with pytest.raises(ValueError, match="material 0: alpha_cutoff of TexturedMaterial must be at least 0"):
        load_scene(writer.write(tmp_path / "alpha.glb"))


def test_what_is_not_honored_is_said_once_by_name(tmp_path):
    writer = Writer()
    image = writer.texture(tmp_path, IMAGE)
    writer.header["materials"] = [
        {
            **{"alphaMode": "DITHER", "occlusionTexture": image, "emissiveTexture": image},
            "extensions": {"KHR_materials_iridescence": {}, "KHR_materials_ior": {}},
        }
    ]
    parts = [writer.square(material=0, COLOR_1=SQUARE) | {"targets": [{}]}, writer.square(mode=1)]
    one(*parts, writer=writer)
    writer.header |= {"animations": [{}], "extensionsUsed": ["KHR_animation_pointer"]}
    with pytest.warns(UserWarning, match="not supported and ignored") as caught:
        load_scene(writer.write(tmp_path / "much.glb"))
    (message,) = [str(each.message) for each in caught]
    expected = ["COLOR_1", "KHR_animation_pointer", "KHR_materials_iridescence", "alpha mode 'DITHER'"]
    expected += ["occlusion textures", "points and lines"]
    expected += ["textures of primitives without texture coordinates"]
    assert message.startswith(f"{tmp_path / 'much.glb'}: not supported and ignored are ")
    for each in expected:
        assert message.count(each) == 1, each
    assert "KHR_materials_ior" not in message


def test_buffers_and_images_are_read_from_files_beside(tmp_path):
    writer = Writer()
    info = writer.texture(tmp_path, IMAGE)
    writer.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": info}}]
    one(writer.square(material=0, TEXCOORD_0=CENTER), writer=writer)
    (tmp_path / "a folder").mkdir()
    (tmp_path / "a folder" / "all.bin").write_bytes(writer.data)
    write_png(tmp_path / "a folder" / "ima ge.png", IMAGE.astype(np.float32))
    header = writer.header | {"buffers": [{"byteLength": len(writer.data), "uri": "a%20folder/all.bin"}]}
    header["images"] = [{"uri": "a%20folder/ima%20ge.png"}]
    path = tmp_path / "beside.gltf"
    path.write_text(json.dumps(header))
    expected = srgb(TEXEL[:, :3])
    np.testing.assert_allclose(load_scene(path).parts[0].surface().base_color, expected, atol=1e-6)
    (tmp_path / "a folder" / "ima ge.png").unlink()
    with pytest.warns(UserWarning, match=r"cannot be read \(image 0, .*ima ge\.png, which does not exist\)"):
        assert load_scene(path).parts[0].material.base_color_texture is None
    assert len(load_mesh(path).position) == 4  # Which needs no images.
    (tmp_path / "a folder" / "all.bin").write_bytes(writer.data[:99])
    with pytest.raises(ValueError, match=rf"must have {len(writer.data)} bytes in buffer 0, got 99 bytes"):
        load_scene(path)
    (tmp_path / "a folder" / "all.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"all\.bin must be the file that .*beside\.gltf needs for buffer 0"):
        load_scene(path)


def test_all_textures_are_transformed_and_coats_and_transmission_are_read(tmp_path):
    """KHR_texture_transform on every texture of a material, its channels, and the factors of its layers."""
    writer = Writer()
    moved = {"KHR_texture_transform": {"offset": [0.25, 0.5], "scale": [2, 4], "texCoord": 1}}
    color = np.broadcast_to([0.2, 0.4, 0.6], (2, 2, 3))
    texture = writer.texture(tmp_path, color, extensions=moved)
    anisotropy = {"anisotropyStrength": 0.1, "anisotropyTexture": texture}
    coat = {"clearcoatFactor": 0.9, "clearcoatRoughnessFactor": 0.3, "clearcoatNormalTexture": texture}
    coat |= {"clearcoatTexture": texture, "clearcoatRoughnessTexture": texture}
    extension = {
        "KHR_materials_specular": {"specularTexture": texture, "specularColorTexture": texture},
        "KHR_materials_anisotropy": anisotropy,
        "KHR_materials_clearcoat": coat,
        "KHR_materials_transmission": {"transmissionFactor": 0.7, "transmissionTexture": texture},
        "KHR_materials_sheen": {"sheenColorTexture": texture, "sheenRoughnessTexture": texture},
    }
    pbr = {"baseColorTexture": texture, "metallicRoughnessTexture": texture}
    item = {"pbrMetallicRoughness": pbr, "normalTexture": texture, "emissiveTexture": texture, "extensions": extension}
    writer.header["materials"] = [item]
    one(writer.square(material=0, TEXCOORD_0=PLACE, TEXCOORD_1=PLACE), writer=writer)
    with pytest.warns(UserWarning, match="ignored are normal maps of clearcoats .*, refraction and blur"):
        material = load_scene(writer.write(tmp_path / "a.glb")).parts[0].material
    assert len(material.textures) == 13
    for each in material.textures:
        assert each.set == 1
        # With v up, image coordinates are (2 u + 0.25, 1 - (4 (1 - v) + 0.5)).
        np.testing.assert_allclose(each.transform, [[2, 0, 0.25], [0, 4, -3.5]], atol=1e-6)
    assert [float(x) for x in (material.clearcoat, material.clearcoat_roughness, material.transmission)] == [
        pytest.approx(value) for value in (0.9, 0.3, 0.7)
    ]
    for name, value in (("clearcoat", 0.2), ("clearcoat_roughness", 0.4), ("transmission", 0.2)):
        image = np.asarray(getattr(material, f"{name}_texture").image)
        np.testing.assert_allclose(image, np.full((2, 2, 1), value), atol=2e-3)


def test_sheens_are_read_and_left_out_under_clear_coats(tmp_path):
    writer = Writer()
    color = np.full((2, 2, 4), 0.5)
    color[..., 3] = 0.25
    texture = writer.texture(tmp_path, color)
    velvet = {"sheenColorFactor": [0.9, 0.5, 0.1], "sheenRoughnessFactor": 0.4}
    velvet |= {"sheenColorTexture": texture, "sheenRoughnessTexture": texture}
    both = {"KHR_materials_sheen": velvet, "KHR_materials_clearcoat": {"clearcoatFactor": 1.0}}
    writer.header["materials"] = [{"extensions": {"KHR_materials_sheen": velvet}}, {"extensions": both}]
    one(*(writer.square(material=n, TEXCOORD_0=PLACE) for n in (0, 1)), writer=writer)
    with pytest.warns(UserWarning, match="not supported and ignored are sheens under clearcoats$"):
        first, second = (part.material for part in load_scene(writer.write(tmp_path / "a.glb")).parts)
    np.testing.assert_allclose(first.sheen_color, [0.9, 0.5, 0.1], rtol=1e-6)
    assert float(first.sheen_roughness) == pytest.approx(0.4)
    linear = ((0.5 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(first.sheen_color_texture.image, np.full((2, 2, 3), linear), atol=4e-3)
    np.testing.assert_allclose(first.sheen_roughness_texture.image, np.full((2, 2, 1), 0.25), atol=4e-3)
    assert not np.any(second.sheen_color)


def lit() -> Writer:
    """A square and a light of each type; their nodes are turned, and below one that is moved and scaled."""
    writer = Writer()
    one(writer.square(), writer=writer)
    lights = [
        {"type": "point", "color": [1, 0.5, 0.25], "intensity": 3, "name": "bulb"},
        {"type": "spot", "intensity": 40, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.5}, "name": "bulb"},
        {"type": "directional", "color": [1, 1, 0.5], "intensity": 2, "name": "sun"},
        {"type": "spot", "spot": {}},
    ]
    turns = [[0, 0, 0, 1], [0.5, 0.5, -0.5, 0.5], [0.36, 0.48, 0, 0.8], [0, 0, 0.6, 0.8]]
    nodes = [
        {"translation": [number, 2, 3], "rotation": turn, "extensions": {LIGHTS: {"light": number}}}
        for number, turn in enumerate(turns)
    ]
    above = {"children": [2, 3, 4, 5], "translation": [10, 0, 0], "scale": [2, 2, 2]}
    writer.header["nodes"] = [{"mesh": 0}, above, *nodes]
    writer.header["scenes"][0]["nodes"] = [0, 1]
    writer.header |= {"extensions": {LIGHTS: {"lights": lights}}, "extensionsUsed": [LIGHTS]}
    return writer


def test_lights_are_those_of_three_js(tmp_path):
    path = lit().write(tmp_path / "a.glb")
    with pytest.warns(UserWarning, match=r"its directional lights \(1\) are in scene\.suns: jaxprt\.scene\.with_suns"):
        scene, dim = load_scene(path), load_scene(path, lights=1 / 683)
    assert [lamp.name for lamp in scene.point_lights] == ["bulb", "bulb 2", "light 3"]
    suns = [peer for peer in PEER if peer["type"] == "DirectionalLight"]
    lamps = [peer for peer in PEER if peer["type"] != "DirectionalLight"]
    for sun, peer in zip(scene.suns, suns, strict=True):
        np.testing.assert_allclose(sun.irradiance, np.multiply(peer["color"], peer["intensity"]), rtol=1e-6)
        np.testing.assert_allclose(sun.direction, np.negative(peer["target"]), atol=1e-6)
    for lamp, peer in zip(scene.point_lights, lamps, strict=True):
        np.testing.assert_allclose(lamp.position, peer["position"], atol=1e-6)
        np.testing.assert_allclose(lamp.intensity, np.multiply(peer["color"], peer["intensity"]), rtol=1e-6)
        assert (lamp.axis is None) == (peer["type"] == "PointLight")
        if lamp.axis is not None:
            np.testing.assert_allclose(lamp.axis, peer["target"], atol=1e-6)
            np.testing.assert_allclose(lamp.cone, [peer["angle"] * (1 - peer["penumbra"]), peer["angle"]], atol=1e-6)
    np.testing.assert_allclose(dim.suns[0].irradiance, [2 / 683, 2 / 683, 1 / 683], rtol=1e-6)
    assert not load_scene(path, lights=0).point_lights


DAMAGE = {
    r"must refer to one of its 4 lights in node 2, got 4": lambda h, _: h["nodes"][2].update(
        extensions={LIGHTS: {"light": 4}}
    ),
    r"must have a string for type of light 0, got 3": lambda _, lights: lights[0].update(type=3),
    r"a finite number for intensity of light 1, got nan": lambda _, lights: lights[1].update(intensity=np.nan),
    r"must have an intensity and a color of at least 0 in light 0": lambda _, lights: lights[0].update(intensity=-1),
    r"from 0 to pi / 2 in light 1, got 0\.6 and 0\.5": lambda _, lights: lights[1]["spot"].update(innerConeAngle=0.6),
    r"must have a scale above 0 in node 4 of light 2": lambda h, _: h["nodes"][4].update(scale=[1, 1, 0]),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_damaged_lights_are_refused(tmp_path, message):
    writer = lit()
    DAMAGE[message](writer.header, writer.header["extensions"][LIGHTS]["lights"])
    with pytest.raises(ValueError, match=rf"a\.glb {message}|a\.glb.*{message}"):
        load_scene(writer.write(tmp_path / "a.glb"))


def test_what_is_not_read_of_lights_is_named_once(tmp_path):
    writer = lit()
    lights = writer.header["extensions"][LIGHTS]["lights"]
    del lights[2]["type"]
    lights[2]["type"], lights[0]["range"], lights[1]["range"] = "area", 5, 6
    message = r"ignored are lights of type 'area', ranges of lights \(their light decreases with the squared distance"
    with pytest.warns(UserWarning, match=message):
        scene = load_scene(writer.write(tmp_path / "a.glb"))
    assert not scene.suns


def test_indices_beyond_the_vertices_are_refused(tmp_path):
    writer = one((writer := Writer()).square(face=np.array([0, 1, 2, 0, 2, 9], np.uint8)), writer=writer)
    message = r"refer to vertices 0 to 3 in indices of primitive 0 of mesh 0, got 1 of 6 .* first is 9 at 5"
    with pytest.raises(ValueError, match=message):
        load_scene(writer.write(tmp_path / "far.glb"))
