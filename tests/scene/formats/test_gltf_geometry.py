"""Geometry of glTF files: flat normals, instances, skins, and sizes."""

import json
import sys

import numpy as np
import pytest
import scipy.spatial
import trimesh

from jaxprt import require
from jaxprt.files import write_png
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats.gltf_file import Elements
from tests.scene.formats.gltf_writer import FACE, PLACE, SQUARE, Writer, one

# A closed octahedron with shared vertices; no two of its faces have the same normal.
CORNER = np.float32([[1, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 3], [0, 0, -3]])
SIDES = np.uint16([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
Rotation = scipy.spatial.transform.Rotation
TILT = Rotation.from_rotvec([0.3, -0.7, 0.2])


def octahedron(writer, **attribute):
    return writer.square(POSITION=CORNER, NORMAL=None, face=SIDES.ravel(), **attribute)


def triangles(mesh):
    return np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)]


def face_normals(mesh):
    corner = triangles(mesh)
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


def volume(mesh):
    corner = triangles(mesh)
    return np.linalg.det(corner).sum() / 6


@pytest.mark.parametrize("scale", [[2, 0.5, 1], [1, -1, 1]])
def test_triangles_without_normals_are_flat_and_keep_all_attributes(tmp_path, scale):
    random = np.random.default_rng(0)
    place, second, color = random.random((6, 2)), random.random((6, 2)), random.random((6, 3))
    writer = Writer()
    # A normal map asks for tangents: those of the file are along -x and are ignored, section 3.7.2.1.
    info = writer.texture(tmp_path, np.full((2, 2, 3), 0.5), texCoord=1)
    writer.header["materials"] = [{"normalTexture": info}]
    field = {"TEXCOORD_0": place, "TEXCOORD_1": second, "COLOR_0": color, "TANGENT": np.tile([-1.0, 0, 0, -1], (6, 1))}
    one(octahedron(writer, material=0, **field), writer=writer)
    writer.header["nodes"][0] |= {"scale": scale, "rotation": TILT.as_quat().tolist()}
    part = load_scene(writer.write(tmp_path / "flat.glb")).parts[0]
    mesh = part.mesh
    assert mesh.face.shape == (8, 3)
    assert len(mesh.position) == 24
    normal = np.asarray(mesh.normal)[np.asarray(mesh.face)]
    np.testing.assert_allclose(normal, np.repeat(face_normals(mesh)[:, None], 3, 1), atol=1e-6)
    assert volume(mesh) == pytest.approx(8 * np.prod(np.abs(scale)), rel=1e-5)  # 8 = 4/3 x 1 x 2 x 3
    sides = SIDES[:, :: int(np.sign(np.prod(scale)))].ravel()
    corner = np.asarray(mesh.face).ravel()
    expected = CORNER[sides] * scale @ TILT.as_matrix().T
    np.testing.assert_allclose(np.asarray(mesh.position)[corner], expected, atol=1e-6)
    down = [[0, 1]] + np.float32(place) * [[1, -1]]
    np.testing.assert_allclose(np.asarray(mesh.texture)[corner], down[sides], atol=1e-6)
    down = [[0, 1]] + np.float32(second) * [[1, -1]]
    np.testing.assert_allclose(np.asarray(part.second)[corner], down[sides], atol=1e-6)
    np.testing.assert_allclose(np.asarray(part.color)[corner], color[sides], atol=1e-6)
    edge = np.asarray(mesh.tangent)
    assert np.abs(edge @ (TILT.as_matrix() @ [-1, 0, 0])).min() < 0.9  # not those of the file


def instanced(writer, attribute, **node):
    """A file whose node repeats its mesh."""
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attribute}}
    writer.header["nodes"][0] |= {"extensions": extension, **node}
    writer.header |= {key: ["EXT_mesh_gpu_instancing"] for key in ("extensionsUsed", "extensionsRequired")}
    return writer


@pytest.mark.parametrize("kind", ["f4", "i2", "i1"])
def test_instances_are_placed_by_their_transforms_and_that_of_their_node(tmp_path, kind):
    random = np.random.default_rng(1)
    shift = random.normal(size=(5, 3)).astype(np.float32)
    scale = np.float32([[1, 1, 1], [2, 1, 0.5], [1, -2, 1], [-1, -1, 1], [-3, -1, -1]])
    quaternion = Rotation.random(5, random_state=2).as_quat()
    writer = one(octahedron(writer := Writer()), writer=writer)
    if kind == "f4":
        rotation = writer.accessor(quaternion.astype(np.float32))
    else:
        quaternion = np.round(quaternion * np.iinfo(kind).max).astype(kind)
        rotation = writer.accessor(quaternion, normalized=True)
    attribute = {"TRANSLATION": writer.accessor(shift), "ROTATION": rotation, "SCALE": writer.accessor(scale)}
    attribute["_ID"] = writer.accessor(np.arange(5, dtype=np.float32))
    instanced(writer, attribute, translation=[1, 2, 3], rotation=TILT.as_quat().tolist())
    path = writer.write(tmp_path / "instances.glb")
    mesh = load_scene(path).parts[0].mesh
    np.testing.assert_array_equal(load_mesh(path).position, mesh.position)
    corner = triangles(mesh).reshape(5, 8, 3, 3)
    assert len(corner) == 5
    for number in range(5):
        turn = Rotation.from_quat(quaternion[number].astype(float))
        local = turn.apply(CORNER * scale[number]) + shift[number]
        side = SIDES[:, :: int(np.sign(np.prod(scale[number])))]
        np.testing.assert_allclose(corner[number], (TILT.apply(local) + [1, 2, 3])[side], atol=1e-5)
    assert volume(mesh) == pytest.approx(8 * np.abs(np.prod(scale, 1)).sum(), rel=1e-5)
    normal = np.asarray(mesh.normal)[np.asarray(mesh.face)]
    np.testing.assert_allclose(normal, np.repeat(face_normals(mesh)[:, None], 3, 1), atol=1e-5)


def test_instances_may_have_some_of_the_attributes_and_other_nodes_none(tmp_path):
    shift = np.float32([[0, 0, 0], [5, 0, 0], [0, 5, 0]])
    writer = one((writer := Writer()).square(), writer=writer)
    instanced(writer, {"TRANSLATION": writer.accessor(shift)})
    writer.header["nodes"].append({"mesh": 0, "translation": [0, 0, 9]})
    writer.header["scenes"] = [{"nodes": [0, 1]}]
    writer.header.pop("extensionsUsed")  # honored where it stands, declared or not
    writer.header.pop("extensionsRequired")
    mesh = load_mesh(writer.write(tmp_path / "a.glb"), groups=True)
    expected = np.concatenate([SQUARE + each for each in [*shift, np.float32([0, 0, 9])]])
    np.testing.assert_array_equal(mesh.position, expected)
    np.testing.assert_array_equal(mesh.region, [0] * 12 + [1] * 4)
    instanced(writer, {"SCALE": writer.accessor(np.float32([[2, 2, 2]]))})
    np.testing.assert_array_equal(load_mesh(writer.write(tmp_path / "a.glb")).position[:4], 2 * SQUARE)


@pytest.mark.parametrize(
    ("attribute", "message"),
    [
        ({}, "must have TRANSLATION, ROTATION or SCALE in EXT_mesh_gpu_instancing of node 0, got none"),
        ({"ROTATION": np.zeros((2, 4))}, "nonzero quaternions in ROTATION .* got 2 of 2 .* first is .* at 0"),
        (
            {"SCALE": np.full((2, 3), np.nan)},
            "finite numbers in SCALE of EXT_mesh_gpu_instancing of node 0, got 2 of 2",
        ),
        ({"ROTATION": np.ones((2, 3))}, r"must have 4 numbers per element in accessor \d \(ROTATION of"),
        ([1], "must have an object for attributes of EXT_mesh_gpu_instancing of node 0"),
    ],
)
def test_damaged_instances_are_refused(tmp_path, attribute, message):
    writer = one((writer := Writer()).square(), writer=writer)
    if isinstance(attribute, dict):
        attribute = {key: writer.accessor(value) for key, value in attribute.items()}
    instanced(writer, attribute)
    with pytest.raises(ValueError, match=f"a.glb {message}" if message.startswith("must") else message):
        load_scene(writer.write(tmp_path / "a.glb"))


def read(writer, folder):
    """The only part of a file."""
    (part,) = load_scene(writer.write(folder / "a.glb")).parts
    return part


@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize(("key", "value"), [("COLOR_0", np.tile([0.2, 0.4, 0.6], (4, 1))), ("TEXCOORD_0", PLACE)])
def test_integers_that_should_be_normalized_are_read_so_with_a_warning(tmp_path, kind, key, value):
    most = np.iinfo(kind).max
    writer = Writer()
    one(writer.square(**{key: writer.accessor((value * most).astype(kind))}), writer=writer)
    with pytest.warns(UserWarning, match=rf"ignored are {key} of integers without normalized \(they are read as norm"):
        part = read(writer, tmp_path)
    writer.header["accessors"][0]["normalized"] = True
    same = read(writer, tmp_path)
    for shown in (part, same):
        got = shown.color if key == "COLOR_0" else np.asarray(shown.mesh.texture) * [1, -1] + [0, 1]
        np.testing.assert_allclose(got, value, atol=1 / most)


def test_what_is_not_read_of_primitives_is_named(tmp_path):
    writer = Writer()
    primitive = writer.square(COLOR_0=np.full((4, 3), 200.0), UV=PLACE, _OWN=PLACE, TEXCOORD_2=PLACE)
    one(primitive | {"targets": [{"TEXCOORD_1": 0, "POSITION": 0, "NORMAL": 0}]}, writer=writer)
    writer.header["skins"] = [{"joints": [0]}]
    writer.header["nodes"][0] |= {"skin": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}
    expected = r"COLOR_0 beyond 0 to 1 \(colors are clipped\), KHR_node_visibility, TEXCOORD_1 of morph targets, "
    expected += "TEXCOORD_2, UV, skins of primitives without JOINTS_0 and WEIGHTS_0"
    with pytest.warns(UserWarning, match=rf"not supported and ignored are {expected}$"):
        read(writer, tmp_path)


FLATTENED = {"scale": [0, 0, 0]}, {"scale": [1, 0, 1]}, {"scale": [0, 3, 0]}, {"matrix": [0.0] * 16}


@pytest.mark.parametrize("flattened", FLATTENED)
def test_faces_that_a_node_scales_to_nothing_are_left_out(tmp_path, flattened):
    writer = one((writer := Writer()).square(), writer=writer)
    turned = {"rotation": TILT.as_quat().tolist(), "translation": [50, 60, 70], "children": [2]}
    writer.header["nodes"] = [{"mesh": 0}, turned, {"mesh": 0} | flattened]
    writer.header["scenes"][0]["nodes"] = [0, 1]
    np.testing.assert_array_equal(read(writer, tmp_path).mesh.position, SQUARE)
    writer.header["scenes"][0]["nodes"] = [1]
    message = r"a\.glb must hold faces with an area, got 2 that nodes or joints scale to nothing"
    with pytest.raises(ValueError, match=message):
        read(writer, tmp_path)


def test_required_extensions_that_are_not_known_are_refused_by_name_and_optional_ones_are_warned_of(tmp_path):
    writer = one((writer := Writer()).square(), writer=writer)
    path = tmp_path / "a.glb"
    for name in ("EXT_lights_image_based", "EXT_texture_avif", "VENDOR_anything"):
        writer.header |= {"extensionsUsed": [name, name], "extensionsRequired": [name]}
        with pytest.raises(ValueError, match=f"a.glb must not require extensions other than .*, got {name}$"):
            load_scene(writer.write(path))
        writer.header["extensionsRequired"] = []
        with pytest.warns(UserWarning, match=f"a.glb: not supported and ignored are {name}$"):
            load_scene(writer.write(path))
    # Geometry alone needs no textures or lights, but it may need what nobody knows.
    writer.header["extensionsRequired"] = ["EXT_lights_image_based", "EXT_texture_avif", "KHR_materials_unlit"]
    assert len(load_mesh(writer.write(path)).position) == 4
    writer.header["extensionsRequired"] = ["VENDOR_anything"]
    with pytest.raises(ValueError, match="VENDOR_anything"):
        load_mesh(writer.write(path))
    # Other looks of materials are named where a material has them.
    writer.header |= {"extensionsUsed": ["KHR_materials_unlit"], "extensionsRequired": ["KHR_materials_unlit"]}
    assert len(load_scene(writer.write(path)).parts) == 1
    writer.header["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
    writer.header["meshes"][0]["primitives"][0]["material"] = 0
    with pytest.warns(UserWarning, match=r"a\.glb: not supported and ignored are KHR_materials_unlit$"):
        load_scene(writer.write(path))
    del writer.header["meshes"][0]["primitives"][0]["material"]
    # What is read without them is right.
    writer.header |= {"extensionsUsed": [], "extensionsRequired": ["KHR_mesh_quantization", "KHR_texture_transform"]}
    assert len(load_scene(writer.write(path)).parts) == 1


def skinned(writer, joint, weight, inverse, **more):
    """A file with a skinned square in node 0 and two joints: nodes 1 and 2, of which the second turns at (1, 0, 0)."""
    half = np.sqrt(0.5)
    item = writer.square(JOINTS_0=writer.accessor(joint), WEIGHTS_0=writer.accessor(weight), **more)
    one(item, writer=writer)
    writer.header["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [99, 98, 97], "scale": [-5, 5, 5]},
        {"translation": [0, 0, 4], "children": [2]},
        {"translation": [1, 0, 0], "rotation": [0, 0, half, half]},
    ]
    writer.header["skins"] = [{"joints": [1, 2]}]
    if inverse is not None:
        columns = np.float32(inverse).transpose(0, 2, 1).reshape(-1, 16)
        writer.header["skins"][0]["inverseBindMatrices"] = writer.accessor(columns)
    writer.header["scenes"] = [{"nodes": [0, 1]}]
    return writer


JOINT = np.uint8([[0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
WEIGHT = np.float32([[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [2, 6, 0, 0]])
SHIFTED = np.tile(np.eye(4), (2, 1, 1))
SHIFTED[1, 0, 3] = -1  # the second joint stood at (1, 0, 0) when the mesh was bound


def test_skinned_meshes_have_the_pose_of_their_joints_and_not_the_place_of_their_node(tmp_path):
    writer = skinned(Writer(), JOINT, WEIGHT, SHIFTED, TEXCOORD_0=PLACE)
    path = writer.write(tmp_path / "skin.glb")
    with np.errstate(all="raise"):
        scene = load_scene(path)  # without a warning
    # The first joint only lifts by 4. The second turns by a quarter about (1, 0): (x, y) becomes (1 - y, x - 1).
    lifted, turned = SQUARE + [0, 0, 4], np.stack([1 - SQUARE[:, 1], SQUARE[:, 0] - 1, 0 * SQUARE[:, 0] + 4], 1)
    share = np.array([[0], [1], [0.5], [0.75]])  # of the second joint; weights 2 and 6 are a quarter and three
    expected = lifted * (1 - share) + turned * share
    for mesh in (scene.parts[0].mesh, load_mesh(path)):
        np.testing.assert_allclose(mesh.position, expected, atol=1e-6)
        np.testing.assert_allclose(mesh.normal, [[0, 0, 1]] * 4, atol=1e-6)
        np.testing.assert_array_equal(mesh.face, FACE.reshape(-1, 3))
    # Without inverse bind matrices they are the identity.
    writer = skinned(Writer(), JOINT, WEIGHT, None)
    turned = np.stack([1 - SQUARE[:, 1], SQUARE[:, 0], 0 * SQUARE[:, 0] + 4], 1)
    expected = lifted * (1 - share) + turned * share
    np.testing.assert_allclose(load_mesh(writer.write(path)).position, expected, atol=1e-6)


def test_further_sets_of_joints_count_and_vertices_without_weights_follow_their_first_joint(tmp_path):
    writer = skinned(Writer(), 0 * JOINT, 0 * WEIGHT, SHIFTED)
    item = writer.header["meshes"][0]["primitives"][0]["attributes"]
    item["JOINTS_1"] = writer.accessor(np.uint16(JOINT))
    item["WEIGHTS_1"] = writer.accessor(
        np.uint8([[0, 0, 0, 0], [0, 0, 0, 0], [255, 255, 0, 0], [51, 153, 0, 0]]), normalized=True
    )
    lifted, turned = SQUARE + [0, 0, 4], np.stack([1 - SQUARE[:, 1], SQUARE[:, 0] - 1, 0 * SQUARE[:, 0] + 4], 1)
    share = np.array([[0], [0], [0.5], [0.75]])
    found = load_mesh(writer.write(tmp_path / "a.glb")).position
    np.testing.assert_allclose(found, lifted * (1 - share) + turned * share, atol=1e-6)


def test_normals_tangents_and_flat_normals_turn_with_the_skin(tmp_path):
    writer = Writer()
    write_png(tmp_path / "a.png", np.full((2, 2, 3), 0.5, np.float32))
    normal, tangent = np.tile(np.float32([0.6, 0, 0.8]), (4, 1)), np.tile(np.float32([0.8, 0, -0.6, 1]), (4, 1))
    all_second = np.uint8([[1, 0, 0, 0]] * 4), np.float32([[1, 0, 0, 0]] * 4)
    skinned(writer, *all_second, SHIFTED, NORMAL=normal, TANGENT=tangent)
    writer.header["nodes"][2]["scale"] = [1, 1, -2]  # mirrored by its joint
    part = load_scene(writer.write(tmp_path / "a.glb")).parts[0]
    # (x, y, z) becomes (1 - y, x - 1, 4 - 2 z); normals go by the inverse: (0.6, 0, 0.8) to (0, 0.6, -0.4).
    expected = np.array([0, 0.6, -0.4]) / np.hypot(0.6, 0.4)
    np.testing.assert_allclose(part.mesh.normal, [expected] * 4, atol=1e-6)
    expected = np.array([0, 0.8, 1.2]) / np.hypot(0.8, 1.2)
    np.testing.assert_allclose(part.mesh.tangent, [expected] * 4, atol=1e-6)
    np.testing.assert_array_equal(part.handedness, [-1] * 4)
    assert (face_normals(part.mesh) @ [0, 0.6, -0.4] > 0).all()  # fronts stay outside
    skinned(
        writer := Writer(),
        JOINT,
        WEIGHT,
        SHIFTED,
        POSITION=SQUARE + np.float32([[0, 0, 1], [0] * 3, [0] * 3, [0] * 3]),
        NORMAL=None,
    )
    mesh = load_mesh(writer.write(tmp_path / "a.glb"))
    assert len(mesh.position) == 6
    flat = np.repeat(face_normals(mesh)[:, None], 3, 1)
    np.testing.assert_allclose(np.asarray(mesh.normal)[np.asarray(mesh.face)], flat, atol=1e-6)
    # Flat normals of mirrored triangles are those of their fronts.
    skinned(writer := Writer(), *all_second, SHIFTED, NORMAL=None)
    writer.header["nodes"][2]["scale"] = [-1, 1, 1]
    mesh = load_mesh(writer.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(face_normals(mesh), [[0, 0, 1]] * 2, atol=1e-6)
    np.testing.assert_allclose(mesh.normal, [[0, 0, 1]] * 6, atol=1e-6)


def test_of_the_nodes_outside_of_the_scene_only_joints_and_their_ancestors_are_read(tmp_path):
    writer = skinned(Writer(), JOINT, WEIGHT, SHIFTED)
    writer.header["scenes"] = [{"nodes": [0]}]
    path = writer.write(tmp_path / "a.glb")
    expected = load_mesh(path).position
    half = np.sqrt(0.5)
    writer.header["nodes"][1]["children"] = [2, 99]
    writer.header["nodes"] += [
        {"children": 5, "rotation": [0, 0, 0, 0]},
        {"children": [-1, 99, "a"]},
        {"translation": [0, 0, 3], "children": [6]},
        {"translation": [0, 0, 1], "children": [7]},
        {"translation": [1, 0, 0], "rotation": [0, 0, half, half]},
    ]
    np.testing.assert_array_equal(load_mesh(writer.write(path)).position, expected)
    writer.header["skins"][0]["joints"] = [6, 7]  # they stand where nodes 1 and 2 do
    np.testing.assert_allclose(load_mesh(writer.write(path)).position, expected, atol=1e-6)
    writer.header["nodes"][7]["children"] = [5]
    with pytest.raises(
        ValueError, match=r"a\.glb must have joints of skin 0 that belong to trees of nodes, got node 6"
    ):
        load_mesh(writer.write(path))
    writer.header["nodes"][7]["children"] = [6]
    with pytest.raises(ValueError, match=r"nodes that form trees, got node 6 twice, the second time in node 7"):
        load_mesh(writer.write(path))


@pytest.mark.parametrize(
    ("joint", "weight", "inverse", "message"),
    [
        (JOINT + 1, WEIGHT, SHIFTED, "refer to joints 0 to 1 in primitive 0 of mesh 0, got 3 of 4 vertices"),
        (JOINT, -WEIGHT, SHIFTED, "weights of joints of at least 0 in primitive 0 of mesh 0, got 4 of 4"),
        (JOINT, WEIGHT, SHIFTED[:1], "an inverse bind matrix for each of the 2 joints of skin 0, got 1"),
        (JOINT, WEIGHT, SHIFTED * np.nan, "finite inverse bind matrices in skin 0"),
    ],
)
def test_damaged_skins_are_refused(tmp_path, joint, weight, inverse, message):
    writer = skinned(Writer(), joint, weight, inverse)
    with pytest.raises(ValueError, match=f"a.glb must (have )?{message}"):
        load_mesh(writer.write(tmp_path / "a.glb"))


def test_a_real_fox_has_the_vertices_of_its_pose(data):
    path = data / "foreign/Fox.glb"
    mesh = load_scene(path).parts[0].mesh
    # trimesh has the transforms of nodes by name, and the raw accessors; the sum over joints is by hand.
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    header, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    graph = trimesh.load_scene(path, process=False).graph
    names = [header["nodes"][joint]["name"] for joint in header["skins"][0]["joints"]]

    def raw(index, kind, width):
        item = header["accessors"][index]
        view = header["bufferViews"][item["bufferView"]]
        start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
        return np.frombuffer(binary, kind, item["count"] * width, start).reshape(-1, width)

    attribute = header["meshes"][0]["primitives"][0]["attributes"]
    inverse = raw(header["skins"][0]["inverseBindMatrices"], "<f4", 16).reshape(-1, 4, 4).transpose(0, 2, 1)
    pose = np.array([graph[name][0] for name in names]) @ inverse
    position, joint = raw(attribute["POSITION"], "<f4", 3), raw(attribute["JOINTS_0"], "<u2", 4)
    weight = raw(attribute["WEIGHTS_0"], "<f4", 4)
    expected = [
        sum(w * (pose[j] @ [*p, 1]) for j, w in zip(joints, weights, strict=True))[:3] / weights.sum()
        for p, joints, weights in zip(position.astype(float), joint, weight.astype(float), strict=True)
    ]
    np.testing.assert_allclose(np.asarray(mesh.position)[np.asarray(mesh.face).ravel()], expected, atol=1e-4)


def test_zeros_without_a_buffer_view_are_bounded_by_the_size_of_the_file(tmp_path):
    writer = one((writer := Writer()).square(), writer=writer)
    zero = writer.add("accessors", {"componentType": 5126, "count": 4, "type": "VEC3"})
    writer.header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = zero
    path = tmp_path / "a.glb"
    np.testing.assert_array_equal(load_scene(writer.write(path)).parts[0].color, np.zeros((4, 3)))
    writer.header["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = zero
    for count in (2**28, 2**40, 2**53):
        for sparse in ({}, {"sparse": {"count": 1, "indices": {"bufferView": 0, "componentType": 5121}, "values": {}}}):
            writer.header["accessors"][zero] = {"componentType": 5126, "count": count, "type": "VEC3", **sparse}
            size = writer.write(path).stat().st_size
            must = (
                rf"buffer view for accessor {zero} \(POSITION .*\), or at most {size} elements.*, got {count} elements"
            )
            with pytest.raises(ValueError, match=must):
                load_scene(path)
    (tmp_path / "more.bin").write_bytes(bytes(9000))
    writer.header["buffers"] = [{"byteLength": 9000, "uri": "more.bin"}]
    size = writer.write(path).stat().st_size + 9000
    with pytest.raises(ValueError, match=f"at most {size} elements"):
        load_scene(path)


def repeated_by_nodes(writer):
    writer.header["nodes"] = [{"mesh": 0}] * 2000
    writer.header["scenes"] = [{"nodes": list(range(2000))}]
    return 8000, 4000, 2000


def repeated_by_instances(writer):
    instanced(writer, {"SCALE": writer.add("accessors", {"componentType": 5121, "count": 2000, "type": "VEC3"})})
    writer.data += bytes(2000)
    return 8000, 4000, 2000


def repeated_by_primitives(writer):
    writer.header["meshes"][0]["primitives"] *= 500
    return 2000, 1000, 1


@pytest.mark.parametrize("repeat", [repeated_by_nodes, repeated_by_instances, repeated_by_primitives])
def test_geometry_that_does_not_fit_into_memory_is_refused_before_it_is_read(tmp_path, monkeypatch, repeat):
    writer = one((writer := Writer()).square(), writer=writer)
    vertices, faces, meshes = repeat(writer)
    path = writer.write(tmp_path / "many.glb")
    monkeypatch.setattr(require, "available_memory", lambda: 500_000)
    monkeypatch.setattr(Elements, "numbers", lambda *_: pytest.fail("read"))
    message = (
        rf"up to {vertices:,} vertices and {faces:,} triangles in {meshes:,} meshes of .*many\.glb take .* GB, and"
    )
    for load in (load_scene, load_mesh):
        with pytest.raises(MemoryError, match=message):
            load(path)


def test_primitives_that_share_one_array_of_vertices_read_only_their_own(tmp_path, monkeypatch):
    count = 300
    position = np.random.default_rng(0).random((3 * count, 3)).astype(np.float32)
    writer = Writer()
    place, normal = writer.accessor(position), writer.accessor(np.tile(np.float32([0, 0, 1]), (3 * count, 1)))
    corner = np.arange(3 * count, dtype=np.uint16)[::-1].reshape(count, 3)
    items = [writer.square(POSITION=place, NORMAL=normal, face=three) for three in corner]
    rows, numbers = [], Elements.numbers
    monkeypatch.setattr(Elements, "numbers", lambda self, index: rows.append(len(index)) or numbers(self, index))
    mesh = load_mesh(one(*items, writer=writer).write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(triangles(mesh), position[corner])
    assert sum(rows) == 2 * 3 * count


def calls(function, *arguments):
    """Number of functions, of Python and of C, that a call runs."""
    count = 0

    def step(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(step)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return count


def with_nodes(writer, count):
    writer.header["nodes"] = [{"mesh": 0, "translation": [number, 0, 0]} for number in range(count)]
    writer.header["scenes"] = [{"nodes": list(range(count))}]


def with_a_chain(writer, count):
    writer.header["nodes"] = [{"children": [number + 1]} for number in range(count)] + [{"mesh": 0}]


def with_meshes(writer, count):
    with_nodes(writer, count)
    (item,) = writer.header["meshes"][0]["primitives"]
    accessor, view = writer.header["accessors"][0], writer.header["bufferViews"][0]
    writer.header["meshes"] = []
    for number in range(count):
        own = writer.add("accessors", accessor | {"bufferView": writer.add("bufferViews", view)})
        writer.add("meshes", {"primitives": [item | {"attributes": item["attributes"] | {"POSITION": own}}]})
        writer.header["nodes"][number]["mesh"] = number


@pytest.mark.parametrize("change", [with_nodes, with_a_chain, with_meshes])
def test_the_work_is_in_proportion_to_the_objects_of_a_file(tmp_path, unchecked, change):
    work = []
    for count in (100, 400):
        writer = one((writer := Writer()).square(), writer=writer)
        change(writer, count)
        path = writer.write(tmp_path / "a.glb")
        load_scene(path)  # compiled programs and the like
        work.append(calls(load_scene, path))
    assert work[1] < 4.2 * work[0]


def test_a_missing_buffer_that_nothing_uses_does_no_harm_and_is_not_read_for_zeros(tmp_path):
    writer = one((writer := Writer()).square(), writer=writer)
    zero = writer.add("accessors", {"componentType": 5126, "count": 4, "type": "VEC3"})
    writer.header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = zero
    uris = ("missing.bin", "../outside.bin", "http://a/b", "a" * 300, "a\0b", "", 3)
    writer.header["buffers"] = [{"byteLength": 9000, "uri": uri} for uri in uris]
    part = load_scene(writer.write(tmp_path / "a.glb")).parts[0]
    np.testing.assert_array_equal(part.color, np.zeros((4, 3)))


def test_a_chain_of_ten_thousand_nodes_adds_up(tmp_path):
    writer = one((writer := Writer()).square(), writer=writer)
    with_a_chain(writer, 10_000)
    for number, node in enumerate(writer.header["nodes"]):
        node["translation"] = [1, number % 2, 0]
    mesh = load_mesh(writer.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(mesh.position + np.asarray(mesh.origin), SQUARE + [10_001, 5000, 0])
    for node in writer.header["nodes"]:
        node["scale"] = [2, 2, 2]
    with pytest.raises(ValueError, match=r"finite transforms to world coordinates, got .* at node \d+"):
        load_mesh(writer.write(tmp_path / "a.glb"))


def test_quantized_texture_coordinates_are_whole_numbers(tmp_path):
    writer = Writer()
    one(writer.square(TEXCOORD_0=writer.accessor((3 * PLACE).astype(np.uint8))), writer=writer)
    writer.header["extensionsUsed"] = ["KHR_mesh_quantization"]
    np.testing.assert_array_equal(read(writer, tmp_path).mesh.texture, [0, 1] + PLACE * [3, -3])


def test_nodes_without_a_skin_show_the_same_mesh_where_they_are(tmp_path):
    writer = skinned(Writer(), JOINT, WEIGHT, SHIFTED)
    writer.header["nodes"].append({"mesh": 0, "translation": [7, 0, 0]})
    writer.header["scenes"] = [{"nodes": [3, 0]}]  # joints outside of the scene count too
    mesh = load_mesh(writer.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(mesh.position[:4], SQUARE + [7, 0, 0])
    np.testing.assert_allclose(mesh.position[4], [0, 0, 4], atol=1e-6)
