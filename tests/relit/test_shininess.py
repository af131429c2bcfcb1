"""Parts of Blinn-Phong whose colors and exponent change after the precomputation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import BlinnPhong, Lambert
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin

SIZE = 8
FIRST = BlinnPhong([0.4, 0.1, 0.05], 0.3, 20.0)
OTHER = BlinnPhong([0.1, 0.3, 0.3], [0.5, 0.4, 0.1], 60.0)


def scene(material):
    ground = prt.scene.mesh.make_mesh(
        np.array([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3]], float), np.array([[0, 1, 2], [0, 2, 3]])
    )
    return Scene([Part("ball", builtin.sphere(rings=10, sectors=20), material), Part("ground", ground, Lambert(0.4))])


@pytest.fixture(scope="module")
def light():
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 4:6] = [10, 9, 8]
    return Environment(sky)


@pytest.fixture(scope="module", params=[prt.relit.Lobes(), prt.relit.Harmonics(4)], ids=["lobes", "harmonics"])
def pair(request):
    """The first material, free to change, and the other one alone."""
    options = {"system": request.param, "size": SIZE, "progress": False}
    return prt.precompute(scene(FIRST), refine=False, **options), prt.precompute(scene(OTHER), refine=False, **options)


def off(found, true):
    return np.linalg.norm(np.asarray(found) - true) / np.linalg.norm(true)


def test_another_exponent_and_colors_are_those_of_a_scene_made_for_them(pair, light):
    free, alone = pair
    given, eye = {"ball": OTHER}, free.camera.eye
    assert off(free.radiance(light, eye=eye, materials=given), alone.radiance(light, eye=eye)) < 0.01
    camera = dataclasses.replace(free.camera, width=48, height=48)
    assert off(free.picture(light, camera, materials=given), alone.picture(light, camera)) < 0.01


def test_radiance_is_differentiable_in_the_exponent(pair, light):
    free, _ = pair

    def brightness(exponent):
        given = {"ball": dataclasses.replace(OTHER, exponent=exponent)}
        return jnp.mean(free.radiance(light, eye=free.camera.eye, materials=given) ** 2)

    step = 0.5
    slope = (brightness(jnp.asarray(60 + step)) - brightness(jnp.asarray(60 - step))) / (2 * step)
    assert float(jax.grad(brightness)(jnp.asarray(60.0))) == pytest.approx(float(slope), rel=0.1)


@pytest.mark.parametrize(
    ("material", "kind", "message"),
    [
        (BlinnPhong(0.1, 0.3, 300000.0), ValueError, "must be at most 2e.05, got 3e.05"),
        (TexturedMaterial(), TypeError, "must be a BlinnPhong, got TexturedMaterial"),
        (Lambert(0.5), TypeError, "or BlinnPhong or CookTorrance or Appearance or Blend.* got one of class Lambert"),
    ],
)
def test_what_was_not_precomputed_is_refused(pair, light, material, kind, message):
    free, _ = pair
    with pytest.raises(kind, match=message):
        free.radiance(light, eye=free.camera.eye, materials={"ball": material})


def test_an_exponent_sharper_than_the_standard_tables_has_a_table_of_its_own():
    sharp = prt.relit.channels.of_part(scene(BlinnPhong(0.1, 0.3, 3e5)).parts[0])
    assert sharp.table is sharp.blend is None


def test_a_bounce_carries_the_changed_colors(light):
    system = prt.relit.Lobes(texels=2)
    made = prt.precompute(scene(FIRST), refine=False, system=system, bounces=1, size=SIZE, progress=False)
    bare = made.without_bounces()
    first = len(made.scene["ball"].mesh.position)
    eye = made.camera.eye

    def bounced(material):
        given = {"ball": material}
        return np.asarray(
            made.radiance(light, eye=eye, materials=given) - bare.radiance(light, eye=eye, materials=given)
        )[first:]

    red, blue = (bounced(BlinnPhong(color, 0.05, 20.0)).mean(0) for color in ([0.8, 0.1, 0.1], [0.1, 0.1, 0.8]))
    assert red[0] > 2 * red[2] > 0
    assert blue[2] > 2 * blue[0] > 0


def test_the_viewer_changes_exponent_and_colors(pair, light):
    free, _ = pair
    session = prt.view.Session(free, environments={"sky": light})
    told = session.answer({"kind": "scene"}).content
    ball = told["parts"][0]["free"]
    assert ball["exponent"] == 20
    assert ball["exponent_range"] == pytest.approx([1, 2e5], rel=1e-3)
    assert ball["f0"] == pytest.approx(0.3)
    look = {"kind": "look", "seq": 1, "system": "system", "light": 0, "turn": 0.0, "lamps": [], "bounces": False}
    look |= {name: told[name] for name in ("eye", "target", "field_of_view")} | {"stops": None}
    new = {"diffuse": [0.1, 0.3, 0.3], "exponent": 60.0, "f0": 0.5, "specular": [1.0, 0.8, 0.2]}
    reply = session.answer(look | {"materials": {"ball": new}})
    found = np.frombuffer(reply.buffers[0], "<f2").astype(float).reshape(-1, 3)
    true = free.radiance(light, eye=jnp.asarray(told["eye"]), materials={"ball": OTHER})
    assert off(found, np.asarray(true)) < 2e-3
    assert session.answer(look | {"materials": {"ball": {"exponent": 5e5}}}).content["kind"] == "error"
