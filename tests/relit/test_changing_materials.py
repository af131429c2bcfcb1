"""Parts of Blinn-Phong and Cook-Torrance whose colors and lobes change after the precomputation."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces
from jaxprt.brdf import BlinnPhong, CookTorrance, Lambert
from jaxprt.relit import Dynamic, Harmonics, Lobes
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.systems import standard

SIZE = 8
ERROR, HARMONIC = 0.05, 0.25  # of lobes and tensors, and of harmonics, under a window of four texels


class Kind(NamedTuple):
    """A kind of material: two of them, steps in parameters, and one that its standard tables do not reach."""

    first: BlinnPhong | CookTorrance
    other: BlinnPhong | CookTorrance
    steps: dict[str, float]
    beyond: BlinnPhong | CookTorrance
    message: str


KINDS = {
    "Blinn-Phong": Kind(
        BlinnPhong([0.4, 0.1, 0.05], 0.3, 20.0),
        BlinnPhong([0.1, 0.3, 0.3], [0.5, 0.4, 0.1], 60.0),
        {"exponent": 0.5},
        BlinnPhong(0.1, 0.3, 300000.0),
        "must be at most 2e.05, got 3e.05",
    ),
    "Cook-Torrance": Kind(
        CookTorrance([0.4, 0.1, 0.05], 0.3, 0.25, 0.1),
        CookTorrance([0.1, 0.3, 0.3], [0.5, 0.4, 0.1], 0.4, [0.9, 0.7, 0.2]),
        {"roughness": 0.0025, "f0": 0.05},  # no knot of the tables between
        CookTorrance(roughness=2.0),
        "must be from 0.00316 to 1, got 2",
    ),
}
CASES = {
    "harmonics": ("Blinn-Phong", Harmonics(4), 1),
    "lobes": ("Cook-Torrance", Lobes(), 1),
    "dynamic": ("Cook-Torrance", Dynamic(), 0),
}
EVERY = pytest.mark.parametrize("case", CASES)
BOUNCING = pytest.mark.parametrize("case", ["harmonics", "lobes"])


def scene(material):
    mesh = builtin.sphere(rings=6, sectors=8)
    beside = dataclasses.replace(mesh, position=mesh.position + np.array([2.0, 0, 0], np.float32))
    return Scene([Part("ball", mesh, material), Part("beside", beside, TexturedMaterial(metallic=0.4, roughness=0.5))])


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Bounces of few directions."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, bounces.precompute, edge=2, size=8, components=8, modes=8)
        yield


@pytest.fixture(scope="module")
def light():
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 4:6] = [10, 9, 8]
    return Environment(sky)


def made(case, material):
    _, recipe, count = CASES[case]
    options = {"refine": False, "system": recipe, "size": SIZE, "progress": False, "bounces": count, "rays": 0}
    return prt.precompute(scene(material), **options)


@functools.cache
def free(case):
    """A scene of the first material, which is free to change."""
    return made(case, KINDS[CASES[case][0]].first)


def kind_of(case):
    return KINDS[CASES[case][0]]


def off(color, true):
    return np.linalg.norm(np.asarray(color) - true) / np.linalg.norm(true)


@EVERY
def test_a_changed_material_is_that_of_a_scene_made_for_it(case, light):
    other, relit = kind_of(case).other, free(case)
    alone, materials, eye = made(case, other), {"ball": other}, relit.camera.eye
    assert off(relit.radiance(light, eye=eye, materials=materials), alone.radiance(light, eye=eye)) < 0.01
    camera = dataclasses.replace(relit.camera, width=48, height=48)
    assert off(relit.picture(light, camera, materials=materials), alone.picture(light, camera)) < 0.01


@EVERY
def test_radiance_is_that_of_the_exact_sum(case, light):
    kind, relit = kind_of(case), free(case)
    mesh, direct, eye = relit.mesh, relit.without_bounces(), relit.camera.eye
    color = direct.radiance(light, eye=eye, materials={"ball": kind.other})[: len(relit.scene["ball"].mesh.position)]
    true = prt.reference.radiance(relit.scene["ball"].mesh, kind.other, light, eye=eye, occluder=mesh)
    system = relit.surfaces[0].system
    harmonic = isinstance(getattr(system, "system", system), prt.harmonic.HarmonicSystem)
    assert off(color, np.asarray(true)) < (HARMONIC if harmonic else ERROR)


@EVERY
def test_radiance_is_differentiable_in_the_parameters(case, light):
    kind, relit = kind_of(case), free(case)

    def brightness(value):
        materials = {"ball": dataclasses.replace(kind.other, **value)}
        return jnp.mean(relit.radiance(light, eye=relit.camera.eye, materials=materials) ** 2)

    where = {
        name: jnp.asarray([0.5]) if name == "f0" else jnp.asarray(getattr(kind.other, name)) for name in kind.steps
    }
    slopes = jax.grad(brightness)(where)
    for name, step in kind.steps.items():
        ends = [brightness(where | {name: where[name] + sign * step}) for sign in (1, -1)]
        assert float(jnp.sum(slopes[name])) == pytest.approx(float((ends[0] - ends[1]) / (2 * step)), rel=0.1)


def test_vmap_over_materials_and_batches_of_lights_are_loops(light, close):
    kind, relit = kind_of("lobes"), free("lobes")

    def color(scale, environment):
        material = dataclasses.replace(kind.first, diffuse=scale * kind.first.diffuse)
        return relit.radiance(environment, eye=jnp.array([2.0, 2.0, 3.0]), materials={"ball": material})

    scale, turned = jnp.array([0.5, 1.0]), jnp.roll(light.radiance, 3, 2)
    of_materials = jax.vmap(color, (0, None))(scale, light)
    of_lights = color(0.5, Environment(jnp.stack([light.radiance, turned])))
    for number in (0, 1):
        close(of_materials[number], color(scale[number], light), tolerance=2e-5)
        close(of_lights[number], color(0.5, [light, Environment(turned)][number]), tolerance=2e-5)


@BOUNCING
def test_what_was_not_precomputed_is_refused(case, light):
    kind, relit = kind_of(case), free(case)
    wrong = [
        (kind.beyond, ValueError, kind.message),
        (TexturedMaterial(), TypeError, f"must be a {type(kind.first).__name__}, got TexturedMaterial"),
        (Lambert(0.5), TypeError, "or BlinnPhong or CookTorrance or Appearance or Blend.* got one of class Lambert"),
    ]
    for material, error, message in wrong:
        with pytest.raises(error, match=message):
            relit.radiance(light, eye=relit.camera.eye, materials={"ball": material})


@pytest.mark.parametrize("material", [BlinnPhong(0.1, 0.3, 3e5), CookTorrance(roughness=1.5)])
def test_a_material_outside_of_the_standard_tables_has_a_table_of_its_own(material):
    alone = prt.relit.channels.of_part(scene(material).parts[0])
    assert alone.table is alone.blend is None


def test_a_bounce_carries_the_changed_colors(light):
    kind, relit = kind_of("lobes"), free("lobes")
    bare, first, eye = relit.without_bounces(), len(relit.scene["ball"].mesh.position), relit.camera.eye

    def bounced(diffuse):
        materials = {"ball": dataclasses.replace(kind.other, diffuse=jnp.asarray(diffuse), specular=jnp.full(3, 0.05))}
        whole, direct = (each.radiance(light, eye=eye, materials=materials) for each in (relit, bare))
        return np.mean(np.asarray(whole - direct)[first:], 0)

    red, blue = bounced([0.8, 0.1, 0.1]), bounced([0.1, 0.1, 0.8])
    assert red[0] > 2 * red[2] > 0
    assert blue[2] > 2 * blue[0] > 0


@BOUNCING
def test_the_viewer_changes_lobes_and_colors(case, light):
    kind, relit = kind_of(case), free(case).without_bounces()
    session = prt.view.Session(relit, environments={"sky": light})
    told = session.answer({"kind": "scene"}).content
    ball, name = told["parts"][0]["free"], next(iter(kind.steps))
    reach = [1, 2e5] if name == "exponent" else np.exp(standard.COOK_TORRANCE.range)
    assert ball[name] == pytest.approx(float(getattr(kind.first, name)))
    assert ball[f"{name}_range"] == pytest.approx(reach, rel=1e-3)
    look = {"kind": "look", "seq": 1, "system": "system", "light": 0, "turn": 0.0, "lamps": [], "bounces": False}
    look |= {key: told[key] for key in ("eye", "target", "field_of_view")} | {"stops": None}
    new = {"diffuse": [0.1, 0.3, 0.3], name: float(getattr(kind.other, name)), "f0": 0.9, "specular": [0.5, 0.4, 0.1]}
    reply = session.answer(look | {"materials": {"ball": new}})
    color = np.frombuffer(reply.buffers[0], "<f2").astype(float).reshape(-1, 3)
    same = {"f0": jnp.asarray([0.9])} if "f0" in kind.steps else {"specular": 0.9 * jnp.asarray(kind.other.specular)}
    true = relit.radiance(
        light, eye=jnp.asarray(told["eye"]), materials={"ball": dataclasses.replace(kind.other, **same)}
    )
    assert off(color, np.asarray(true)) < 2e-3
    assert session.answer(look | {"materials": {"ball": {name: 5e5}}}).content["kind"] == "error"
