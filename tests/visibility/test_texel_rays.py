"""Rays from points of a picture to texels, beside single rays and closed forms."""

import numpy as np
import pytest

from jaxprt.scene import light_samples
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import cubemap
from jaxprt.visibility import Occluder, picture_rays
from jaxprt.visibility.picture_rays import PicturePoints, TexelRays

SIZE = 8


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
    share = picture_rays.shares(floor, occluder, points, rays)
    corner = np.asarray(floor.position)[np.asarray(floor.face)[0]]
    start = (place @ corner + [0, 1e-5, 0]).astype(np.float32)
    for texel, direction in enumerate(rays.direction):
        point, way = (each.ravel() for each in np.indices((len(start), len(direction))))
        open_ = 1 - occluder.blocked(start, direction, point, way).reshape(len(start), -1).mean(1)
        np.testing.assert_allclose(share[texel] / picture_rays.FULL, open_, atol=0.5 / picture_rays.FULL + 1e-6)


def test_an_edge_inside_of_a_pixel_is_seen_by_its_share():
    """A lid just above the points ends a quarter of a pixel beside them: one of four origins is not below it."""
    floor, lid, step = square(-2, 2, 0.0), square(-4, 0, 1e-3, up=False), 0.02
    place = np.tile([[0.5, 0.25, 0.25]], (64, 1))
    points, (_, rays) = points_on(floor, place, slope=step), rays_up(count=16)
    corner = np.asarray(floor.position)[np.asarray(floor.face)[0]]
    beside = place[0] @ corner - [0.25 * step * (corner[0] - corner[1])[0], 0, -2]
    occluder = Occluder(join([floor, make_mesh(np.asarray(lid.position) + beside, np.asarray(lid.face))]))
    share = picture_rays.shares(floor, occluder, points, rays)
    np.testing.assert_array_equal(share, round(picture_rays.FULL / 4))


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
    share = picture_rays.shares(floor, Occluder(square(-1, 1, 0.0)), points, rays)
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


def test_places_in_texels_are_means_and_widths_of_the_finer_flux():
    texel, factor = np.array([3, 5 * SIZE**2 + 2 * SIZE + 1]), 4
    even = np.ones((6, factor * SIZE, factor * SIZE, 1))
    np.testing.assert_allclose(light_samples.places_in_texels(texel, even, size=SIZE), [[0, 0, 1, 1]] * 2, atol=1e-12)
    np.testing.assert_allclose(
        light_samples.places_in_texels(texel, 0 * even, size=SIZE), [[0, 0, 1, 1]] * 2, atol=1e-12
    )
    spot = np.zeros_like(even)
    spot[5, 2 * factor, factor + 3] = 7  # the first row and the last column of the second texel
    found = light_samples.places_in_texels(texel[1:], spot, size=SIZE)
    np.testing.assert_allclose(found, [[0.75, -0.75, 0.25, 0.25]], atol=1e-12)
