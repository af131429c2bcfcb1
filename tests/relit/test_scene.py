"""Scenes made ready: every recipe against the exact sum, methods of the whole, other materials, pictures, bad input.

The scene is a floor of a textured material, a ball of a plain BRDF above it, and an ideally diffuse wall behind.
"""

import dataclasses
import functools
import pathlib
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces, bright_texels, harmonic, lobe, separable, visibility
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.image import automatic_exposure, raster, sky
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, RelitScene, Terms, measuring, refinement, reflection
from jaxprt.relit.channels import of_part
from jaxprt.relit.registry import SYSTEMS
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import background, environment_from_image
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap

SIZE = 8
EYE = jnp.array([1.0, 2.5, 2.0])
GLOSSY = CookTorrance(diffuse=0.5, specular=0.5, roughness=0.5, f0=0.4)


class Fixed(eqx.Module):
    """A BRDF of no model that may change."""

    brdf: CookTorrance

    def __call__(self, wi, wo):
        return self.brdf(wi, wo)


FIXED = Fixed(GLOSSY)
CAMERA = Camera(EYE, [0.0, 0.5, 0.0], [0.0, 1.0, 0.0], 1.0, 24, 16)
NAMES = ["floor", "ball", "wall"]
# What two tensors of eight components may differ by that have other regions: they do by .005, and by .1 if the parts of
# a region are not alike.
EIGHT_COMPONENTS = 0.01
BOUNDS = np.cumsum([36, 34])


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Small maps, and bounces of few directions."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, lobe.tabulate, resolution=12)
        bound(patch, separable.factor, terms=6, resolution=16)
        bound(patch, bounces.precompute, edge=2, size=8, components=8, modes=8)
        patch.setattr(measuring, "_PICTURE", 24)
        patch.setattr(measuring, "_PIXELS", 12)
        yield


@functools.cache
def mesh(name: str) -> Mesh:
    if name == "ball":
        ball = builtin.sphere(rings=5, sectors=8)
        return make_mesh(0.7 * ball.position + jnp.array([0.0, 0.9, 0.0]), ball.face, normal=ball.normal)
    plane = builtin.plane(cells=5)
    place = np.asarray(plane.position)
    if name == "floor":
        return make_mesh(1.5 * place, plane.face, texture=0.5 + 0.5 * place[:, [0, 2]])
    return make_mesh(1.5 * place[:, [0, 2, 1]] * [1, -1, 1] + [0, 1.5, -1.5], plane.face)


@functools.cache
def image(channels: int, low: float, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(low, 1, (4, 4, channels)), jnp.float32)


def wood(*, rough: bool = True, seed: int = 0, **factor) -> TexturedMaterial:
    """A material with textures of color, metalness and, if asked for, roughness."""
    images = {"base_color": image(3, 0.2, seed), "metallic": image(1, 0.0, seed)}
    images |= {"roughness": image(1, 0.8)} if rough else {}
    textures = {f"{name}_texture": Texture(each) for name, each in images.items()}
    return TexturedMaterial(**{"roughness": 0.8, **factor, **textures})


def scene(floor: TexturedMaterial | None = None, **more) -> Scene:
    materials = (wood() if floor is None else floor), GLOSSY, Lambert(jnp.array([0.7, 0.5, 0.3]))
    return Scene([Part(name, mesh(name), each) for name, each in zip(NAMES, materials, strict=True)], **more)


def light(seed: int = 3) -> Environment:
    radiance = np.random.default_rng(seed).uniform(0.2, 1.0, (6, SIZE, SIZE, 3))
    radiance[2, 2:4, 3] += 6.0
    return Environment(jnp.asarray(radiance, jnp.float32))


RECIPES = {
    "lobe": Lobes(texels=8),
    "harmonic": Harmonics(degree=3),
    "separable": Terms(terms=4, keep=384, resolution=16),
    "clusters": Clusters(terms=4, components=16, resolution=16, keep=384, texels=4),
}


@functools.cache
def relit(name: str, *, rough: bool = True) -> RelitScene:
    return prt.precompute(scene(wood(rough=rough)), refine=False, system=RECIPES[name], size=SIZE, progress=False)


@functools.cache
def exact(name: str, *, rough: bool) -> np.ndarray:
    """Radiance of a part by the exact sum, in the shadows of all."""
    shading = of_part(scene(wood(rough=rough))[name])
    if name == "wall":
        rays, normal = visibility.Occluder(scene().mesh), np.asarray(shading.mesh.normal)
        seen, _ = visibility.fractional(rays, visibility.start_points(shading.mesh, rays), normal, size=SIZE)
        area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)
        flux = seen / visibility.LEVELS * np.maximum(normal @ area.T, 0)
        return flux @ np.asarray(light().radiance).reshape(-1, 3) / np.pi * np.asarray(shading.exact.albedo)
    options = {"eye": EYE, "occluder": scene().mesh, "error": 0.01}
    return np.asarray(prt.reference.radiance(shading.mesh, shading.exact, light(), **options))


# Largest relative L2 error of the parts: textured, BRDF, ideally diffuse. Half of it or less was measured.
ERRORS = {
    "lobe": (True, (0.1, 0.04, 0.02)),
    "harmonic": (True, (0.12, 0.06, 0.06)),
    "separable": (False, (0.04, 0.1, 1e-4)),
    "clusters": (False, (0.04, 0.1, 0.02)),
}


@pytest.mark.parametrize("name", ERRORS)
def test_radiance_of_each_part_is_that_of_the_exact_sum(name):
    rough, error = ERRORS[name]
    color = np.split(np.asarray(relit(name, rough=rough).radiance(light(), eye=EYE)), BOUNDS)
    for part, got, most in zip(scene().parts, color, error, strict=True):
        away = np.asarray(EYE) - np.asarray(part.mesh.position)
        facing = np.sum(np.asarray(part.mesh.normal) * away, 1) > 0.2 * np.linalg.norm(away, axis=1)
        expected = exact(part.name, rough=rough)[facing]
        off = np.linalg.norm(got[facing] - expected) / np.linalg.norm(expected)
        assert off <= most, part.name


def own_calls(name: str) -> prt.System:
    """The system of the ball alone, by its own functions."""
    ball, recipe = mesh("ball"), RECIPES[name]
    if name == "lobe":
        transport = lobe.precompute(ball, size=SIZE)
        system = lobe.LobeSystem(transport, lobe.tabulate(FIXED, lobes=recipe.lobes))
        samples = bright_texels.samples_for(FIXED, size=SIZE)
        return bright_texels.BrightTexels(system, transport, FIXED, count=recipe.texels, samples=samples)
    if name == "harmonic":
        transport = harmonic.precompute(ball, degree=recipe.degree, size=SIZE)
        return harmonic.HarmonicSystem(transport, harmonic.tabulate(FIXED, degree=recipe.degree))
    brdf = separable.factor(FIXED, terms=recipe.terms, resolution=16)
    return separable.SeparableSystem(separable.precompute(ball, brdf, keep=384, size=SIZE), brdf)


@pytest.mark.parametrize("name", ["lobe", "harmonic", "separable"])
def test_a_scene_of_one_mesh_is_the_systems_own_bit_for_bit(name):
    alone = Scene([Part("ball", mesh("ball"), FIXED)])
    ready = prt.precompute(alone, refine=False, system=RECIPES[name], size=SIZE, progress=False)
    expected = prt.radiance(own_calls(name), light(), eye=EYE)
    np.testing.assert_array_equal(ready.radiance(light(), eye=EYE), expected)
    np.testing.assert_array_equal(ready.mesh.position, mesh("ball").position)
    assert ready.shading[0].blend is None


def test_each_part_may_have_a_system_of_its_own_and_vertices_stay_in_the_meshs_order():
    systems = {"wall": RECIPES["separable"], "ball": RECIPES["harmonic"], "floor": RECIPES["lobe"]}
    mixed = prt.precompute(scene(), refine=False, system=systems, size=SIZE, progress=False)
    color = np.split(np.asarray(mixed.radiance(light(), eye=EYE)), BOUNDS)
    same = relit("lobe"), relit("harmonic"), relit("separable", rough=False)
    for number, (got, other) in enumerate(zip(color, same, strict=True)):
        np.testing.assert_array_equal(got, np.split(np.asarray(other.radiance(light(), eye=EYE)), BOUNDS)[number])
    np.testing.assert_array_equal(mixed.mesh.position, np.concatenate([each.mesh.position for each in scene().parts]))
    assert mixed.vertices == len(mixed.mesh.position)


def test_stages_give_the_whole():
    ready, materials = relit("harmonic"), {"floor": wood(seed=1)}
    whole = ready.radiance(light(), eye=EYE, materials=materials)
    arriving = ready.shade(ready.light(light()), materials)
    np.testing.assert_array_equal(ready.combine(arriving, ready.view(EYE, materials)), whole)
    np.testing.assert_array_equal(prt.radiance(ready, light(), eye=EYE, materials=materials), whole)
    once = ready.appearances(materials)
    np.testing.assert_array_equal(ready.radiance(light(), eye=EYE, materials=once), whole)


def test_a_blend_takes_the_place_of_weights(close):
    ready = relit("harmonic")
    blend = ready.shading[0].blend
    twice = {"floor": eqx.tree_at(lambda each: each.weight, blend, 2 * blend.weight)}
    once, got = (np.asarray(ready.radiance(light(), eye=EYE, materials=each)) for each in ({"floor": blend}, twice))
    np.testing.assert_array_equal(once, ready.radiance(light(), eye=EYE))
    close(got[: BOUNDS[0]], 2 * once[: BOUNDS[0]])


def test_gradients_in_materials_are_differences():
    ready = relit("harmonic")
    weight = np.random.default_rng(5).normal(size=(ready.vertices, 3)).astype(np.float32)
    lit = ready.light(light())

    @jax.jit
    def total(material):
        return jnp.vdot(weight, ready.combine(lit, ready.view(EYE, {"floor": material})))

    material = wood(base_color=(0.5, 0.6, 0.7))
    slope = jax.grad(total)(material)
    assert isinstance(slope, TexturedMaterial)
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(slope))
    places = {
        "factor": lambda each: each.base_color,
        "color": lambda each: each.base_color_texture.image,
        "metallic": lambda each: each.metallic_texture.image,
    }
    for name, place in places.items():
        # Radiance is linear in each of them.
        step = 0.2 * np.random.default_rng(6).uniform(-1, 1, place(material).shape).astype(np.float32)
        ends = [total(eqx.tree_at(place, material, place(material) + sign * step)) for sign in (1, -1)]
        np.testing.assert_allclose(np.vdot(place(slope), step), (ends[0] - ends[1]) / 2, rtol=2e-3, err_msg=name)


@pytest.fixture(scope="module")
def reflecting():
    """The scene with one bounce."""
    return prt.precompute(scene(), refine=False, system=RECIPES["harmonic"], bounces=1, size=SIZE, progress=False)


def test_lights_must_have_faces_that_bounces_can_make_coarser(reflecting):
    step = reflecting.light_step
    assert step == reflecting.bounces.tensor.light_step > 1
    odd = Environment(np.ones((6, step + 1, step + 1, 3), np.float32))
    for call in (functools.partial(reflecting.radiance, eye=EYE), reflecting.light, reflecting.picture):
        with pytest.raises(ValueError, match=f"a multiple of {step} texels along an edge, .*, got {step + 1}"):
            call(odd)


def test_lights_of_small_faces_have_bounces(monkeypatch):
    """Reflected light has as many texels as the light where that is small."""
    coarser = functools.partial(bounces.precompute.__wrapped__, size=8, components=8, modes=8)
    monkeypatch.setattr(reflection.bounces, "precompute", coarser)
    parts = [Part("floor", mesh("floor"), Lambert(0.7)), Part("wall", mesh("wall"), Lambert(0.5))]
    ready = prt.precompute(Scene(parts), refine=False, system=RECIPES["harmonic"], bounces=1, size=4, progress=False)
    sky = Environment(jnp.ones((6, 4, 4, 3)))
    whole, direct = (np.asarray(prt.radiance(each, sky, eye=EYE)) for each in (ready, ready.without_bounces()))
    assert np.isfinite(whole).all()
    assert 1.05 < whole.sum() / direct.sum() < 1.5


def test_a_second_bounce_off_a_material_of_channels_is_kept():
    red = TexturedMaterial(base_color=(0.8, 0.1, 0.1), metallic=0.0, roughness=0.8)
    parts = [Part("floor", mesh("floor"), Lambert(0.7)), Part("wall", mesh("wall"), red)]
    once, twice = (
        prt.precompute(Scene(parts), refine=False, system=RECIPES["harmonic"], bounces=count, size=SIZE, progress=False)
        for count in (1, 2)
    )
    assert twice.bounces.tensor.second is not None
    direct, first, both = (
        each.radiance(light(), eye=EYE)[:, 0].sum() for each in (once.without_bounces(), once, twice)
    )
    first, both = first - direct, both - direct
    assert 1.03 < both / first < 1.5


def test_parts_beyond_the_number_of_regions_send_light_together_if_they_are_alike(monkeypatch):
    red, blue = (TexturedMaterial(color, metallic=0.0, roughness=0.8) for color in ((0.8, 0.1, 0.1), (0.1, 0.1, 0.8)))
    colors = enumerate((red, blue))
    parts = [Part(f"{n} {name}", mesh(name), color) for n, color in colors for name in ("floor", "wall")]
    other = [Part("ball", mesh("ball"), FIXED), Part("second ball", mesh("ball"), FIXED)]
    scenes = {}
    for count in (2, 16):
        monkeypatch.setattr(reflection, "_REGIONS", count)
        options = {"system": RECIPES["harmonic"], "bounces": 1, "size": SIZE, "progress": False}
        scenes[count] = prt.precompute(Scene([*parts[::2], *other, *parts[1::2]]), refine=False, **options)
    few, many = (scene.bounces.tensor for scene in scenes.values())
    assert (len(few.factor), len(many.factor)) == (3, 5)
    few, many, direct = (
        np.asarray(scene.radiance(light(), eye=EYE)) for scene in (*scenes.values(), scenes[16].without_bounces())
    )
    assert np.linalg.norm(many - direct) > 0.05 * np.linalg.norm(many)
    assert np.linalg.norm(few - many) < EIGHT_COMPONENTS * np.linalg.norm(many)


def test_two_bounces_go_on_from_the_store_of_one(tmp_path, monkeypatch):
    def reflected(count):
        options = {"system": RECIPES["harmonic"], "size": SIZE, "path": tmp_path / "store", "progress": False}
        ready = prt.precompute(scene(), refine=False, bounces=count, **options)
        return ready.radiance(light(), eye=EYE) - ready.without_bounces().radiance(light(), eye=EYE)

    once = reflected(1)
    stage, done = visibility.blocks.compute, []

    def counted(job, run, **options):
        if not pathlib.Path(run.path).exists():
            done.append(pathlib.Path(run.path).name)
        return stage(job, run, **options)

    monkeypatch.setattr(visibility.blocks, "compute", counted)
    twice = reflected(2)
    assert done == ["clusters_2"]
    assert np.linalg.norm(twice) > 1.01 * np.linalg.norm(once)
    np.testing.assert_array_equal(reflected(1), once)


def test_a_report_of_bounces_has_the_errors_of_direct_light(reflecting):
    found, direct = (each.report([light()]) for each in (reflecting, relit("harmonic")))
    for mine, other in zip(found.part, direct.part, strict=True):
        np.testing.assert_allclose(mine.errors, other.errors, rtol=1e-3)
    assert found.nbytes > direct.nbytes


def test_pictures_show_the_radiance_before_the_light():
    picture = relit("harmonic").picture(light(), CAMERA, materials={"floor": wood(seed=1)})
    seen = np.asarray(raster.rasterize(scene().mesh, CAMERA, samples=4).triangle).max(-1) >= 0
    sky = np.asarray(background(light(), raster.ray_direction(CAMERA)))
    assert picture.shape == (16, 24, 3)
    np.testing.assert_allclose(np.asarray(picture)[~seen], sky[~seen], rtol=1e-6)
    assert 0.2 < seen.mean() < 0.9


def test_pictures_show_the_pixels_of_the_lights_file_behind_the_same_surfaces():
    pixels = np.random.default_rng(5).uniform(0.1, 1, (64, 128, 3)).astype(np.float32)
    from_file = environment_from_image(pixels, size=light().radiance.shape[-2])
    texels, ready = Environment(from_file.radiance), relit("harmonic")
    one, other = (np.asarray(ready.picture(each, CAMERA)) for each in (from_file, texels))
    cover = np.asarray(ready.coverage(CAMERA))
    np.testing.assert_allclose(one[cover == 1], other[cover == 1], rtol=1e-6)
    np.testing.assert_allclose(one[cover == 0], np.asarray(sky(from_file, CAMERA))[cover == 0], rtol=1e-6)
    assert np.abs(one - other)[cover == 0].max() > 0.1
    inside = jax.jit(lambda light: ready.picture(light, CAMERA))(from_file)
    np.testing.assert_allclose(inside, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("samples", [1, 4, 16])
def test_alpha_is_the_coverage(samples):
    ready = relit("harmonic")
    alpha = ready.picture(light(), CAMERA, samples=samples, background=None)[..., 3]
    np.testing.assert_allclose(alpha, ready.coverage(CAMERA, samples=samples), atol=1e-6)


def test_exposure_is_of_the_surfaces_whatever_is_behind_them():
    ready = relit("harmonic")
    picture, cover = ready.picture(light(), CAMERA), ready.coverage(CAMERA)
    window = jnp.where(cover[..., None] == 1, picture, 1e4)
    assert float(ready.exposure(window, CAMERA)) == pytest.approx(float(ready.exposure(picture, CAMERA)), rel=1e-6)
    shown = np.asarray(picture @ jnp.asarray([0.2126, 0.7152, 0.0722]))[np.asarray(cover) == 1]
    bright = np.percentile(shown[shown > 0], 99)
    assert float(ready.exposure(picture, CAMERA)) == pytest.approx(np.log2(0.9 / bright), abs=1e-4)
    with pytest.raises(ValueError, match=r"picture must have the camera's 16 x 24 pixels .* got 24 x 16"):
        ready.exposure(jnp.ones((24, 16, 3)), CAMERA)


def test_exposure_is_not_of_lamps():
    ball, lamp = mesh("ball"), mesh("ball")
    lamp = dataclasses.replace(lamp, position=np.asarray(lamp.position) + np.float32([0, 2.5, 0]))
    glow = TexturedMaterial(0.5, 0.0, 1.0, specular=0.0, emissive=20.0)
    parts = [Part("ball", ball, TexturedMaterial(0.5, 0.0, 1.0, specular=0.0)), Part("lamp", lamp, glow)]
    ready = prt.precompute(Scene(parts), system="lobe", size=8, refine=False, progress=False)
    camera = orbit(ready.mesh, width=32, height=32)
    picture = ready.picture(light(), camera)
    stops = ready.exposure(picture, camera)
    below = automatic_exposure(picture[18:], coverage=ready.coverage(camera)[18:])  # where the lamp is not
    assert float(stops) == pytest.approx(float(below), abs=1e-5)
    assert float(stops) > float(automatic_exposure(picture)) + 2


def test_the_camera_is_the_scenes_first_or_one_that_sees_all():
    ready = relit("harmonic")
    made_of = ready.shading, ready.layout, [surface.system for surface in ready.surfaces]
    with_camera = RelitScene(scene(cameras=[CAMERA, orbit(mesh("ball"))]), *made_of)
    np.testing.assert_array_equal(with_camera.picture(light()), relit("harmonic").picture(light(), CAMERA))
    around = relit("harmonic").camera
    half, away = around.field_of_view / 2, np.asarray(scene().mesh.position - around.eye)
    forward = np.asarray(around.target - around.eye) / np.linalg.norm(around.target - around.eye)
    assert np.all(away @ forward >= np.cos(half) * np.linalg.norm(away, axis=1) - 1e-5)
    assert around.eye[1] > around.target[1]


def test_a_function_as_brdf_passes_through_programs():
    part = Part("ball", mesh("ball"), lambda wi, wo: GLOSSY(wi, wo))
    ready = prt.precompute(Scene([part]), refine=False, system=RECIPES["harmonic"], size=SIZE, progress=False)
    color = jax.jit(lambda ready: ready.radiance(light(), eye=EYE))(ready)
    np.testing.assert_allclose(color, ready.radiance(light(), eye=EYE), rtol=1e-4)


def test_a_second_call_with_the_same_folder_traces_nothing(tmp_path, monkeypatch):
    options = {"system": {"floor": "lobe", "ball": "harmonic", "wall": "harmonic"}, "size": SIZE, "progress": False}
    options["system"] |= {"floor": RECIPES["lobe"], "ball": RECIPES["harmonic"]}
    first = prt.precompute(scene(), refine=False, path=tmp_path / "kept" / "scene", **options)

    def refuse(*_, **__):
        raise AssertionError("rays were traced")

    monkeypatch.setattr(visibility.rays, "fractional", refuse)
    second = prt.precompute(scene(), refine=False, path=tmp_path / "kept" / "scene", **options)
    np.testing.assert_array_equal(second.radiance(light(), eye=EYE), first.radiance(light(), eye=EYE))
    monkeypatch.undo()
    moved = eqx.tree_at(lambda each: each.parts[1].mesh.position, scene(), mesh("ball").position + 0.1)
    message = r"0_floor.lobe\.prt holds arrays that were computed from other inputs .* name another path or delete it"
    with pytest.raises(ValueError, match=message):
        prt.precompute(moved, refine=False, path=tmp_path / "kept" / "scene", **options)


def test_names_of_systems_are_sizes_of_them():
    assert set(SYSTEMS) == {"dynamic", "lobe", "harmonic", "separable"}
    assert all(isinstance(each, Dynamic | Lobes | Harmonics | Terms | Clusters) for each in SYSTEMS.values())


BAD = {
    "unknown": ("fast", ValueError, "the system must be one of dynamic, harmonic, lobe, separable, got 'fast'"),
    "kind": (
        3,
        TypeError,
        "the system must be of class Recipe, which jaxprt.relit.Lobes, Harmonics, Dynamic, Terms or Clusters",
    ),
    "missing": ({"floor": "lobe"}, ValueError, r"for each of the parts ['floor', 'ball', 'wall'], got ['floor']"),
    "more": (dict.fromkeys([*NAMES, "roof"], "lobe"), ValueError, "'wall'], got ['floor', 'ball', 'wall', 'roof']"),
    "rough": (
        dict.fromkeys(NAMES, "separable"),
        ValueError,
        "part 'floor': the separable system must have one roughness for all vertices, got a texture from 0.",
    ),
    "clusters": (Clusters(), ValueError, "part 'floor': the separable system must have one roughness"),
}


@pytest.mark.parametrize("name", ["rough", "clusters"])
@pytest.mark.usefixtures("unchecked")
def test_systems_that_a_scene_cannot_have_are_refused_before_rays_are_traced(name, monkeypatch):
    system, error, message = BAD[name]
    monkeypatch.setattr(visibility.rays, "fractional", None)
    with pytest.raises(error, match=re.escape(message)):
        prt.precompute(scene(), refine=False, system=system, size=SIZE, progress=False)


@pytest.mark.parametrize("name", ["unknown", "kind", "missing", "more"])
@pytest.mark.usefixtures("unchecked")
def test_systems_that_do_not_exist_are_refused_before_meshes_are_divided(name, monkeypatch):
    system, error, message = BAD[name]
    monkeypatch.setattr(refinement, "divided", None)
    with pytest.raises(error, match=re.escape(message)):
        prt.precompute(scene(), system=system, size=SIZE, progress=False)


@pytest.mark.usefixtures("unchecked")
def test_numbers_that_no_dynamic_system_has_are_refused():
    for options, error, message in (
        ({"ranks": (0, 8, 8)}, ValueError, "each rank must be at least 1, got 0"),
        ({"ranks": (8, 8)}, ValueError, r"ranks must be three, of the BRDFs, the view and the light, got \(8, 8\)"),
        ({"lobes": 0, "ranks": None}, ValueError, "needs lobes, or ranks of a tensor, or both; got neither"),
        ({"lobes": -1}, ValueError, "lobes must be at least 0, got -1"),
        ({"modes": 0}, ValueError, "modes must be at least 1, got 0"),
        ({"texels": 1.5}, TypeError, "texels must be a whole number, got 1.5"),
    ):
        with pytest.raises(error, match=message):
            Dynamic(**options)


@pytest.mark.usefixtures("unchecked")
def test_sizes_bounces_and_scenes_of_another_kind_are_refused():
    for size in (0, 12, -8):
        with pytest.raises(ValueError, match=f"size must be a power of two, got {size}"):
            prt.precompute(scene(), refine=False, system="harmonic", size=size)
    with pytest.raises(ValueError, match=r"bounces must be at least 0, .* got -1"):
        prt.precompute(scene(), refine=False, system="harmonic", bounces=-1)
    for count, error in ((1.5, TypeError), (True, TypeError), ("2", ValueError)):
        with pytest.raises(error, match=f"bounces must be a whole number or 'all', got {count!r}"):
            prt.precompute(scene(), refine=False, system="harmonic", bounces=count)
    with pytest.raises(
        TypeError, match=r"the scene must be of class Scene, which jaxprt\.load_scene makes, got one of"
    ):
        prt.precompute(mesh("ball"), refine=False, system="harmonic")


MATERIALS = {
    "list": ([wood()], TypeError, "the materials must be a dictionary from names of parts to materials, got list"),
    "unknown": ({"roof": wood()}, ValueError, "for the parts ['floor', 'ball', 'wall'], got one for 'roof'"),
    "kind": (
        {"floor": GLOSSY},
        TypeError,
        "the material of part 'floor' must be a TexturedMaterial, got CookTorrance",
    ),
    "brdf": ({"ball": wood()}, TypeError, "the material of part 'ball' must be a CookTorrance, got TexturedMaterial"),
    "shape": (
        {"floor": prt.Blend(jnp.ones((3, 3, 3)), (jnp.zeros(3),))},
        ValueError,
        "[36 vertices, 4 channels, c], got [3, 3, 3]",
    ),
    "parameter": ({"floor": prt.Blend(jnp.ones((36, 4, 3)))}, ValueError, "must have 1 parameters, got 0 parameters"),
}


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.usefixtures("unchecked")
def test_materials_that_a_scene_cannot_have_are_refused(name):
    materials, error, message = MATERIALS[name]
    with pytest.raises(error, match=re.escape(message)):
        relit("lobe").radiance(light(), eye=EYE, materials=materials)


@pytest.mark.parametrize("name", ["lobe", "harmonic"])
def test_a_part_takes_any_metallic_roughness_material(name, close):
    """Other terms and roughness than the part was precomputed with; the system is that of the new material."""
    for new in (wood(roughness=1.0), wood(rough=False, roughness=0.2, specular=0.3), TexturedMaterial(0.8)):
        again = prt.precompute(scene(new), refine=False, system=RECIPES[name], size=SIZE, progress=False)
        color = relit(name).radiance(light(), eye=EYE, materials={"floor": new})
        close(color, again.radiance(light(), eye=EYE), tolerance=1e-5)


def test_radiance_has_a_gradient_in_the_roughness_of_a_part():
    ready = relit("lobe")
    floor = ready.scene["floor"].material

    def total(roughness):
        changed = {"floor": eqx.tree_at(lambda each: each.roughness, floor, roughness)}
        return jnp.sum(ready.radiance(light(), eye=EYE, materials=changed))

    slope = jax.grad(total)(jnp.asarray(0.7))
    step = (total(0.703) - total(0.697)) / 0.006
    np.testing.assert_allclose(slope, step, rtol=0.05)


@pytest.mark.usefixtures("unchecked")
def test_lights_eyes_and_cameras_of_another_kind_are_refused():
    ready = relit("lobe")
    for call in (ready.light, functools.partial(ready.radiance, eye=EYE), ready.picture):
        with pytest.raises(TypeError, match=r"the light must be of class Environment, which jaxprt\.scene\.load_env"):
            call(light().radiance)
    with pytest.raises(
        ValueError, match=r"one environment \[6, 8, 8, c\], got \[6, 16, 16, 3\]: load it with .*size=8"
    ):
        ready.radiance(Environment(jnp.ones((6, 16, 16, 3))), eye=EYE)
    assert relit("separable", rough=False).light_size == SIZE
    with pytest.raises(ValueError, match=r"one environment \[6, 8, 8, c\], got \[6, 16, 16, 3\]"):
        relit("separable", rough=False).picture(Environment(jnp.ones((6, 16, 16, 3))))
    with pytest.raises(ValueError, match=r"a picture needs one light \[6, n, n, c\], got \[2, 6, 8, 8, 3\]"):
        ready.picture(Environment(jnp.ones((2, 6, SIZE, SIZE, 3))))
    with pytest.raises(TypeError, match="the camera must be of class Camera"):
        ready.picture(light(), EYE)
    with pytest.raises(ValueError, match="the eye must be one position"):
        ready.view(jnp.ones(2))
    np.testing.assert_array_equal(
        ready.radiance(light(), eye=np.asarray(EYE).tolist()), ready.radiance(light(), eye=EYE)
    )
    with pytest.raises(TypeError, match=r"the view must be of class SceneView, which RelitScene\.view makes"):
        ready.combine(ready.light(light()), EYE)
