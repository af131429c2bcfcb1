"""Lamps: integrals of what is seen against closed forms, lobes over disks against SciPy, and what surfaces send."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxprt import lamps, lobe
from jaxprt.brdf import GGX
from jaxprt.scene import Mesh, PointLight, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.scene.points import on_triangles
from jaxprt.sphere import directions
from jaxprt.systems.lamps.outline import lobe_integral
from jaxprt.systems.protocol import Blend
from jaxprt.visibility.blocks import Run

HEIGHT, SIDE = 0.8, 0.3
SAMPLED = 0.01  # what 256 points on a lamp leave of its irradiance, relative to the norm
FLAT_SHAPED = 0.015  # of a highlight of a flat lamp, relative to the norm: it has the solid angle that samples see


def square(center, half: float, *, down: bool) -> Mesh:
    """A square that lies flat."""
    corner = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * half + center
    normal = np.tile([0.0, -1.0 if down else 1.0, 0.0], (4, 1))
    return make_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]), normal=normal)


def floor(cells: int) -> Mesh:
    x, z = np.meshgrid(np.linspace(-1, 1, cells), np.linspace(-1, 1, cells))
    position = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    first = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)).ravel()
    face = np.concatenate([np.stack([first, first + cells, first + 1], 1)])
    other = np.stack([first + 1, first + cells, first + cells + 1], 1)
    return make_mesh(position, np.concatenate([face, other]), normal=np.tile([0.0, 1.0, 0.0], (len(position), 1)))


GROUND, LAMP = floor(7), square([0, HEIGHT, 0], SIDE, down=True)
COUNT = len(GROUND.position)
QUIET = Run(progress=False)
BULB = PointLight("bulb", [0.2, 0.5, -0.3], 2.0)


@pytest.fixture(scope="module")
def transport() -> lamps.LampTransport:
    return lamps.precompute(GROUND, [LAMP, BULB], occluder=join([GROUND, LAMP]))


def irradiance(point: np.ndarray, lamp: Mesh = LAMP) -> float:
    """Of a rectangle parallel to a small surface: Lambert's formula over its edges."""
    corner = np.asarray(lamp.position, np.float64) - point
    unit = corner / np.linalg.norm(corner, axis=1, keepdims=True)
    following = np.roll(unit, -1, 0)
    across = np.cross(unit, following)
    angle = np.arccos(np.clip(np.sum(unit * following, 1), -1, 1))
    return float(abs(np.sum(across[:, 1] / np.linalg.norm(across, axis=1) * angle)) / 2)


def lamp_integral(value, most: float = SIDE) -> np.ndarray:
    """Sum over a fine grid on the lamp up to an x: value(direction [n 3]) at each vertex, times solid angle."""
    grid = (np.arange(120) + 0.5) / 120 * 2 * SIDE - SIDE
    x, z = np.meshgrid(grid, grid)
    place = np.stack([x, 0 * x + HEIGHT, z], -1)
    area, place = (2 * SIDE / 120) ** 2, place[x < most]
    result = []
    for number, point in enumerate(np.asarray(GROUND.position, np.float64)):
        way = place - point
        square_ = np.sum(way**2, 1)
        unit = way / np.sqrt(square_)[:, None]
        result.append(np.sum(value(number, unit) * unit[:, 1] / square_) * area)
    return np.array(result)


def test_the_irradiance_of_a_square_is_lamberts_formula(transport):
    expected = np.array([irradiance(point) for point in np.asarray(GROUND.position, np.float64)])
    got = sum(np.asarray(each) for each, lamp in zip(transport.cosine, transport.lamp, strict=True) if lamp == 0)
    assert np.linalg.norm(got - expected) <= SAMPLED * np.linalg.norm(expected)
    solid = sum(np.asarray(each) for each, lamp in zip(transport.solid_angle, transport.lamp, strict=True) if lamp == 0)
    expected = lamp_integral(lambda number, unit: np.ones(len(unit)))
    assert np.linalg.norm(solid - expected) <= SAMPLED * np.linalg.norm(expected)


def test_near_lamps_are_lamberts_formula_too():
    """A thirtieth of the lamp's width above the middle of the ground, where 256 points are too few."""
    close_by = square([0.0, 0.02, 0.0], SIDE, down=True)
    near = lamps.precompute(GROUND, [close_by], occluder=join([GROUND, close_by]))
    middle = int(np.argmin(np.abs(np.asarray(near.position)).sum(1)))
    expected = irradiance(np.zeros(3), close_by)
    np.testing.assert_allclose(np.sum(np.asarray(near.cosine)[:, middle]), expected, rtol=0.08)


def test_a_point_light_falls_with_the_square_of_the_distance(transport, close):
    way = np.asarray(BULB.position) - np.asarray(GROUND.position)
    square_ = np.sum(way**2, 1)
    close(np.asarray(transport.solid_angle[-1]), 1 / square_, tolerance=1e-4)  # rays start off the surface
    close(np.asarray(transport.cosine[-1]), way[:, 1] / square_**1.5, tolerance=1e-4)


def test_a_spot_lights_its_cone(transport):
    axis, inner, outer = np.array([0.3, -1.0, 0.2]), 0.4, 1.0
    spot = PointLight("spot", BULB.position, 2.0, axis=axis, cone=(inner, outer))
    lit = lamps.precompute(GROUND, [LAMP, spot], occluder=join([GROUND, LAMP]))
    way = np.asarray(GROUND.position, np.float64) - np.asarray(BULB.position)
    angle = np.arccos(way @ axis / np.linalg.norm(way, axis=1) / np.linalg.norm(axis))
    # KHR_lights_punctual, "Inner and Outer Cone Angles".
    scale = 1 / max(0.001, np.cos(inner) - np.cos(outer))
    expected = np.clip(np.cos(angle) * scale - np.cos(outer) * scale, 0, 1) ** 2
    assert (expected == 0).any()
    assert (expected == 1).any()
    np.testing.assert_allclose(lit.solid_angle[-1], transport.solid_angle[-1] * expected, atol=1e-4)
    np.testing.assert_array_equal(lit.solid_angle[:-1], transport.solid_angle[:-1])
    for wrong in ({"axis": [0, 0, 0]}, {"axis": axis, "cone": (1.0, 0.5)}, {"axis": [np.inf, 0, 0]}):
        with pytest.raises(ValueError, match="of point light 'spot' must be"):
            PointLight("spot", BULB.position, 2.0, **wrong)


def test_what_stands_between_casts_a_shadow_and_backs_send_nothing():
    wall = square([0, HEIGHT / 2, 0], 3.0, down=True)
    dark = lamps.precompute(GROUND, [LAMP, BULB], occluder=join([GROUND, LAMP, wall]), samples=16)
    assert not np.any(dark.solid_angle)
    turned = square([0, HEIGHT, 0], SIDE, down=False)
    away = lamps.precompute(GROUND, [turned], occluder=join([GROUND, turned]), samples=16)
    assert not np.any(away.solid_angle)
    below = PointLight("below", [0.0, -1.0, 0.0], 1.0)
    assert not np.any(lamps.precompute(GROUND, [below]).solid_angle)


@pytest.fixture(scope="module")
def screen() -> Mesh:
    """What hides the half of the lamp at x > 0, just below it."""
    high = HEIGHT - 1e-3
    corner = np.array([[0.0, high, -3], [3.0, high, -3], [3.0, high, 3], [0.0, high, 3]])
    return make_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]), normal=np.tile([0.0, 1.0, 0.0], (4, 1)))


def test_half_a_lamp_behind_an_edge_sends_half_its_light(screen):
    """The edge of the screen halves the lamp for vertices at x = 0, and hides nothing else's half."""
    options = {"samples": 256, "pieces": 1}
    whole, half = (
        np.asarray(lamps.precompute(GROUND, [LAMP], occluder=join([GROUND, LAMP, *more]), **options).cosine)
        for more in ([], [screen])
    )
    middle = np.abs(np.asarray(GROUND.position)[:, 0]) < 1e-6
    np.testing.assert_allclose((half / whole)[0, middle], 0.5, atol=0.02)


mean_density = jax.jit(lamps.relight.mean_density)


@pytest.mark.parametrize("chord", [0.0, 0.02, 0.3])
def test_lobes_over_disks_are_normal_distributions_over_disks(chord):
    apart = np.linspace(0, 0.9, 25)
    toward = np.stack([np.sin(apart), 0 * apart, np.cos(apart)])
    for concentration in (3.0, 40.0, 700.0):
        mean = np.tile(np.float32([0, 0, 1])[:, None, None], (1, 1, 25))
        sharp, size = np.full((1, 25), concentration, np.float32), np.full(25, chord, np.float32)
        got = np.asarray(mean_density(mean, sharp, list(toward.astype(np.float32)), size))[0]
        offset = concentration * np.sum((toward - np.array([[0], [0], [1.0]])) ** 2, 0)
        if chord:
            inside = scipy.stats.ncx2.cdf(concentration * chord, 2, offset) / (np.pi * chord)
        else:
            inside = concentration / (2 * np.pi) * np.exp(-offset / 2)
        expected = inside / -np.expm1(-2 * concentration)
        assert np.abs(got - expected).max() <= 0.03 * expected.max()


@pytest.mark.parametrize("concentration", [3.0, 30.0, 1000.0])
def test_lobes_over_polygons_are_sums_over_the_sphere(concentration):
    """For 24 lobes around a square of .3 to 1.5 radians, a long panel, and a triangle beside which lobes are pads."""
    random = np.random.default_rng(0)
    square_ = np.array([[-0.2, -0.2, 1], [0.2, -0.2, 1], [0.2, 0.2, 1], [-0.2, 0.2, 1]])
    for corner in (square_, square_ * [4, 4, 1], square_ * [5, 0.3, 1] + [0.3, 0, 0], square_[[0, 1, 2, 2]]):
        unit = corner / np.linalg.norm(corner, axis=1, keepdims=True)
        # Each triangle of a fan by the middles of 300 x 300 cells of a square, of which one side is its first corner.
        u, v = np.meshgrid(*[(np.arange(300) + 0.5) / 300] * 2)
        first, second, third = corner[0], corner[1:-1, None, None], corner[2:, None, None]
        place = first + u[..., None] * (second - first + v[..., None] * (third - second))
        length = np.linalg.norm(place, axis=-1)
        area = u / 300**2 * np.linalg.norm(np.cross(second - first, third - first), axis=-1) / length**3
        mean = random.dirichlet(np.ones(4), 24) @ corner + random.normal(size=(24, 3)) * [0.1, 0.1, 0]
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        peak = concentration / (-2 * np.pi * np.expm1(-2 * concentration))
        way = place / length[..., None]
        expected = [np.sum(peak * np.exp(concentration * (way @ m - 1)) * area) for m in mean]
        sharp = jnp.full((24, 1), concentration, jnp.float32)
        got = np.asarray(
            lobe_integral(jnp.asarray(mean.T[..., None], jnp.float32), sharp, jnp.asarray(unit[..., None], jnp.float32))
        )
        np.testing.assert_allclose(got[:, 0], expected, atol=2e-3)
        assert np.ptp(expected) > 0.1 * np.max(expected)


def test_integrals_over_polygons_and_their_slopes_are_finite_where_means_are_corners_poles_and_on_edges():
    corner = np.array([[-0.6, 0, 0.8], [0.6, 0, 0.8], [0.6, 0.8, 0], [0, 0.8, 0.6], [-0.3, 0.4, 0.7]])
    corner[-1] /= np.linalg.norm(corner[-1])
    mean = np.concatenate([corner, [[0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 0]], np.cross(corner[0], corner[1:2])])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    arguments = [np.float32(each) for each in (mean.T[..., None], np.full((len(mean), 1), 50), corner[..., None])]
    value = lobe_integral(*arguments)
    assert np.all((np.asarray(value) >= 0) & (np.asarray(value) <= 1))
    for slope in jax.jit(jax.grad(lambda *x: jnp.sum(lobe_integral(*x) ** 2), argnums=(0, 1, 2)))(*arguments):
        assert np.isfinite(slope).all()


def flat_lamps(mesh: Mesh) -> tuple[int, ...]:
    return lamps.precompute(GROUND, [mesh], samples=16, run=QUIET).flat


def test_flat_convex_lamps_are_polygons_and_others_are_disks():
    grid = floor(9)
    turn = np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]])
    for mesh in (LAMP, grid, make_mesh(np.asarray(grid.position) @ turn, grid.face)):
        assert flat_lamps(mesh) == (0,)
    eight, nine = (disk(corners) for corners in (8, 9))
    assert flat_lamps(eight) == (0,)
    assert flat_lamps(make_mesh(LAMP.position, np.asarray(LAMP.face)[:1])) == (0,)
    position, face = np.asarray(grid.position), np.asarray(grid.face)
    corner = face[np.any(position[face].min(1)[:, [0, 2]] < -0.5, 1)]
    sheet = join([LAMP, square([0, HEIGHT, 0], SIDE, down=False)])
    bent = make_mesh(position + [0, 0.1, 0] * position[:, :1] ** 2, face)
    twice = make_mesh(position, np.concatenate([corner, corner]))
    for mesh in (nine, make_mesh(position, corner), twice, sheet, bent, builtin.sphere(rings=8, sectors=16)):
        assert flat_lamps(mesh) == ()
    both = lamps.precompute(GROUND, [BULB, sheet, LAMP], samples=16, run=QUIET)
    assert both.flat == (2,)
    np.testing.assert_allclose(both.outline[0, 1:].sum(0).mean(0), 4 * np.array([0, HEIGHT, 0]), atol=1e-6)


def wall(low: float, high: float, half: float = 0.5) -> Mesh:
    """A panel in the plane x = -0.1 that shines towards +x."""
    corner = np.array([[-0.1, low, -half], [-0.1, high, -half], [-0.1, high, half], [-0.1, low, half]])
    return make_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]), normal=np.tile([1.0, 0.0, 0.0], (4, 1)))


TABLE = {"lobes": 4, "resolution": 12}


def test_panels_through_the_horizon_are_those_above_it():
    table, eye = lobe.tabulate(GGX(f0=0.9, roughness=0.4), **TABLE), jnp.array([1.0, 0.5, 0.1])
    options = {"pieces": 16, "run": QUIET}
    through, above = (
        np.asarray(lamps.LitByLamps(lamps.precompute(GROUND, [panel], **options), table).view(eye))[0, :, 0]
        for panel in (wall(-0.2, 0.5), wall(0.0, 0.5))
    )
    front = np.asarray(GROUND.position)[:, 0] > 0.1
    assert np.linalg.norm((through - above)[front]) < 0.01 * np.linalg.norm(above[front])


def test_points_behind_a_panel_see_no_highlight_and_have_slopes():
    table, eye = lobe.tabulate(GGX(f0=0.9, roughness=0.4), **TABLE), jnp.array([1.0, 0.5, 0.1])
    lit = lamps.LitByLamps(lamps.precompute(GROUND, [wall(0.05, 0.6)], run=QUIET), table)
    face = np.asarray(GROUND.face)
    points = on_triangles(face, np.arange(len(face)), np.tile(np.float32([0.6, 0.3, 0.1]), (len(face), 1)))
    behind = np.asarray(points.carry(lit.transport.position))[:, 0] < -0.1
    sent, at_vertices = np.asarray(lit.view(eye, None, points))[0, :, 0], np.asarray(lit.view(eye))[0, :, 0]
    # Diffuse light is interpolated across the panel.
    assert np.abs(sent[behind]).max() < 0.05 * at_vertices.max()
    assert sent.max() < 1.1 * at_vertices.max()

    def total(eye, table):
        return jnp.sum(lamps.LitByLamps(lit.transport, table).view(eye) ** 2)

    for slope in jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1), allow_int=True))(eye, table)):
        assert np.isfinite(slope).all()


@pytest.mark.parametrize(("half", "wide"), [(3e-3, False), (3e-4, False), (3e-5, False), (3e-3, True)])
def test_small_panels_are_point_lights(half, wide):
    """A panel that is much smaller than its distance lights the ground as a point light of the same flux does."""
    table, eye = lobe.tabulate(GGX(f0=0.9, roughness=0.3), **TABLE), jnp.array([0.4, 0.8, 0.6])
    if wide:  # of concentration 1
        table = dataclasses.replace(table, scale=0 * table.scale)
    small = lamps.precompute(GROUND, [square([0, HEIGHT, 0], half, down=True)], run=QUIET)
    bulb = lamps.precompute(GROUND, [PointLight("bulb", [0, HEIGHT, 0], 1.0)], run=QUIET)
    got, expected = (np.asarray(lamps.LitByLamps(each, table).view(eye))[0, :, 0] for each in (small, bulb))
    position = np.asarray(GROUND.position, np.float64) - [0, HEIGHT, 0]
    expected = expected * 4 * half**2 * -position[:, 1] / np.linalg.norm(position, axis=1)
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-4 * expected.max())


def disk(corners: int) -> Mesh:
    angle = 2 * np.pi * np.arange(corners) / corners
    position = np.stack([np.cos(angle), 1 + 0 * angle, np.sin(angle)], -1)
    rest = np.arange(1, corners - 1)
    return make_mesh(position, np.stack([0 * rest, rest, rest + 1], 1), normal=np.tile([0.0, -1.0, 0.0], (corners, 1)))


reflected = jax.jit(lambda table, wi, wo: table(wi, wo))


@pytest.mark.parametrize("hidden", [False, True])
def test_highlights_of_lamps_are_integrals_over_what_is_seen_of_the_lamp(close, screen, hidden):
    """Of what the table of lobes says of the BRDF, so that its own error has no part."""
    eye = jnp.array([0.4, 0.8, 0.6])  # sees the lamp mirrored around a vertex
    options = {"pieces": 16, "occluder": join([GROUND, LAMP, *([screen] if hidden else [])])}
    fine = lamps.precompute(GROUND, [LAMP, BULB], **options)
    for roughness in (0.3, 0.5):
        table = lobe.tabulate(GGX(f0=0.9, roughness=roughness), lobes=4, resolution=12)
        lit = lamps.LitByLamps(fine, table)
        wo = np.asarray(directions.view(fine.frame, fine.position, eye))
        frame = np.asarray(fine.frame)

        def value(number, unit, table=table, wo=wo, frame=frame):
            wi = jnp.asarray(unit @ frame[number].T, jnp.float32)
            # The table holds the cosine.
            return np.asarray(reflected(table, wi, np.broadcast_to(wo[number], wi.shape)))[:, 0]

        sent = lit.view(eye)
        close(np.asarray(lit.view(jnp.asarray(np.tile(eye, (COUNT, 1))))), np.asarray(sent))
        # Rays take no more than there is.
        left = np.asarray(lit.view(eye, traced=jnp.ones(COUNT)))
        assert np.all(left <= np.asarray(sent) * (1 + 1e-5))
        assert np.all(left >= 0)
        expected = lamp_integral(value, 0.0 if hidden else SIDE)
        got = np.asarray(lit.combine(jnp.array([[1.0], [0.0]]), sent))[:, 0]
        assert np.linalg.norm(got - expected) <= FLAT_SHAPED * np.linalg.norm(expected)
        way = np.asarray(BULB.position) - np.asarray(GROUND.position)
        unit = way / np.linalg.norm(way, axis=1, keepdims=True)
        wi = jnp.asarray(np.einsum("vij,vj->vi", frame, unit), jnp.float32)
        expected = np.asarray(reflected(table, wi, wo))[:, 0] / np.sum(way**2, 1)
        got = np.asarray(lit.combine(jnp.array([[0.0], [1.0]]), sent))[:, 0]
        close(got, expected, tolerance=1e-3)  # rays start off the surface, and lobes are sharp


def test_points_on_vertices_are_these_vertices_and_matte_ones_do_not_depend_on_the_eye(transport, close):
    blend = Blend(jnp.asarray(np.random.default_rng(0).uniform(size=(COUNT, 1, 3)).astype(np.float32)))
    lit, eye = lamps.LitByLamps(transport), jnp.array([0.3, 1.0, 0.5])
    every = np.asarray(lit.view(eye, blend))
    np.testing.assert_array_equal(every, lit.view(jnp.asarray(-np.asarray(eye)), blend))
    face = np.asarray(GROUND.face)
    points = on_triangles(face, np.arange(len(face)), np.tile(np.float32([1, 0, 0]), (len(face), 1)))
    there = jax.tree.map(points.carry, blend)
    close(np.asarray(lit.view(eye, there, points)), every[:, face[:, 0]])
    gray, white = (np.asarray(each.view(eye)) for each in (lamps.LitByLamps(transport, albedo=[0.5]), lit))
    close(2 * gray, white)


def test_bad_lamps_are_refused(unchecked):
    flat = make_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), normal=np.tile([0.0, 1.0, 0.0], (3, 1)))
    for given, message in (
        ({"lamps": []}, "lamps must be at least one, got none"),
        ({"lamps": [flat]}, "a lamp must have an area"),
        ({"lamps": [LAMP], "pieces": 3}, "pieces must be a power of two, and at most the 256 samples, got 3"),
        ({"lamps": [LAMP], "samples": 2}, "at most the 2 samples, got 4"),
    ):
        with pytest.raises(ValueError, match=message):
            lamps.precompute(GROUND, **given)
    with pytest.raises(TypeError, match="lamp 0 must be"):
        lamps.precompute(GROUND, ["lamp"])
    with pytest.raises(ValueError, match="intensity of point light 'dark' must be at least 0"):
        PointLight("dark", [0, 0, 0], -1.0)
    with pytest.raises(ValueError, match="position of point light 'lost'"):
        PointLight("lost", [0, np.nan, 0], 1.0)
