"""Parts of Blinn-Phong and Cook-Torrance whose colors and lobes change after the precomputation."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
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
        {"roughness": 0.01, "f0": 0.05},
        CookTorrance(roughness=2.0),
        "must be from 0.00316 to 1, got 2",
    ),
}
CASES = [("Blinn-Phong", Harmonics(4)), ("Cook-Torrance", Lobes()), ("Cook-Torrance", Dynamic())]


def scene(material):
    mesh = builtin.sphere(rings=10, sectors=20)
    beside = dataclasses.replace(mesh, position=mesh.position + np.array([2.0, 0, 0], np.float32))
    return Scene([Part("ball", mesh, material), Part("beside", beside, TexturedMaterial(metallic=0.4, roughness=0.5))])


@pytest.fixture(scope="module")
def light():
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 4:6] = [10, 9, 8]
    return Environment(sky)


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}, {type(case[1]).__name__}")
def pair(request):
    """A kind of material, a scene of the first one, which is free to change, and a scene made for the other one."""
    name, recipe = request.param
    options = {"refine": False, "system": recipe, "size": SIZE, "progress": False, "bounces": 1, "rays": 0}
    kind = KINDS[name]
    return kind, *(prt.precompute(scene(material), **options) for material in (kind.first, kind.other))


def off(color, true):
    return np.linalg.norm(np.asarray(color) - true) / np.linalg.norm(true)


def test_a_changed_material_is_that_of_a_scene_made_for_it(pair, light):
    kind, free, alone = pair
    materials, eye = {"ball": kind.other}, free.camera.eye
    assert off(free.radiance(light, eye=eye, materials=materials), alone.radiance(light, eye=eye)) < 0.01
    camera = dataclasses.replace(free.camera, width=48, height=48)
    assert off(free.picture(light, camera, materials=materials), alone.picture(light, camera)) < 0.01


def test_radiance_is_that_of_the_exact_sum(pair, light):
    kind, free, _ = pair
    mesh, direct, eye = free.mesh, free.without_bounces(), free.camera.eye
    color = direct.radiance(light, eye=eye, materials={"ball": kind.other})[: len(free.scene["ball"].mesh.position)]
    true = prt.reference.radiance(free.scene["ball"].mesh, kind.other, light, eye=eye, occluder=mesh)
    system = free.surfaces[0].system
    harmonic = isinstance(getattr(system, "system", system), prt.harmonic.HarmonicSystem)
    assert off(color, np.asarray(true)) < (HARMONIC if harmonic else ERROR)


def test_radiance_is_differentiable_in_the_parameters(pair, light):
    kind, free, _ = pair

    def brightness(value):
        materials = {"ball": dataclasses.replace(kind.other, **value)}
        return jnp.mean(free.radiance(light, eye=free.camera.eye, materials=materials) ** 2)

    where = {
        name: jnp.asarray([0.5]) if name == "f0" else jnp.asarray(getattr(kind.other, name)) for name in kind.steps
    }
    slopes = jax.grad(brightness)(where)
    for name, step in kind.steps.items():
        ends = [brightness(where | {name: where[name] + sign * step}) for sign in (1, -1)]
        assert float(jnp.sum(slopes[name])) == pytest.approx(float((ends[0] - ends[1]) / (2 * step)), rel=0.1)


def test_vmap_over_materials_and_batches_of_lights_are_loops(pair, light, close):
    kind, free, _ = pair

    def color(scale, environment):
        material = dataclasses.replace(kind.first, diffuse=scale * kind.first.diffuse)
        return free.radiance(environment, eye=jnp.array([2.0, 2.0, 3.0]), materials={"ball": material})

    scale, turned = jnp.array([0.5, 1.0]), jnp.roll(light.radiance, 3, 2)
    of_materials = jax.vmap(color, (0, None))(scale, light)
    of_lights = color(0.5, Environment(jnp.stack([light.radiance, turned])))
    for number in (0, 1):
        close(of_materials[number], color(scale[number], light), tolerance=2e-5)
        close(of_lights[number], color(0.5, [light, Environment(turned)][number]), tolerance=2e-5)


def test_what_was_not_precomputed_is_refused(pair, light):
    kind, free, _ = pair
    wrong = [
        (kind.beyond, ValueError, kind.message),
        (TexturedMaterial(), TypeError, f"must be a {type(kind.first).__name__}, got TexturedMaterial"),
        (Lambert(0.5), TypeError, "or BlinnPhong or CookTorrance or Appearance or Blend.* got one of class Lambert"),
    ]
    for material, error, message in wrong:
        with pytest.raises(error, match=message):
            free.radiance(light, eye=free.camera.eye, materials={"ball": material})


@pytest.mark.parametrize("material", [BlinnPhong(0.1, 0.3, 3e5), CookTorrance(roughness=1.5)])
def test_a_material_outside_of_the_standard_tables_has_a_table_of_its_own(material):
    alone = prt.relit.channels.of_part(scene(material).parts[0])
    assert alone.table is alone.blend is None


def test_a_bounce_carries_the_changed_colors(pair, light):
    kind, free, _ = pair
    bare, first, eye = free.without_bounces(), len(free.scene["ball"].mesh.position), free.camera.eye

    def bounced(diffuse):
        materials = {"ball": dataclasses.replace(kind.other, diffuse=jnp.asarray(diffuse), specular=jnp.full(3, 0.05))}
        whole, direct = (relit.radiance(light, eye=eye, materials=materials) for relit in (free, bare))
        return np.mean(np.asarray(whole - direct)[first:], 0)

    red, blue = bounced([0.8, 0.1, 0.1]), bounced([0.1, 0.1, 0.8])
    assert red[0] > 2 * red[2] > 0
    assert blue[2] > 2 * blue[0] > 0


def test_the_viewer_changes_lobes_and_colors(pair, light):
    kind, free = pair[0], pair[1].without_bounces()
    session = prt.view.Session(free, environments={"sky": light})
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
    true = free.radiance(
        light, eye=jnp.asarray(told["eye"]), materials={"ball": dataclasses.replace(kind.other, **same)}
    )
    assert off(color, np.asarray(true)) < 2e-3
    assert session.answer(look | {"materials": {"ball": {name: 5e5}}}).content["kind"] == "error"
