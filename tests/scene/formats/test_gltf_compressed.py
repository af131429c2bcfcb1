"""Compressed geometry and textures of glTF files: Draco, meshoptimizer, KTX 2 and WebP, made by their own encoders."""

import base64
import struct
import sys

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
        (lambda w: {"content": content_of(w)[:9]}, "an undamaged mesh of Draco"),
        (lambda w: {"content": patched(w, 0, b"OCARD")}, "an undamaged mesh of Draco .* got data that start b'OCARD"),
        # The first number after the header of 11 bytes is that of triangles.
        (lambda w: {"content": patched(w, 11, b"\xff\xff\xff\xff")}, "undamaged mesh of Draco|2 triangles"),
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


def test_counts_of_draco_accessors_are_those_of_the_data_and_fit_into_memory(tmp_path, monkeypatch):
    writer = Writer()
    one(draco(writer), writer=writer)
    index = writer.header["meshes"][0]["primitives"][0]["indices"]
    for number in range(index + 1):
        writer.header["accessors"][number]["count"] = 3 * 10**9
    with pytest.raises(ValueError, match="decoded bytes for each byte of KHR_draco_mesh_compression"):
        load_scene(writer.write(tmp_path / "a.glb"))
    for number in range(index + 1):
        writer.header["accessors"][number]["count"] = 3 * 10**4
    monkeypatch.setattr(require, "available_memory", lambda: 10**6)
    with pytest.raises(MemoryError, match=r"the decoded data of .*a\.glb"):
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
        ({"filter": "QUATERNION"}, "undamaged data of meshoptimizer"),
        ({"byteStride": 10}, "elements of multiples of 4 up to 256 bytes .* got 10 bytes"),
        ({"mode": "INDICES"}, "elements of 2 or 4 bytes .* got 12 bytes"),
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
        (content[:100], "an undamaged KTX 2 texture of Basis Universal, ETC1S or UASTC"),
        (content[:-20], "an undamaged KTX 2 texture"),
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
