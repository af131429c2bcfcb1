"""What points of a picture see of lamps, against closed forms."""

import jax
import numpy as np

from jaxprt.scene import Mesh, PointLight
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import directions
from jaxprt.systems.lamps.places import at_points, places
from jaxprt.visibility import Occluder, picture_rays

EDGE = 32  # points along the edge of the ground, which is one square from -1 to 1
HEIGHT, RADIUS = 0.6, 0.3
SUMMED = 0.005  # what sums over places leave of the irradiance
SPREAD = 0.05  # what 32 rays leave of it at single points of a half-shadow, relative to the norm
MEAN = 0.015  # and at means of 8 x 8 points, which the dither pattern fills


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
    return position, picture_rays.moments(Occluder(mesh), mesh, points, position, normal, own)


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
    transport = at_points(moment, *jax.device_put((np.float32(position), frame)), [bulb, spot], np.array([1, 1]))
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
