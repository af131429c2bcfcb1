"""Mesh files of all formats: OFF, STL, and damaged files.

OFF and STL files as other programs write them.

Mutations of small valid files: each ends in a mesh or in an error that names the file, in little memory.
"""

import tracemalloc
import warnings

import numpy as np
import pytest
import trimesh

from jaxprt.scene import load_mesh, load_scene
from jaxprt.scene.formats import mesh_file

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
ROWS = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
MUTATIONS = 40  # of each kind of file
MEMORY = 64 << 20  # bytes; the files have at most 2,000
WORDS = [b"-1", b"0", b"1e999", b"nan", b"99999999999", b"2147483648", b"-", b"/", b"//", b"#", b"\\\n", b"\xff", b""]
WORDS += [b"list", b"element face 9", b"end_header", b"f", b"v", b"usemtl", b"\r", b"\n\n", b"\xef\xbb\xbf", b"\0"]

OBJ = (
    b"mtllib scene.mtl\no ring\nv 0 0 0 1 0 0\nv 2 0 0 1 0 0\nv 2 0 -1\nv 1 0 -1\nv 1 0 -2\nv 0 0 -2\nvt 0 0\nvt 1 .5\n"
)
OBJ += b"vn 0 1 0\nusemtl a\nf 2/1/1 3/2/1 4/1/1 5/2/1 6/1/1 1/2/1\ng two\nusemtl b\nf -6//1 -5//1 -4//1\nf 1 2 3 4\n"
MTL = (
    b"newmtl a\nKd .5 .2 .1\nKs .1 .1 .1\nNs 20\nillum 2\nmap_Kd -s 1 1 1 absent.png\nnewmtl b\nPr .3\nPm 1\nKe 1 1 1\n"
)
PLY = b"ply\nformat ascii 1.0\ncomment TextureFile absent.png\nelement vertex 6\nproperty float x\nproperty float y\n"
PLY += b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
PLY += b"property list uchar int vertex_indices\nproperty list uchar float texcoord\nelement tristrips 1\n"
PLY += b"property list int int vertex_indices\nend_header\n0 0 0 255 0 0\n2 0 0 255 0 0\n2 0 -1 0 0 9\n1 0 -1 0 0 9\n"
PLY += b"1 0 -2 0 0 9\n0 0 -2 9 9 9\n6 1 2 3 4 5 0 12 0 0 1 0 1 1 1 1 0 1 0 .5\n3 0 1 2 0\n7 0 1 2 -1 3 4 5\n"
OFF = b"COFF\n6 2 0\n0 0 0 255 0 0 255\n2 0 0 255 0 0 255\n2 0 -1 0 0 9 255\n1 0 -1 0 0 9 255\n1 0 -2 0 0 9 255\n"
OFF += b"0 0 -2 9 9 9 255\n6 1 2 3 4 5 0\n3 0 1 2\n"


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def off(folder, keyword="OFF", rows=ROWS, faces=("4 0 1 2 3",), counts=None):
    counts = counts or f"{len(rows)} {len(faces)} 0"
    return write(folder, "mesh.off", "\n".join([keyword, counts, *rows, *faces]))


def base_color(path):
    (part,) = load_scene(path).parts
    return np.asarray(part.surface().base_color), np.asarray(part.mesh.position)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_headers_of_off_files_have_many_forms(tmp_path, mark, end):
    for head in ("OFF\n4 2 0", "OFF4 2 0", "OFF 4 2", "# text\nOFF # 9 9\n\n4 2 5 # counts", "4 2 0", "off\n4 2 0"):
        text = "\n".join([head, *ROWS, "3 0 1 2", "", "3 0 2 3", "trailing text"])
        geometry = mesh_file.read(write(tmp_path, "mesh.off", mark + text.replace("\n", end).encode()), groups=False)
        np.testing.assert_array_equal(geometry.position, SQUARE, head)
        np.testing.assert_array_equal(geometry.face, [[0, 1, 2], [0, 2, 3]], head)


@pytest.mark.parametrize("most", ["255", "1.0"])
@pytest.mark.parametrize("alpha", ["", " 255"])
def test_vertex_colors_of_off_files_are_the_base_color(tmp_path, most, alpha):
    alpha = alpha if most == "255" else alpha.replace("255", "1.0")
    color = [f"{most} 0 0{alpha}", f"0 {most} 0{alpha}", f"0 0 {most}{alpha}", f"{most} {most} {most}{alpha}"]
    path = off(tmp_path, "COFF", [f"{row} {rgb}" for row, rgb in zip(ROWS, color, strict=True)])
    np.testing.assert_allclose(base_color(path)[0], [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], atol=1e-6)


def test_face_colors_of_off_files_split_the_vertices(tmp_path):
    path = off(tmp_path, faces=["3 0 1 2 255 0 0", "3 0 2 3 0 255 0"])
    base, position = base_color(path)
    face = np.asarray(load_mesh(path).face)
    assert len(position) == 6
    np.testing.assert_array_equal(position[face], SQUARE[[[0, 1, 2], [0, 2, 3]]])
    np.testing.assert_allclose(base[face], [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3], atol=1e-6)
    base, position = base_color(off(tmp_path, faces=["3 0 1 2 1.0 0.0 0.0 1.0", "3 0 2 3"]))
    assert sorted(base[:, 0].tolist()) == [0.5] * 3 + [1.0] * 3


def test_what_cannot_be_read_of_an_off_file_is_named_in_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"mesh\.off: .* indices of colors of faces"):
        load_scene(off(tmp_path, faces=["4 0 1 2 3 7"]))
    with pytest.warns(UserWarning, match=r"mesh\.off: .* numbers after the coordinates of vertices"):
        load_scene(off(tmp_path, rows=[f"{row} 1 2 3" for row in ROWS]))
    with pytest.warns(UserWarning, match=r"are colors of faces, beside those of vertices$"):
        load_scene(off(tmp_path, "COFF", [f"{row} 1 0 0" for row in ROWS], ["4 0 1 2 3 0 1 0"]))
    with pytest.warns(UserWarning, match=r"are indices of colors of vertices$"):
        load_scene(off(tmp_path, "COFF", [f"{row} 7" for row in ROWS]))
    with pytest.warns(UserWarning, match=r"are alpha of colors$"):
        load_scene(off(tmp_path, "COFF", [f"{row} 1 0 0 .5" for row in ROWS]))


def test_normals_texture_coordinates_and_fourth_coordinates_of_off_files_are_read(tmp_path):
    rows = [f"{row} 0 0 -2 255 0 0 255 0.25 {i}" for i, row in enumerate(ROWS)]
    path = off(tmp_path, "STCNOFF", rows)
    geometry = mesh_file.content(path, groups=False).geometry
    np.testing.assert_array_equal(geometry.normal, [[0, 0, -2]] * 4)
    np.testing.assert_array_equal(geometry.texture, [[0.25, i] for i in range(4)])
    np.testing.assert_allclose(geometry.color, [[1, 0, 0]] * 4)
    geometry = mesh_file.read(off(tmp_path, "4OFF", [f"{row} 2" for row in ROWS]), groups=False)
    np.testing.assert_array_equal(geometry.position, SQUARE / 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keyword": "OFF BINARY"}, "it must be text of three dimensions, got OFF BINARY"),
        ({"counts": "2147483648 1 0"}, "its header counts 2147483648 vertices and 1 faces, but it has"),
        ({"counts": "4 9999999999999999 0"}, "its header counts 4 vertices and 9999999999999999 faces, but it has"),
        ({"rows": ["0 0 0", "1 0", "1 1 0", "0 1 0"]}, "row 2 of the vertex rows must have 3 numbers, but has 2"),
        ({"rows": ["0 0 0", "1 0 x", "1 1 0", "0 1 0"]}, "row 2 of the vertex rows must be numbers, got '1 0 x'"),
        ({"faces": ["99999999999 0 1 2"]}, "row 1 of the face rows must have .* numbers, but has 4"),
        ({"faces": ["3 0 1 2", "3.7 0 1 2 3"]}, "row 2 of the face rows must have a list of 0 or more .*, got 3.7"),
        ({"faces": ["3 0 1 2", "3 0 1.9 2"]}, "row 2 of the face rows must have whole numbers in its list, got 1.9"),
    ],
)
def test_damaged_off_files_are_refused_in_words_that_say_where(tmp_path, options, message):
    with pytest.raises(ValueError, match=rf"mesh\.off must be an undamaged OFF file, .*{message}"):
        load_mesh(off(tmp_path, **options))


@pytest.mark.parametrize("face", ["3 0 1 7", "3 0 1 nan"])
def test_an_off_file_whose_faces_name_missing_vertices_is_refused(tmp_path, face):
    with pytest.raises(ValueError, match=r"mesh\.off: faces must refer to vertices 0 to 3, got 1 of 2 .* at face 1"):
        load_mesh(off(tmp_path, faces=["3 0 1 2", face]))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_text_stl_files_of_any_encoding_and_case_are_read(tmp_path, encoding, end):
    text = f"solid a vertex 9 9 9\n{FACET}endsolid a\nsolid b\n{FACET.upper().replace('1 0 0', '1e0 0 0')}endsolid b\n"
    path = write(tmp_path, "mesh.stl", text.replace("\n", end).encode(encoding))
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.position, [[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2)
    np.testing.assert_array_equal(mesh.face, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(mesh.normal, [[0, 0, 1]] * 6)


@pytest.mark.parametrize("start", [b"", b"solid exported by something", b"\xef\xbb\xbf"])
def test_binary_stl_files_may_start_like_text(tmp_path, start):
    source = trimesh.creation.box()
    content = source.export(file_type="stl")
    path = write(tmp_path, "mesh.stl", start.ljust(80, b" ") + content[80:])
    position = mesh_file.read(path, groups=False).position
    np.testing.assert_array_equal(position.reshape(-1, 3, 3), source.triangles.astype(np.float32))
    assert len(load_scene(path).parts) == 1


@pytest.mark.parametrize("place", ["header", "attribute"])
def test_colors_of_a_binary_stl_file_are_named_in_a_warning(tmp_path, place):
    content = bytearray(trimesh.creation.box().export(file_type="stl"))
    if place == "header":
        content[:20] = b"COLOR=\xff\x00\x00\xff,MATERIAL"[:20].ljust(20)
    else:
        content[84 + 48 : 84 + 50] = (0x8000 | 31).to_bytes(2, "little")
    path = write(tmp_path, "mesh.stl", bytes(content))
    with pytest.warns(UserWarning, match=r"mesh\.stl: not supported and ignored are colors of STL triangles"):
        load_scene(path)
    load_mesh(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bytes(80) + (1).to_bytes(4, "little") + bytes(49), "take 134 bytes, but it has 133"),
        (b"nothing", "it must start with 'solid' or have 84 bytes or more, got 7 bytes"),
        (f"solid\n{FACET}", "its 1 facets must have three vertices and end with 'endsolid', got 3 vertices"),
        (f"solid\n{FACET.replace('vertex 1 0 0', '')}endsolid", "three vertices .* got 2 vertices"),
        (
            f"solid\n{FACET.replace('vertex 1 0 0', 'vertex 1 0')}endsolid",
            "row 2 of the vertex rows must have 3 numbers",
        ),
    ],
)
def test_damaged_stl_files_are_refused_in_words_that_say_where(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"mesh\.stl must be an undamaged STL file, .*{message}"):
        load_mesh(write(tmp_path, "mesh.stl", content))


def binary_ply(order):
    head, _, body = PLY.partition(b"end_header\n")
    rows = [line.split() for line in body.splitlines()]
    data = b"".join(np.array(row[:3], order + "f4").tobytes() + bytes(map(int, row[3:])) for row in rows[:6])
    for row in rows[6:8]:
        count = int(row[0])
        data += bytes([count]) + np.array(row[1 : 1 + count], order + "i4").tobytes()
        data += bytes([int(row[1 + count])]) + np.array(row[2 + count :], order + "f4").tobytes()
    data += np.array(rows[8], order + "i4").tobytes()
    name = b"binary_little_endian" if order == "<" else b"binary_big_endian"
    return head.replace(b"ascii", name) + b"end_header\n" + data


FILES = {
    "a.obj": OBJ,
    "scene.mtl": MTL,
    "a.ply": PLY,
    "little.ply": binary_ply("<"),
    "big.ply": binary_ply(">"),
    "a.off": OFF,
    "binary.stl": trimesh.creation.box().export(file_type="stl"),
    "text.stl": trimesh.creation.box().export(file_type="stl_ascii").encode(),
}


def mutation(rng, content):
    """Content with one to three changes: of a word, a byte or a bit, a piece repeated or taken out, or the end cut."""
    for _ in range(rng.integers(1, 4)):
        at, end = sorted(rng.integers(0, len(content) + 1, 2))
        kind = rng.integers(6)
        if kind == 0:
            words = content.split(b" ")
            words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
            content = b" ".join(words)
        elif kind == 1:
            content = content[:at] + rng.bytes(1) + content[at + 1 :]
        elif kind == 2 and at < len(content):
            content = content[:at] + bytes([content[at] ^ (1 << rng.integers(8))]) + content[at + 1 :]
        elif kind == 3:
            content = content[:at] + WORDS[rng.integers(len(WORDS))] + content[at:]
        elif kind == 4:
            content = content[:at] + content[at : at + 40] + content[at:]
        else:
            content = content[:at] if rng.integers(2) else content[:at] + content[min(end, at + 40) :]
    return content


def outcome(path, *, whole):
    """The error of reading a file, or None, with all warnings, and the most memory that NumPy and Python took."""
    error = None
    tracemalloc.start()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if whole:
                load_scene(path)
            else:
                mesh_file.read(path, groups=False)
        except (ValueError, FileNotFoundError, MemoryError) as raised:
            error = str(raised)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return error, caught, peak


@pytest.mark.parametrize("name", FILES)
def test_mutated_files_end_in_a_mesh_or_an_error_that_names_them(tmp_path, name, capfd):
    rng = np.random.default_rng(sum(name.encode()))
    (tmp_path / "scene.mtl").write_bytes(MTL)
    path = tmp_path / name.replace("scene.mtl", "a.obj")
    path.write_bytes(FILES[path.name])
    errors = []
    for number in range(MUTATIONS):
        (tmp_path / name).write_bytes(mutation(rng, FILES[name]))
        # Whole scenes take longer, because their meshes go to the device.
        error, caught, peak = outcome(path, whole=number % 6 == 0 or name == "scene.mtl")
        assert error is None or (str(tmp_path) in error and "Error: " not in error), (number, error)
        assert all(str(tmp_path) in str(each.message) and each.category is UserWarning for each in caught), number
        assert peak < MEMORY, (number, peak)
        errors.append(error)
    assert None in errors
    assert not any(line and "XLA" not in line for line in capfd.readouterr().err.splitlines())
