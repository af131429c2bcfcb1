"""Textures with labelled texels, and SciPy's interpolation of the same image."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
import trimesh

from jaxprt.scene import load_mesh, texture

# Three rows of four texels: hundreds count rows from the top, units columns from the left.
LABEL = jnp.asarray(100.0 * np.arange(3)[:, None, None] + np.arange(4)[:, None])


def test_the_lower_left_texel_is_at_small_coordinates():
    corner = [[0.125, 1 / 6], [0.875, 1 / 6], [0.125, 5 / 6], [0.875, 5 / 6], [0.375, 0.5]]
    np.testing.assert_allclose(texture.lookup(LABEL, jnp.array(corner))[:, 0], [200, 203, 0, 3, 101], atol=1e-3)


def test_half_way_between_texels_is_their_mean():
    place = jnp.array([[0.25, 1 / 6], [0.125, 1 / 3], [0.25, 1 / 3]])
    np.testing.assert_allclose(texture.lookup(LABEL, place)[:, 0], [200.5, 150, 150.5], rtol=1e-5)


def test_the_texture_repeats_and_its_edges_meet():
    place = jnp.array([[0.3, 0.4], [0.875, 1 / 6]])
    for shift in ([1, 0], [0, -1], [-3, 5], [1000, 1000]):
        moved = texture.lookup(LABEL, place + jnp.array(shift))
        np.testing.assert_allclose(moved, texture.lookup(LABEL, place), atol=0.05)  # Of 203, at coordinates of 1000.
    # Left and right edges are one line, as are top and bottom.
    edge = jnp.array([[0.0, 0.5], [1.0, 0.5], [0.125, 0.0], [0.125, 1.0]])
    np.testing.assert_allclose(texture.lookup(LABEL, edge)[:, 0], [101.5, 101.5, 100, 100], rtol=1e-5)


def test_lookup_is_scipys_periodic_interpolation(close):
    random = np.random.default_rng(0)
    image, place = random.normal(size=(5, 7, 3)), random.uniform(-2, 3, size=(4, 50, 2))
    grid = [(1 - place[..., 1]) * 5 - 0.5, place[..., 0] * 7 - 0.5]
    expected = [scipy.ndimage.map_coordinates(image[..., c], grid, order=1, mode="grid-wrap") for c in range(3)]
    close(texture.lookup(*(jnp.asarray(each, jnp.float32) for each in (image, place))), np.stack(expected, -1))


def test_an_image_of_one_texel_is_constant():
    place = jnp.asarray(np.random.default_rng(0).normal(size=(9, 2)), jnp.float32)
    np.testing.assert_allclose(texture.lookup(jnp.full((1, 1, 2), 0.3), place), 0.3, rtol=1e-6)


def test_the_gradient_in_the_image_is_the_weight_of_each_texel(close):
    gradient = jax.grad(lambda image: texture.lookup(image, jnp.array([0.3, 0.4]))[0])(LABEL)
    expected = np.zeros((3, 4, 1))
    # x = .3 * 4 - .5 = .7 and y = .6 * 3 - .5 = 1.3.
    expected[1:, :2, 0] = np.outer([0.7, 0.3], [0.3, 0.7])
    close(gradient, expected)


@pytest.mark.parametrize("name", ["meshes/spot.obj", "meshes_awkward/fuze.obj"])
def test_coordinates_that_trimesh_reads_are_those_of_the_loaded_vertices(data, name):
    mesh, read = load_mesh(data / name), trimesh.load(data / name, process=False, skip_materials=True)
    np.testing.assert_array_equal(mesh.position, np.asarray(read.vertices, np.float32))
    lines = (data / name).read_text().splitlines()
    written, corner, faces = (
        [line.split()[1:] for line in lines if line.startswith(key)] for key in ("vt ", "v ", "f ")
    )
    # Of the first vertex of the first face, as the file has it.
    vertex, coordinate = (int(number) - 1 for number in faces[0][0].split("/")[:2])
    own = np.flatnonzero((np.asarray(mesh.position) == np.asarray(corner[vertex][:3], np.float32)).all(1))
    uv = np.asarray(read.visual.uv)[own]
    assert np.abs(uv - np.asarray(written[coordinate][:2], float)).max(1).min() < 1e-6
