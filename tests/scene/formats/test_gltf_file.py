"""The container of glTF files: damage, of fields, images and bytes, and compressed data.

Damaged glTF files: fields of wrong types, images that cannot be read, and random damage.

Compressed geometry and textures of glTF files: Draco, meshoptimizer, KTX 2 and WebP, made by their own encoders.
"""

import base64
import codecs
import copy
import json
import pathlib
import random
import resource
import struct
import sys
import warnings
from typing import Any

import DracoPy
import meshopt
import numpy as np
import OpenImageIO
import pytest

from jaxprt import require
from jaxprt.files import images, read_image
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats.gltf_geometry import mesh_counts
from tests.scene.formats.gltf_writer import FACE, PLACE, SQUARE, Writer, one

NAN = float("nan")
DRACO, MESHOPT = "KHR_draco_mesh_compression", "KHR_meshopt_compression"
QUANTIZED = 2e-4  # Draco's 14 bits over a square of edge 1, normals of 10 bits
# 12 x 8 texels of (40 + 15 x, 90, 200 - 10 x) in column x, with alpha 128 from column 4 on or none, by basisu 2.10.
ETC1S = """
q0tUWCAyMLsNChoKAAAAAAEAAAAMAAAACAAAAAAAAAAAAAAAAQAAAAEAAAABAAAAaAAAADwAAACkAAAAJAAAAMgAAAAAAAAAlgAAAAAAAABeAQAAAAAA
AAUAAAAAAAAAAAAAAAAAAAA8AAAAAAAAAAIAOACjAQIAAwMAAAgIAAAAAAAAAAA/AAAAAAAAAAAA/////0AAPw8AAAAAAAAAAP////8fAAAAS1RYd3Jp
dGVyAEJhc2lzIFVuaXZlcnNhbCAyLjEwAAAFAAIAMgAAAAkAAAAzAAAAAAAAAAAAAAAAAAAAAgAAAAIAAAADAAAACMAMAAAAAAAAkjiAKAACAACAoJ4/
GoEcwAwAAAAAABDEW74AMAEAAAAAAIDAhYyoNQAsLS0tVVVVVQXgwEQAAAAAABCEmvAOEwATAAQAAAAgkDMERA4QAAAAAqbk4WkEoxwBMAMAAAAAAIAE
IACCAZa3xg==
"""
UASTC = """
q0tUWCAyMLsNChoKAAAAAAEAAAAMAAAACAAAAAAAAAAAAAAAAQAAAAEAAAAAAAAAaAAAACwAAACUAAAALAAAAAAAAAAAAAAAAAAAAAAAAADAAAAAAAAA
AGAAAAAAAAAAYAAAAAAAAAAsAAAAAAAAAAIAKACmAQEAAwMAABAAAAAAAAAAAAB/AAAAAAAAAAAA/////x8AAABLVFh3cml0ZXIAQmFzaXMgVW5pdmVy
c2FsIDIuMTAAAAQAAAB/fwAAsUBbilJZtltR+lD6UPpQ+rFAc0q+WTb+UfpQ+lD6UPqxQHMyzliWZ1H6UPpQ+lD6sUBbilJZtltR+lD6UPpQ+rFAc0q+
WTb+UfpQ+lD6UPqxQHMyzliWZ1H6UPpQ+lD6
"""
KTX2 = {"ETC1S": base64.b64decode(ETC1S), "UASTC": base64.b64decode(UASTC)}
TEXELS = np.stack(np.broadcast_arrays(40 + 15 * np.arange(12), 90, 200 - 10 * np.arange(12)), -1) / 255
BLOCKS = {"ETC1S": 0.1, "UASTC": 0.01}  # largest error of a value in these codecs


def everything(folder: pathlib.Path) -> Writer:
    """A file that uses all fields that are read."""
    writer = Writer()
    image = np.random.default_rng(0).random((3, 2, 4))
    info = writer.texture(folder, image, extensions={"KHR_texture_transform": {"scale": [1, 2], "texCoord": 0}})
    writer.header["samplers"] = [{"wrapS": 33648, "wrapT": 10497, "magFilter": 9729}]
    writer.header["textures"][0]["sampler"] = 0
    pbr = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0.5, "baseColorTexture": info}
    extensions = {"KHR_materials_ior": {"ior": 1.4}, "KHR_materials_specular": {"specularTexture": info}}
    material = {"name": "a", "pbrMetallicRoughness": pbr, "normalTexture": info, "extensions": extensions}
    writer.header["materials"] = [material | {"doubleSided": False, "emissiveFactor": [0, 0, 1]}]
    index, value = writer.view(np.uint8([1]).tobytes()), writer.view(SQUARE[1:2].tobytes())
    parts = {"count": 1, "indices": {"bufferView": index, "componentType": 5121}, "values": {"bufferView": value}}
    first = writer.square(material=0, POSITION=writer.accessor(SQUARE, sparse=parts), TEXCOORD_0=PLACE)
    joint, weight = np.uint8([[0, 0, 0, 0]] * 4), np.float32([[1, 0, 0, 0]] * 4)
    second = writer.square(JOINTS_0=joint, WEIGHTS_0=weight, NORMAL=None)
    one(first, writer=writer)
    one(second, writer=writer)
    inverse = writer.accessor(np.eye(4, dtype=np.float32).reshape(1, 16))
    writer.header["skins"] = [{"joints": [1], "inverseBindMatrices": inverse}]
    shift = writer.accessor(np.float32([[0, 0, 1], [0, 0, 2]]))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": shift}}}
    writer.header["nodes"] = [
        {"mesh": 0, "children": [1], "rotation": [0, 0, 0, 1], "extensions": instances},
        {"camera": 0, "scale": [1, 1, 1], "translation": [0, 0, 1]},
        {"mesh": 1, "skin": 0, "matrix": np.eye(4).ravel().tolist()},
    ]
    writer.header["scenes"] = [{"nodes": [0, 2]}]
    writer.header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 1}}]
    writer.header["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    return writer


def places(item: Any, way: tuple = ()) -> list[tuple]:
    """The ways to all values of a header."""
    found = []
    for key, value in item.items() if isinstance(item, dict) else enumerate(item):
        found.append((*way, key))
        if isinstance(value, dict | list):
            found += places(value, (*way, key))
    return found


def changed(header: dict, way: tuple, value: Any) -> dict:
    """A header with another value at a place."""
    header = copy.deepcopy(header)
    item: Any = header
    for key in way[:-1]:
        item = item[key]
    item[way[-1]] = value
    return header


def outcome(path: pathlib.Path) -> str:
    """ "read", or the error that names the file; other errors pass."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=f"{path}: not supported and ignored are")
        warnings.filterwarnings("ignore", message=".* triangles lose their shape in float32")
        try:
            load_scene(path)
            message = "read"
        except (ValueError, FileNotFoundError, MemoryError) as error:
            message = str(error)
    assert message == "read" or str(path) in message
    assert len(message) < 2000
    return message


ROWS = [1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]  # of a matrix, which must be by columns
# One case for each kind of check; the test of all values of a header reaches the others.
PRIMITIVE, PBR = ("meshes", 0, "primitives", 0), ("materials", 0, "pbrMetallicRoughness")
TYPES = [
    (("nodes", 0, "mesh"), True, r"refer to one of its 2 meshes in node 0, got True"),
    (("nodes", 0, "mesh"), 10**400, r"refer to one of its 2 meshes in node 0, got 10{79}\.\.\.$"),
    (("nodes", 0, "mesh"), 0.5, r"refer to one of its 2 meshes in node 0, got 0\.5"),
    (("nodes", 0, "children"), 1, r"have a list for children of node 0, got 1"),
    (("nodes", 0, "rotation"), [0, 0, 10**400, 1], r"have 4 finite numbers for the rotation of node 0, got"),
    (("nodes", 0, "extensions"), [], r"have an object for extensions of node 0, got \[\]"),
    (("nodes", 2), "node", r"with a list of nodes, all of them objects, got 'node' at 2"),
    (("scenes", 0, "nodes"), [0, 0], r"nodes that form trees, got node 0 twice, the second time in scene 0"),
    (
        ("accessors", 0, "count"),
        5,
        r"keep accessor 0 \(POSITION of primitive 0 of mesh 0\) inside .* of 48 bytes, got 5",
    ),
    (("accessors", 0, "byteOffset"), -4, r"number of at least 0 for byteOffset of accessor 0 \(POSITION .*, got -4"),
    (("accessors", 0, "componentType"), 5130, "have 3 numbers per element .* got type 'VEC3' of component type 5130"),
    (("accessors", 0, "count"), 0, r"have 1 or more elements in accessor 0 \(POSITION .*\), got 0"),
    (("accessors", 0, "count"), 2**53, r"keep accessor 0 .* inside buffer view \d of 48 bytes"),
    (("accessors", 0, "normalized"), 1, r"have true or false for normalized of accessor 0 .* got 1"),
    (("accessors", 0, "sparse", "count"), 5, r"replace 1 to 4 elements, .* got 5 of component type 5121"),
    (("accessors", 1, "count"), 3, r"have 4 elements in TEXCOORD_0 .*, as in POSITION, got 3"),
    (("accessors", 3, "componentType"), 5126, "have 1 whole numbers per element"),
    ((*PRIMITIVE, "attributes"), {}, "be an undamaged glTF file, got one that lacks 'POSITION'"),
    ((*PRIMITIVE, "mode"), 7, r"have a mode from 0 to 6 in primitive 0 of mesh 0, got 7"),
    (("meshes", 0, "primitives"), [4], r"have an object for primitive 0 of mesh 0, got 4"),
    (("nodes", 1, "scale"), [0, 0, 0], "have invertible transforms for camera 0, got a scale of zero"),
    (("nodes", 2, "matrix"), ROWS, r"the last row of which is 0 0 0 1, in node 2, got \[5\.0, 6\.0, 7\.0, 1\.0\]"),
    (("nodes", 0, "rotation"), [0, 0, 0, 0], "have a nonzero quaternion for the rotation of node 0, got zero"),
    (("scenes", 0), {}, "hold vertices and faces, got no faces"),
    ((*PBR, "metallicFactor"), NAN, "a finite number for metallicFactor of material 0"),
    ((*PBR, "baseColorFactor"), [1, 1, 1], "4 finite numbers for baseColorFactor"),
    ((*PBR, "roughnessFactor"), 1.5, r"be between 0 and 1, .* 1\.5"),
    (("materials", 0, "normalTexture", "index"), 4, r"one of its 1 textures in \w+Texture of material 0"),
    (("cameras", 0, "perspective", "yfov"), 4, "have yfov from 0 to pi"),
    (("skins", 0, "joints"), [], r"have one or more joints in skin 0, got none"),
    (("bufferViews", 1, "byteLength"), 2**52, r"have buffers of at least \d+ bytes for buffer view 1"),
    (("bufferViews", 3, "byteStride"), 3, r"keep accessor 0 .* each 3 bytes"),
    (("bufferViews", 3, "byteStride"), 2**50, r"keep accessor 0 .* inside buffer view 3"),
    (("images", 0), {"uri": 5}, r"name a file or hold data in image 0, got 5"),
    (("asset", "version"), "1.0", "of version 2, got version 1.0"),
    (("asset", "minVersion"), "2.1", r"be a glTF file that needs no more than version 2\.0, got minVersion 2\.1"),
    (("extensionsRequired",), ["EXT_a", "EXT_b"], "not require extensions other than .*, got EXT_a, EXT_b$"),
    (("extensionsUsed",), ["KHR_a", 3], r"have a list of strings for extensionsUsed of the file, got 3 in it"),
]


@pytest.mark.parametrize(("way", "value", "message"), TYPES)
def test_fields_of_wrong_types_are_refused_by_name(tmp_path, way, value, message):
    writer = everything(tmp_path)
    writer.header = changed(writer.header, way, value)
    with pytest.raises(ValueError, match=rf"wrong\.glb.* must .*{message}"):
        load_scene(writer.write(tmp_path / "wrong.glb"))


def test_files_that_are_cut_off_or_something_else_are_refused(tmp_path):
    content = everything(tmp_path).write(tmp_path / "whole.glb").read_bytes()
    load_scene(tmp_path / "whole.glb")
    path = tmp_path / "broken.glb"
    for size in (0, 3, 11, 19, 25, 200, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"broken\.glb must be an undamaged GLB file"):
            load_scene(path)
    path.write_bytes(content[:9])
    with pytest.raises(ValueError, match=r"of at least 20 bytes, its two headers, got 9$"):
        load_scene(path)
    path.write_bytes(b"glTX" + content[4:])
    with pytest.raises(ValueError, match=r"which starts with the text glTF, got the bytes 67 6c 54 58$"):
        load_scene(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.glb must be a glTF file, and there is no such file"):
        load_scene(tmp_path / "absent.glb")


def test_what_is_not_used_may_be_damaged_and_extras_may_be_anything(tmp_path):
    writer = everything(tmp_path)
    path = tmp_path / "a.glb"
    expected = load_scene(writer.write(path)).mesh
    for kind in ("nodes", "meshes", "materials", "accessors", "scenes", "cameras"):
        writer.header[kind][0] |= {"extras": [NAN, "x", {"nodes": 3}], "unknown": 10**300, "name": {"a": [1]}}
    writer.header["accessors"].append({"count": -1})
    writer.header["nodes"].append({"mesh": 99})
    writer.header["materials"].append({"pbrMetallicRoughness": 3})
    writer.header["meshes"].append({"primitives": None})
    writer.header |= {"extras": 1, "animations": [], "whatever": NAN}
    np.testing.assert_array_equal(load_scene(writer.write(path)).mesh.position, expected.position)


def test_headers_may_start_with_a_byte_order_mark(tmp_path):
    path = everything(tmp_path).write(tmp_path / "a.gltf")
    expected = load_scene(path).mesh
    for mark, encoding in ((codecs.BOM_UTF8, "utf-8"), (b"", "utf-16"), (b"  \n", "utf-8")):
        (tmp_path / "b.gltf").write_bytes(mark + path.read_text().encode(encoding))
        np.testing.assert_array_equal(load_scene(tmp_path / "b.gltf").mesh.position, expected.position)
    glb = one((writer := Writer()).square(), writer=writer).write(tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(glb[12:16], "little")
    size = (len(glb) + 4).to_bytes(4, "little") + (length + 4).to_bytes(4, "little")
    marked = glb[:8] + size + glb[16:20] + codecs.BOM_UTF8 + b" " + glb[20:]
    (tmp_path / "b.glb").write_bytes(marked)
    np.testing.assert_array_equal(load_mesh(tmp_path / "b.glb").position, SQUARE)


def test_images_that_cannot_be_read_are_left_out_and_named(tmp_path):
    writer = everything(tmp_path)
    path = tmp_path / "a.glb"
    writer.header["images"][0] = {"uri": "picture.png"}
    content = (tmp_path / "image.png").read_bytes()
    for wrong in (b"", b"no picture", content[:40], content[:-30]):
        (tmp_path / "picture.png").write_bytes(wrong)
        with pytest.warns(
            UserWarning, match=r"ignored are textures that cannot be read \(image 0, picture\.png must be"
        ):
            scene = load_scene(writer.write(path))
        material = scene["a"].material
        assert material.textures == ()
        assert float(material.metallic) == 0.5
        np.testing.assert_array_equal(material.emissive, [0, 0, 1])
    writer.header["images"][0] = {"uri": "data:image/png;base64,AAAA"}
    with pytest.warns(UserWarning, match=r"textures that cannot be read \(image 0, data:image/png;base64,AAAA must be"):
        load_scene(writer.write(path))
    writer.header["images"][0] = {"uri": "gone.png"}
    with pytest.warns(UserWarning, match=r"that cannot be read \(image 0, .*gone\.png, which does not exist\)"):
        assert load_scene(writer.write(path))["a"].material.textures == ()


def test_names_of_materials_can_be_written_to_files(tmp_path):
    writer = one((writer := Writer()).square(material=0), writer=writer)
    for name, expected in (("\ud800x", "?x"), (7, "7"), ("", "material 0"), (None, "material 0"), ("häuser", "häuser")):
        writer.header["materials"] = [{"name": name}]
        (part,) = load_scene(writer.write(tmp_path / "a.glb")).parts
        assert part.name == expected


EXTREMES = [None, True, False, 0, -1, 1, 3, 2**31, 2**32, 2**53, 2**63, 10**30, 10**400, 0.5, -0.0, 1e308, NAN, NAN * 2]
EXTREMES += [float("inf"), "", "text", "../../../../etc/passwd", "\0", [], {}, [[]], [0] * 3, ["x"], {"a": 1}]
EXTREMES += [[1e300] * 16]


def mutated(content: bytes, path: pathlib.Path, rng: random.Random, header: dict, writer: Writer) -> None:
    """Writes a file with one random damage."""
    kind = rng.choice(["flip", "cut", "value", "value", "remove", "insert"])
    if kind == "cut":
        path.write_bytes(content[: rng.randrange(len(content))])
    elif kind == "insert":
        place = rng.randrange(len(content))
        path.write_bytes(content[:place] + rng.randbytes(rng.choice([1, 4, 100])) + content[place:])
    elif kind == "flip":
        damaged = bytearray(content)
        for _ in range(rng.choice([1, 4, 30])):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(bytes(damaged))
    else:
        writer.header = copy.deepcopy(header)
        for _ in range(rng.choice([1, 1, 3])):
            way = rng.choice(places(writer.header))
            if kind == "value":
                writer.header = changed(writer.header, way, rng.choice(EXTREMES))
                continue
            item: Any = writer.header
            for key in way[:-1]:
                item = item[key]
            del item[way[-1]]
        try:
            writer.write(path)
        except (KeyError, TypeError):  # the writer needs some of the fields
            path.write_text(json.dumps(writer.header))


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_random_damage_ends_in_a_scene_or_an_error_that_names_the_file(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(require, "available_memory", lambda: 300_000_000)
    rng = random.Random(45)
    writer = everything(tmp_path)
    header, path = writer.header, tmp_path / f"damaged.{suffix}"
    content = writer.write(path).read_bytes()
    assert outcome(path) == "read"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcomes = []
    for _ in range(250):
        mutated(content, path, rng, header, writer)
        outcomes.append(outcome(path))
    assert 20 < outcomes.count("read") < 200
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600_000  # kB


def test_all_values_of_a_header_may_be_of_any_type(tmp_path, monkeypatch):
    """Each value once, with a type or an extreme that differs from place to place."""
    monkeypatch.setattr(require, "available_memory", lambda: 300_000_000)
    writer = everything(tmp_path)
    header, path = writer.header, tmp_path / "damaged.glb"
    errors = 0
    for number, way in enumerate(places(header)):
        writer.header = changed(header, way, EXTREMES[(7 * number) % len(EXTREMES)])
        errors += outcome(writer.write(path)) != "read"
    assert errors > 100


def draco(writer: Writer, **change) -> dict:
    """The square with texture coordinates and joints as a Draco primitive, whose accessors have no data."""
    joint, weight = np.tile(np.uint8([[0, 0, 0, 0]]), (4, 1)), np.tile(np.float32([[1, 0, 0, 0]]), (4, 1))
    content = DracoPy.encode(
        SQUARE,
        FACE.reshape(-1, 3),
        quantization_bits=14,
        preserve_order=True,
        tex_coord=PLACE.astype(float),
        normals=np.tile([0.0, 0, 1], (4, 1)),
        generic_attributes={3: joint, 4: weight},
    )
    numbers = {one["attribute_type"]: one["unique_id"] for one in DracoPy.decode(content).attributes[:2]}
    numbers |= {0: DracoPy.decode(content).attributes[-1]["unique_id"]}
    named = {"POSITION": numbers[0], "NORMAL": numbers[1], "TEXCOORD_0": numbers[3], "JOINTS_0": 3, "WEIGHTS_0": 4}
    values = {"POSITION": SQUARE, "NORMAL": SQUARE, "TEXCOORD_0": PLACE, "JOINTS_0": joint, "WEIGHTS_0": weight}
    attribute = {key: writer.accessor(value) for key, value in values.items()}
    index = writer.accessor(FACE)
    for number in (*attribute.values(), index):
        del writer.header["accessors"][number]["bufferView"]
    view = writer.view(change.pop("content", content))
    extension = {"bufferView": view, "attributes": named} | change
    writer.header |= {"extensionsUsed": [DRACO], "extensionsRequired": [DRACO]}
    return {"attributes": attribute, "indices": index, "extensions": {DRACO: extension}}


def content_of(writer: Writer) -> bytes:
    """The compressed bytes of the last buffer view."""
    view = writer.header["bufferViews"][-1]
    return writer.data[view["byteOffset"] :][: view["byteLength"]]


def test_draco_primitives_are_decoded(tmp_path):
    writer = Writer()
    one(draco(writer), writer=writer)
    writer.header["nodes"] = [{"mesh": 0, "skin": 0}, {"translation": [0, 0, 5]}]
    writer.header["skins"] = [{"joints": [1]}]
    path = writer.write(tmp_path / "a.glb")
    mesh = load_scene(path).mesh
    np.testing.assert_allclose(mesh.position, SQUARE + [0, 0, 5], atol=QUANTIZED)
    np.testing.assert_allclose(mesh.normal, np.tile([0, 0, 1], (4, 1)), atol=QUANTIZED)
    np.testing.assert_allclose(mesh.texture, PLACE * [1, -1] + [0, 1], atol=QUANTIZED)
    np.testing.assert_array_equal(np.asarray(mesh.face).ravel(), FACE)
    np.testing.assert_array_equal(load_mesh(path).position, mesh.position)


def patched(writer: Writer, place: int, value: bytes) -> bytes:
    content = bytearray(content_of(writer))
    content[place : place + len(value)] = value
    return bytes(content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: {"content": content_of(w)[:-9]}, "an undamaged mesh of Draco in .* of primitive 0 of mesh 0, got"),
        # The first number after the header of 11 bytes is that of triangles.
        (lambda w: {"content": patched(w, 12, b"\x7f")}, "2 triangles and 4 vertices .* got 2 triangles and 127 vert"),
        (lambda w: {"attributes": {"POSITION": 77}}, "4 elements of 3 in POSITION of KHR_draco.*, got none"),
        (lambda w: {"attributes": {"NORMAL": 0}}, "POSITION and indices in KHR_draco"),
        (lambda w: {"bufferView": 999}, "must refer to one of its"),
    ],
)
def test_damaged_draco_data_are_refused(tmp_path, change, message):
    draco(writer := Writer())
    options = change(writer)
    writer = Writer()
    one(draco(writer, **options), writer=writer)
    with pytest.raises(ValueError, match=rf"a\.glb .*({message})"):
        load_scene(writer.write(tmp_path / "a.glb"))


def test_counts_stand_in_the_header_of_draco_data_after_metadata():
    rows, columns = 5, 7
    y, x = np.mgrid[:rows, :columns]
    position = np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(np.float32)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    face = np.stack([first, first + 1, first + columns], 1).astype(np.uint32)
    for options in (
        {"preserve_order": True},
        {},
        {"create_metadata": True, "generic_attributes": {"a name": position}},
    ):
        content = DracoPy.encode(position, face, **options)
        mesh = DracoPy.decode(content)
        assert mesh_counts(content) == (len(mesh.faces), len(mesh.points)), options
    assert struct.unpack_from("<H", content, 9)[0] & 0x8000


def meshopt_file(name: str, **change) -> Writer:
    """The square, all its views compressed: floats, a filtered normal, and triangles."""
    writer = Writer()
    normal = meshopt.encode_filter_oct(np.tile(np.float32([0, 0, 1, 0]), (4, 1)), 4, 8)
    index = np.zeros(6, np.uint32) + FACE
    packed = {
        "POSITION": (SQUARE, "ATTRIBUTES", "NONE", {"componentType": 5126, "type": "VEC3"}),
        "NORMAL": (normal, "ATTRIBUTES", "OCTAHEDRAL", {"componentType": 5120, "type": "VEC3", "normalized": True}),
        "indices": (index, "TRIANGLES", "NONE", {"componentType": 5123, "type": "SCALAR"}),
    }
    number = {}
    for key, (value, mode, words, form) in packed.items():
        content = meshopt.encode_gltf_buffer(value, mode)
        view = writer.view(content)
        stride = 2 if key == "indices" else value.dtype.itemsize * value.shape[1]
        extension = writer.header["bufferViews"][view] | {"byteStride": stride, "count": len(value), "mode": mode}
        extension |= {} if words == "NONE" else {"filter": words}
        extension |= change if key == "POSITION" else {}
        fallback = {"buffer": 1, "byteOffset": 0, "byteLength": stride * len(value), "extensions": {name: extension}}
        fallback |= {} if key == "indices" else {"byteStride": stride}
        writer.header["bufferViews"][view] = fallback
        number[key] = writer.add("accessors", {"bufferView": view, "count": len(value), **form})
    writer.header["buffers"] = [{"byteLength": 100, "extensions": {name: {"fallback": True}}}]
    writer.header |= {"extensionsUsed": [name], "extensionsRequired": [name]}
    primitive = {"attributes": {"POSITION": number["POSITION"], "NORMAL": number["NORMAL"]}}
    return one(primitive | {"indices": number["indices"]}, writer=writer)


@pytest.mark.parametrize("name", ["EXT_meshopt_compression", MESHOPT])
@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_views_of_meshoptimizer_are_decoded(tmp_path, name, suffix):
    mesh = load_scene(meshopt_file(name).write(tmp_path / f"a.{suffix}")).mesh
    np.testing.assert_array_equal(mesh.position, SQUARE)
    np.testing.assert_allclose(mesh.normal, np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    triangles = np.asarray(mesh.position)[np.asarray(mesh.face)]
    assert {tuple(map(tuple, np.roll(t, -np.argmin(t @ [1, 2, 4]), 0).tolist())) for t in triangles} == {
        tuple(map(tuple, t.tolist())) for t in SQUARE[FACE.reshape(-1, 3)]
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"byteLength": 20}, "undamaged data of meshoptimizer in KHR_meshopt_compression of buffer view 0"),
        ({"byteLength": 10**6}, "buffers of at least 1000000 bytes for the compressed data of buffer view 0"),
        ({"mode": "VERTICES"}, "one of the modes ATTRIBUTES, TRIANGLES, INDICES .* got 'VERTICES' and 'NONE'"),
        ({"filter": "LINEAR"}, "of the filters NONE, OCTAHEDRAL, .* got 'ATTRIBUTES' and 'LINEAR'"),
        ({"byteStride": 10}, "elements of multiples of 4 up to 256 bytes .* got 10 bytes"),
        ({"count": 5}, "must have 48 decoded bytes .* got 5 elements of 12 bytes"),
        ({"buffer": 9}, "must refer to one of its 2 buffers in the compressed data of buffer view 0"),
    ],
)
def test_damaged_views_of_meshoptimizer_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=rf"a\.glb must .*{message}|a\.glb {message}"):
        load_scene(meshopt_file(MESHOPT, **change).write(tmp_path / "a.glb"))


def test_sizes_of_compressed_views_are_checked_before_they_are_decoded(tmp_path):
    writer = meshopt_file(MESHOPT, count=10**9)
    writer.header["bufferViews"][0]["byteLength"] = 12 * 10**9
    with pytest.raises(ValueError, match=r"at most 1024 decoded bytes for each byte of .* got 12000000000 for "):
        load_scene(writer.write(tmp_path / "a.glb"))


def textured(content: bytes, extension: str) -> Writer:
    writer = Writer()
    source = writer.add("images", {"bufferView": writer.view(content), "mimeType": "image/any"})
    texture = {"index": writer.add("textures", {"extensions": {extension: {"source": source}}})}
    pbr = {"baseColorTexture": texture, "metallicRoughnessTexture": texture}
    writer.header["materials"] = [{"pbrMetallicRoughness": pbr}]
    writer.header |= {"extensionsUsed": [extension], "extensionsRequired": [extension]}
    return one(writer.square(material=0, TEXCOORD_0=PLACE), writer=writer)


@pytest.mark.parametrize("codec", KTX2)
def test_ktx2_textures_are_those_that_were_encoded(tmp_path, codec):
    path = textured(KTX2[codec], "KHR_texture_basisu").write(tmp_path / "a.glb")
    material = load_scene(path).parts[0].material
    (tmp_path / "any.image").write_bytes(KTX2[codec])
    read, _ = read_image(tmp_path / "any.image")
    assert read.shape == (8, 12, 4 if codec == "ETC1S" else 3)  # this one states sRGB, the other linear values
    if codec == "ETC1S":
        np.testing.assert_array_equal(material.base_color_texture.image, read[..., :3])
        np.testing.assert_array_equal(
            read[..., 3], np.where(np.arange(12) < 4, 1, np.float32(128) / 255) + 0 * read[..., 3]
        )
    roughness = np.asarray(material.roughness_texture.image)[..., 0]
    np.testing.assert_allclose(roughness, np.broadcast_to(TEXELS[:, 1], (8, 12)), atol=BLOCKS[codec])
    color = images.decode_image(KTX2[codec], name="a", decoded=False)[..., :3]
    np.testing.assert_allclose(color, np.broadcast_to(TEXELS, (8, 12, 3)), atol=BLOCKS[codec])


def test_damaged_ktx2_textures_are_left_out_by_name(tmp_path):
    content = KTX2["UASTC"]
    for damaged, message in (
        (content[:100], "an undamaged KTX 2 file, got.*ETC1S and UASTC of Basis Universal"),
        (content[:-20], "an undamaged KTX 2 file"),
        (content[:12] + struct.pack("<I", 37) + content[16:], "vkFormat 37 holds no Basis Universal payload"),
        (content[:20] + struct.pack("<2I", 2**20, 2**20) + content[28:], "must (have|be)"),
    ):
        with pytest.warns(UserWarning, match=f"textures that cannot be read .*{message}"):
            scene = load_scene(textured(damaged, "KHR_texture_basisu").write(tmp_path / "a.glb"))
        assert not scene.parts[0].material.textures


def test_webp_textures_are_read(tmp_path):
    image = np.round(np.broadcast_to(TEXELS, (8, 12, 3)) * 255).astype(np.uint8)
    path = str(tmp_path / "image.webp")
    spec = OpenImageIO.ImageSpec(12, 8, 3, "uint8")
    spec.attribute("Compression", "lossless")
    writer = OpenImageIO.ImageOutput.create(path)
    assert writer.open(path, spec)
    assert writer.write_image(np.ascontiguousarray(image))
    writer.close()
    content = (tmp_path / "image.webp").read_bytes()
    material = load_scene(textured(content, "EXT_texture_webp").write(tmp_path / "a.glb")).parts[0].material
    np.testing.assert_allclose(np.asarray(material.roughness_texture.image)[0, :, 0], TEXELS[:, 1], atol=1e-6)


@pytest.mark.parametrize("library", ["DracoPy", "meshopt", "opengl_basisu"])
def test_without_the_extra_an_error_names_the_command_that_installs_it(tmp_path, monkeypatch, library):
    writer = Writer()
    writer = {
        "DracoPy": lambda: one(draco(writer), writer=writer),
        "meshopt": lambda: meshopt_file(MESHOPT),
        "opengl_basisu": lambda: textured(KTX2["UASTC"], "KHR_texture_basisu"),
    }[library]()
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"needs the package {library}: pip install 'jaxprt\[web\]'"):
        load_scene(writer.write(tmp_path / "a.glb"))


def test_uncompressed_fallbacks_need_no_library(tmp_path, monkeypatch):
    for library in ("DracoPy", "meshopt", "opengl_basisu"):
        monkeypatch.setitem(sys.modules, library, None)
    writer = Writer()
    primitive = writer.square() | {"extensions": {DRACO: {"bufferView": 0, "attributes": {"POSITION": 0}}}}
    writer.header["bufferViews"][0]["extensions"] = {MESHOPT: {"buffer": 0, "byteLength": 9, "count": 4}}
    texture = writer.texture(tmp_path, np.ones((2, 2, 3)))
    writer.header["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": 7}}
    writer.header["materials"] = [{"emissiveTexture": texture}]
    writer.header |= {"extensionsRequired": [DRACO, MESHOPT, "KHR_texture_basisu"]}
    with pytest.warns(UserWarning, match="textures of primitives without texture coordinates"):
        scene = load_scene(one(primitive | {"material": 0}, writer=writer).write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(scene.mesh.position, SQUARE)
    assert scene.parts[0].material.textures
