"""Warnings of `precompute`: parts that are seen from behind, and BRDFs that create light."""

import re
import warnings

import equinox as eqx
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import GGX, BlinnPhong, Lambert, MetallicRoughness
from jaxprt.relit import warn
from jaxprt.relit.channels import of_part
from jaxprt.scene import Mesh, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import make_mesh

BALL = builtin.sphere(rings=8, sectors=16)


def inside_out(mesh: Mesh) -> Mesh:
    return make_mesh(np.asarray(mesh.position), np.asarray(mesh.face)[:, ::-1])


def told(function, *arguments) -> list[str]:
    """The texts of the warnings of a call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        function(*arguments)
    return [str(each.message) for each in caught]


def seen(*mesh: Mesh, elevation: float = 0.3) -> list[str]:
    """The warnings of a scene of some meshes, from slightly above, or from below."""
    scene = Scene([Part(str(number), each, Lambert()) for number, each in enumerate(mesh)])
    return told(warn.of_backs, scene, scene.mesh, orbit(scene.mesh, elevation=elevation))


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_parts_that_are_inside_out_or_seen_from_below_are_named_at_any_size(size):
    scaled = eqx.tree_at(lambda each: each.position, BALL, BALL.position * size)
    beside = eqx.tree_at(lambda each: each.position, scaled, scaled.position + np.float32([2.5 * size, 0, 0]))
    assert seen(scaled) == []
    (text,) = seen(scaled, inside_out(beside))
    assert re.search("sees 100% of part '1' from behind, and backs are black: .* inside out", text)
    plane = builtin.plane(cells=2)
    assert [len(seen(plane, elevation=elevation)) for elevation in (0.5, -0.5)] == [0, 1]


def test_lamps_silhouettes_and_faces_of_both_orientations_are_not_named():
    scene = Scene([Part("lamp", builtin.plane(cells=2), TexturedMaterial(emissive=2.0))])
    assert told(warn.of_backs, scene, scene.mesh, orbit(scene.mesh, elevation=-0.5)) == []
    both = make_mesh(
        np.concatenate([np.asarray(BALL.position)] * 2),
        np.concatenate([np.asarray(BALL.face), np.asarray(BALL.face)[:, ::-1] + len(BALL.position)]),
        normal=np.concatenate([np.asarray(BALL.normal), -np.asarray(BALL.normal)]),
    )
    assert seen(both) == []
    assert seen(builtin.chess()) == []


def dome(*, radius=50.0, lowest=-1.0, outward=False) -> Mesh:
    """The part of a sphere above a height, relative to its radius."""
    position, face = np.asarray(BALL.position) * radius, np.asarray(BALL.face)
    face = face[(position[face][:, :, 1] >= lowest * radius - 1e-3).all(1)]
    return make_mesh(position, face if outward else face[:, ::-1])


def shells(*mesh: Mesh, material=None, **more) -> list[str]:
    """The warnings of shells and of backs in a scene of some meshes."""
    scene = Scene([Part(str(number), each, material or Lambert()) for number, each in enumerate(mesh)], **more)
    camera = orbit(scene.mesh, elevation=0.3)
    return told(warn.of_shells, scene) + told(warn.of_backs, scene, scene.mesh, camera)


@pytest.mark.parametrize("lowest", [-1.0, 0.0])
@pytest.mark.parametrize("outward", [False, True])
def test_a_dome_is_said_to_hide_the_light_however_it_is_turned(lowest, outward):
    floor = eqx.tree_at(lambda each: each.position, builtin.plane(cells=2), builtin.plane(cells=2).position * 20)
    (text,) = shells(BALL, floor, dome(lowest=lowest, outward=outward))
    assert re.search("part '2' encloses the scene and hides the light of the environment from it", text)


def test_ceilings_and_open_cups_enclose_nothing():
    plane, cup = builtin.plane(cells=2), dome(radius=4.0)
    ceiling = make_mesh(np.asarray(plane.position) * 9 + [0, 3, 0], np.asarray(plane.face))
    height = np.asarray(cup.position)[np.asarray(cup.face)][..., 1].max(1)
    cup = make_mesh(np.asarray(cup.position), np.asarray(cup.face)[height < 3])
    for meshes in ([BALL], [BALL, ceiling], [BALL, cup]):
        assert not any("encloses" in text for text in shells(*meshes))


def test_a_room_with_a_lamp_asks_for_a_camera_inside():
    lamp = prt.scene.PointLight("bulb", [0.0, 3.0, 0.0], 1.0)
    (text,) = shells(BALL, dome(radius=5.0), point_lights=[lamp])
    assert re.search("part '1' from behind, and backs are black: it encloses the scene, so give a camera inside", text)


def test_brdfs_that_create_light_are_named_and_wrong_values_refused():
    for brdf, gain in (
        (Lambert(1.0), None),
        (Lambert((0.2, 1.5, 0.1)), "1.5"),
        (BlinnPhong(0.8, 0.9, 40.0), "1.27"),
        (GGX(1.0, 0.05), None),
        (MetallicRoughness(base_color=(200.0, 30.0, 20.0), metallic=0.0), "191"),
        (TexturedMaterial(base_color=1.0, metallic=0.0, roughness=0.1), None),
    ):
        part = Part("ball", BALL, brdf)
        text = told(warn.of_gain, Scene([part]), [of_part(part)])
        assert len(text) == (gain is not None), brdf
        assert gain is None or f"the BRDF of part 'ball' reflects {gain} times" in text[0]
    for brdf, message in (
        (lambda wi, wo: -wi[..., 2:], "must be finite and not negative"),
        (lambda wi, wo: 0 * wi[..., 2:] + np.nan, "must be finite and not negative"),
        (lambda wi, wo: 0.3, r"must return \[256, c\] for 256 directions, got \[\]"),
    ):
        with pytest.raises(ValueError, match=f"part 'ball': the BRDF {message}"):
            prt.precompute(Scene([Part("ball", BALL, brdf)]), refine=False, system="lobe", size=4, progress=False)


def test_precompute_warns_of_both():
    scene = Scene([Part("ball", inside_out(BALL), Lambert(1.5))])
    with pytest.warns(UserWarning, match="from behind"), pytest.warns(UserWarning, match=r"reflects 1\.5 times"):
        prt.precompute(scene, refine=False, system="harmonic", size=2, progress=False)
