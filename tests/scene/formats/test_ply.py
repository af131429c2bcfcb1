"""PLY files as other programs write them."""

import struct
import time
import tracemalloc
import warnings

import numpy as np
import pytest

from jaxprt import require
from jaxprt.files import write_png
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats import mesh_file, ply

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
XYZ = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"
IMAGE = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], np.float32)  # red, green; blue, white
CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
CODES |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
CODES |= {"float32": "f", "float64": "d"}
FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"]


def write(folder, elements, form="ascii", comments=(), name="mesh.ply"):
    """Writes a file. `elements` has, for each element, its name, properties as in a header, and rows of values."""
    header, body = [f"ply\nformat {form} 1.0\n", *(f"comment {comment}\n" for comment in comments)], []
    for element, properties, rows in elements:
        lines = properties.splitlines()
        header += [f"element {element} {len(rows)}\n", *(f"{line}\n" for line in lines)]
        for row in rows:
            for line, value in zip(lines, row, strict=True):
                words = line.split()
                items = list(value) if words[1] == "list" else [value]
                length = [(words[2], len(items))] if words[1] == "list" else []
                body += [*length, *((words[-2], item) for item in items)]
            body.append(("", None))
    path = folder / name
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    if order:
        data = b"".join(struct.pack(order + CODES[kind], value) for kind, value in body if kind)
    else:
        data = " ".join(f"{value}" if kind else "\n" for kind, value in body).encode()
    path.write_bytes("".join([*header, "end_header\n"]).encode() + data)
    return path


def colors(path):
    """Base color of each vertex of the only part of a scene."""
    (part,) = load_scene(path).parts
    return np.asarray(part.surface().base_color), np.asarray(part.mesh.position)


@pytest.mark.parametrize("form", FORMATS)
def test_lists_of_all_types_and_of_different_lengths_are_read(tmp_path, form):
    lengths = ["char", "uint8", "int16", "ushort", "int", "uint32"]
    for length, index in zip(lengths, ["uint", "int32", "uint16", "short", "int8", "uchar"], strict=True):
        faces = (
            "face",
            f"property list {length} {index} vertex_index\n",
            [([0, 1, 2],), ([0, 1, 2, 3],), ([2, 3, 0],)],
        )
        path = write(tmp_path, [("vertex", XYZ, SQUARE.tolist()), faces], form)
        geometry = mesh_file.read(path, groups=False)
        np.testing.assert_array_equal(geometry.position, SQUARE)
        np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [2, 3, 0]], f"{length} {index}")


@pytest.mark.parametrize("form", FORMATS)
def test_other_elements_and_lists_of_vertices_are_passed_over(tmp_path, form):
    camera = ("camera", "property double fov\nproperty list uchar float matrix\n", [(0.5, [1, 2, 3])])
    rows = [(*position, [7] * number, 0.5) for number, position in enumerate(SQUARE.tolist())]
    vertex = ("vertex", XYZ + "property list uchar short bones\nproperty double weight\n", rows)
    face = (
        "face",
        "property uchar flag\nproperty list uchar int vertex_indices\nproperty int id\n",
        [(1, [0, 1, 2, 3], 9)],
    )
    edge = ("edge", "property int vertex1\nproperty int vertex2\n", [(0, 1), (1, 2)])
    material = ("material", "property uchar ambient_red\nproperty float power\n", [(1, 2.5)])
    geometry = mesh_file.read(write(tmp_path, [camera, material, vertex, edge, face], form), groups=False)
    np.testing.assert_array_equal(geometry.position, SQUARE)
    np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("form", FORMATS)
def test_lists_of_different_lengths_are_the_same_in_blocks_of_any_size(tmp_path, form, monkeypatch):
    properties = f"property list uchar short junk\n{FACES}property float weight\nproperty list uchar float texcoord\n"
    lengths = [3, 0, 4, 1, 3, 5, 0, 0, 3]
    faces = [([7] * (row % 4), [row] * count, row / 2, [row / 4] * (2 * count)) for row, count in enumerate(lengths)]
    path = write(tmp_path, [("vertex", XYZ, [[0, 0, 0]] * 9), ("face", properties, faces)], form)
    content = path.read_bytes()
    header = ply.read_header(content)
    monkeypatch.setattr(ply, "_BLOCK", 4)
    for most in (1, 40, 10_000):
        monkeypatch.setattr(ply, "_BYTES", most)
        face = ply.read_elements(content, header, {"face"}, {"vertex_indices", "texcoord"})["face"]
        np.testing.assert_array_equal(face["weight"], np.arange(9) / 2)
        np.testing.assert_array_equal(face["junk"].length, np.arange(9) % 4)
        assert not len(face["junk"].value)
        for name, values in (
            ("vertex_indices", [face[1] for face in faces]),
            ("texcoord", [face[3] for face in faces]),
        ):
            np.testing.assert_array_equal(face[name].length, [len(value) for value in values])
            np.testing.assert_array_equal(face[name].value, np.concatenate(values))


def test_long_lists_that_nothing_uses_take_no_memory_and_others_count_before_they_are_read(tmp_path, monkeypatch):
    faces = [([1] * 1_000_000, [0, 1, 2]), ([], [0, 2, 3])]
    properties = "property list uint uchar junk\n" + FACES
    path = write(tmp_path, [("vertex", XYZ, SQUARE.tolist()), ("face", properties, faces)], "binary_little_endian")
    tracemalloc.start()
    try:
        geometry = mesh_file.read(path, groups=False)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [0, 2, 3]])
    assert peak < 4 * path.stat().st_size  # the bytes of the file, and a mask over a block of them
    monkeypatch.setattr(require, "available_memory", lambda: 3_000_000)
    with pytest.raises(MemoryError, match=r"the elements of .*mesh\.ply take 0\.0 GB"):
        load_mesh(path)


def test_the_work_for_a_header_is_in_proportion_to_its_elements():
    header = "ply\nformat ascii 1.0\n" + "".join(f"element kind{number} 0\n" for number in range(20_000))
    start = time.process_time()
    assert len(ply.read_header(f"{header}end_header\n".encode()).elements) == 20_000
    assert time.process_time() - start < 2  # 8 s if each name is compared with all others
    with pytest.raises(ValueError, match="its header must have one element 'kind7' with 0 or more rows"):
        ply.read_header(f"{header}element kind7 0\nend_header\n".encode())


def test_strips_that_turn_at_triangles_without_area_keep_their_orientation(tmp_path):
    ribbon = [[0.0, 1, 0], [0, 0, 0], [1, 1, 0], [2, 1, 0], [1, 0, 0]]
    strips = ("tristrips", "property list int int vertex_indices\n", [([0, 1, 2, 2, 3, 4],)])
    geometry = mesh_file.read(write(tmp_path, [("vertex", XYZ, ribbon), strips]), groups=False)
    corner = geometry.position[geometry.face]
    np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [3, 2, 4]])
    np.testing.assert_array_equal(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), [[0, 0, 1]] * 2)


@pytest.mark.parametrize(
    ("form", "kind", "most", "half", "names"),
    [
        ("ascii", "uchar", 255, 128 / 255, ("red", "green", "blue")),
        ("binary_little_endian", "ushort", 65535, 32768 / 65535, ("diffuse_red", "diffuse_green", "diffuse_blue")),
        ("binary_big_endian", "float", 1, 0.5, "rgb"),
    ],
)
def test_vertex_colors_are_the_base_color_decoded_from_srgb(tmp_path, form, kind, most, half, names):
    middle = 0.5 if kind == "float" else (most + 1) // 2
    color = [(most, 0, 0), (0, most, 0), (0, 0, most), (middle, middle, middle)]
    rows = [(*position, *rgb) for position, rgb in zip(SQUARE.tolist(), color, strict=True)]
    properties = XYZ + "".join(f"property {kind} {name}\n" for name in names)
    base, _ = colors(write(tmp_path, [("vertex", properties, rows), ("face", FACES, [([0, 1, 2, 3],)])], form))
    gray = ((half + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(base, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [gray] * 3], atol=1e-6)


@pytest.mark.parametrize("form", FORMATS)
def test_face_colors_split_the_vertices_between_faces_of_different_colors(tmp_path, form):
    properties = FACES + "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n"
    rows = [([0, 1, 2], 255, 0, 0, 255), ([0, 2, 3], 0, 255, 0, 255)]
    path = write(tmp_path, [("vertex", XYZ, SQUARE.tolist()), ("face", properties, rows)], form)
    base, position = colors(path)
    assert len(position) == 6
    face = np.asarray(load_mesh(path).face)
    np.testing.assert_array_equal(position[face], SQUARE[[[0, 1, 2], [0, 2, 3]]])
    np.testing.assert_allclose(base[face], [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3], atol=1e-6)
    same = [([0, 1, 2], 255, 0, 0, 255), ([0, 2, 3], 255, 0, 0, 255)]
    assert len(colors(write(tmp_path, [("vertex", XYZ, SQUARE.tolist()), ("face", properties, same)], form))[1]) == 4


def wedges(folder, form="ascii", image="image.png", extra=""):
    properties = FACES + "property list uchar float texcoord\n" + extra
    rows = [([0, 1, 2], [0, 0, 1, 0, 1, 1]), ([0, 2, 3], [0.5, 0, 1, 1, 0, 1])]
    if extra:
        rows = [(*row, number) for number, row in enumerate(rows)]
    comments = [f"TextureFile {name}" for name in image.split("|")] if image else []
    return write(folder, [("vertex", XYZ, SQUARE.tolist()), ("face", properties, rows)], form, comments)


@pytest.mark.parametrize("form", FORMATS)
def test_wedge_texture_coordinates_and_their_image_are_read(tmp_path, form):
    write_png(tmp_path / "my image.png", IMAGE)
    (part,) = load_scene(wedges(tmp_path, form, "my image.png")).parts
    face = np.asarray(part.mesh.face)
    expected = [[[0, 0], [1, 0], [1, 1]], [[0.5, 0], [1, 1], [0, 1]]]
    np.testing.assert_array_equal(np.asarray(part.mesh.texture)[face], expected)
    np.testing.assert_array_equal(np.asarray(part.mesh.position)[face], SQUARE[[[0, 1, 2], [0, 2, 3]]])
    assert len(part.mesh.position) == 5
    assert part.material.base_color_texture is not None
    np.testing.assert_array_equal(part.material.base_color, [1, 1, 1])
    np.testing.assert_allclose(part.material.base_color_texture.image, IMAGE, atol=1e-6)


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_of_vertices_have_the_image_too_which_replaces_vertex_colors(tmp_path, names):
    write_png(tmp_path / "image.png", IMAGE)
    properties = XYZ + "".join(f"property float {name}\n" for name in names)
    properties += "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    rows = [(*position, *position[:2], 0, 0, 0) for position in SQUARE.tolist()]
    elements = [("vertex", properties, rows), ("face", FACES, [([0, 1, 2, 3],)])]
    (part,) = load_scene(write(tmp_path, elements, comments=["TextureFile image.png"])).parts
    np.testing.assert_array_equal(part.mesh.texture, SQUARE[:, :2])
    assert part.material.base_color_texture is not None
    assert part.color is None


def test_images_that_are_missing_damaged_or_without_coordinates_are_named_in_one_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"mesh\.ply: .* TextureFile \(.*image\.png, which does not exist\)"):
        (part,) = load_scene(wedges(tmp_path)).parts
    np.testing.assert_array_equal(part.material.base_color, [0.5] * 3)
    (tmp_path / "image.png").write_text("no picture")
    with pytest.warns(UserWarning, match=r"TextureFile \(.*image\.png must be an EXR"):
        load_scene(wedges(tmp_path))
    elements = [("vertex", XYZ, SQUARE.tolist()), ("face", FACES, [([0, 1, 2, 3],)])]
    with pytest.warns(UserWarning, match=r"TextureFile a\.png \(there are no texture coordinates\)"):
        load_scene(write(tmp_path, elements, comments=["TextureFile a.png"]))
    load_mesh(wedges(tmp_path))  # which reads no images, and warns of none


def test_each_image_of_several_is_a_part(tmp_path):
    write_png(tmp_path / "a.png", IMAGE)
    write_png(tmp_path / "b.png", IMAGE[::-1])
    parts = load_scene(wedges(tmp_path, image="a.png|b.png", extra="property int texnumber\n")).parts
    assert [part.name for part in parts] == ["mesh", "mesh 2"]
    for part, image in zip(parts, (IMAGE, IMAGE[::-1]), strict=True):
        np.testing.assert_allclose(part.material.base_color_texture.image, image, atol=1e-6)
        assert len(part.mesh.face) == 1
    first, second = load_scene(wedges(tmp_path, image="a.png|a.png", extra="property int texnumber\n")).parts
    assert first.material.base_color_texture.image is second.material.base_color_texture.image


def textured(folder, elements, form):
    """A file of a square with two images and texture coordinates of the vertices."""
    write_png(folder / "a.png", IMAGE)
    write_png(folder / "b.png", IMAGE[::-1])
    vertex = ("vertex", XYZ + "property float u\nproperty float v\n", [[*row, *row[:2]] for row in SQUARE.tolist()])
    return write(folder, [vertex, *elements], form, ["TextureFile a.png", "TextureFile b.png"])


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("faces", [[], [([0, 1], 1)]])
@pytest.mark.filterwarnings(r"ignore:.*TextureFile b\.png")
def test_strips_alone_have_the_first_image(tmp_path, form, faces):
    strips = ("tristrips", "property list int int vertex_indices\n", [([0, 1, 3, 2],)])
    elements = [("face", FACES + "property int texnumber\n", faces), strips]
    (part,) = load_scene(textured(tmp_path, elements, form)).parts
    assert len(part.mesh.face) == 2
    np.testing.assert_allclose(part.material.base_color_texture.image, IMAGE, atol=1e-6)


@pytest.mark.parametrize("form", FORMATS)
def test_indices_with_fractions_are_refused_with_their_row(tmp_path, form):
    faces = ("face", "property list uchar float vertex_indices\n", [([0, 1, 2],), ([0, 1.75, 2, 3],)])
    path = write(tmp_path, [("vertex", XYZ, SQUARE.tolist()), faces], form)
    with pytest.raises(ValueError, match=r"mesh\.ply must .* row 2 of the face rows must have whole .*, got 1\.75"):
        load_mesh(path)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", [b"\r\n", b"\r"])
def test_headers_with_a_byte_order_mark_and_other_line_ends_are_read(tmp_path, form, mark, end):
    elements = [("vertex", XYZ, SQUARE.tolist()), ("face", FACES, [([0, 1, 2, 3],)])]
    path = write(tmp_path, elements, form)
    header, _, body = path.read_bytes().partition(b"end_header\n")
    body = body.replace(b"\n", end) if form == "ascii" else body
    header = header.replace(b"element vertex", b"element\tvertex ").replace(b"\n", end)
    path.write_bytes(mark + header + b"end_header" + end + body)
    geometry = mesh_file.read(path, groups=False)
    np.testing.assert_array_equal(geometry.position, SQUARE)
    np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [0, 2, 3]])


HEADER = f"ply\nformat {{}} 1.0\nelement vertex {{}}\n{XYZ}element face {{}}\n{FACES}end_header\n"


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(("vertices", "faces"), [(2**31, 1), (10**30, 1), (-1, 1)])
def test_counts_that_the_file_cannot_hold_are_refused(tmp_path, form, vertices, faces):
    path = tmp_path / "lie.ply"
    path.write_bytes(HEADER.format(form, vertices, faces).encode() + bytes(60))
    with pytest.raises(ValueError, match=r"lie\.ply must be an undamaged PLY file, .* its header "):
        load_mesh(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ply\n", "plx\n"), "it must start with a line 'ply'"),
        (("end_header", "end"), "its header must end with a line 'end_header'"),
        (("format ascii 1.0\n", ""), "its header must state a format"),
        (("property float x", "property quad x"), "a line that is not known, 'property quad x'"),
        (("element face 1", "element face one"), "a line that is not known, 'element face one'"),
        (("property float x", "property float a"), "must have the properties x, y and z"),
        (("vertex_indices", "corners"), "must have a list of the name vertex_indices or vertex_index"),
        (("0 1.0", "0 hello"), "row 1 of the vertex rows must be numbers, got '0.0 0 hello"),
        (("4 0 1 2 3", "4.5 0 1 2 3"), "must have a list of 0 or more numbers, got 4.5"),
        (("4 0 1 2 3", "4 0 1.5 2 3"), "row 1 of the face rows must have whole numbers in its list, got 1.5"),
        (("4 0 1 2 3", ""), "its header counts 1 face rows, but it has 0"),
    ],
)
def test_damaged_files_are_refused_in_words_that_say_where(tmp_path, change, message):
    text = HEADER.format("ascii", 4, 1) + "0.0 0 1.0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    path = tmp_path / "damaged.ply"
    path.write_text(text)
    load_mesh(path)
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(ValueError, match=rf"damaged\.ply must be an undamaged PLY file, .*{message}"):
        load_mesh(path)


def test_what_a_picture_would_show_and_is_not_read_is_named(tmp_path):
    more = "".join(f"property float {name}\n" for name in ("quality", "scalar_C2M", "f_dc_0", "emissive_red"))
    path = write(
        tmp_path,
        [
            ("vertex", XYZ + more, [(*position, 0, 0, 0, 0) for position in SQUARE.tolist()]),
            ("face", FACES, [([0, 1, 2, 3],)]),
            ("material", "property uchar ambient_red\n", [(0,)]),
        ],
    )
    path.write_bytes(path.read_bytes().replace(b"end_header", b"colour x\nobj_info y\nend_header", 1))
    expected = "elements material, emissive_red of vertex, f_dc_0 of vertex, header lines colour"
    with pytest.warns(UserWarning, match=f"not supported and ignored are {expected}$"):
        load_scene(path)


def test_alpha_is_named_in_a_warning_but_where_it_is_0_or_opaque_everywhere(tmp_path):
    properties = XYZ + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha"))
    for alpha, count in (([0] * 4, 0), ([255] * 4, 0), ([255, 255, 255, 0], 1), ([100] * 4, 1)):
        rows = [(*position, 255, 0, 0, a) for position, a in zip(SQUARE.tolist(), alpha, strict=True)]
        path = write(tmp_path, [("vertex", properties, rows), ("face", FACES, [([0, 1, 2, 3],)])])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            load_scene(path)
        assert [str(w.message) for w in caught] == [f"{path}: not supported and ignored are alpha of colors"] * count


def test_vertex_colors_of_a_ply_do_not_change_the_material_that_a_mitsuba_dictionary_states(tmp_path):
    properties = XYZ + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = [(*position, 255, 0, 0) for position in SQUARE.tolist()]
    path = write(tmp_path, [("vertex", properties, rows), ("face", FACES, [([0, 1, 2, 3],)])])
    shape = {"type": "ply", "filename": str(path), "bsdf": {"type": "diffuse"}}
    (part,) = load_scene({"type": "scene", "shape": shape}).parts
    assert part.color is None


def test_a_float_a_hair_above_one_is_white_and_not_a_byte():
    from jaxprt.scene.formats.geometry import linear_color

    np.testing.assert_allclose(
        linear_color(np.array([[1.0000001, 1, 0], [0.5, 0.5, 0]]))[:, 0], [1, 0.21404], rtol=1e-4
    )
    np.testing.assert_allclose(linear_color(np.array([[255.0, 0, 0], [127.5, 0, 0]]))[:, 0], [1, 0.21404], rtol=1e-4)


@pytest.mark.parametrize("strips", [[[0, 1, 2, 3, -1, 4, 5, 6, 7]], [[0, 1, 2, 3], [4, 5, 6, 7, -1]]])
def test_triangle_strips_are_triangles_of_one_orientation(tmp_path, strips):
    ribbon = [[x, y, z] for z in (0.0, 1) for x in (0.0, 1) for y in (1.0, 0)]
    elements = [
        ("vertex", XYZ, ribbon),
        ("tristrips", "property list int int vertex_indices\n", [(s,) for s in strips]),
    ]
    geometry = mesh_file.read(write(tmp_path, elements), groups=False)
    np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [2, 1, 3], [4, 5, 6], [6, 5, 7]])
    corner = geometry.position[geometry.face]
    np.testing.assert_array_equal(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), [[0, 0, 1]] * 4)


def test_dark_8_bit_colors_are_not_taken_for_fractions(tmp_path):
    properties = XYZ + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = [(*position, 1, 1, 0) for position in SQUARE.tolist()]
    base, _ = colors(write(tmp_path, [("vertex", properties, rows), ("face", FACES, [([0, 1, 2, 3],)])]))
    np.testing.assert_allclose(base, [[1 / 255 / 12.92] * 2 + [0]] * 4, rtol=1e-5)


def test_an_image_outside_of_the_folder_is_refused(tmp_path):
    write_png(tmp_path / "image.png", IMAGE)
    (tmp_path / "scene").mkdir()
    for name in ("../image.png", str(tmp_path / "image.png"), "..\\image.png"):
        with pytest.raises(ValueError, match=r"TextureFile must refer to files in the folder of the scene"):
            load_scene(wedges(tmp_path / "scene", image=name))
