"""Visibility pyramids: bits, means, and what a vertex sees of a lobe, against sums over all texels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

from jaxprt import lobe
from jaxprt.decompose import mixture
from jaxprt.scene import builtin
from jaxprt.sphere import cubemap
from tests.systems.scenes import SIZE, ball_on_ground, pyramids_on_ground, seen_on_ground

BYTE = 2e-3  # half a step of a byte
SLOPE = 5e-3  # change of slopes over 1e-5, in visibility per radian
# A pyramid's boxes and tents are no normal distribution: at most .047 was measured, root mean square.
FRACTION = 0.06


@pytest.fixture(scope="module")
def compressed():
    return pyramids_on_ground()


@pytest.fixture(scope="module")
def seen():
    return seen_on_ground().seen(np.arange(len(ball_on_ground().position)))


@jax.jit
def look(transport, face, s, t, spread):
    return transport.lobe_visibility(face, s, t, jnp.asarray(spread))


def read(transport, direction, spread):
    """Shares of one lobe in the same world direction for all vertices."""
    count = len(transport.position)
    place = np.broadcast_to(np.float32(direction)[:, None, None], (3, 1, count))
    return look(transport, *cubemap.project(*place), np.full((1, count), spread, np.float32))


def exact(seen, direction, spread):
    """Mean visibility over a von Mises-Fisher lobe, by all texels."""
    size = int(np.sqrt(seen.shape[1] / 6))
    center = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64).ravel()
    concentration = float(mixture.concentration_of(jnp.asarray(spread)))
    weight = area * np.exp(concentration * (center @ direction - 1))
    return seen @ (weight / weight.sum()) / 16


def test_every_texel_is_its_own_bit(seen):
    assert lobe.pyramid.scales(64).total <= 6000  # bytes
    pyramid = lobe.pyramid.pyramid(jnp.asarray(seen))
    blank = lobe.LobeTransport(
        pyramid, jnp.zeros((0, len(seen)), jnp.uint8), jnp.zeros((len(seen), 3)), jnp.zeros((len(seen), 3, 3)), SIZE
    )
    every = jnp.arange(seen.shape[1])
    for each in (blank, lobe.texel_bits(blank)):
        np.testing.assert_array_equal(np.asarray(each.visible(every)), (seen >= 8).T)


def test_cells_of_all_levels_are_the_means_of_their_texels():
    size = 32
    share = np.random.default_rng(2).integers(0, 17, (3, 6, size // 4, size // 4)).repeat(4, 2).repeat(4, 3)
    share[0, :, ::3] = 0
    pyramid, scale = lobe.pyramid.pyramid(jnp.asarray(share.reshape(3, -1), jnp.uint8)), lobe.pyramid.scales(size)
    transport = lobe.LobeTransport(pyramid, jnp.zeros((0, 3), jnp.uint8), jnp.zeros((3, 3)), jnp.zeros((3, 3, 3)), size)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64)
    edges = scale.edge.tolist()[1:]
    every = jax.jit(lambda seen: [seen.cells(jnp.arange(6 * edge**2), edge=edge) for edge in edges])(transport)
    for number, (edge, found) in enumerate(zip(edges, every, strict=True), 1):
        bits, fold = number < scale.bits, size // edge
        value, weight = ((share >= 8) * 1.0, np.ones_like(area)) if bits else (share / 16, area)
        squares, whole = (x.reshape(-1, 6, edge, fold, edge, fold).sum((3, 5)) for x in (value * weight, weight[None]))
        np.testing.assert_allclose(found.T, (squares / whole).reshape(3, -1), atol=0.003)
        clear = (share >= 8).reshape(3, 6, edge, fold, edge, fold).mean((3, 5)).reshape(3, -1)
        of_bits = jax.jit(lambda bits, edge=edge: bits.cells(jnp.arange(6 * edge**2), edge=edge))
        np.testing.assert_allclose(of_bits(lobe.texel_bits(transport)).T, clear, rtol=1e-6)


@pytest.mark.parametrize("value", [0, 16])
def test_what_is_open_or_closed_all_around_is_so_at_all_scales(value):
    pyramid = lobe.pyramid.pyramid(jnp.full((2, 6 * SIZE**2), value, jnp.uint8))
    transport = lobe.LobeTransport(pyramid, jnp.zeros((0, 2), jnp.uint8), jnp.zeros((2, 3)), jnp.zeros((2, 3, 3)), SIZE)
    for spread in (1e-5, 0.01, 0.1, 0.99):
        for direction in ([1, 0, 0], [0.5, -0.5, 0.7], [1, 1, 1]):
            visible, by_s, by_t = read(transport, direction, spread)
            np.testing.assert_allclose(visible, value / 16, atol=1e-6)
            np.testing.assert_allclose([by_s, by_t], 0, atol=1e-4)


@pytest.mark.parametrize("spread", [3e-3, 0.01, 0.03, 0.1, 0.3])
def test_visible_parts_are_the_means_over_lobes(compressed, seen, spread):
    random = np.random.default_rng(0).normal(size=(12, 3))
    wrong = []
    for direction in random / np.linalg.norm(random, axis=1, keepdims=True):
        visible, *_ = read(compressed, direction, spread)
        wrong.append(np.asarray(visible)[0] - exact(seen, direction, spread))
    assert np.sqrt(np.mean(np.square(wrong))) < FRACTION


def test_visible_parts_at_a_scale_of_bytes_are_its_means_weighted_by_splines(compressed, seen):
    """At the center of a texel, and at the scale's own spread."""
    scale = lobe.pyramid.scales(SIZE)
    mean = seen.reshape(-1, 6, 4, 4, 4, 4).astype(float) / 16
    area = np.asarray(cubemap.solid_angle(size=SIZE)).reshape(6, 4, 4, 4, 4)
    mean = (mean * area).sum((3, 5)) / area.sum((2, 4))
    mean = np.moveaxis(np.asarray(cubemap.pad(jnp.asarray(np.moveaxis(mean, 0, -1), jnp.float32))), -1, 0)
    spline = scipy.interpolate.BSpline.basis_element(np.arange(4) - 1.5)([-1, 0, 1])
    for face, row, column in ((0, 1, 2), (3, 2, 1), (5, 0, 3)):
        direction = np.asarray(cubemap.direction(size=4))[face, row, column]
        visible, *_ = read(compressed, direction, float(scale.spread[2]))
        around = mean[:, face, row : row + 3, column : column + 3]
        np.testing.assert_allclose(visible[0], np.einsum("i,vij,j->v", spline, around, spline), atol=BYTE + 1e-5)


def test_slopes_are_what_differentiation_gives(compressed):
    shape = 1, len(compressed.position)
    face, s, t = cubemap.project(*(np.full(shape, x, np.float32) for x in (0.3, 0.9, 0.2)))
    spread = np.full(shape, 0.03, np.float32)
    _, by_s, by_t = look(compressed, face, s, t, spread)
    slope = jax.jit(jax.grad(lambda s, t: jnp.sum(look(compressed, face, s, t, spread)[0]), argnums=(0, 1)))
    gradient = slope(s, t)
    np.testing.assert_allclose(gradient[0], by_s, atol=1e-5)
    np.testing.assert_allclose(gradient[1], by_t, atol=1e-5)


def gradient(transport, direction, spread):
    """Gradient on the sphere of the visible part of a lobe, for all vertices."""
    face, s, t = (float(x) for x in cubemap.project(*np.float32(direction)))
    _, by_s, by_t = (np.asarray(x, np.float64)[0] for x in read(transport, direction, spread))
    ways = by_s * (1 + s * s) + by_t * s * t, by_t * (1 + t * t) + by_s * s * t
    first, second, normal = cubemap.axes()[int(face)]
    point = s * first + t * second + normal
    moved = ways[0][:, None] * first + ways[1][:, None] * second
    return np.linalg.norm(point) * (moved - point * (moved @ point)[:, None] / (point @ point))


def test_visible_parts_and_their_slopes_are_continuous_between_texels_and_over_the_edges_of_the_cube(compressed):
    """At scales of bytes: a step of 1e-5 changes them by as much, where slopes of bilinear look-up jump."""
    for spread in (0.05, 0.2):
        for one, other in (
            ([1, 0.3, 0.99999], [0.99999, 0.3, 1]),
            ([-0.2, 1, 0.99999], [-0.2, 0.99999, 1]),
            ([1, 0.499995, 0.2], [1, 0.500005, 0.2]),  # between texels of 4 x 4 a face
            ([1, -0.249995, 0.2], [1, -0.250005, 0.2]),  # at the center of one
        ):
            first, second = (np.asarray(read(compressed, x, spread)[0]) for x in (one, other))
            np.testing.assert_allclose(first, second, atol=2e-3)
            first, second = (gradient(compressed, x, spread) for x in (one, other))
            np.testing.assert_allclose(first, second, atol=SLOPE)


def test_tracing_gives_what_compressing_known_visibility_gives(compressed):
    with pytest.raises(ValueError, match="size must be a power of two, at least 8, got 4"):
        lobe.precompute(builtin.sphere(rings=4, sectors=5), size=4)
    scene = ball_on_ground()
    chosen = np.arange(0, len(scene.position), 7)
    traced = lobe.precompute(scene, size=SIZE, vertex=chosen)
    # Known visibility is in four bits, in which 9 sixteenths are 8.
    assert np.mean(np.asarray(traced.pyramid) != np.asarray(compressed.pyramid)[chosen]) < 0.05
    assert (
        np.max(np.abs(np.asarray(traced.pyramid)[:, -96:].astype(int) - np.asarray(compressed.pyramid)[chosen, -96:]))
        <= 2
    )
    assert np.max(np.abs(np.asarray(traced.vector).astype(int) - np.asarray(compressed.vector)[:, chosen])) <= 8


def test_the_mean_of_the_seen_part_does_not_depend_on_the_face_of_the_lobe():
    """At an edge of the cube, where a long step on the planes of two faces ends at two places."""
    place = [cubemap.project(*(jnp.asarray([x]) for x in way)) for way in ([0.6, 1.0, 0.99999], [0.6, 0.99999, 1.0])]
    concentration = jnp.array([4.0])
    slope, moved = np.array([0.3, -1.5, 1.2]), []
    for face, s, t in place:
        first, second, normal = cubemap.axes()[int(face[0])]
        point = float(s[0]) * first + float(t[0]) * second + normal
        # Derivatives by s and t of what has this gradient at the direction of the point.
        tangent = slope - point * (slope @ point) / (point @ point)
        by_s, by_t = (jnp.asarray([tangent @ each / np.linalg.norm(point)]) for each in (first, second))
        visible = jnp.array([0.3]), by_s, by_t
        seen = lobe.system._seen_part(visible, face, s, t, mixture.drop(concentration), concentration)
        way = np.array([float(x[0]) for x in cubemap.unproject(*seen[1:4])])
        moved.append(way / np.linalg.norm(way))
    start = np.array([0.6, 1, 1]) / np.linalg.norm([0.6, 1, 1])
    assert moved[0] @ start < np.cos(0.5)
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-4)
