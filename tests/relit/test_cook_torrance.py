"""Parts of Cook-Torrance whose colors, roughness and F0 change after the precomputation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import CookTorrance
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.systems import standard

SIZE = 8
ERROR, HARMONIC = 0.05, 0.25  # of lobes and tensors, and of harmonics, under a window of four texels
FIRST = CookTorrance([0.4, 0.1, 0.05], 0.3, 0.25, 0.1)
OTHER = CookTorrance([0.1, 0.3, 0.3], [0.5, 0.4, 0.1], 0.4, [0.9, 0.7, 0.2])
RECIPES = {"lobes": prt.relit.Lobes(), "harmonics": prt.relit.Harmonics(4), "dynamic": prt.relit.Dynamic()}


def scene(material):
    mesh = builtin.sphere(rings=10, sectors=20)
    beside = dataclasses.replace(mesh, position=mesh.position + np.array([2.0, 0, 0], np.float32))
    rough = TexturedMaterial(metallic=0.4, roughness=0.5)
    return Scene([Part("ball", mesh, material), Part("beside", beside, rough)])


@pytest.fixture(scope="module")
def light():
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 4:6] = [10, 9, 8]
    return Environment(sky)


@pytest.fixture(scope="module", params=RECIPES)
def pair(request):
    """The first material, free to change, and the other one alone."""
    options = {"system": RECIPES[request.param], "size": SIZE, "progress": False, "bounces": 1, "rays": 0}
    return prt.precompute(scene(FIRST), refine=False, **options), prt.precompute(scene(OTHER), refine=False, **options)


def off(found, true):
    return np.linalg.norm(np.asarray(found) - true) / np.linalg.norm(true)


def test_a_material_in_the_plane_of_roughness_and_f0_is_that_of_a_scene_made_for_it(pair, light):
    free, alone = pair
    given, eye = {"ball": OTHER}, free.camera.eye
    assert off(free.radiance(light, eye=eye, materials=given), alone.radiance(light, eye=eye)) < 0.01
    camera = dataclasses.replace(free.camera, width=48, height=48)
    assert off(free.picture(light, camera, materials=given), alone.picture(light, camera)) < 0.01


def test_radiance_is_that_of_the_exact_sum(pair, light):
    free, _ = pair
    mesh, direct, eye = free.mesh, free.without_bounces(), free.camera.eye
    found = direct.radiance(light, eye=eye, materials={"ball": OTHER})[: len(free.scene["ball"].mesh.position)]
    true = prt.reference.radiance(free.scene["ball"].mesh, OTHER, light, eye=eye, occluder=mesh)
    harmonic = isinstance(_system(free), prt.harmonic.HarmonicSystem)
    assert off(found, np.asarray(true)) < (HARMONIC if harmonic else ERROR)


def _system(relit):
    system = relit.surfaces[0].system
    return getattr(system, "system", system)


def test_radiance_is_differentiable_in_roughness_and_f0(pair, light):
    free, _ = pair

    def brightness(roughness, f0):
        given = {"ball": dataclasses.replace(OTHER, roughness=roughness, f0=f0)}
        return jnp.mean(free.radiance(light, eye=free.camera.eye, materials=given) ** 2)

    where = jnp.asarray(0.4), jnp.asarray([0.5])
    slopes = jax.grad(brightness, argnums=(0, 1))(*where)
    for number, (step, slope) in enumerate(zip((0.01, 0.05), slopes, strict=True)):
        ends = [brightness(*(x + sign * step * (n == number) for n, x in enumerate(where))) for sign in (1, -1)]
        assert float(jnp.sum(slope)) == pytest.approx(float((ends[0] - ends[1]) / (2 * step)), rel=0.1)


@pytest.mark.parametrize(
    ("material", "kind", "message"),
    [
        (CookTorrance(roughness=2.0), ValueError, "must be from 0.00316 to 1, got 2"),
        (TexturedMaterial(), TypeError, "must be a CookTorrance, got TexturedMaterial"),
    ],
)
def test_what_was_not_precomputed_is_refused(pair, light, material, kind, message):
    free, _ = pair
    with pytest.raises(kind, match=message):
        free.radiance(light, eye=free.camera.eye, materials={"ball": material})


def test_a_roughness_outside_of_the_standard_tables_has_a_table_of_its_own():
    rough = prt.relit.channels.of_part(scene(CookTorrance(roughness=1.5)).parts[0])
    assert rough.table is rough.blend is None


def test_the_viewer_drags_a_material_through_the_plane(pair, light):
    free = pair[0].without_bounces()
    session = prt.view.Session(free, environments={"sky": light})
    told = session.answer({"kind": "scene"}).content
    ball = told["parts"][0]["free"]
    assert ball["roughness"] == pytest.approx(0.25)
    assert ball["roughness_range"] == pytest.approx(np.exp(standard.COOK_TORRANCE.range))
    assert ball["f0"] == pytest.approx(0.1)
    look = {"kind": "look", "seq": 1, "system": "system", "light": 0, "turn": 0.0, "lamps": [], "bounces": False}
    look |= {name: told[name] for name in ("eye", "target", "field_of_view")} | {"stops": None}
    new = {"diffuse": [0.1, 0.3, 0.3], "roughness": 0.4, "f0": 0.9, "specular": [0.5, 0.4, 0.1]}
    reply = session.answer(look | {"materials": {"ball": new}})
    found = np.frombuffer(reply.buffers[0], "<f2").astype(float).reshape(-1, 3)
    gray = {"ball": dataclasses.replace(OTHER, f0=jnp.asarray([0.9]))}
    true = free.radiance(light, eye=jnp.asarray(told["eye"]), materials=gray)
    assert off(found, np.asarray(true)) < 2e-3
    assert session.answer(look | {"materials": {"ball": {"roughness": 3.0}}}).content["kind"] == "error"
