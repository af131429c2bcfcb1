"""Lightmaps: where texels lie on a part, and images of what they receive."""

from typing import Any

import numpy as np
import OpenImageIO
import pytest

import jaxprt as prt
from jaxprt import sensors
from jaxprt.brdf import Lambert
from jaxprt.scene import Part, Scene, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.view.gltf import write_lightmap

PLACE = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], float)
UV = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
FACE = np.array([[0, 1, 2], [0, 2, 3]])


def floor(uv=UV, place=PLACE, face=FACE):
    return Part("floor", make_mesh(place, face, texture=uv), Lambert([0.5] * 3))


def test_texels_lie_where_the_coordinates_put_them():
    result = sensors.lightmap(floor(), size=20)
    assert len(result.texel) == 16 * 16
    first = result.position[np.all(result.texel == [2, 2], 1)][0]  # at the top left: u is .125, and v .875
    np.testing.assert_allclose(first, [-0.9375, 0, -0.9375], atol=1e-5)
    np.testing.assert_allclose(result.normal, np.broadcast_to([0, 1, 0], result.normal.shape), atol=1e-6)


def test_texels_beside_charts_take_the_nearest_value():
    result = sensors.lightmap(floor(), size=20)
    image = result.image(result.position)
    np.testing.assert_array_equal(image[0, 0], image[2, 2])
    np.testing.assert_array_equal(image[10, 19], image[10, 17])


def test_a_lightmap_has_the_shadow_and_is_read_back(tmp_path):
    part, ball = floor(), Part("ball", builtin.sphere(rings=24, sectors=48), Lambert([0.5] * 3))
    ball = Part(
        "ball",
        make_mesh(0.3 * np.asarray(ball.mesh.position, float) + [0, 0.5, 0], np.asarray(ball.mesh.face)),
        ball.material,
    )
    result = sensors.lightmap(part, size=24)
    basis = sensors.Harmonics(2)
    transport = sensors.transport(
        Scene([part, ball]), result.position, result.normal, basis=basis, size=16, progress=False
    )
    result.write(tmp_path / "map.exr", transport)
    spec = OpenImageIO.ImageBuf(str(tmp_path / "map.exr")).spec()
    assert (spec.width, spec.height, spec.nchannels) == (24, 24, 9)
    uniform = np.zeros(9, np.float32)
    uniform[0] = 2 * np.sqrt(np.pi) / np.pi
    image = result.image(transport.apply(uniform))
    assert image[12, 12] < 0.75 < 0.95 < image[2, 2]
    write_lightmap(tmp_path / "map.glb", part, 0.5 * image[..., None].repeat(3, -1))
    shown: Any = prt.load_scene(tmp_path / "map.glb").parts[0].material
    assert shown.emissive_texture is not None
    np.testing.assert_allclose(shown.emissive, 1)


@pytest.mark.parametrize(
    ("uv", "message"),
    [
        (None, "the part 'floor' must have texture coordinates, got none"),
        (2 * UV, "texture coordinates must be from 0 to 1, got 0.2 to 1.8"),
    ],
)
def test_coordinates_that_cannot_be_used_are_refused(uv, message):
    with pytest.raises(ValueError, match=message):
        sensors.lightmap(floor(uv), size=8)


def test_triangles_that_overlap_are_refused():
    twice = floor(
        np.concatenate([UV, UV]), np.concatenate([PLACE, PLACE + [0, 1, 0]]), np.concatenate([FACE, FACE + 4])
    )
    with pytest.raises(ValueError, match="triangles must not overlap in the texture"):
        sensors.lightmap(twice, size=16)
