"""Lit backs and holes of relit scenes, from precomputation to picture."""

import dataclasses

import numpy as np
import pytest

import jaxprt as prt
from jaxprt.scene import Camera, Part, Scene, Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face, make_mesh
from jaxprt.sphere import cubemap
from jaxprt.systems.protocol import Blend

SIZE = 16
HALVES = Texture(np.array([[[0.0], [1.0]]], np.float32), np.eye(2, 3, dtype=np.float32), 0, ("clamp", "clamp"))
MATTE = TexturedMaterial(base_color=0.8, metallic=0.0, specular=0.0)


def sheet(count, turn):
    """A square that looks to +z, or to -z, of count x count vertices; u runs along x."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, count)] * 2)
    position = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    place = np.stack([(x + 1) / 2, (y + 1) / 2], -1).reshape(-1, 2)
    return make_mesh(position, grid_face(rows=count, columns=count)[:, ::-turn], texture=place)


def picture(mesh, material):
    """The sheet in front of the camera, before a light that is red in front of it and green behind it."""
    relit = prt.precompute(Scene([Part("sheet", mesh, material)]), system="harmonic", size=SIZE, progress=False)
    front = np.asarray(cubemap.direction(size=SIZE)).reshape(6, SIZE, SIZE, 3)[..., 2:] > 0
    light = prt.Environment(np.where(front, [1.0, 0, 0], [0, 1.0, 0]).astype(np.float32))
    camera = Camera((0.0, 0, 4), (0.0, 0, 0), (0.0, 1, 0), 0.4, 17, 16)
    return relit, np.asarray(relit.picture(light, camera))


@pytest.fixture(scope="module")
def facing():
    return picture(sheet(3, 1), MATTE)[1]


def test_a_lit_back_looks_like_a_front(facing):
    relit, seen = picture(sheet(3, -1), dataclasses.replace(MATTE, back="lit"))
    np.testing.assert_allclose(seen, facing, atol=1e-4)
    assert facing[8, 8, 0] == pytest.approx(0.8, abs=0.02)  # the light in front of it alone
    assert (len(relit.mesh.position), len(relit.mesh.face)) == (18, 16)
    np.testing.assert_array_equal(relit.mesh.position[:9], sheet(3, -1).position)


def test_a_hidden_back_shows_what_is_behind_and_a_black_one_is_black():
    for back, middle, words in (
        ("hidden", [0, 1, 0], "its material hides backs"),
        ("black", [0, 0, 0], "backs are black"),
    ):
        with pytest.warns(UserWarning, match=f"from behind, and {words}"):
            _, seen = picture(sheet(3, -1), dataclasses.replace(MATTE, back=back))
        np.testing.assert_allclose(seen[8, 8], middle, atol=1e-6)


def test_a_hole_shows_the_background_and_the_rest_its_light(facing):
    mask = dataclasses.replace(MATTE, alpha_texture=HALVES, alpha_mode="mask")
    _, seen = picture(sheet(3, 1), mask)
    np.testing.assert_allclose(seen[:, 10:], facing[:, 10:], atol=1e-4)
    np.testing.assert_allclose(seen[:, :7], np.broadcast_to([0.0, 1, 0], seen[:, :7].shape), atol=1e-6)


def test_the_vertices_of_the_file_are_known_among_copies_and_added_ones():
    leaf, ground = sheet(3, 1), sheet(2, 1)
    above = dataclasses.replace(leaf, position=leaf.position * 0.3 + np.array([0.1, 0.2, 0.3], np.float32))
    parts = [Part("leaf", above, dataclasses.replace(MATTE, back="lit")), Part("ground", ground, MATTE)]
    options = {"system": "harmonic", "size": 8, "refine": 0.02, "vertices": 500, "progress": False}
    relit = prt.precompute(Scene(parts), **options)
    assert relit.division is not None
    assert len(relit.mesh.position) > 18 + 4
    file = np.concatenate([above.position, ground.position])
    np.testing.assert_array_equal(np.asarray(relit.mesh.position)[relit.file_vertex], file)
    first = relit.shading[0].blend
    assert first is not None
    weight = np.asarray(first.weight)[:9] * np.linspace(0.1, 1, 9, dtype=np.float32)[:, None, None]
    given = Blend(weight, tuple(np.asarray(each)[:9] for each in first.parameter))
    blend = relit.appearances({"leaf": given})["leaf"].blend
    assert blend is not None
    spread = np.asarray(blend.weight)
    place = [tuple(row) for row in np.asarray(relit.scene.parts[0].mesh.position).tolist()]
    assert len(spread) == len(place)
    for row, here in zip(spread, place, strict=True):  # the same on both sides
        np.testing.assert_allclose(row, spread[place.index(here)], rtol=1e-5)
    assert len(set(place)) == len(place) // 2
