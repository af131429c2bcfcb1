"""Reflections by rays: a mirror beside a wall that glows, whose picture is known in closed form, and hard cases.

The wall stands behind a floor that is a smooth metal: a ray from the eye, mirrored by the floor, hits the wall or not.
"""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces, lobe
from jaxprt.relit import Lobes, RelitScene, casting, curvature, tracing
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.scene.points import on_triangles
from jaxprt.systems.bounces import traced

SIZE = 8
EYE = jnp.array([0.3, 1.5, 3.0])
GLOW = np.array([2.0, 1.0, 0.5], np.float32)
DARK = Environment(jnp.zeros((6, SIZE, SIZE, 3)))
CAMERA = Camera(EYE, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.9, 24, 18)
ALBEDO = 0.9  # of the mirror, and a little more at grazing angles
COARSE = 0.06  # by which the albedo of a small table is off
FAINT = 1e-3  # of the light of the wall: what a small table has of a mirror in its diffuse part, which lamps light


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Small maps, and bounces of few directions."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, lobe.tabulate, resolution=12)
        bound(patch, bounces.precompute, edge=2, size=8, components=8, modes=8)
        yield


@functools.cache
def mesh(name: str) -> Mesh:
    plane = builtin.plane(cells=6)
    place = np.asarray(plane.position)
    if name == "floor":
        return make_mesh(1.5 * place + [0, 0, 0.5], plane.face)
    return make_mesh(place[:, [0, 2, 1]] * [1, -1, 1] + [0, 1, -1], plane.face)


def mirror(**more) -> TexturedMaterial:
    return TexturedMaterial(**{"base_color": jnp.ones(3), "roughness": 0.03, **more})


def wall(color: float | jax.Array = 0.5, **more) -> TexturedMaterial:
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0, **more)


@functools.cache
def relit() -> RelitScene:
    parts = [
        Part("floor", mesh("floor"), mirror(base_color=0.9 * jnp.ones(3))),
        Part("wall", mesh("wall"), wall(emissive=GLOW)),
    ]
    return prt.precompute(Scene(parts), refine=False, system=Lobes(4, 0), size=SIZE, bounces=1, progress=False)


def light(seed: int = 1) -> Environment:
    radiance = np.random.default_rng(seed).uniform(0.2, 1.0, (6, SIZE, SIZE, 3))
    return Environment(jnp.asarray(radiance, jnp.float32))


def test_a_ball_spreads_the_cone_of_a_ray_as_its_curvature_says():
    ball, radius, distance = builtin.sphere(rings=40, sectors=60), 2.0, 3.0
    ball = make_mesh(radius * np.asarray(ball.position), ball.face)
    cast = casting.Caster(ball)
    np.testing.assert_allclose(cast.bend[100:-100], 1 / radius, rtol=0.02)
    face = 40 * 60 // 2
    hit = np.array([[face, -1]]), np.full((1, 2, 3), 1 / 3, np.float32)
    middle = np.asarray(ball.position)[cast.face[face]].mean(0)
    start = np.stack([middle * (1 + distance / radius), middle])
    ones = jnp.ones((1, 2))
    rays = traced.ReflectionRays(jnp.zeros((1, 2, 3)), jnp.zeros((1, 2), jnp.int32), ones, 50 * ones)
    spread = cast.spread(rays, *hit, start)
    np.testing.assert_allclose(spread[0, 0], (1 + 2 * distance / radius) ** 2 / 50, rtol=0.05)
    few = traced.ReflectionRays(
        jnp.zeros((4, 2, 3)), jnp.zeros((4, 2), jnp.int32), jnp.full((4, 2), 0.5), jnp.full((4, 2), 50.0)
    )
    four = cast.spread(few, *(np.repeat(each, 4, 0) for each in hit), start)
    np.testing.assert_allclose(four[:, 0], spread[0, 0] / 2, rtol=1e-5)
    assert np.all(spread <= 1)


def test_a_ray_from_a_point_ends_in_nothing_in_a_back_or_in_its_own_triangle():
    plane, count = mesh("floor"), len(mesh("floor").face)
    position, face = np.asarray(plane.position), np.asarray(plane.face)
    above = make_mesh(np.concatenate([position, position + [0, 1, 0]]), np.concatenate([face, face + len(position)]))
    points = on_triangles(face, np.arange(count), np.full((count, 3), 1 / 3, np.float32))
    way = jnp.broadcast_to(jnp.array([[[0.0, 1.0, 0.0]], [[0.0, -1.0, 0.0]]]), (2, count, 3))
    rays = traced.ReflectionRays(
        way, jnp.zeros((2, count), jnp.int32), jnp.ones((2, count)), jnp.full((2, count), 50.0)
    )
    for scene, upward in ((plane, -1), (above, -2)):
        triangle, _, _ = casting.Caster(scene).cast(rays, points, at_vertices=False)
        np.testing.assert_array_equal(triangle[0], upward)
        np.testing.assert_array_equal(triangle[1], -2)
        vertices = on_triangles(face, np.arange(count), np.eye(3, dtype=np.float32)[np.zeros(count, int)])
        triangle, _, _ = casting.Caster(scene).cast(rays, vertices, at_vertices=True)
        np.testing.assert_array_equal(triangle[0], upward)
        np.testing.assert_array_equal(triangle[1], -3)
    face = np.array([[0, 1, 2]])
    alone = casting.Caster(make_mesh(position[np.asarray(plane.face)[0]], face))
    points = on_triangles(face, np.array([0]), np.full((1, 3), 1 / 3, np.float32))
    rays = jax.tree.map(lambda rows: rows[:, :1], rays)
    hit = alone.cast(rays, points, at_vertices=False)
    np.testing.assert_array_equal(hit[0], [[-1], [-2]])
    assert np.isfinite(alone.spread(rays, *hit)).all()


def mirrored(place: np.ndarray) -> np.ndarray:
    """How far inside of the wall the mirrored ray from the eye through a point of the floor hits; outside below 0."""
    way = place - np.asarray(EYE)
    way[:, 1] *= -1
    hit = place + way * ((-1 - place[:, 2]) / way[:, 2])[:, None]
    return np.minimum.reduce([1 - np.abs(hit[:, 0]), hit[:, 1], 2 - hit[:, 1]])


def test_a_mirror_shows_a_wall_that_glows_where_the_closed_form_has_it():
    ready = relit()
    assert [surface.has_rays for surface in ready.surfaces] == [True, False]
    color = np.asarray(ready.radiance(DARK, eye=EYE))[:49]
    inside = mirrored(np.array(mesh("floor").position))
    shown, bare = inside > 0.1, inside < -0.1
    assert shown.sum() > 8
    assert bare.sum() > 8
    np.testing.assert_allclose(color[shown], np.broadcast_to(ALBEDO * GLOW, (shown.sum(), 3)), rtol=COARSE)
    np.testing.assert_allclose(color[bare], 0, atol=FAINT)
    # Without rays the wall is a polygon, which lobes blur.
    polygon, deep = np.asarray(ready.with_rays(0).radiance(DARK, eye=EYE))[:49], inside > 0.2
    assert deep.sum() > 8
    np.testing.assert_allclose(polygon[deep], np.broadcast_to(ALBEDO * GLOW, (deep.sum(), 3)), rtol=0.05)
    np.testing.assert_allclose(polygon[bare], 0, atol=FAINT)


def test_points_batches_and_programs_agree_with_the_vertices(close):
    ready = relit()
    color = ready.radiance(light(), eye=EYE)
    face = np.asarray(mesh("floor").face)
    corners = on_triangles(face, np.arange(len(face)), np.eye(3, dtype=np.float32)[np.arange(len(face)) % 3])
    whole = ready.radiance(light(), eye=EYE, points=[corners, corners])
    vertex = face[np.arange(len(face)), np.arange(len(face)) % 3]
    # Rays of vertices start a nudge off all of their triangles, those of points off their own.
    apart = (
        np.asarray(mesh("floor").position)[vertex, 2] > -0.9
    )  # Where the wall stands on it, vertices start in front.
    close(whole[: len(face)][apart], np.asarray(color)[vertex[apart]], tolerance=0.02)
    batch = relit().radiance(Environment(jnp.stack([light(2).radiance, light().radiance])), eye=EYE)
    close(batch[1], color, tolerance=1e-5)
    # The eye is known inside of programs too, unless it is an argument.
    close(jax.jit(lambda each: ready.radiance(Environment(each), eye=EYE))(light().radiance), color, tolerance=1e-4)
    with pytest.raises(ValueError, match=re.escape("but the eye is traced by JAX: call RelitScene.view")):
        jax.jit(lambda eye: ready.radiance(light(), eye=eye))(EYE)
    with pytest.raises(ValueError, match="but the eye is traced by JAX"):
        jax.grad(lambda eye: jnp.sum(ready.radiance(light(), eye=eye)))(EYE)
    assert np.isfinite(jax.jit(lambda eye: ready.with_rays(0).radiance(light(), eye=eye))(EYE)).all()


def mirrored_by_pixels() -> np.ndarray:
    """How far inside of the wall what pixels of the floor mirror is; 0 for other pixels."""
    rays = np.asarray(prt.image.raster.ray_direction(CAMERA)).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        place = np.asarray(EYE) + rays * (-EYE[1] / rays[:, 1])[:, None]
    on_floor = (rays[:, 1] < -0.1) & (np.abs(place[:, 0]) < 1.4) & (np.abs(place[:, 2] - 0.5) < 1.4)
    return np.where(on_floor, mirrored(np.where(on_floor[:, None], place, 1.0)), 0)


def test_a_mirror_of_two_triangles_shows_the_edge_of_a_wall_without_bounces():
    plane = builtin.plane(cells=1)
    floor = make_mesh(1.5 * np.asarray(plane.position) + [0, 0, 0.5], plane.face)
    parts = [Part("floor", floor, mirror()), Part("wall", mesh("wall"), wall(0.0))]
    ready = prt.precompute(Scene(parts), refine=False, system=Lobes(4, 0), size=SIZE, progress=False)
    white = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    rays, stored = (
        np.asarray(each.picture(white, CAMERA, samples=1)).reshape(-1, 3)[:, 0] for each in (ready, ready.with_rays(0))
    )
    inside = mirrored_by_pixels()
    hidden, free = inside > 0.15, inside < -0.15
    assert rays[hidden].max() < 0.05 < 0.3 < stored[hidden].mean()
    np.testing.assert_allclose(rays[free], rays[free].mean(), rtol=0.1)
    kept = ready.picture_view(CAMERA).picture(white)
    np.testing.assert_allclose(kept, ready.picture(white, CAMERA), rtol=1e-4)


def test_a_kept_view_gives_the_picture_of_every_light_and_of_the_closed_form(close):
    ready = relit()
    view = ready.picture_view(CAMERA)
    for seed in (1, 2):
        close(view.picture(light(seed)), ready.picture(light(seed), CAMERA), tolerance=1e-5)
    close(
        jax.jit(lambda each: ready.picture(Environment(each), CAMERA))(light().radiance),
        ready.picture(light(), CAMERA, shadows="vertices"),
        tolerance=1e-4,
    )
    dark = np.asarray(ready.picture(DARK, CAMERA, samples=1)).reshape(-1, 3)
    inside = mirrored_by_pixels()
    assert (inside > 0.15).sum() > 10
    np.testing.assert_allclose(dark[inside > 0.15] / (ALBEDO * GLOW), 1, rtol=COARSE)
    np.testing.assert_allclose(dark[inside < -0.15], 0, atol=FAINT)


def test_four_points_of_a_sample_share_its_rays(monkeypatch):
    cast, drawn = casting.Caster.cast, []

    def counted(self, rays, points, **options):
        drawn.append(np.asarray(rays.chance) > 0)
        return cast(self, rays, points, **options)

    monkeypatch.setattr(casting.Caster, "cast", counted)
    pictures = []
    for detail in (1, 2):
        monkeypatch.setattr(curvature, "detail", lambda mesh, *_, to=detail: jnp.full(len(mesh.face), to, jnp.uint8))
        pictures.append(np.asarray(relit().picture(DARK, CAMERA)).reshape(-1, 3))
    (all_rays, some), few = drawn, drawn[1].sum(0) == 2
    assert np.all(all_rays)
    assert np.all(some[:, ~few])
    assert few.sum() > 1000
    # Each four points cast the eight rays of one sample.
    np.testing.assert_array_equal(some[:, few].reshape(8, -1, 4).sum(-1), 1)
    inside = mirrored_by_pixels()
    np.testing.assert_allclose(pictures[1][inside > 0.3] / (ALBEDO * GLOW), 1, rtol=COARSE)


def test_the_sky_in_a_mirror_ends_where_the_closed_form_has_the_wall(close):
    """Stored visibility, of vertices and of texels as wide as a third of the wall, has no such edge."""
    black, white = {"wall": wall(0.0, emissive=np.zeros(3))}, Environment(jnp.ones((6, SIZE, SIZE, 3)))
    view = relit().picture_view(CAMERA, materials=black, samples=1)
    sky, inside = np.asarray(view.picture(white)).reshape(-1, 3), mirrored_by_pixels()
    assert min((inside > 0.02).sum(), (inside < -0.02).sum()) > 50
    np.testing.assert_allclose(sky[inside > 0.02], 0, atol=COARSE)
    np.testing.assert_allclose(sky[inside < -0.02], ALBEDO, rtol=COARSE)
    close(relit().picture(white, CAMERA, materials=black, samples=1).reshape(-1, 3), sky, tolerance=1e-5)
    vertices, inside = (
        relit().radiance(white, materials=black, eye=EYE)[:49],
        mirrored(np.array(mesh("floor").position)),
    )
    np.testing.assert_allclose(vertices[inside > 0.1], 0, atol=COARSE)
    np.testing.assert_allclose(vertices[inside < -0.1], ALBEDO, rtol=COARSE)


def test_light_is_linear_and_colors_have_the_gradient_of_finite_differences(close):
    ready, weight = relit(), np.random.default_rng(2).normal(size=(98, 3)).astype(np.float32)
    view = ready.view(EYE)

    def lit(radiance):
        return jnp.vdot(weight, ready.combine(ready.shade(ready.light(Environment(radiance))), view))

    slope, none = jax.grad(lit)(light().radiance), lit(DARK.radiance)
    close(jnp.vdot(slope, light(2).radiance), lit(light(2).radiance) - none, tolerance=1e-4)

    def colored(value):
        materials = {
            "wall": wall(jnp.array([value, 0.4, 0.5])),
            "floor": mirror(base_color=value * jnp.ones(3)),
        }
        return jnp.vdot(weight, ready.radiance(light(), eye=EYE, materials=materials))

    step = 0.02
    finite = (colored(0.6 + step) - colored(0.6 - step)) / (2 * step)
    close(jax.jit(jax.grad(colored))(0.6), finite, tolerance=0.01)


def test_what_reflects_nothing_but_the_sky_shows_no_rays(close):
    """From behind the wall the floor mirrors the sky alone, beside which harmonics would ring."""
    eye = EYE * jnp.array([1.0, 1.0, -1.0])
    view = relit().view(eye)
    assert view.reflected is not None
    assert view.reflected.hits == ()
    color, direct = (each.radiance(light(), eye=eye)[:49] for each in (relit(), relit().without_bounces()))
    close(color, direct, tolerance=0.01)


def test_rough_parts_have_no_rays_and_bad_numbers_of_them_are_refused():
    rough = lobe.tabulate(prt.brdf.CookTorrance(diffuse=0.2, specular=0.7, roughness=0.6), lobes=4)
    assert not traced.is_sharp(rough)
    assert not traced.is_sharp(lobe.tabulate(prt.brdf.Lambert(0.5), lobes=2))
    with pytest.raises(ValueError, match="rays must be a whole number of at least 0, at most 4096, got -1"):
        relit().with_rays(-1)
    assert relit().with_rays(0).view(EYE).reflected is None
    without = relit().with_rays(0)
    assert without.with_rays(8).stage.rays == 8
    alone = [surface.without_rays for surface in without.surfaces]
    with pytest.raises(ValueError, match="rays must be 0 for a scene that was precomputed with rays=0, got 8"):
        tracing.check_more_rays(8, 0, alone)
    tracing.check_more_rays(8, 8, alone)
    with pytest.raises(ValueError, match="rays must be a whole number of at least 0, at most 4096, got -2"):
        prt.precompute(relit().scene, refine=False, system="lobe", bounces=1, rays=-2)


def test_embree_holds_the_triangles_of_the_last_scenes():
    one = casting.caster(relit().mesh)
    assert casting.caster(relit().mesh) is one
    others = [make_mesh(np.asarray(mesh("wall").position) + k, mesh("wall").face) for k in range(5)]
    assert len({id(casting.caster(each)) for each in others}) == 5
    assert casting.caster(relit().mesh) is not one
