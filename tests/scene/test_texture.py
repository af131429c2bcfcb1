"""Textures with labelled texels, and SciPy's interpolation of the same image.

Normal maps: tilted normals, and the variance that mean normals tell, against samples of scipy's distribution.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from scipy import stats

from jaxprt.scene import builtin, load_mesh, texture
from jaxprt.scene.mesh import brush, grid_face, make_mesh

# Three rows of four texels: hundreds count rows from the top, units columns from the left.
LABEL = jnp.asarray(100.0 * np.arange(3)[:, None, None] + np.arange(4)[:, None])
UP = np.float32([[0, 0, 1]])
FRAME = np.eye(3, dtype=np.float32)[None]
ONE = np.ones(1, np.float32)


def test_the_texture_repeats_and_its_edges_meet():
    place = jnp.array([[0.3, 0.4], [0.875, 1 / 6]])
    for shift in ([1, 0], [0, -1], [-3, 5], [1000, 1000]):
        moved = texture.lookup(LABEL, place + jnp.array(shift))
        np.testing.assert_allclose(moved, texture.lookup(LABEL, place), atol=0.05)  # Of 203, at coordinates of 1000.
    # Left and right edges are one line, as are top and bottom.
    edge = jnp.array([[0.0, 0.5], [1.0, 0.5], [0.125, 0.0], [0.125, 1.0]])
    np.testing.assert_allclose(texture.lookup(LABEL, edge)[:, 0], [101.5, 101.5, 100, 100], rtol=1e-5)


@pytest.mark.parametrize(("wrap", "mode"), [("repeat", "grid-wrap"), ("mirror", "reflect"), ("clamp", "nearest")])
def test_lookup_is_scipys_interpolation_in_every_wrap_mode(close, wrap, mode):
    random = np.random.default_rng(0)
    image, place = random.normal(size=(5, 7, 3)), random.uniform(-2, 3, size=(4, 50, 2))
    grid = [(1 - place[..., 1]) * 5 - 0.5, place[..., 0] * 7 - 0.5]
    expected = [scipy.ndimage.map_coordinates(image[..., c], grid, order=1, mode=mode) for c in range(3)]
    found = texture.lookup(*(jnp.asarray(each, jnp.float32) for each in (image, place)), wrap=(wrap, wrap))
    close(found, np.stack(expected, -1))


@pytest.mark.parametrize("name", ["meshes/spot.obj", "meshes_awkward/quadknot.obj"])
def test_texture_coordinates_are_the_files(data, name):
    mesh = load_mesh(data / name)
    lines = (data / name).read_text().splitlines()
    place, corner, faces = ([line.split()[1:] for line in lines if line.startswith(key)] for key in ("vt ", "v ", "f "))
    fans = [(face[0], *face[k : k + 2]) for face in faces for k in range(1, len(face) - 1)]
    index = np.array([[each.split("/")[:2] for each in fan] for fan in fans], int) - 1
    written = [np.array([each[:count] for each in rows], float) for rows, count in ((corner, 3), (place, 2))]
    expected = np.concatenate([rows[index[..., k]] for k, rows in enumerate(written)], -1)
    face = np.asarray(mesh.face)
    actual = np.concatenate([np.asarray(mesh.position)[face], np.asarray(mesh.texture)[face]], -1)
    # trimesh orders an OBJ's faces by material, and splits polygons by another diagonal: as sets of corners.
    corners = [np.unique(each.reshape(-1, 5).astype(np.float32).round(5), axis=0) for each in (expected, actual)]
    np.testing.assert_allclose(*corners, atol=2e-5)


def affine(place):
    """Vertices of a square whose texture is turned, stretched and sheared, with the images of u and v."""
    inverse = np.linalg.inv([[2.0, 0.5], [-1.0, 3.0]])
    position = np.column_stack([place @ inverse.T, np.zeros(len(place))])
    return position, np.append(inverse[:, 0], 0)


def test_dpdu_of_an_affine_texture_is_the_same_everywhere():
    u, v = np.meshgrid(np.linspace(-3, 5, 7), np.linspace(0, 1, 5))
    place = np.column_stack([u.ravel(), v.ravel()])
    position, along = affine(place)
    face = grid_face(rows=5, columns=7)
    found = texture.dpdu(make_mesh(position, face, texture=place))
    np.testing.assert_allclose(found, np.broadcast_to(along, found.shape), atol=1e-5)
    mirrored = texture.dpdu(make_mesh(position, face, texture=place * [-1, 1]))
    np.testing.assert_allclose(mirrored, np.broadcast_to(-along, found.shape), atol=1e-5)


def test_a_globe_is_brushed_along_its_circles_of_latitude():
    rows, columns = 33, 65
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    polar, azimuth = np.pi * (1 - v.ravel()), 2 * np.pi * u.ravel()
    position = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    place = np.column_stack([u.ravel(), v.ravel()])
    mesh = make_mesh(position, grid_face(rows=rows, columns=columns), normal=position, texture=place)
    found = texture.dpdu(mesh)
    east = np.column_stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth])
    inside = np.sin(polar) > 0.3
    expected = 2 * np.pi * np.sin(polar)[:, None] * east
    # Faces end where they do: their chords are to one side of a vertex at the seam.
    np.testing.assert_allclose(found[inside], expected[inside], atol=0.06 * 2 * np.pi)
    inner = inside & (u.ravel() > 0) & (u.ravel() < 1)
    np.testing.assert_allclose(found[inner], expected[inner], atol=0.012 * 2 * np.pi)
    tangent = np.asarray(brush(mesh, found).tangent)
    assert np.min(np.sum(tangent * east, 1)[inner]) > 0.999
    assert np.isfinite(tangent).all()


def test_faces_that_cover_nothing_of_the_texture_do_not_count():
    place = np.array([[0.3, 0.4], [0.3, 0.4], [0.3, 0.4], [0.5, 0.4], [0.3, 0.6]])
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]])
    found = texture.dpdu(make_mesh(position, np.array([[0, 1, 2], [2, 3, 4]]), texture=place))
    np.testing.assert_allclose(found, [[0, 0, 0]] * 2 + [[5, 0, 0]] * 3, atol=1e-5)


def test_a_texture_that_is_mirrored_at_shared_vertices_is_brushed_without_a_seam():
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(1, -1, 21))
    position = np.column_stack([x.ravel(), y.ravel(), -0.15 * (x**2 + y**2).ravel()])
    place = np.column_stack([np.abs(y).ravel(), x.ravel()])
    mesh = make_mesh(position, grid_face(rows=21, columns=21), texture=place)
    tangent = np.asarray(brush(mesh, texture.dpdu(mesh)).tangent)
    assert np.min(np.abs(tangent[:, 1])) > 0.93  # Along y, of which the surface's slope takes a little.


def test_a_face_that_squeezes_the_texture_does_not_decide_alone():
    """On the second face u runs along y, a thousand times as far as along x on the first."""
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]])
    place = np.array([[0.0, 0], [1, 0], [0, 1], [1e-3, 1]])
    found = texture.dpdu(make_mesh(position, np.array([[0, 1, 2], [0, 2, 3]]), texture=place))[0]
    assert found[0] > 0.85 * np.linalg.norm(found)  # As far apart from the first as of two equal ones.


@pytest.mark.parametrize(("image", "place"), [((8, 16), (5, 2)), ((8, 16, 3), (5, 3))])
@pytest.mark.usefixtures("unchecked")
def test_lookups_of_other_shapes_are_refused(image, place):
    with pytest.raises(ValueError, match=r"image must be \[h, w, c\] and coordinates \[..., 2\], got \["):
        texture.lookup(jnp.ones(image), jnp.ones(place))


def test_a_mesh_without_texture_coordinates_has_no_dpdu():
    with pytest.raises(ValueError, match="must have texture coordinates, got none"):
        texture.dpdu(builtin.plane(cells=1))


def test_handedness_tells_where_an_image_is_mirrored():
    place = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    square = np.concatenate([place, np.zeros((4, 1))], 1)
    face = grid_face(rows=2, columns=2)[:, ::-1]
    corner = square[[0, 1, 3, 2]]
    for flip, expected in (([1, 1], 1), ([-1, 1], -1), ([-1, -1], 1), ([0, 0], 1)):
        mesh = make_mesh(corner, face, texture=place[[0, 1, 3, 2]] * flip)
        assert float(mesh.normal[0, 2]) == 1
        np.testing.assert_array_equal(texture.handedness(mesh), [expected] * 4)
    with pytest.raises(ValueError, match="must have texture coordinates, got none"):
        texture.handedness(builtin.plane(cells=1))


tilt = jax.jit(texture.tilt_normals)
normal_variance, widen_roughness = jax.jit(texture.normal_variance), jax.jit(texture.widen_roughness)
slope_of_tilted = jax.jit(jax.grad(lambda mean: jnp.sum(texture.tilt_normals(FRAME, ONE, mean, ONE))))


def tilted(mean, *, scale: float = 1.0, handedness: float = 1.0) -> np.ndarray:
    return np.asarray(tilt(FRAME, handedness * ONE, np.float32([mean]), scale * ONE))[0]


def test_texels_become_unit_normals_and_zero_becomes_the_surface():
    normal = np.float32([[[0.3, -0.2, 0.8], [0, 0, 0], [0, 0, -0.4]]])
    unit = 2 * texture.unit_normals((normal + 1) / 2) - 1
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(unit[0, 0], normal[0, 0] / np.linalg.norm(normal[0, 0]), rtol=1e-5)
    np.testing.assert_allclose(unit[0, 1:], [[0, 0, 1], [0, 0, -1]], atol=1e-6)
    gray = np.full((2, 2, 1), 0.3, np.float32)
    assert texture.unit_normals(gray) is gray


def test_the_scale_and_the_handedness_change_slopes():
    np.testing.assert_allclose(tilted([0.6, 0.0, 0.8]), [0.6, 0, 0.8], rtol=1e-6)
    expected = np.float32([0.5 * 0.2, -0.5 * 0.4, 0.6])
    found = tilted([0.2, 0.4, 0.6], scale=0.5, handedness=-1.0)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), rtol=1e-6)


@pytest.mark.parametrize("mean", [[0.5, 0, -0.7], [0, 0, -1], [0, 0, 0], [1e-30, 0, -1e-30]])
def test_normals_below_the_surface_are_raised_above_it(mean):
    normal = tilted(mean)
    np.testing.assert_allclose(np.linalg.norm(normal), 1, rtol=1e-5)
    assert normal[2] > 0.09
    slope = slope_of_tilted(np.float32([mean]))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("concentration", [8.0, 400.0])
def test_the_length_of_a_mean_tells_the_variance_of_its_normals(concentration):
    samples = stats.vonmises_fisher(UP[0], concentration, seed=1).rvs(200_000)
    mean = samples.mean(0, keepdims=True).astype(np.float32)
    variance = float(normal_variance(mean, ONE, 3 * ONE)[0])
    np.testing.assert_allclose(variance, 1 / concentration, rtol=0.05)
    # A rough surface of such normals is as rough as samples of both slopes together, for narrow distributions.
    if concentration > 100:
        random = np.random.default_rng(2)
        alpha = 0.2**2  # of Beckmann's distribution: slopes have the variance alpha^2 / 2 along each axis
        slope = samples[:, :2] / samples[:, 2:] + random.normal(0, alpha / 2**0.5, (len(samples), 2))
        rough = float(widen_roughness(np.float32([0.2]), np.float32([variance]))[0])
        np.testing.assert_allclose(rough**4, 2 * np.var(slope), rtol=0.02)


def test_magnified_texels_and_equal_normals_add_no_roughness():
    mean = np.float32([[0.3, 0, 0.8], [0.6, 0, 0.8]])
    variance = np.asarray(normal_variance(mean, np.ones(2, np.float32), np.float32([0.0, 5.0])))
    np.testing.assert_allclose(variance, 0, atol=1e-6)
    rough = np.float32([0.0, 0.5])
    none = np.zeros(2, np.float32)
    np.testing.assert_array_equal(widen_roughness(rough, none), rough)
    slope = jax.jit(jax.grad(lambda each: jnp.sum(texture.widen_roughness(each, none))))(rough)
    np.testing.assert_array_equal(slope, 1)
