"""Mutations of small valid files: each ends in a mesh or in an error that names the file, in little memory."""

import tracemalloc
import warnings

import numpy as np
import pytest
import trimesh

from jaxprt.scene import load_scene
from jaxprt.scene.formats import mesh_file

MUTATIONS = 60  # of each kind of file
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
