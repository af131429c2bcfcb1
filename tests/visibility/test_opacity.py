"""Rays through holes and translucent surfaces, against the same holes cut into the mesh and against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import visibility
from jaxprt.scene import Part, Scene, Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face, join, make_mesh
from jaxprt.scene.sides import two_sided
from jaxprt.visibility import Occluder, picture_rays
from jaxprt.visibility.picture_rays import LampPlaces

SIZE = 8
RAMP = np.array([[[0.0], [1.0]]], np.float32)  # opacity 2 u - 1/2, clamped: half of it is in each half of the sheet


def sheet(height, across=(-1.0, 1.0)):
    """A square of two triangles above the origin that looks down; u runs along x."""
    x, z = np.meshgrid(across, (-1.0, 1.0))
    position = np.stack([x, np.full_like(x, height), z], -1).reshape(-1, 3)
    place = np.stack([(x + 1) / 2, (z + 1) / 2], -1).reshape(-1, 2)
    return make_mesh(position, grid_face(rows=2, columns=2)[:, ::-1], texture=place)


def scene(**field):
    field.setdefault("alpha_texture", Texture(RAMP, np.eye(2, 3, dtype=np.float32), 0, ("clamp", "clamp")))
    material = TexturedMaterial(**field)
    return Scene([Part("ground", make_mesh(*GROUND), TexturedMaterial()), Part("leaf", sheet(0.7), material)])


GROUND = (
    np.array([[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2], [0.1, 0, 0.2], [0.4, 0, -0.3]]),
    np.array([[0, 1, 4], [1, 2, 4], [2, 3, 5], [3, 0, 5], [4, 2, 5], [0, 4, 5]]),
)


def seen(mesh):
    """Visible shares of the two inner vertices of the ground."""
    rays = Occluder(mesh)
    start, normal = visibility.start_points(mesh, rays)[[4, 5]], np.asarray(mesh.normal)[[4, 5]]
    return visibility.fractional(rays, start, normal, size=SIZE)[0] / 16


def test_a_hole_by_alpha_is_a_hole_in_the_mesh():
    whole = scene(alpha_mode="mask", alpha_cutoff=0.5)
    cut = join([whole.parts[0].mesh, sheet(0.7, (0.0, 1.0))])
    np.testing.assert_array_equal(seen(whole.mesh), seen(cut))
    assert np.any(seen(whole.mesh) != seen(scene().mesh))


def test_a_translucent_surface_stops_its_share_of_light():
    plain = scene(alpha_texture=None, alpha=0.25, alpha_mode="blend")
    expected = 1 - 0.25 * (1 - seen(scene().mesh))
    got = seen(plain.mesh)
    above = seen(make_mesh(*GROUND)) > 0
    np.testing.assert_allclose(got[above], expected[above], atol=1 / 8)  # neighbors by an eighth are not supersampled
    assert np.mean(got[above]) == pytest.approx(np.mean(expected[above]), abs=0.01)


def test_both_sides_of_a_translucent_sheet_stop_light_once():
    plain = scene(alpha_texture=None, alpha=0.25, alpha_mode="blend", back="lit")
    doubled = two_sided(plain)
    assert len(doubled.mesh.face) == len(plain.mesh.face) + 2
    np.testing.assert_array_equal(seen(doubled.mesh), seen(plain.mesh))


def test_rays_stop_as_often_as_light_does():
    count, random = 4000, np.random.default_rng(0)
    x = random.uniform(-1, 1, count).astype(np.float32)
    origin = np.stack([x, np.full(count, 0.5, np.float32), random.uniform(-0.9, 0.9, count).astype(np.float32)], 1)
    up, each = np.array([[0, 1, 0]], np.float32), np.arange(count)
    share = np.clip(x + 0.5, 0, 1)  # 2 u - 1/2
    rays = Occluder(scene(alpha_mode="blend").mesh)
    np.testing.assert_allclose(rays.passed(origin, up, each, 0 * each), 1 - share, atol=1 / 500)
    for stopped in (rays.blocked(origin, up, each, 0 * each), rays.hit(origin, np.repeat(up, count, 0))[0] >= 0):
        assert np.mean(stopped) == pytest.approx(np.mean(share), abs=3 / count**0.5 / 2)
        assert not np.any(stopped[share == 0])
        assert np.all(stopped[share == 1])
    triangle, distance, weight = rays.hit(origin, np.repeat(up, count, 0), solid=True)
    assert np.all(triangle >= 6)
    np.testing.assert_allclose(distance, 0.2, rtol=1e-5)
    place = np.einsum("nk,nki->ni", weight, rays.position[rays.face[triangle]])
    np.testing.assert_allclose(place[:, [0, 2]], origin[:, [0, 2]], atol=1e-5)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_opacity_is_that_of_the_texture_lookup(wrap):
    random = np.random.default_rng(1)
    image = random.random((3, 5, 1)).astype(np.float32)
    texture = Texture(image, np.array([[1.7, 0.4, -0.8], [-0.3, 2.1, 0.3]], np.float32), 0, (wrap, wrap))
    mesh = sheet(1.0)
    vertex_alpha = np.array([1, 0.5, 0.25, 0.75], np.float32)
    part = Part("a", mesh, TexturedMaterial(alpha=0.9, alpha_texture=texture, alpha_mode="blend"), alpha=vertex_alpha)
    rays = Occluder(Scene([part]).mesh)
    origin = np.column_stack([random.uniform(-0.9, 0.9, (300, 2)), np.zeros(300)])[:, [0, 2, 1]].astype(np.float32)
    up, each = np.array([[0, 1, 0]], np.float32), np.arange(300)
    triangle, _, weight = rays.hit(origin, np.repeat(up, 300, 0), solid=True)
    corner = np.asarray(mesh.face)[triangle]
    place = np.einsum("nk,nki->ni", weight, np.asarray(mesh.texture)[corner])
    alpha = 0.9 * np.sum(weight * vertex_alpha[corner], 1) * np.asarray(texture.at(jnp.asarray(place)))[:, 0]
    np.testing.assert_allclose(rays.passed(origin, up, each, 0 * each), 1 - alpha, atol=2e-5)


def test_scenes_of_which_nothing_is_below_the_cutoff_have_no_opacity():
    assert scene(alpha_mode="mask", alpha_cutoff=0.0).mesh.opacity is None


def test_a_part_that_is_not_there_stops_nothing():
    np.testing.assert_array_equal(seen(scene(alpha_mode="blend", alpha=0.0).mesh), seen(make_mesh(*GROUND)))


def test_rays_from_pixels_pass_what_rays_of_vertices_pass():
    random, count = np.random.default_rng(0), 500
    spot = random.dirichlet([1, 1, 1], count)
    way = np.array([[0, 1, 0], [0.3, 0.8, -0.1]], np.float32)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    rays = picture_rays.TexelRays(np.repeat(way[:, None], picture_rays.PLACES, 1), np.array([3, 2]))
    points = picture_rays.PicturePoints(
        np.arange(count) % 6, spot, np.zeros((count, 2, 3)), *np.divmod(np.arange(count), 9)
    )
    for field in ({"alpha_mode": "mask"}, {"alpha_mode": "blend"}, {"alpha_mode": "blend", "back": "lit"}):
        mesh = two_sided(scene(**field)).mesh
        occluder = Occluder(mesh)
        share = picture_rays.shares(picture_rays.triangles(mesh), occluder, points, rays)
        corner = np.asarray(mesh.position)[np.asarray(mesh.face)[points.triangle]]
        place = np.einsum("pk,pki->pi", spot, corner).astype(np.float32) + np.array([0, 1e-6, 0], np.float32)
        number, texel = np.tile(np.arange(count), 2), np.repeat(np.arange(2), count)
        passed = occluder.passed(place, way, number, texel).reshape(2, count)
        # A ray in a thousand may pass the edge of a hole on the other side.
        assert np.mean(np.abs(share / picture_rays.FULL - passed) > 1 / picture_rays.FULL) < 1e-3
        assert np.mean(share < picture_rays.FULL) > 0.1
        assert np.any((share > 0) & (share < picture_rays.FULL)) == (field["alpha_mode"] == "blend")


def test_lamps_shine_through_what_lets_light_pass():
    points = picture_rays.PicturePoints(
        np.array([0]), np.array([[0.2, 0.3, 0.5]]), np.zeros((1, 2, 3)), *np.zeros((2, 1), int)
    )
    lamp = LampPlaces(  # a point light above the left half of the leaf
        np.array([[-0.3, 5, 0]], np.float32),
        np.zeros((1, 3), np.float32),
        *np.array([[[0]], [[1]]]),
        *np.array([[1], [4]]),
    )

    def light(**field):
        mesh = scene(**field).mesh
        corner = np.asarray(mesh.position)[np.asarray(mesh.face)[0]]
        place, up = points.barycentric @ corner, np.array([[0.0, 1, 0]])
        return picture_rays.moments(picture_rays.triangles(mesh), Occluder(mesh), points, place, up, lamp)[0], place

    open_, place = light(alpha_texture=None, alpha=0.0, alpha_mode="mask")
    assert all(np.any(moment != 0) for moment in open_)
    at = place[0] + (0.7 / 5) * (lamp.place[0] - place[0])
    assert np.all(np.abs(at[[0, 2]]) < 1)
    through = light(alpha_texture=None, alpha=0.25, alpha_mode="blend")[0]
    for moment, part, nothing in zip(open_, through, light()[0], strict=True):
        np.testing.assert_array_equal(nothing, 0)
        np.testing.assert_allclose(part, 0.75 * moment, rtol=1e-5)
