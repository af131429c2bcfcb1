import numpy as np
import pytest
import trimesh

from jaxprt.scene import builtin
from jaxprt.scene.mesh import split
from jaxprt.sphere import cubemap, directions


@pytest.fixture(scope="module")
def scene():
    return builtin.chess()


def surface(mesh):
    return trimesh.Trimesh(np.asarray(mesh.position, np.float64), mesh.face, process=False)


def weld(mesh):
    """Vertices in one place made one; positions are built from the same points, up to rounding."""
    _, first, place = np.unique(np.round(np.asarray(mesh.position), 6), axis=0, return_index=True, return_inverse=True)
    return trimesh.Trimesh(np.asarray(mesh.position)[first], place.reshape(-1)[np.asarray(mesh.face)], process=False)


def assert_frames(mesh):
    frame = np.asarray(directions.frame(mesh.normal, mesh.tangent), np.float64)
    assert np.abs(frame @ frame.swapaxes(1, 2) - np.eye(3)).max() < 1e-5


def irradiance_from_above(light):
    cosine = np.maximum(cubemap.vector_area(size=light.radiance.shape[1])[..., 1:2], 0)
    return np.sum(np.asarray(light.radiance, np.float64) * cosine, (0, 1, 2))


def test_the_chess_scene_has_three_regions_of_the_stated_size(scene):
    assert scene.position.shape == (16778, 3)
    assert np.unique(scene.region).tolist() == [0, 1, 2]
    assert_frames(scene)


def test_every_edge_of_a_piece_is_shared_by_two_faces_in_opposite_directions(scene):
    pieces = weld(split(scene)[0])
    assert pieces.is_watertight
    assert pieces.is_winding_consistent


def test_there_are_six_pieces_and_a_cross_each_with_its_outside_out(scene):
    pieces = weld(split(scene)[0]).split(only_watertight=True)
    assert len(pieces) == 7
    for piece in pieces:
        assert piece.volume > 0
        height = np.ptp(piece.vertices[:, 1])
        assert height < 0.25 or 1000 <= len(piece.vertices) <= 2500
        low = piece.vertices[:, 1].min()
        assert low == pytest.approx(0.004, abs=1e-6) or height < 0.25


def test_normals_of_the_chess_scene_agree_with_its_faces(scene):
    cosine = (surface(scene).face_normals[:, None] * np.asarray(scene.normal)[np.asarray(scene.face)]).sum(2)
    assert cosine.min() > 0.15  # The lowest are in grooves, where vertices have the mean normal of both sides.
    assert np.average(cosine.min(1) > 0.9, weights=surface(scene).area_faces) > 0.94


def test_squares_alternate_and_the_corner_on_the_right_of_the_viewer_is_light(scene):
    _, light, dark = split(scene)
    for squares, parity in ((light, 0), (dark, 1)):
        top = np.asarray(squares.normal)[np.asarray(squares.face)][:, 0, 1] == 1
        middle = np.asarray(squares.position)[np.asarray(squares.face)].mean(1)[top]
        assert len(middle) == 18 * 2 * 12**2
        assert (np.floor(middle[:, [0, 2]]).sum(1) % 2 == parity).all()


def test_squares_share_the_positions_of_their_borders(scene):
    _, light, dark = split(scene)
    board = weld(builtin.join([light, dark]))
    # Only the lower rim of the side is open.
    edge, count = np.unique(board.edges_sorted, axis=0, return_counts=True)
    assert board.vertices[edge[count == 1], 1].max() < -0.1
    assert count.max() == 2


@pytest.mark.parametrize(("rings", "sectors"), [(2, 3), (7, 11)])
def test_the_sphere_is_closed_with_exact_normals_and_vertex_poles(rings, sectors, close):
    mesh = builtin.sphere(rings=rings, sectors=sectors)
    assert mesh.position.shape == ((rings - 1) * sectors + 2, 3)
    close(mesh.normal, np.asarray(mesh.position), tolerance=1e-6)
    solid = surface(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    assert len(mesh.face) == 2 * sectors * (rings - 1)
    np.testing.assert_array_equal(np.sort(mesh.position[np.abs(mesh.position[:, 1]) == 1], 0), [[0, -1, 0], [0, 1, 0]])
    assert_frames(mesh)


def test_the_plane_is_flat_and_faces_up():
    mesh = builtin.plane(cells=5)
    assert mesh.position.shape == (36, 3)
    assert surface(mesh).area == pytest.approx(4)
    np.testing.assert_allclose(surface(mesh).face_normals, np.tile([0, 1, 0], (50, 1)), atol=1e-6)
    np.testing.assert_array_equal(mesh.normal, np.tile([0.0, 1, 0], (36, 1)))


@pytest.mark.parametrize("make", [builtin.daylight, builtin.studio])
@pytest.mark.parametrize("size", [16, 64])
def test_a_white_diffuse_plane_facing_up_has_mean_radiance_one(make, size):
    light = make(size=size)
    assert light.radiance.shape == (6, size, size, 3)
    assert irradiance_from_above(light).mean() / np.pi == pytest.approx(1, abs=1e-5)
    assert float(light.radiance.min()) >= 0


@pytest.mark.parametrize("make", [builtin.daylight, builtin.studio])
def test_a_coarse_light_is_the_mean_of_a_fine_one(make, close):
    coarse, fine = make(size=16), make(size=64)
    area = np.asarray(cubemap.solid_angle(size=64), np.float64).reshape(6, 16, 4, 16, 4, 1)
    mean = (np.asarray(fine.radiance).reshape(6, 16, 4, 16, 4, 3) * area).sum((2, 4)) / area.sum((2, 4))
    # The light is the same but for its scale: over a coarse texel, the cosine is not quite that of the sun in it.
    close(coarse.radiance, mean, tolerance=5e-3)


def test_half_of_the_daylight_is_from_a_warm_sun_of_two_degrees(close):
    light = builtin.daylight()
    sun = np.array([-0.62, 0.62, 0.48]) / np.linalg.norm([-0.62, 0.62, 0.48])
    direction = np.asarray(cubemap.direction(size=64))
    near = np.degrees(np.arccos(np.clip(direction @ sun, -1, 1))) < 4
    cosine = np.asarray(cubemap.vector_area(size=64))[..., 1:2]
    part = (np.asarray(light.radiance) * cosine)[near].sum(0)
    assert part.mean() / np.pi == pytest.approx(0.5, abs=0.02)
    assert part[0] > part[1] > part[2]
    brightest = np.unravel_index(light.radiance.sum(-1).argmax(), (6, 64, 64))
    assert np.degrees(np.arccos(direction[brightest] @ sun)) < 2
    # Texels that the disk covers in full hold its radiance: the energy over the solid angle.
    expected = part / sun[1] / (2 * np.pi * (1 - np.cos(np.radians(2))))
    close(light.radiance.max((0, 1, 2)), expected, tolerance=0.05)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: builtin.sphere(rings=1), "rings must be at least 2 and sectors at least 3, got 1 and 64"),
        (lambda: builtin.sphere(sectors=2), "rings must be at least 2 and sectors at least 3, got 32 and 2"),
        (lambda: builtin.plane(cells=0), "cells must be at least 1, got 0"),
        (lambda: builtin.daylight(size=0), "size must be at least 1, got 0"),
        (lambda: builtin.studio(size=0), "size must be at least 1, got 0"),
    ],
)
def test_impossible_sizes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
