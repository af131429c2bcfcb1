import numpy as np
import pytest

from jaxprt.scene.mesh import join, make_mesh
from jaxprt.visibility import starts
from jaxprt.visibility.occluder import Occluder

FACES = np.array([[0, 1, 2], [0, 2, 3]])


def box(low, high, *, inward=False):
    """A box of six squares with corners of their own, so that normals are flat."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    position, face = [], []
    for axis in range(3):
        for side in (0, 1):
            corner = np.array([[side, 0, 0], [side, 1, 0], [side, 1, 1], [side, 0, 1]])[
                :, np.argsort(np.roll([0, 1, 2], axis))
            ]
            order = FACES if (side == 1) != inward else FACES[:, ::-1]
            face.append(order + 4 * len(position))
            position.append(low + corner * (high - low))
    return make_mesh(np.concatenate(position), np.concatenate(face))


CUBE = box([-1, -1, -1], [1, 1, 1])
WING = box([0.2, -0.1, -0.5], [3, 0.1, 0.5])  # its root is inside of the cube


def moved(mesh, scene, monkeypatch):
    """Ray origins, and which of them are elsewhere than they would be without other solids."""
    occluder = Occluder(scene)
    found = starts.start_points(mesh, occluder)
    with monkeypatch.context() as patch:
        none = np.zeros(len(mesh.position), bool)
        patch.setattr(starts, "out_of_solids", lambda mesh, occluder, start, *_, wanted: (start, none))
        before = starts.start_points(mesh, occluder)
    return found, np.any(found != before, axis=1)


def test_rays_of_a_buried_root_start_where_the_wing_comes_out(monkeypatch):
    start, elsewhere = moved(WING, join([CUBE, WING]), monkeypatch)
    position, normal = np.asarray(WING.position), np.asarray(WING.normal)
    root, end = position[:, 0] < 1, normal[:, 0] < -0.5  # the end of the wing is inside altogether
    np.testing.assert_array_equal(elsewhere, root & ~end)
    place = start[elsewhere]
    np.testing.assert_allclose(place[:, 0], 1, atol=1e-5)
    assert np.all(place[:, 0] > 1)
    # Still on the wing's surface, a rounding above it.
    above = np.sum((place - position[elsewhere]) * normal[elsewhere], 1)
    assert np.all((above > 0) & (above < 1e-5))


def test_vertices_that_are_not_wanted_stay_where_they_are():
    scene = join([CUBE, WING])
    whole, buried = starts.start_points_and_buried(WING, Occluder(scene))
    wanted = np.flatnonzero(buried)[::2]
    start, inside = starts.start_points_and_buried(WING, Occluder(scene), wanted=wanted)
    np.testing.assert_array_equal(np.flatnonzero(inside), wanted)
    np.testing.assert_array_equal(start[wanted], whole[wanted])
    others = np.setdiff1d(np.flatnonzero(buried), wanted)
    assert np.any(start[others] != whole[others])


def test_the_visibility_of_a_buried_root_is_that_beside_the_wall():
    occluder, up = Occluder(join([CUBE, WING])), np.array([0, 1, 0], np.float32)
    top = np.flatnonzero(np.asarray(WING.normal)[:, 1] > 0.5)
    start = starts.start_points(WING, occluder)[top]
    hidden, free = (start[np.asarray(WING.position)[top, 0] < 1], start[np.asarray(WING.position)[top, 0] > 1])
    angle = np.linspace(0.1, np.pi - 0.1, 20)
    ahead = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1).astype(np.float32) + 1e-3 * up
    for origin, seen in ((hidden, ahead[:, 0] > 0), (free, angle < np.pi - np.arctan2(0.9, 2))):
        for point in origin:
            triangle, _, _ = occluder.hit(np.repeat(point[None], len(ahead), 0), ahead)
            np.testing.assert_array_equal(triangle < 0, seen)


def sheet(size, slope):
    """Both sides of a square that is tilted about the z axis."""
    corner = size * np.array([[-1, -slope, -1], [-1, -slope, 1], [1, slope, 1], [1, slope, -1]])
    return make_mesh(np.concatenate([corner, corner]), np.concatenate([FACES, FACES[:, ::-1] + 4]))


def test_rays_below_a_close_sheet_start_where_their_triangles_come_out(monkeypatch):
    """A wider sheet crosses, at a distance of less than a thousandth of the scene."""
    one, other = sheet(1, 0.0), sheet(3, 1e-3)
    start, elsewhere = moved(one, join([one, other]), monkeypatch)
    position, up = np.asarray(one.position), np.asarray(one.normal)[:, 1] > 0
    np.testing.assert_array_equal(elsewhere, (position[:, 0] > 0) == up)
    np.testing.assert_allclose(start[elsewhere][:, 0], 0, atol=0.02)
    # Sheets that are farther apart leave room for light.
    assert not moved(one, join([one, sheet(3, 0.1)]), monkeypatch)[1].any()


@pytest.mark.parametrize(
    ("mesh", "others"),
    [
        (box([-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]), [CUBE]),  # altogether inside: no picture shows it
        (CUBE, [WING]),  # another solid passes through its faces, not its vertices
        (box([-1, -1, -1], [1, 1, 1], inward=True), [box([-0.2, -1, -0.2], [0.2, 0, 0.2])]),  # a closed room
        (box([-0.2, -1, -0.2], [0.2, 0, 0.2]), [box([-1, -1, -1], [1, 1, 1], inward=True)]),  # a block on its floor
    ],
    ids=["inside", "pierced", "room", "block"],
)
def test_rays_of_other_vertices_start_where_they_did(monkeypatch, mesh, others):
    _, elsewhere = moved(mesh, join([mesh, *others]), monkeypatch)
    assert not elsewhere.any()


def test_the_order_of_vertices_and_a_turn_change_nothing(monkeypatch):
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    order = np.random.default_rng(0).permutation(len(WING.position))
    place = np.argsort(order)

    def turned(mesh, chosen):
        corner = np.asarray(mesh.face) if chosen is None else place[np.asarray(mesh.face)]
        position = np.asarray(mesh.position, float) @ turn.T
        return make_mesh(position if chosen is None else position[chosen], corner)

    wing = turned(WING, order)
    found = starts.start_points(wing, Occluder(join([turned(CUBE, None), wing])))
    expected = starts.start_points(WING, Occluder(join([CUBE, WING])))[order] @ turn.T
    np.testing.assert_allclose(found, expected, atol=2e-5)
