"""Scenes made ready: every recipe against the exact sum, methods of the whole, other materials, pictures, bad input.

The scene is a floor of a textured material, a ball of a plain BRDF above it, and an ideally diffuse wall behind.
"""

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
from jaxprt.image import sky
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, RelitScene, Terms, measuring, refinement, reflection
from jaxprt.relit.channels import of_part
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import environment_from_image
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


OWN = RECIPES | {"lobe": Lobes(lobes=2, texels=8)}


def own_calls(name: str) -> prt.System:
    """The system of the ball alone, by its own functions."""
    ball, recipe = mesh("ball"), OWN[name]
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
    ready = prt.precompute(alone, refine=False, system=OWN[name], size=SIZE, progress=False)
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


def test_stages_evaluated_materials_and_blends_give_the_whole(close):
    ready, materials = relit("harmonic"), {"floor": wood(seed=1)}
    whole = ready.radiance(light(), eye=EYE, materials=materials)
    arriving = ready.shade(ready.light(light()), materials)
    np.testing.assert_array_equal(ready.combine(arriving, ready.view(EYE, materials)), whole)
    np.testing.assert_array_equal(prt.radiance(ready, light(), eye=EYE, materials=materials), whole)
    once = ready.appearances(materials)
    np.testing.assert_array_equal(ready.radiance(light(), eye=EYE, materials=once), whole)
    blend = ready.shading[0].blend
    twice = eqx.tree_at(lambda each: each.weight, blend, 2 * blend.weight)
    once, got = (np.asarray(ready.radiance(light(), eye=EYE, materials={"floor": each})) for each in (blend, twice))
    np.testing.assert_array_equal(once, ready.radiance(light(), eye=EYE))
    close(got[: BOUNDS[0]], 2 * once[: BOUNDS[0]])


def test_gradients_in_materials_are_differences():
    ready = relit("lobe")
    weight = np.random.default_rng(5).uniform(0.5, 1.5, size=(ready.vertices, 3)).astype(np.float32)
    lit = ready.light(light())

    @jax.jit
    def total(material):
        return jnp.vdot(weight, ready.combine(lit, ready.view(EYE, {"floor": material})))

    material = wood(base_color=(0.5, 0.6, 0.7), roughness=0.7)
    slope = jax.grad(total)(material)
    assert isinstance(slope, TexturedMaterial)
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(slope))
    # Radiance is linear in all but roughness.
    places = {
        "factor": (lambda each: each.base_color, 0.2, 2e-3),
        "color": (lambda each: each.base_color_texture.image, 0.2, 2e-3),
        "metallic": (lambda each: each.metallic_texture.image, 0.2, 2e-3),
        "roughness": (lambda each: each.roughness, 0.004, 0.05),
    }
    for name, (place, size, most) in places.items():
        step = np.float32(size) * np.random.default_rng(6).uniform(0.5, 1, place(material).shape).astype(np.float32)
        ends = [total(eqx.tree_at(place, material, place(material) + sign * step)) for sign in (1, -1)]
        np.testing.assert_allclose(np.vdot(place(slope), step), (ends[0] - ends[1]) / 2, rtol=most, err_msg=name)


@pytest.mark.parametrize("name", ["lobe", "harmonic"])
def test_a_part_takes_any_metallic_roughness_material(name, close):
    """Other terms and roughness than the part was precomputed with; the system is that of the new material."""
    new = wood(rough=False, roughness=0.2, specular=0.3)
    again = prt.precompute(scene(new), refine=False, system=RECIPES[name], size=SIZE, progress=False)
    color = relit(name).radiance(light(), eye=EYE, materials={"floor": new})
    close(color, again.radiance(light(), eye=EYE), tolerance=1e-5)


def reflecting(count: int, path: pathlib.Path | None = None) -> RelitScene:
    """A wall with channels beside a floor, with bounces."""
    red = TexturedMaterial(base_color=(0.8, 0.1, 0.1), metallic=0.0, roughness=0.8)
    parts = [Part("floor", mesh("floor"), Lambert(0.7)), Part("wall", mesh("wall"), red)]
    options = {"system": RECIPES["harmonic"], "size": SIZE, "path": path, "progress": False}
    return prt.precompute(Scene(parts), refine=False, bounces=count, **options)


def test_a_second_bounce_goes_on_from_the_store_of_one(tmp_path, monkeypatch):
    """It brings light off a material of channels too."""

    def reflected(count):
        ready = reflecting(count, tmp_path / "store")
        return np.asarray(ready.radiance(light(), eye=EYE) - ready.without_bounces().radiance(light(), eye=EYE))

    once = reflected(1)
    stage, done = visibility.blocks.compute, []

    def counted(job, run, **options):
        if not pathlib.Path(run.path).exists():
            done.append(pathlib.Path(run.path).name)
        return stage(job, run, **options)

    monkeypatch.setattr(visibility.blocks, "compute", counted)
    twice = reflected(2)
    assert done == ["clusters_2"]
    assert 1.03 < twice[:, 0].sum() / once[:, 0].sum() < 1.5
    np.testing.assert_array_equal(reflected(1), once)


def test_bounces_ask_for_lights_that_they_can_make_coarser_and_reports_are_of_direct_light():
    ready = reflecting(1)
    step = ready.light_step
    assert step == ready.bounces.tensor.light_step > 1
    odd = Environment(np.ones((6, step + 1, step + 1, 3), np.float32))
    for call in (functools.partial(ready.radiance, eye=EYE), ready.light, ready.picture):
        with pytest.raises(ValueError, match=f"a multiple of {step} texels along an edge, .*, got {step + 1}"):
            call(odd)
    found, direct = (each.report([light()]) for each in (ready, ready.without_bounces()))
    for mine, other in zip(found.part, direct.part, strict=True):
        np.testing.assert_allclose(mine.errors, other.errors, rtol=1e-3)
    assert found.nbytes > direct.nbytes


def test_parts_beyond_the_number_of_regions_send_light_together_if_they_are_alike(monkeypatch):
    red, blue = (TexturedMaterial(color, metallic=0.0, roughness=0.8) for color in ((0.8, 0.1, 0.1), (0.1, 0.1, 0.8)))
    colors = enumerate((red, blue))
    parts = [Part(f"{n} {name}", mesh(name), color) for n, color in colors for name in ("floor", "wall")]
    function = lambda wi, wo: GLOSSY(wi, wo)  # noqa: E731
    other = [Part("ball", mesh("ball"), function), Part("second ball", mesh("ball"), function)]
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
    inside = jax.jit(lambda ready: ready.radiance(light(), eye=EYE))(scenes[16].without_bounces())
    np.testing.assert_allclose(inside, direct, rtol=1e-4)


def test_pictures_show_the_pixels_of_the_lights_file_behind_the_same_surfaces():
    pixels = np.random.default_rng(5).uniform(0.1, 1, (64, 128, 3)).astype(np.float32)
    from_file = environment_from_image(pixels, size=light().radiance.shape[-2])
    texels, ready = Environment(from_file.radiance), relit("harmonic")
    one, other = (np.asarray(ready.picture(each, CAMERA)) for each in (from_file, texels))
    cover = np.asarray(ready.coverage(CAMERA))
    np.testing.assert_allclose(one[cover == 1], other[cover == 1], rtol=1e-6)
    np.testing.assert_allclose(one[cover == 0], np.asarray(sky(from_file, CAMERA))[cover == 0], rtol=1e-6)
    assert np.abs(one - other)[cover == 0].max() > 0.1
    inside = jax.jit(lambda light: ready.picture(light, CAMERA, samples=1))(from_file)
    np.testing.assert_allclose(inside, ready.picture(texels, CAMERA, samples=1), rtol=1e-4, atol=1e-5)


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


def test_a_second_call_with_the_same_folder_traces_nothing(tmp_path, monkeypatch):
    systems = {"floor": RECIPES["lobe"], "ball": RECIPES["harmonic"], "wall": RECIPES["harmonic"]}
    options = {"system": systems, "size": SIZE, "path": tmp_path / "kept" / "scene", "progress": False}
    first = prt.precompute(scene(), refine=False, **options)

    def refuse(*_, **__):
        raise AssertionError("rays were traced")

    monkeypatch.setattr(visibility.rays, "fractional", refuse)
    second = prt.precompute(scene(), refine=False, **options)
    np.testing.assert_array_equal(second.radiance(light(), eye=EYE), first.radiance(light(), eye=EYE))
    monkeypatch.undo()
    moved = eqx.tree_at(lambda each: each.parts[1].mesh.position, scene(), mesh("ball").position + 0.1)
    message = r"0_floor.lobe\.prt holds arrays that were computed from other inputs .* name another path or delete it"
    with pytest.raises(ValueError, match=message):
        prt.precompute(moved, refine=False, **options)


ROUGH = "part 'floor': the separable system must have one roughness for all vertices, got a texture from 0."
SYSTEMS = {
    "unknown": ("fast", ValueError, "the system must be one of dynamic, harmonic, lobe, separable, got 'fast'"),
    "kind": (
        3,
        TypeError,
        "the system must be of class Recipe, which jaxprt.relit.Lobes, Harmonics, Dynamic, Terms or Clusters",
    ),
    "missing": ({"floor": "lobe"}, ValueError, r"for each of the parts ['floor', 'ball', 'wall'], got ['floor']"),
    "more": (dict.fromkeys([*NAMES, "roof"], "lobe"), ValueError, "'wall'], got ['floor', 'ball', 'wall', 'roof']"),
    "rough": (dict.fromkeys(NAMES, "separable"), ValueError, ROUGH),
    "clusters": (Clusters(), ValueError, "part 'floor': the separable system must have one roughness"),
}


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.usefixtures("unchecked")
def test_systems_that_a_scene_cannot_have_are_refused_before_rays_are_traced(name, monkeypatch):
    """Those that do not exist, before meshes are divided."""
    system, error, message = SYSTEMS[name]
    exists = name in ("rough", "clusters")
    monkeypatch.setattr(visibility.rays, "fractional", None)
    if not exists:
        monkeypatch.setattr(refinement, "divided", None)
    with pytest.raises(error, match=re.escape(message)):
        prt.precompute(scene(), refine=not exists, system=system, size=SIZE, progress=False)


def made(given=None, **options):
    """A scene with other options."""
    return prt.precompute(scene() if given is None else given, refine=False, system="harmonic", **options)


def shown(materials):
    """Radiance with other materials."""
    return relit("lobe").radiance(light(), eye=EYE, materials=materials)


WRONG = [
    (lambda: Dynamic(ranks=(0, 8, 8)), ValueError, "each rank must be at least 1, got 0"),
    (
        lambda: Dynamic(ranks=(8, 8)),
        ValueError,
        "ranks must be three, of the BRDFs, the view and the light, got (8, 8)",
    ),
    (lambda: Dynamic(lobes=0, ranks=None), ValueError, "needs lobes, or ranks of a tensor, or both; got neither"),
    (lambda: Dynamic(lobes=-1), ValueError, "lobes must be at least 0, got -1"),
    (lambda: Dynamic(modes=0), ValueError, "modes must be at least 1, got 0"),
    (lambda: Dynamic(texels=1.5), TypeError, "texels must be a whole number, got 1.5"),
    (lambda: made(size=12), ValueError, "size must be a power of two, got 12"),
    (lambda: made(bounces=-1), ValueError, "bounces must be at least 0, and below 2^31, or 'all', got -1"),
    (lambda: made(bounces=True), TypeError, "bounces must be a whole number or 'all', got True"),
    (lambda: made(bounces="2"), ValueError, "bounces must be a whole number or 'all', got '2'"),
    (lambda: made(mesh("ball")), TypeError, "the scene must be of class Scene, which jaxprt.load_scene makes, got one"),
    (lambda: shown([wood()]), TypeError, "must be a dictionary from names of parts to materials, got list"),
    (lambda: shown({"roof": wood()}), ValueError, "for the parts ['floor', 'ball', 'wall'], got one for 'roof'"),
    (lambda: shown({"floor": GLOSSY}), TypeError, "of part 'floor' must be a TexturedMaterial, got CookTorrance"),
    (lambda: shown({"ball": wood()}), TypeError, "of part 'ball' must be a CookTorrance, got TexturedMaterial"),
    (
        lambda: shown({"floor": prt.Blend(jnp.ones((3, 3, 3)), (jnp.zeros(3),))}),
        ValueError,
        "[36 vertices, 4 channels, c], got [3, 3, 3]",
    ),
    (lambda: shown({"floor": prt.Blend(jnp.ones((36, 4, 3)))}), ValueError, "must have 1 parameters, got 0 parameters"),
    (
        lambda: relit("lobe").picture(Environment(jnp.ones((2, 6, SIZE, SIZE, 3)))),
        ValueError,
        "a picture needs one light [6, n, n, c], got [2, 6, 8, 8, 3]",
    ),
]


@pytest.mark.usefixtures("unchecked")
def test_what_scenes_cannot_be_made_of_or_shown_in_is_refused():
    for call, error, message in WRONG:
        with pytest.raises(error, match=re.escape(message)):
            call()
