"""OBJ files as other programs write them."""

import codecs

import numpy as np
import pytest

from jaxprt.files import write_png
from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats import mesh_file

TRIANGLE = "v 0 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3\n"
POSITION = [[0, 0, 0], [0, 0, 1], [1, 0, 0]]
MARKS = {
    "utf-8-sig": codecs.BOM_UTF8,
    "utf-16-le": codecs.BOM_UTF16_LE,
    "utf-16-be": codecs.BOM_UTF16_BE,
    "utf-32-le": codecs.BOM_UTF32_LE,
}


def write(folder, text, name="scene.obj"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("encoding", MARKS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_byte_order_marks_and_line_ends_change_nothing(tmp_path, encoding, end):
    mark = b"" if encoding == "utf-8-sig" else MARKS[encoding]
    text = "mtllib böse.mtl\n" + TRIANGLE.replace("f ", "usemtl größe\nf ")
    text = text.replace("\n", end)
    material = f"newmtl größe{end}Kd 1 0 0{end}"
    write(tmp_path, mark + material.encode(encoding), "böse.mtl")
    (part,) = load_scene(write(tmp_path, mark + text.encode(encoding))).parts
    assert part.name == "größe"
    np.testing.assert_array_equal(part.mesh.position, POSITION)
    np.testing.assert_array_equal(part.material.base_color, [1, 0, 0])


def test_names_in_windows_1252_are_read(tmp_path):
    write(tmp_path, "newmtl Weiß …\nKd 1 0 0\n".encode("cp1252"), "Möbel.mtl")
    text = "mtllib Möbel.mtl\n" + TRIANGLE.replace("f ", "usemtl Weiß …\nf ")
    (part,) = load_scene(write(tmp_path, text.encode("cp1252"))).parts
    assert part.name == "Weiß …"
    np.testing.assert_array_equal(part.material.base_color, [1, 0, 0])


@pytest.mark.parametrize("content", [TRIANGLE.encode("utf-16-le"), b"\xff\xfe" + b"\x00\xd8" * 3, b"v 0 0\0 0\n"])
def test_what_is_not_text_is_refused(tmp_path, content):
    with pytest.raises(ValueError, match=r"scene\.obj must be an undamaged OBJ file, got one that is not text"):
        load_mesh(write(tmp_path, content))
    write(tmp_path, "mtllib scene.mtl\n" + TRIANGLE)
    write(tmp_path, content, "scene.mtl")
    with pytest.raises(ValueError, match=r"scene\.mtl must be an MTL file, got one that is not text"):
        load_scene(tmp_path / "scene.obj")


@pytest.mark.parametrize("most", [1, 255])
def test_vertex_colors_are_the_base_color_decoded_from_srgb(tmp_path, most):
    rows = [f"{most} 0 0", f"0 {most} 0", f"{0.5 * most} {0.5 * most} {most}"]
    lines = [f"v {x} {y} {z} {rgb}" for (x, y, z), rgb in zip(POSITION, rows, strict=True)]
    (part,) = load_scene(write(tmp_path, "\n".join([*lines, "f 1 2 3"]))).parts
    gray = ((0.5 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(part.surface().base_color, [[1, 0, 0], [0, 1, 0], [gray, gray, 1]], atol=1e-6)
    assert float(part.material.specular) == 0


def test_vertex_colors_multiply_materials_and_are_left_out_where_there_is_an_image(tmp_path):
    write_png(tmp_path / "white.png", np.ones((2, 2, 3), np.float32))
    write(tmp_path, "newmtl half\nKd .5 .5 .5\nnewmtl image\nKd 1 1 1\nmap_Kd white.png\n", "scene.mtl")
    lines = [f"v {x} {y} {z} 1 0 0\nvt {x} {z}" for x, y, z in POSITION]
    faces = "usemtl half\nf 1/1 2/2 3/3\nusemtl image\nf 1/1 2/2 3/3\nusemtl none\nf 1/1 2/2 3/3\n"
    with pytest.warns(UserWarning, match=r"usemtl none \(no such material\)"):
        half, image, none = load_scene(write(tmp_path, "\n".join(["mtllib scene.mtl", *lines, faces]))).parts
    np.testing.assert_allclose(half.surface().base_color, [[0.5, 0, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(image.surface().base_color, [[1, 1, 1]] * 3, atol=1e-6)
    np.testing.assert_allclose(none.surface().base_color, [[1, 0, 0]] * 3, atol=1e-6)


@pytest.mark.parametrize("missing", ["v 1 0 0", "v 1 0 0 1", "v 1 0 0 nan 0 0", "v 1 0 0 inf 0 0"])
def test_vertices_without_color_stay_gray(tmp_path, missing):
    text = f"v 0 0 0 1 0 0\nv 0 0 1 0 0 1\n{missing}\nf 1 2 3\n"
    (part,) = load_scene(write(tmp_path, text)).parts
    np.testing.assert_allclose(part.surface().base_color, [[1, 0, 0], [0, 0, 1], [0.5, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(part.mesh.position, POSITION)


def test_positions_keep_the_digits_of_the_file(tmp_path):
    text = "v 512345.678912345 4987654.321098765 0\nv 512346.678912345 4987654.321098765 0\n"
    text += "v 512345.678912345 4987655.321098765 1e-3\nf 1 2 3\n"
    position = mesh_file.read(write(tmp_path, text), groups=False).position
    np.testing.assert_array_equal(position[0], [512345.678912345, 4987654.321098765, 0])
    assert position.dtype == np.float64


def test_corners_of_different_form_may_be_mixed(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 2\n"
    text += "f 1/1 2/2 3/3\nf 1//1 3//1 4//1\nf 1/1/1 2/2/1 4//1\nf 1 2 3\nf 1/ 2// 3\n"
    geometry = mesh_file.read(write(tmp_path, text), groups=False)
    position, face = geometry.position, geometry.face
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(position[face], square[[[0, 1, 2], [0, 2, 3], [0, 1, 3], [0, 1, 2], [0, 1, 2]]])
    np.testing.assert_array_equal(geometry.texture[face[0]], [[0, 0], [1, 0], [1, 1]])
    np.testing.assert_array_equal(geometry.texture[face[1]], np.zeros((3, 2)))
    np.testing.assert_array_equal(np.isnan(geometry.normal[face]).all(2)[:, 0], [True, False, False, True, True])
    np.testing.assert_array_equal(geometry.normal[face[2]], [[0, 0, 2]] * 3)


def test_faces_with_missing_normals_are_loaded_without_them_and_a_warning_says_so(tmp_path):
    text = "v 0 0 0\nv 0 0 1\nv 1 0 0\nvn 1 0 0\nf 1//1 2//7 3//1\n"
    with pytest.warns(UserWarning, match=r"should refer to normals 1 to 1 or none, got 1 of 1 .* in line 5"):
        mesh = load_mesh(write(tmp_path, text))
    np.testing.assert_allclose(mesh.normal, [[0, 1, 0]] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f 1 2", "three or more of the vertices 1 to ., got 1 of . faces that do not, the first is 'f 1 2' in line 6"),
        ("f", "the first is 'f' in line 6"),
        ("f 0/0/0 1/1/1 2/2/2", "the first is 'f 0/0/0 1/1/1 2/2/2' in line 6"),
        ("f 1 2 99999999999999999999999999", "in line 6"),
        ("f 1 2 -4611686018427387904", "in line 6"),
        ("f 1 2 -4", "in line 6"),
        ("f 1 2 3.5", "the first is 'f 1 2 3.5' in line 6"),
        ("f /1 /2 /3", "in line 6"),
        ("v 1 2", "v has 3 or more numbers, got 'v 1 2' in line 6"),
        ("v", "v has 3 or more numbers, got 'v' in line 6"),
        ("v 1 x 2", "v has 3 or more numbers, got 'v 1 x 2' in line 6"),
        ("v 1,5 2 3", "got 'v 1,5 2 3' in line 6"),
        ("v 1-2 3 4 5", "got 'v 1-2 3 4 5' in line 6"),
        ("v 1_0 0 0", "v has 3 or more numbers, got 'v 1_0 0 0' in line 6"),
        ("f 1_0 2 3", "the first is 'f 1_0 2 3' in line 6"),
        (f"f 1 2 {'1' * 5000}", "the first is 'f 1 2 1111"),
        ("f 1/1/1/9 2 3", "the first is 'f 1/1/1/9 2 3' in line 6"),
        ("f 1/// 2/// 3///", "the first is 'f 1/// 2/// 3///' in line 6"),
        ("vt", "vt has 1 or more numbers, got 'vt' in line 6"),
        ("vn 1 0", "vn has 3 or more numbers, got 'vn 1 0' in line 6"),
        ("v nan 0 0\nf 1 2 4", "positions must be finite, got 1 of 4 that are not, the first is 'v nan 0 0' in line 6"),
        ("v 1e999 0 0\nf 1 2 4", "positions must be finite, .* the first is 'v 1e999 0 0' in line 6"),
    ],
)
def test_damaged_statements_are_refused_with_their_line(tmp_path, line, message):
    text = TRIANGLE.replace("f 1 2 3", "f 1 \\\n 2 3")
    with pytest.raises(ValueError, match=rf"scene\.obj.*{message}"):
        load_mesh(write(tmp_path, text + line))
    with pytest.raises(ValueError, match=rf"scene\.obj.*{message}"):  # among statements of several blocks
        load_mesh(write(tmp_path, text + line + "\n# nothing" * 70000 + "\nv 0 0 0\nf 1 2 3"))


def test_statements_in_different_blocks_belong_together(tmp_path):
    text = "v 0 0 0\n" + "\n" * 70000 + "v 1 0 0\nv 0 1 0 # far\nusemtl a\nf -3 -2 -1\n" + "#\n" * 70000
    text += "usemtl b\nf 1 2 3\nv 5 5 5 1 0 0\nusemtl a\nf -4 -3 -1"
    geometry = mesh_file.read(write(tmp_path, text), groups=False)
    corner = geometry.position[geometry.face]
    np.testing.assert_array_equal(corner[:, 2], [[0, 1, 0], [0, 1, 0], [5, 5, 5]])
    np.testing.assert_array_equal(geometry.region[geometry.face[:, 0]], [0, 1, 0])


def test_many_faces_are_as_many_triangles(tmp_path):
    rows = 300
    place = [f"v {x} {y} 0\nvt {x} {y}" for y in range(rows) for x in range(rows)]
    first = [y * rows + x + 1 for y in range(rows - 1) for x in range(rows - 1)]
    faces = ["f " + " ".join(f"{i}/{i}" for i in (a, a + 1, a + rows + 1, a + rows)) for a in first]
    geometry = mesh_file.read(write(tmp_path, "\n".join([*place, *faces])), groups=False)
    assert geometry.face.shape == (2 * (rows - 1) ** 2, 3)
    np.testing.assert_array_equal(geometry.position[:, :2], geometry.texture)
    corner = geometry.position[geometry.face]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_array_equal(area, np.tile([0, 0, 1], (len(area), 1)))


def test_an_empty_material_name_is_that_of_faces_without_a_material(tmp_path):
    text = TRIANGLE + "usemtl \nf 3 2 1\nusemtl.map_off a\nusemtl\nf 1 2 3\n"
    (part,) = load_scene(write(tmp_path, text)).parts
    assert part.name == "scene"
    assert len(part.mesh.face) == 3


def test_a_comment_that_ends_in_a_backslash_does_not_continue(tmp_path):
    geometry = mesh_file.read(
        write(tmp_path, "# C:\\models\\\n" + TRIANGLE.replace("v 0 0 1", "v 0 0 \\\n 1")), groups=False
    )
    np.testing.assert_array_equal(geometry.position, POSITION)
