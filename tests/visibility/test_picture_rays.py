"""What points of a picture see of texels and of lamps, beside single rays and closed forms."""

import jax
import numpy as np
import pytest

from jaxprt.scene import Mesh, PointLight, light_samples
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import cubemap, directions
from jaxprt.systems.lamps.places import at_points, places
from jaxprt.visibility import Occluder, picture_rays
from jaxprt.visibility.picture_rays import PicturePoints, TexelRays

SIZE = 8
EDGE = 32  # points along the edge of the ground, which is one square from -1 to 1
HEIGHT, RADIUS = 0.6, 0.3
SUMMED = 0.005  # what sums over places leave of the irradiance
SPREAD = 0.05  # what 32 rays leave of it at single points of a half-shadow, relative to the norm
MEAN = 0.015  # and at means of 8 x 8 points, which the dither pattern fills


def square(low, high, height, *, up=True):
    """A horizontal square of two triangles."""
    corner = [[low, height, low], [high, height, low], [high, height, high], [low, height, high]]
    face = np.array([[0, 2, 1], [0, 3, 2]])
    return make_mesh(np.array(corner, float), face if up else face[:, ::-1])


def points_on(mesh, place, *, slope=0.0):
    """Points of the floor's first triangle at given barycentric coordinates, as those of one row of pixels."""
    count = len(place)
    step = np.zeros((count, 2, 3), np.float32)
    step[:, 0] = [slope, -slope, 0]
    column = np.arange(count)
    return PicturePoints(np.zeros(count, np.int32), place.astype(np.float32), step, 0 * column, column)


def rays_up(*, count):
    """Rays to the texels around +y."""
    way = np.asarray(cubemap.direction(size=SIZE)).reshape(-1, 3)
    texel = np.argsort(-way[:, 1])[:4]
    direction = light_samples.in_texels(texel, np.ones((6, SIZE, SIZE, 1)), size=SIZE, count=picture_rays.PLACES)
    return texel, TexelRays(direction, np.full(len(texel), count))


def test_shares_are_those_of_single_rays_to_every_place():
    floor, lid = square(-2, 2, 0.0), square(-1, 0.3, 1.0, up=False)
    occluder = Occluder(join([floor, lid]))
    random = np.random.default_rng(0)
    place = random.dirichlet([1, 1, 1], 100)
    points, (_, rays) = points_on(floor, place), rays_up(count=picture_rays.PLACES)
    share = picture_rays.shares(picture_rays.triangles(floor), occluder, points, rays)
    corner = np.asarray(floor.position)[np.asarray(floor.face)[0]]
    start = (place @ corner + [0, 1e-5, 0]).astype(np.float32)
    for texel, direction in enumerate(rays.direction):
        point, way = (each.ravel() for each in np.indices((len(start), len(direction))))
        open_ = 1 - occluder.blocked(start, direction, point, way).reshape(len(start), -1).mean(1)
        np.testing.assert_allclose(share[texel] / picture_rays.FULL, open_, atol=0.5 / picture_rays.FULL + 1e-6)


def test_rays_that_are_left_out_where_others_agree_lose_no_thin_shadow():
    """The half-shadow of a bar across a row of neighboring points, of which packets far from it see all."""
    corner = np.array([[-0.03, 0.5, -2], [0.03, 0.5, -2], [0.03, 0.5, 2], [-0.03, 0.5, 2]])
    floor, bar = square(-2, 2, 0.0), make_mesh(corner, np.array([[0, 2, 1], [0, 3, 2]]))
    occluder, (_, rays) = Occluder(join([floor, bar])), rays_up(count=picture_rays.PLACES)
    first = np.linspace(0.44, 0.56, 400)
    place = np.stack([first, 0.05 * np.ones(400), 0.95 - first], -1)
    share = (
        picture_rays.shares(picture_rays.triangles(floor), occluder, points_on(floor, place), rays) / picture_rays.FULL
    )
    start = (place @ np.asarray(floor.position)[np.asarray(floor.face)[0]] + [0, 1e-5, 0]).astype(np.float32)
    for row, direction in zip(share, rays.direction, strict=True):
        point, way = (each.ravel() for each in np.indices((len(start), len(direction))))
        seen = 1 - occluder.blocked(start, direction, point, way).reshape(len(start), -1).mean(1)
        assert 0.2 < (seen < 1).mean() < 0.8
        np.testing.assert_allclose(row, seen, atol=0.1)
        assert abs((1 - row).sum() / (1 - seen).sum() - 1) < 0.01


def test_an_edge_inside_of_a_pixel_is_seen_by_its_share():
    """A lid just above the points ends a quarter of a pixel beside them: one of four origins is not below it."""
    floor, lid, step = square(-2, 2, 0.0), square(-4, 0, 1e-3, up=False), 0.02
    place = np.tile([[0.5, 0.25, 0.25]], (64, 1))
    points, (_, rays) = points_on(floor, place, slope=step), rays_up(count=16)
    corner = np.asarray(floor.position)[np.asarray(floor.face)[0]]
    beside = place[0] @ corner - [0.25 * step * (corner[0] - corner[1])[0], 0, -2]
    occluder = Occluder(join([floor, make_mesh(np.asarray(lid.position) + beside, np.asarray(lid.face))]))
    share = picture_rays.shares(picture_rays.triangles(floor), occluder, points, rays)
    np.testing.assert_array_equal(share, round(picture_rays.FULL / 4))


def test_shares_of_corners_are_interpolated_where_they_agree_and_traced_where_they_do_not():
    floor, lid = square(-2, 2, 0.0), square(-1, 0.3, 1.0, up=False)
    occluder, place = Occluder(join([floor, lid])), np.random.default_rng(0).dirichlet([1, 1, 1], 100)
    points, (_, rays) = points_on(floor, place), rays_up(count=16)
    corner = np.tile(np.asarray(floor.face)[0][:, None], (1, 100))
    seen = np.array([[240, 240, 240, 0], [120, 60, 90, 0], [0, 0, 0, 9], [120, 59, 90, 132]], np.uint8)
    share = picture_rays.shares(picture_rays.triangles(floor), occluder, points, rays, stored=(seen.T, corner))
    traced = picture_rays.shares(picture_rays.triangles(floor), occluder, points, rays)
    same = np.ptp(seen[:, corner[:, 0]].astype(int), 1) <= picture_rays.FULL / 4
    between = np.einsum("tk,pk->tp", seen[:, corner[:, 0]], place)
    np.testing.assert_array_equal(same, [True, True, True, False])
    assert np.abs(share[same] - between[same]).max() <= 0.5 + 1e-3
    np.testing.assert_array_equal(share[~same], traced[~same])


@pytest.mark.parametrize("bad", ["padding", "no area", "below"])
def test_points_that_see_nothing_see_nothing(bad):
    floor = square(-1, 1, 0.0)
    points, (_, rays) = points_on(floor, np.tile([[1 / 3] * 3], (5, 1))), rays_up(count=3)
    if bad == "padding":
        points = points._replace(triangle=np.full(5, -1, np.int32), barycentric=np.zeros((5, 3), np.float32))
    if bad == "no area":
        floor = make_mesh(np.zeros((4, 3)), np.asarray(floor.face), normal=np.tile([[0.0, 1, 0]], (4, 1)))
    if bad == "below":
        rays = TexelRays(-rays.direction, rays.per_texel)
    share = picture_rays.shares(picture_rays.triangles(floor), Occluder(square(-1, 1, 0.0)), points, rays)
    assert not share.any()


def test_places_within_a_texel_follow_the_flux_of_the_finer_light():
    fine = np.zeros((6, 4 * SIZE, 4 * SIZE, 3), np.float32)
    fine[2, 5, 9], fine[2, 6, 10] = 3.0, 1.0  # both in texel (1, 2) of face 2
    texel = np.array([2 * SIZE**2 + 1 * SIZE + 2, 0])
    way = light_samples.in_texels(texel, fine, size=SIZE, count=64)
    center = np.asarray(cubemap.direction(size=4 * SIZE))
    first, second = way[0] @ center[2, 5, 9], way[0] @ center[2, 6, 10]
    assert np.all(np.maximum(first, second) > np.cos(0.05))  # half of a fine texel's diagonal
    assert abs(np.sum(first > second) - 48) <= 2  # Places near the common corner are nearer to the other middle.
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), 1, atol=1e-6)
    # A texel without flux is covered evenly: its mean direction is that of its area.
    area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)[0]
    mean = way[1].mean(0)
    assert mean @ area / np.linalg.norm(mean) / np.linalg.norm(area) > 1 - 1e-4


def test_spots_in_texels_are_means_and_widths_of_the_finer_flux():
    texel, factor = np.array([3, 5 * SIZE**2 + 2 * SIZE + 1]), 4
    even = np.ones((6, factor * SIZE, factor * SIZE, 1))
    np.testing.assert_allclose(light_samples.spots_in_texels(texel, even, size=SIZE), [[0, 0, 1, 1]] * 2, atol=1e-12)
    np.testing.assert_allclose(
        light_samples.spots_in_texels(texel, 0 * even, size=SIZE), [[0, 0, 1, 1]] * 2, atol=1e-12
    )
    spot = np.zeros_like(even)
    spot[5, 2 * factor, factor + 3] = 7  # the first row and the last column of the second texel
    found = light_samples.spots_in_texels(texel[1:], spot, size=SIZE)
    np.testing.assert_allclose(found, [[0.75, -0.75, 0.25, 0.25]], atol=1e-12)


def level(corner, face, up: float) -> Mesh:
    """A mesh that lies flat, turned up or down."""
    return make_mesh(np.asarray(corner, float), np.asarray(face), normal=np.tile([0.0, up, 0.0], (len(corner), 1)))


GROUND = level([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], [[0, 2, 1], [0, 3, 2]], 1.0)


def disk(radius: float, height: float, count: int = 128) -> Mesh:
    """A disk above the origin, turned down."""
    angle = 2 * np.pi * np.arange(count) / count
    rim = np.stack([radius * np.cos(angle), 0 * angle + height, radius * np.sin(angle)], 1)
    number = np.arange(count)
    face = np.stack([0 * number + count, number, (number + 1) % count], 1)
    return level(np.concatenate([rim, [[0, height, 0]]]), face, -1.0)


def board(low: float, height: float) -> Mesh:
    """A wide board above the half of the ground with x above `low`."""
    corner = [[low, height, -9], [9, height, -9], [9, height, 9], [low, height, 9]]
    return level(corner, [[0, 1, 2], [0, 2, 3]], 1.0)


def seen(lamps, *others: Mesh) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Points in a square grid, and the integrals of lamps there, without their pieces."""
    grid = (np.arange(EDGE) + 0.5) / EDGE * 2 - 1
    x, z = (each.ravel() for each in np.meshgrid(grid, grid))
    corner = np.asarray(GROUND.position)[np.asarray(GROUND.face)].astype(np.float64)
    planes = np.stack([corner[..., 0], corner[..., 2], np.ones((2, 3))], 1)
    weight = np.linalg.solve(planes, np.stack([x, z, 0 * x + 1])[None]).transpose(0, 2, 1)
    triangle = np.where(weight[0].min(1) >= 0, 0, 1)
    slope = np.linalg.solve(planes, np.array([[2 / EDGE, 0], [0, 2 / EDGE], [0, 0]])[None]).transpose(0, 2, 1)
    number = np.arange(EDGE**2)
    points = picture_rays.PicturePoints(
        triangle, weight[triangle, number], slope[triangle], number // EDGE, number % EDGE
    )
    position, normal = np.stack([x, 0 * x, z], 1), np.tile([0.0, 1, 0], (EDGE**2, 1))
    mesh = join([GROUND, *(lamp for lamp in lamps if isinstance(lamp, Mesh)), *others])
    own = places(lamps, np.ones(len(lamps)))
    return position, picture_rays.moments(picture_rays.triangles(mesh), Occluder(mesh), points, position, normal, own)


def off(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


def test_a_disk_is_the_closed_form_at_points():
    """Siegel and Howell, "Thermal Radiation Heat Transfer": a small surface parallel to a disk, beside its axis."""
    for height in (0.1, HEIGHT):
        position, (solid, cosine, direction) = seen([disk(RADIUS, height)])
        beside = np.hypot(position[:, 0], position[:, 2])
        a, r = height / beside, RADIUS / beside
        z = 1 + a**2 + r**2
        expected = np.pi / 2 * (1 - (z - 2 * r**2) / np.sqrt(z**2 - 4 * r**2))
        assert off(cosine.sum(0), expected) < SUMMED * (3 if height < RADIUS else 1)
        np.testing.assert_allclose(cosine, direction[:, 1], rtol=1e-5, atol=1e-9)
        assert np.all(np.linalg.norm(direction, axis=1) <= solid * (1 + 1e-5))


def test_half_shadows_are_the_visible_part_of_the_lamp():
    """The edge of a board divides the lamp along a line, for each point along another one."""
    position, (_, whole, _) = seen([disk(RADIUS, HEIGHT)])
    low, high = 0.05, 0.3
    _, (_, cosine, _) = seen([disk(RADIUS, HEIGHT)], board(low, high))
    # Sum over a fine grid on the lamp, which the edge of the board divides at one x for each point.
    grid = (np.arange(200) + 0.5) / 200 * 2 * RADIUS - RADIUS
    x, z = (each.ravel() for each in np.meshgrid(grid, grid))
    x, z = x[np.hypot(x, z) < RADIUS], z[np.hypot(x, z) < RADIUS]
    way = np.stack([x, 0 * x + HEIGHT, z], 1) - position[:, None]
    edge = position[:, 0] + (low - position[:, 0]) * HEIGHT / high
    open_ = x < edge[:, None]
    sent = HEIGHT**2 / np.sum(way**2, -1) ** 2 * (2 * RADIUS / 200) ** 2
    expected, got = np.sum(sent * open_, 1), cosine.sum(0)
    assert off(np.sum(sent, 1), whole.sum(0)) < SUMMED * 2
    half = open_.any(1) & ~open_.all(1)
    assert half.mean() > 0.2
    assert off(got, expected) < SPREAD
    block = (EDGE // 8, 8, EDGE // 8, 8)
    assert off(got.reshape(block).mean((1, 3)), expected.reshape(block).mean((1, 3))) < MEAN
    np.testing.assert_array_equal(got[edge < -RADIUS - 1 / EDGE], 0)  # from everywhere in the pixel


def test_sheets_that_emit_on_both_sides_light_as_one_side_does():
    lamp = disk(RADIUS, HEIGHT)
    back = make_mesh(lamp.position, np.asarray(lamp.face)[:, ::-1], normal=-np.asarray(lamp.normal))
    assert places([lamp], np.ones(1)).per_piece[0, 0] > 0
    assert places([join([lamp, back])], np.ones(1)).per_piece[0, 0] > 0  # a coarse level is accurate
    screen = board(0.05, 0.3)
    one, both = (seen([each], screen)[1][1].sum(0) for each in (lamp, join([lamp, back])))
    assert off(both, one) < SPREAD


def test_point_lights_and_spots_have_one_place():
    bulb = PointLight("bulb", [0.2, 0.5, -0.3], 2.0)
    spot = PointLight("spot", bulb.position, 1.0, axis=[0.3, -1.0, 0.2], cone=(0.4, 1.0))
    position, moment = seen([bulb, spot])
    way = np.asarray(bulb.position) - position
    square = np.sum(way**2, 1)
    frame = np.tile(np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]], np.float32), (len(way), 1, 1))
    transport = at_points(
        moment, *jax.device_put((np.float32(position), frame)), [bulb, spot], np.array([1, 1]), (None, ())
    )
    np.testing.assert_allclose(transport.solid_angle[0], 1 / square, rtol=1e-4)
    np.testing.assert_allclose(transport.cosine[0], way[:, 1] / square**1.5, rtol=1e-4)
    axes = (jax.numpy.tile(np.float32(each), (len(way), 1)) for each in ([0.6, 0.8, 0.0], [0.0, 0.0, 1.0]))
    tilted = directions.frame(*axes)
    cosine = np.maximum(way @ [0.6, 0.8, 0.0], 0) / square**1.5
    np.testing.assert_allclose(transport.tilted(tilted).cosine[0], cosine, rtol=1e-3, atol=1e-4)
    share = spot.share(-way / np.sqrt(square)[:, None])
    assert 0 < np.mean(share == 0) < 1
    np.testing.assert_allclose(transport.cosine[1], share * np.asarray(transport.cosine[0]), rtol=1e-3, atol=1e-6)


def test_backs_send_nothing_and_strong_lamps_get_more_rays():
    lamp = disk(RADIUS, HEIGHT)
    turned = make_mesh(lamp.position, lamp.face, normal=-np.asarray(lamp.normal))
    assert not np.any(seen([turned])[1][0])
    many = places([lamp] * 6, np.array([1000.0, 1, 1, 1, 1, 1]))
    assert many.strata[0] > many.strata[1]
    assert np.all(4 * many.strata >= many.pieces)
