"""Bright texels one by one: what is taken out of a light, and that it lights as the light did."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt
from jaxprt import bright_texels, harmonic, lobe, reference
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join
from jaxprt.scene.points import Points
from jaxprt.sphere import cubemap
from jaxprt.systems import light_cells
from jaxprt.visibility import precompute
from jaxprt.visibility.blocks import Run

SIZE = 8
ALL = 6 * SIZE**2
COUNT = 6
EYE = jnp.array([1.0, 2.0, 3.0])
GLOSSY = AshikhminShirley(diffuse=[0.3, 0.2, 0.1], specular=[0.2, 0.4, 0.5], nu=20.0, nv=80.0)
GRAY = AshikhminShirley(diffuse=0.3, specular=0.4, nu=20.0, nv=80.0)


@pytest.fixture
def random():
    return np.random.default_rng(11)


@pytest.fixture(scope="module")
def mesh():
    return join([builtin.sphere(rings=5, sectors=7), builtin.plane(cells=2)])


@pytest.fixture(scope="module")
def transport(mesh):
    return precompute(mesh, size=SIZE)


@pytest.fixture(scope="module")
def sky():
    """Daylight, whose sun is some hundred times as bright as the rest."""
    return builtin.daylight(size=SIZE)


def flux(radiance):
    """Flux of each texel, all colors together, in float64."""
    radiance = np.asarray(radiance, np.float64).reshape(ALL, -1)
    return radiance.sum(1) * np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()


def whole(texel, excess):
    """An environment of nothing but the excess."""
    radiance = jnp.zeros((ALL, excess.shape[1])).at[texel].set(excess)
    return Environment(radiance.reshape(6, SIZE, SIZE, -1))


def exact(transport, brdf, light, eye=EYE):
    """Every texel summed with the BRDF at its center and the same stored visibility."""
    seen = jnp.asarray(transport.seen(np.arange(len(transport.position))))
    return reference.integrate(seen, transport.position, transport.frame, brdf, light, eye, error=np.inf)


shine = jax.jit(bright_texels.radiance)  # one program; outside of programs it looks at values as well


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("strength", [1e-20, 1.0, 1e28])
def test_excess_and_rest_are_the_light(random, colors, strength):
    radiance = strength * random.exponential(size=(6, SIZE, SIZE, colors)).astype(np.float32) ** 3
    texel, excess, rest = bright_texels.split(Environment(jnp.asarray(radiance, jnp.float32)), count=COUNT)
    order = np.argsort(-flux(radiance))
    np.testing.assert_array_equal(texel, order[:COUNT])
    np.testing.assert_allclose(whole(texel, excess).radiance + rest.radiance, radiance, rtol=1e-6)
    assert np.all(np.asarray(excess) > 0)
    assert np.all(np.asarray(rest.radiance) >= 0)
    # What is left is level with the brightest that was not taken, and all others are as they were.
    np.testing.assert_allclose(flux(rest.radiance)[order[:COUNT]], flux(radiance)[order[COUNT]], rtol=1e-5)
    untouched = np.asarray(rest.radiance).reshape(ALL, -1)[order[COUNT:]]
    np.testing.assert_array_equal(untouched, radiance.reshape(ALL, -1)[order[COUNT:]])


@pytest.mark.parametrize("count", [1, 40, 300])
@pytest.mark.parametrize("kind", ["random", "constant", "few"])
def test_the_brightest_are_taken_and_of_equal_ones_the_first(random, kind, count):
    brightness = {
        "random": random.random(6 * 32**2),
        "constant": np.ones(6 * 32**2),
        "few": random.integers(3, size=6 * 32**2),
    }
    light = Environment(jnp.asarray(brightness[kind].reshape(6, 32, 32, 1), jnp.float32))
    texel, _, _ = bright_texels.split(light, count=count)
    flux = np.asarray(light.radiance[..., 0] * cubemap.solid_angle(size=32)).ravel()
    np.testing.assert_array_equal(texel, np.argsort(-flux, kind="stable")[:count])


def test_a_texel_keeps_its_color(random):
    radiance = jnp.asarray(random.uniform(0.1, 3, size=(6, SIZE, SIZE, 3)), jnp.float32)
    texel, excess, rest = bright_texels.split(Environment(radiance), count=COUNT)
    before = np.asarray(radiance).reshape(ALL, 3)[texel]
    for part in (np.asarray(excess)[:-1], np.asarray(rest.radiance).reshape(ALL, 3)[texel[:-1]]):
        part = part / part.sum(1, keepdims=True)
        np.testing.assert_allclose(part, before[:-1] / before[:-1].sum(1, keepdims=True), rtol=1e-3)


def test_texels_of_equal_flux_have_no_excess():
    solid_angle = cubemap.solid_angle(size=SIZE)[..., None]
    flat = Environment(1 / solid_angle)
    _, excess, rest = bright_texels.split(flat, count=COUNT)
    np.testing.assert_allclose(excess * solid_angle.max(), 0, atol=1e-6)
    np.testing.assert_allclose(rest.radiance, flat.radiance, rtol=1e-6)
    constant = Environment(jnp.ones((6, SIZE, SIZE, 1)))
    _, excess, rest = bright_texels.split(constant, count=COUNT)
    # Four texels around each of six face centers are alike and the largest.
    np.testing.assert_allclose(excess, 0, atol=1e-6)
    np.testing.assert_allclose(rest.radiance, 1, rtol=1e-6)


def test_fewer_bright_texels_than_asked_for_are_taken_whole():
    radiance = jnp.zeros((6, SIZE, SIZE, 3)).at[2, 3, 4].set(jnp.array([5.0, 3, 0])).at[0, 0, 0].set(1.0)
    texel, excess, rest = bright_texels.split(Environment(radiance), count=COUNT)
    np.testing.assert_array_equal(texel[:2], [2 * 64 + 3 * 8 + 4, 0])
    np.testing.assert_array_equal(excess[:3], [[5, 3, 0], [1, 1, 1], [0, 0, 0]])
    assert not np.asarray(rest.radiance).any()


def test_all_but_one_texel_can_be_taken(random):
    radiance = random.uniform(1, 2, size=(6, SIZE, SIZE, 3)).astype(np.float32)
    texel, excess, rest = bright_texels.split(Environment(jnp.asarray(radiance)), count=ALL - 1)
    np.testing.assert_allclose(flux(rest.radiance), flux(radiance).min(), rtol=1e-5)
    np.testing.assert_allclose(whole(texel, excess).radiance + rest.radiance, radiance, rtol=1e-6)


def test_a_batch_of_lights_is_refused(sky):
    with pytest.raises(ValueError, match=r"the light must be one environment \[6, n, n, c\], got \[2, 6, 8, 8, 3\]"):
        bright_texels.split(Environment(jnp.stack([sky.radiance] * 2)), count=COUNT)


def test_a_light_of_float32_keeps_its_type_where_float64_is_enabled(sky, x64):
    _, excess, rest = bright_texels.split(sky, count=COUNT)
    assert excess.dtype == rest.radiance.dtype == np.float32


@pytest.mark.parametrize("part", ["vertices", "texels"])
def test_none_have_no_radiance(mesh, transport, part):
    count = 0 if part == "texels" else COUNT
    lit = precompute(mesh, size=SIZE, vertex=np.zeros(0, int)) if part == "vertices" else transport
    color = shine(lit, GLOSSY, jnp.zeros(count, int), jnp.ones((count, 3)), eye=EYE)
    assert color.shape == (len(lit.position), 3)
    assert not np.asarray(color).any()


def test_none_may_be_taken(transport, sky):
    texel, excess, rest = bright_texels.split(sky, count=0)
    np.testing.assert_array_equal(rest.radiance, sky.radiance)
    assert not np.asarray(shine(transport, GLOSSY, texel, excess, eye=EYE)).any()


@pytest.mark.parametrize("count", [-1, ALL])
def test_an_impossible_number_of_texels_is_refused(sky, count):
    with pytest.raises(ValueError, match=f"number of texels must be from 0 to {ALL - 1}, got {count}"):
        bright_texels.split(sky, count=count)


def test_the_excess_has_finite_slopes_even_in_the_dark(random):
    """As an inverse problem meets them: a light that starts black."""

    def energy(radiance):
        _, excess, rest = bright_texels.split(Environment(radiance), count=COUNT)
        return jnp.sum(jnp.sin(excess)) + jnp.sum(rest.radiance**2)

    for radiance in (jnp.zeros((6, SIZE, SIZE, 3)), jnp.ones((6, SIZE, SIZE, 3))):
        assert np.isfinite(np.asarray(jax.grad(energy)(radiance))).all()


@pytest.mark.parametrize("colored", ["both", "light", "brdf", "neither"])
def test_excess_and_rest_light_as_the_light_did(transport, sky, close, colored):
    brdf = GLOSSY if colored in ("both", "brdf") else GRAY
    light = sky if colored in ("both", "light") else Environment(sky.radiance[..., :1])
    texel, excess, rest = bright_texels.split(light, count=COUNT)
    bright = shine(transport, brdf, texel, excess, eye=EYE)
    assert bright.shape == (39, 1 if colored == "neither" else 3)
    close(bright, exact(transport, brdf, whole(texel, excess)))
    close(bright + exact(transport, brdf, rest), exact(transport, brdf, light))
    assert np.count_nonzero(np.asarray(bright).any(1)) > 10


def test_what_vertices_see_of_the_texels_may_be_looked_up_before_or_with_the_view(mesh, transport, sky, close):
    nothing = harmonic.DiffuseSystem(harmonic.precompute_diffuse(mesh, size=SIZE), jnp.zeros(3))
    system = bright_texels.BrightTexels(nothing, transport, GLOSSY, count=COUNT)
    lit, seen = system.light(sky), system.view(EYE)
    assert lit.seen is None
    assert np.shape(system.shade(lit).seen) == (COUNT, len(transport.position))
    np.testing.assert_array_equal(system.combine(system.shade(lit), seen), system.combine(lit, seen))
    close(system.combine(lit, seen), shine(transport, GLOSSY, lit.texel, lit.excess, eye=EYE))


def test_bright_texels_on_matte_surfaces_are_one_vector_for_all_views(mesh, transport, sky, close):
    albedo = jnp.array([0.8, 0.5, 0.2])
    diffuse = harmonic.DiffuseSystem(harmonic.precompute_diffuse(mesh, size=SIZE), albedo)
    system = bright_texels.BrightTexels(diffuse, transport, Lambert(albedo), count=40)
    lit = system.shade(system.light(sky))
    assert lit.flux is not None
    rest = diffuse.combine(diffuse.shade(diffuse.light(bright_texels.split(sky, count=40)[2])), diffuse.view(EYE))
    expected = shine(transport, Lambert(albedo), lit.texel, lit.excess, eye=EYE)
    close(system.combine(lit, system.view(EYE)) - rest, expected)
    np.testing.assert_array_equal(
        system.combine(system.light(sky), system.view(EYE)), system.combine(lit, system.view(EYE))
    )
    at = Points(mesh.face[:5].T, jnp.full((3, 5), 1 / 3))
    frame = np.asarray(at.frame(transport.frame))[:, 2]
    row = np.asarray(at.carry(lit.flux, axis=2))
    tilted = at.tilted(frame + 0.2 * np.roll(frame, 1, 1))
    upright = np.einsum("ckv,vk->vc", row[:, :3], frame)
    for place, normal in ((at, frame), (tilted, np.asarray(tilted.normal).T)):
        flux = np.einsum("ckv,vk->vc", row[:, :3], normal) + np.maximum(row[:, 3].T - upright, 0)
        under = diffuse.combine(lit.rest, diffuse.view(EYE, None, place), place)
        found = system.combine(lit, system.view(EYE, None, place), place) - under
        close(found, np.maximum(flux, 0) * np.asarray(albedo))


@pytest.mark.parametrize(("count", "most"), [(1, 0.03), (64, 0.01)])
def test_points_of_a_matte_ball_are_lit_by_their_cosines(count, most):
    """A ball alone: nothing but its own horizon hides a sun of one texel, or a sky of many."""
    ball, random = builtin.sphere(rings=12, sectors=24), np.random.default_rng(count)
    seen = precompute(ball, size=SIZE, run=Run(progress=False))
    sky = np.zeros((6 * SIZE**2, 3), np.float32)
    sky[random.choice(len(sky), count, replace=False)] = random.uniform(50, 100, (count, 1))
    diffuse = harmonic.DiffuseSystem(harmonic.precompute_diffuse(ball, size=SIZE), jnp.ones(3))
    system = bright_texels.BrightTexels(diffuse, seen, Lambert([1.0, 1.0, 1.0]), count=count)
    lit = system.shade(system.light(Environment(jnp.asarray(sky.reshape(6, SIZE, SIZE, 3)))))
    at = Points(ball.face.T, jnp.asarray(random.dirichlet([1, 1, 1], len(ball.face)).T, jnp.float32))
    area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)[np.asarray(lit.texel)]
    cosine = np.maximum(np.asarray(at.frame(seen.frame))[:, 2] @ area.T, 0)
    expected = cosine @ np.asarray(lit.excess) / np.pi
    under = diffuse.combine(lit.rest, diffuse.view(EYE, None, at), at)
    found = system.combine(lit, system.view(EYE, None, at), at) - under
    assert np.linalg.norm(found - expected) < most * np.linalg.norm(expected)


def test_texels_in_any_order_and_twice_over_add_up(transport, sky, close):
    texel, excess, _ = bright_texels.split(sky, count=COUNT)
    color = shine(transport, GLOSSY, texel, excess, eye=EYE)
    close(shine(transport, GLOSSY, texel[::-1], excess[::-1], eye=EYE), color)
    same = jnp.full(COUNT, texel[0])
    once = shine(transport, GLOSSY, same, excess * jnp.eye(COUNT)[0][:, None], eye=EYE)
    close(shine(transport, GLOSSY, same, jnp.tile(excess[:1] / COUNT, (COUNT, 1)), eye=EYE), once)


def test_texels_and_excess_of_whole_numbers_count_as_such_and_those_of_another_light_are_refused(
    transport, close, unchecked
):
    """Whole numbers gave black, texels of a finer light those of others."""
    texel = jnp.arange(16)
    whole = jnp.full((16, 3), 2)
    close(
        bright_texels.radiance(transport, GLOSSY, texel, whole, eye=EYE),
        bright_texels.radiance(transport, GLOSSY, texel, 2.0 * jnp.ones((16, 3)), eye=EYE),
    )
    most = 6 * transport.size**2
    for call in (
        partial(bright_texels.irradiance, transport),
        lambda *given: bright_texels.radiance(transport, GLOSSY, *given, eye=EYE),
    ):
        with pytest.raises(ValueError, match=f"the texels must be between 0 and {most - 1}, got 1 of 16"):
            call(texel + most - 15, jnp.ones((16, 3)))
        with pytest.raises(ValueError, match="the excess must be finite"):
            call(texel, jnp.full((16, 3), jnp.nan))


def soft(size=32):
    """A room with two soft boxes over a dim gradient, and noise in every texel."""
    s, t = np.meshgrid(np.arange(size), np.arange(size))
    room = np.random.default_rng(3).uniform(0.05, 0.15, (6, size, size, 3)) * np.array([1.0, 0.9, 0.7])
    room[2] += 4 * ((abs(s - 9) < 4) & (abs(t - 20) < 7))[..., None]
    room[0] += 9 * ((abs(s - 22) < 2) & (abs(t - 12) < 3))[..., None]
    return Environment(jnp.asarray(room, jnp.float32))


@pytest.mark.parametrize("strength", [1e-20, 1.0, 1e28])
def test_cells_and_rest_are_the_light_and_leave_it_even(strength):
    size = 32
    light = Environment(strength * soft(size).radiance)
    cell, excess, rest = light_cells.split(light)
    left, first = np.asarray(light.radiance, np.float64), 0
    area = np.asarray(cubemap.solid_angle(size=size), np.float64)[..., None]
    for edge, count in ((16, 64), (8, 64)):
        rows, fold = slice(first, first + count), size // edge
        taken, cells = np.asarray(excess, np.float64)[rows], np.asarray(cell)[rows]

        def mean(value, edge=edge, fold=fold):
            value, weight = (
                x.reshape(6, edge, fold, edge, fold, -1) for x in (value * area, area + 0 * value[..., :1])
            )
            return (value.sum((2, 4)) / weight.sum((2, 4))).reshape(6 * edge**2, -1)

        solid = area.reshape(6, edge, fold, edge, fold).sum((2, 4)).ravel()
        before = mean(left).sum(1) * solid
        np.testing.assert_array_equal(np.sort(cells), np.sort(np.argsort(-before)[:count]))  # those with the most flux
        whole = np.zeros((6 * edge**2, 3))
        whole[cells] = taken
        left = left - whole.reshape(6, edge, edge, 3).repeat(fold, 1).repeat(fold, 2)
        after = mean(left).sum(1) * solid
        np.testing.assert_allclose(after[cells], np.sort(before)[-count - 1], rtol=1e-3)
        first += count
    assert np.all(np.asarray(excess) >= 0)
    np.testing.assert_allclose(np.asarray(rest.radiance, np.float64), left, atol=1e-5 * strength)


def test_a_black_light_has_no_cells_and_stays_black():
    _, excess, rest = light_cells.split(Environment(jnp.zeros((6, 32, 32, 3))))
    assert not np.any(np.asarray(excess))
    assert not np.any(np.asarray(rest.radiance))


def test_soft_boxes_half_hidden_from_glossy_surfaces_are_right_by_cells(mesh):
    """Lobes read the light and what is seen of it apart: beside a box behind the horizon of a neighbor they are off."""
    light, brdf = soft(), AshikhminShirley(diffuse=0.0, specular=0.8, nu=20.0, nv=20.0)
    seen = precompute(mesh, size=32, run=Run(progress=False))
    rest = lobe.LobeSystem(lobe.compress(seen), lobe.tabulate(brdf, lobes=4))
    expected = np.asarray(exact(seen, brdf, light))
    off = []
    for cells in (False, True):
        system = bright_texels.BrightTexels(rest, rest.transport, brdf, count=8, samples=1, cells=cells)
        off.append(
            np.linalg.norm(np.asarray(jaxprt.radiance(system, light, eye=EYE)) - expected) / np.linalg.norm(expected)
        )
    assert off[1] < 0.4 * off[0]
    assert off[1] < 0.03


def test_the_light_chooses_small_cells_for_small_boxes_and_medium_ones_for_a_sky():
    """Of the places for cells of 6 x 32 x 32, 16 x 16 and 8 x 8 those of one size stay empty."""
    boxes = np.full((6, 64, 64, 3), 0.01, np.float32)
    boxes[2, 20:28, 30:36] = boxes[4, 40:44, 10:20] = 10.0
    x, y = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64))
    sky = 1 + np.exp(-4 * (x**2 + (y - 0.3) ** 2))[None, ..., None] * np.array([0, 0, 3, 0, 2, 1]).reshape(6, 1, 1, 1)
    used = []
    for light in (boxes, np.broadcast_to(sky, boxes.shape).astype(np.float32)):
        _, excess, _ = light_cells.split(Environment(jnp.asarray(light)))
        used.append([bool(np.any(rows)) for rows in np.split(np.asarray(excess), [64, 128])])
    assert used == [[True, False, True], [False, True, True]]


def test_cells_need_faces_of_a_power_of_two_and_visibility_that_has_them(mesh, transport):
    with pytest.raises(ValueError, match="power of two texels along an edge, got 24"):
        light_cells.split(Environment(jnp.ones((6, 24, 24, 3))))
    nothing = harmonic.DiffuseSystem(harmonic.precompute_diffuse(mesh, size=SIZE), jnp.zeros(3))
    with pytest.raises(TypeError, match=r"which jaxprt\.lobe\.precompute makes"):
        bright_texels.BrightTexels(nothing, transport, GLOSSY, cells=True)
    with pytest.raises(ValueError, match="by_lobes must be with cells and a LobeSystem, got cells=False and a Diff"):
        bright_texels.BrightTexels(nothing, transport, GLOSSY, by_lobes=True)


def test_smoother_materials_sum_more_places_of_a_cell(mesh):
    """As when a rough part becomes smooth: with the middle alone each cell would be a dot."""
    light, brdf = soft(), AshikhminShirley(diffuse=0.0, specular=0.8, nu=1500.0, nv=1500.0)
    seen = precompute(mesh, size=32, run=Run(progress=False))
    rest = lobe.LobeSystem(lobe.compress(seen), lobe.tabulate(brdf, lobes=4))
    few, some, many = (
        np.asarray(jaxprt.radiance(bright_texels.BrightTexels(rest, rest.transport, brdf, 8, n, True), light, eye=EYE))
        for n in (1, 4, 12)
    )
    assert np.linalg.norm(few - many) > 0.1 * np.linalg.norm(many)
    assert np.linalg.norm(some - many) < 0.1 * np.linalg.norm(few - many)
