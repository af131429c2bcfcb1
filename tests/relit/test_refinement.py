import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf.varying import PerVertex
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.scene.builtin import assemble, patch
from jaxprt.scene.mesh import make_mesh


def square(low, high, height):
    return assemble(
        [patch([[[low, height, -1], [high, height, -1]], [[low, height, 1], [high, height, 1]]], rows=1, columns=1)]
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A ground of two parts, the first with colors, and a lid above the border between them."""
    left = square(-1, 0, 0)
    red = Part("left", left, TexturedMaterial(), color=1 + left.position)
    parts = [
        red,
        Part("right", square(0, 1, 0), prt.brdf.Lambert(0.5)),
        Part("lid", square(-0.3, 0.3, 0.3), prt.brdf.Lambert(0.2)),
    ]
    camera = prt.Camera([0, 3, 0.1], [0, 0, 0], [0, 0, -1], 0.6, 16, 16)
    return Scene(parts, [camera])


@pytest.fixture(scope="module")
def light() -> prt.Environment:
    return prt.scene.builtin.daylight(size=8)


def test_parts_cast_shadows_on_each_other_and_are_divided_alike_at_their_border(scene, light, close):
    fine = prt.refine(scene, error=0.05, vertices=2000, environments=[light], progress=False)
    assert [part.name for part in fine.parts] == ["left", "right", "lid"]
    assert [part.material for part in fine.parts] == [part.material for part in scene.parts]
    assert fine.cameras == scene.cameras
    counts = [len(part.mesh.position) for part in fine.parts]
    assert min(counts[:2]) > 10
    assert sum(counts) < 2000
    border = [np.asarray(fine[name].mesh.position) for name in ("left", "right")]
    border = [set(map(tuple, each[each[:, 0] == 0])) for each in border]
    assert border[0] == border[1]
    assert len(border[0]) > 4
    close(np.asarray(fine["left"].color), 1 + np.asarray(fine["left"].mesh.position))


def test_what_is_no_scene_is_refused(scene, light, unchecked):
    with pytest.raises(TypeError, match="the scene must be of class Scene"):
        prt.refine(scene.mesh)
    with pytest.raises(TypeError, match="environments must be a list of lights, got one Environment"):
        prt.refine(scene, environments=light)
    varying = Part(
        "varying", make_mesh(np.eye(3), np.array([[0, 1, 2]])), PerVertex(prt.brdf.Lambert(jnp.full((3,), 0.5)))
    )
    with pytest.raises(TypeError, match="part 'varying' must be one BRDF for all vertices"):
        prt.refine(Scene([varying]), error=1.0, progress=False)


def test_precompute_divides_stores_the_division_and_says_which_vertices_are_the_files(scene, tmp_path):
    options = {"system": prt.relit.Harmonics(degree=1), "size": 8, "path": tmp_path / "kept", "progress": False}
    relit = prt.precompute(scene, refine=0.05, **options)
    assert len(relit.mesh.position) > len(scene.mesh.position) + 10
    np.testing.assert_array_equal(np.asarray(relit.mesh.position)[relit.file_vertex], scene.mesh.position)
    np.testing.assert_array_equal(np.asarray(relit.mesh.region)[relit.file_vertex], scene.mesh.region)
    again = prt.precompute(scene, refine=0.05, **options)
    np.testing.assert_array_equal(again.mesh.face, relit.mesh.face)
    with pytest.raises(ValueError, match="divides another scene, or for other cameras"):
        prt.precompute(scene, refine=0.04, **options)
    # Weights at the vertices of the file are interpolated like its colors.
    blend = relit.appearances({"left": scene["left"].material})["left"].blend
    count = len(scene["left"].mesh.position)
    of_file = type(blend)(blend.weight[:count], tuple(row[:count] for row in blend.parameter))
    light = prt.scene.builtin.daylight(size=8)
    color = relit.radiance(light, eye=relit.camera.eye, materials={"left": of_file})
    np.testing.assert_allclose(color, relit.radiance(light, eye=relit.camera.eye), rtol=1e-4, atol=1e-6)


def test_meshes_stay_as_they_are_on_demand_and_where_nothing_is_gained(scene):
    recipe = prt.relit.Harmonics(degree=1)
    kept = prt.precompute(scene, refine=False, system=recipe, size=8, progress=False)
    assert len(kept.mesh.position) == len(scene.mesh.position)
    np.testing.assert_array_equal(kept.file_vertex, np.arange(len(scene.mesh.position)))
    for wrong, error in (("fine", TypeError), (-0.1, ValueError), (float("nan"), ValueError)):
        with pytest.raises(error, match="refine"):
            prt.precompute(scene, refine=wrong, system=recipe, size=8, progress=False)


def test_a_limit_of_vertices_is_told(scene):
    with pytest.warns(UserWarning, match="at most 40 vertices were allowed"):
        relit = prt.precompute(
            scene, refine=0.001, vertices=40, system=prt.relit.Harmonics(degree=1), size=8, progress=False
        )
    assert len(scene.mesh.position) < len(relit.mesh.position) <= 40
