"""Transfer in files: the round trip, and files that are written and read by NumPy alone."""

import dataclasses
import io
import json
import os
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import harmonic
from jaxprt.scene import builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import directions
from jaxprt.sphere.low_frequency import TOOLS, Convention

RNG = np.random.default_rng(8)
OTHER = Convention(condon_shortley=True, over_pi=False, order="alternating", axes="+x-z+y")
MESH = builtin.sphere(rings=4, sectors=6)
COUNT = len(MESH.position)


def vectors(colors=3):
    return harmonic.TransferVector(jnp.asarray(RNG.normal(size=(9, colors, COUNT)), jnp.float32), MESH.position)


def matrices():
    frame = directions.frame(MESH.normal, MESH.tangent)
    return harmonic.TransferMatrix(jnp.asarray(RNG.normal(size=(COUNT, 1, 9, 9)), jnp.float32), MESH.position, frame)


@pytest.mark.parametrize("name", ["transfer.npz", "transfer.npy", "transfer.ply"])
def test_vectors_come_back(name, tmp_path, close):
    for made, convention in ((vectors(), OTHER), (vectors(1), Convention())):
        harmonic.export_transfer(tmp_path / name, made, MESH, convention=convention)
        given = {"convention": convention} if name.endswith("npy") else {}
        close(harmonic.import_transfer(tmp_path / name, MESH, **given).vector, made.vector)


@pytest.mark.parametrize("name", ["transfer.npz", "transfer.npy"])
def test_matrices_and_vectors_of_corners_come_back(name, tmp_path, close):
    for made, what in ((matrices(), "matrices"), (vectors(), "vectors of corners")):
        corners = what != "matrices"
        harmonic.export_transfer(tmp_path / name, made, MESH, convention=OTHER, corners=corners)
        given = {"convention": OTHER, "what": what} if name.endswith("npy") else {}
        read = harmonic.import_transfer(tmp_path / name, MESH, **given)
        for one, other in zip(dataclasses.astuple(read), dataclasses.astuple(made), strict=True):
            close(one, other)
    held = np.load(tmp_path / name)
    held = held["coefficient"] if name.endswith("npz") else held
    assert held.shape == (len(MESH.face), 3, 9, 3)


def test_a_tools_vectors_light_as_they_do_there(tmp_path, close):
    """Irradiance of open vertices in Mitsuba's signs without 1/pi, written by NumPy alone, gives our radiance."""
    normal = np.asarray(MESH.normal, np.float64)
    x, y, z = normal.T
    polynomial = np.stack([1 + 0 * x, -y, z, -x, x * y, -y * z, 3 * z**2 - 1, -x * z, x**2 - y**2])
    factor = np.sqrt([1 / 4, 3 / 4, 3 / 4, 3 / 4, 15 / 4, 15 / 4, 5 / 16, 15 / 4, 15 / 16]) / np.sqrt(np.pi)
    cosine = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
    np.save(tmp_path / "tool.npy", (polynomial * (factor * cosine)[:, None]).T)
    convention = dataclasses.replace(TOOLS["Mitsuba 3"], over_pi=False)
    transport = harmonic.import_transfer(tmp_path / "tool.npy", MESH, convention=convention)
    light = prt.Environment(jnp.asarray(RNG.uniform(size=(6, 4, 4, 3)), jnp.float32))
    color = prt.radiance(harmonic.DiffuseSystem(transport, jnp.ones(1)), light, eye=jnp.zeros(3))
    close(color, prt.scene.irradiance(light, MESH.normal, degree=2) / np.pi)


def test_matrices_of_the_tool_map_its_light_to_its_light(tmp_path, close):
    """In the file the rows of a vertex meet light in the tool's coefficients, and give it in the vertex's frame."""
    made, light = matrices(), RNG.normal(size=9).astype(np.float32)
    harmonic.export_transfer(tmp_path / "m.npy", made, MESH, convention=OTHER)
    theirs = np.load(tmp_path / "m.npy")[:, 0] @ OTHER.write(light)
    arriving = np.einsum("voi,i->vo", np.asarray(made.matrix)[:, 0], light)
    close(theirs, OTHER.write(arriving, axis=1, world=False))


def test_a_ply_file_has_named_properties_in_the_tools_axes(tmp_path):
    made = vectors(1)
    harmonic.export_transfer(tmp_path / "t.ply", made, MESH, convention=OTHER)
    head, _, body = (tmp_path / "t.ply").read_bytes().partition(b"end_header\n")
    assert b"property float sh_8_0" in head
    assert b'comment jaxprt convention {"condon_shortley": true' in head
    rows = np.frombuffer(body, "<f4", COUNT * 12).reshape(COUNT, 12)
    x, y, z = np.asarray(MESH.position).T
    np.testing.assert_array_equal(rows[:, :3], np.stack([x, -z, y], 1))
    np.testing.assert_allclose(rows[:, 3], np.pi * np.asarray(made.vector)[0, 0], rtol=1e-6)
    loaded = prt.load_mesh(tmp_path / "t.ply")
    np.testing.assert_array_equal(loaded.face, MESH.face)


def test_what_does_not_fit_is_refused(tmp_path):
    path = tmp_path / "t.npy"
    with pytest.raises(ValueError, match=r"must end in \.npz, \.npy or \.ply, got '.*glb'"):
        harmonic.export_transfer(tmp_path / "t.glb", vectors(), MESH)
    with pytest.raises(
        ValueError, match=r"\.ply file must hold vectors of vertices, got matrices of vertices for \.ply"
    ):
        harmonic.export_transfer(tmp_path / "t.ply", matrices(), MESH)
    few = make_mesh(np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match=f"have all 3 vertices of the mesh, got {COUNT}"):
        harmonic.export_transfer(path, vectors(), few)
    harmonic.export_transfer(path, vectors(), MESH)
    with pytest.raises(ValueError, match="does not say its convention: give convention="):
        harmonic.import_transfer(path, MESH)
    ours = Convention()
    with pytest.raises(ValueError, match=rf"must be \[3, lm\] or \[3, lm, c\], got \[{COUNT}, 9, 3\]"):
        harmonic.import_transfer(path, few, convention=ours)
    with pytest.raises(ValueError, match='what must be "vectors"'):
        harmonic.import_transfer(path, MESH, convention=ours, what="lights")
    with pytest.raises(ValueError, match=rf"must be \[{COUNT}, lm, lm\]"):
        harmonic.import_transfer(path, MESH, convention=ours, what="matrices")
    corner = RNG.normal(size=(len(MESH.face), 3, 9))
    np.save(path, corner)
    with pytest.raises(ValueError, match=r"corners .* must agree where they share a vertex, got \d+ vertices"):
        harmonic.import_transfer(path, MESH, convention=ours, what="vectors of corners")
    corner[0, 0, 0] = np.nan
    np.save(path, corner)
    with pytest.raises(ValueError, match=r"coefficients of .* must be finite, got 1 of"):
        harmonic.import_transfer(path, MESH, convention=ours, what="vectors of corners")
    harmonic.export_transfer(tmp_path / "t.npz", vectors(), MESH)
    with pytest.raises(ValueError, match=r"convention must be that of .*, got .*=True.*: the file says .*=False"):
        harmonic.import_transfer(tmp_path / "t.npz", MESH, convention=Convention(condon_shortley=True))
    moved = dataclasses.replace(MESH, position=MESH.position.at[3, 0].add(1.0))
    with pytest.raises(ValueError, match=r"positions of .* in the axes of jaxprt, got 1 of \d+ that are not, first 3"):
        harmonic.import_transfer(tmp_path / "t.npz", moved)
    np.savez(tmp_path / "u.npz", coefficient=np.ones((COUNT, 9)), convention="{}x")
    with pytest.raises(ValueError, match="must be one that export_transfer writes, got "):
        harmonic.import_transfer(tmp_path / "u.npz", MESH)
    np.savez(tmp_path / "v.npz", other=np.ones(3))
    with pytest.raises(ValueError, match="must hold an array `coefficient`, got other"):
        harmonic.import_transfer(tmp_path / "v.npz", MESH)


RIGHT = json.dumps(dataclasses.asdict(Convention()))


def packed(**arrays):
    """The bytes of an npz file, with the arrays of a right one unless others are named."""
    file = io.BytesIO()
    right = {"coefficient": np.ones((COUNT, 9)), "position": np.asarray(MESH.position), "convention": RIGHT}
    np.savez(file, **(right | arrays), allow_pickle=True)
    return file.getvalue()


def zipped(content):
    """An npz file with some bytes in place of the coefficients."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("coefficient.npy", content)
    return file.getvalue()


def header(shape):
    """The header of an npy file without its values."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("t.npz", b"", "must be an undamaged .npz file"),
        ("t.npz", packed()[:400], "must be an undamaged .npz file"),
        ("t.npz", zipped(header((3, 9))), "must be an undamaged .npz file"),
        ("t.npz", packed(coefficient=np.array([{}], object)), "must be an undamaged .npz file"),
        ("t.npz", packed(coefficient=np.ones((COUNT, 9), complex)), "must be of real numbers, got complex128"),
        ("t.npz", packed(coefficient=np.full((COUNT, 9), "1.0")), "must be of real numbers, got <U3"),
        ("t.npz", packed(coefficient=np.full((COUNT, 9), 1e60)), "must be finite, got"),
        ("t.npz", packed(position=np.ones((COUNT, 2))), r"`position` must be \[.., 3\]"),
        ("t.npz", packed(position=np.array("here")), "`position` must be of real numbers"),
        ("t.npz", packed(convention="[" * 100_000), "must be one that export_transfer writes"),
        ("t.npz", packed(convention='{"order": 3}'), "must be one that export_transfer writes"),
        ("t.npy", b"", "must be an undamaged .npy file"),
        ("t.npy", header((2**40, 2**40)), "must be an undamaged .npy file"),
        ("t.ply", b"", "must be an undamaged .ply file"),
        (
            "t.ply",
            b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n",
            "must be an undamaged .ply file|coefficient",
        ),
    ],
)
def test_damaged_files_are_refused_by_their_name(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"(?s){name}.*{message}"):
        harmonic.import_transfer(path, MESH, convention=None if name == "t.npz" else Convention())


def test_pipes_in_place_of_transfer_are_refused(tmp_path):
    for name in ("t.npz", "t.npy", "t.ply"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(ValueError, match=f"{name} must be a file of transfer .*, got a special file"):
            harmonic.import_transfer(tmp_path / name, MESH)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        harmonic.import_transfer(tmp_path / "u.npz", MESH)
