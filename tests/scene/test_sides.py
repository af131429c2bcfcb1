"""Reversed copies of faces whose backs are lit and can be seen."""

import dataclasses

import numpy as np
import pytest
import trimesh

from jaxprt.scene import Camera, Part, Scene, TexturedMaterial
from jaxprt.scene.mesh import make_mesh
from jaxprt.scene.sides import hidden_backs, two_sided

LIT = TexturedMaterial(back="lit")
BOX = trimesh.creation.box()
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])


def part(name, position, face, material=LIT, **field):
    return Part(name, make_mesh(position, face), material, **field)


def counts(scene):
    return [(len(part.mesh.position), len(part.mesh.face)) for part in scene.parts]


def test_an_open_surface_gets_a_reversed_copy_that_follows_it():
    color, alpha = np.random.default_rng(0).random((4, 3)), np.linspace(0, 1, 4)
    before = Scene([part("a", *SQUARE, color=color, alpha=alpha), part("b", *SQUARE, TexturedMaterial())])
    after = two_sided(before)
    assert counts(after) == [(8, 4), (4, 2)]
    assert [part.name for part in after.parts] == ["a", "b"]
    assert hidden_backs(after).tolist() == [True, False]
    old, new = before.parts[0], after.parts[0]
    for name in ("position", "normal", "tangent"):
        sign = 1 if name == "position" else -1
        rows = np.asarray(getattr(old.mesh, name))
        np.testing.assert_array_equal(getattr(new.mesh, name), np.concatenate([rows, sign * rows]))
    np.testing.assert_array_equal(new.mesh.face[:2], old.mesh.face)
    np.testing.assert_array_equal(new.mesh.face[2:] - 4, np.asarray(old.mesh.face)[:, ::-1])
    for field, rows in (("color", color), ("alpha", alpha), ("handedness", np.ones(4))):
        sign = -1 if field == "handedness" else 1
        np.testing.assert_allclose(getattr(new, field), np.concatenate([rows, sign * rows]), rtol=1e-6)
    assert two_sided(after) is after


@pytest.mark.parametrize("turn", [1, -1])
def test_closed_surfaces_are_copied_only_if_they_are_inside_out(turn):
    scene = two_sided(Scene([part("box", BOX.vertices, BOX.faces[:, ::turn])]))
    assert counts(scene) == [(8, 12) if turn == 1 else (16, 24)]


def test_a_surface_may_be_closed_by_the_parts_together():
    halves = [part(name, BOX.vertices, BOX.faces[own]) for name, own in (("a", slice(6)), ("b", slice(6, 12)))]
    assert counts(two_sided(Scene(halves))) == [(8, 6), (8, 6)]
    assert counts(two_sided(Scene(halves[:1]))) != [(8, 6)]


def test_the_inside_of_a_room_is_seen_by_cameras_and_through_holes():
    room = part("room", BOX.vertices, BOX.faces)
    inside, outside = (Camera(eye, (0.0, 0, 0.1), (0.0, 1, 0), 1.0, 8, 8) for eye in ((0.0, 0, 0), (0.0, 0, 2)))
    assert counts(two_sided(Scene([room], [outside]))) == [(8, 12)]
    assert counts(two_sided(Scene([room], [outside, inside]))) == [(16, 24)]
    pierced = dataclasses.replace(room, material=TexturedMaterial(back="lit", alpha_mode="mask", alpha=0.4))
    glass = dataclasses.replace(room, material=TexturedMaterial(1.0, 0.0, back="lit", transmission=0.5))
    for open_room in (pierced, glass):
        assert counts(two_sided(Scene([open_room]))) == [(16, 24)]


def test_files_that_hold_both_sides_get_no_third():
    face = np.concatenate([SQUARE[1], SQUARE[1][:, ::-1]])
    assert counts(two_sided(Scene([part("leaf", SQUARE[0], face)]))) == [(4, 4)]
