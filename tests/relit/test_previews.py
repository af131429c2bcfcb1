"""Previews of `jaxprt.precompute`: scenes of less quality that come before the result and leave it alone."""

import jax
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.relit import build
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.visibility import Run, rays

SIZE, COARSE = 8, 4


@pytest.fixture(scope="module")
def scene():
    """A matte ball over a plane of two triangles."""
    matte = TexturedMaterial(base_color=0.5, metallic=0.0, specular=0.0)
    corner = np.array([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3]], float)
    ground = prt.scene.mesh.make_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]))
    return Scene([Part("ball", builtin.sphere(rings=8, sectors=16), matte), Part("ground", ground, matte)])


@pytest.fixture
def fewer(monkeypatch):
    monkeypatch.setattr(build, "_COARSE", COARSE)


def precompute(scene, **options):
    options = {"progress": False, "size": SIZE, "system": "lobe", "refine": 0.1, "vertices": 200} | options
    return prt.precompute(scene, **options)


def assert_equal(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    assert all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


@pytest.mark.filterwarnings("ignore:.*vertices leave an error")
def test_previews_go_from_few_rays_to_all_and_the_result_is_that_without_them_bit_for_bit(scene, fewer):
    previews, white = [], Environment(np.ones((6, SIZE, SIZE, 3)))
    result = precompute(scene, bounces=1, preview=previews.append)
    first, divided, direct = previews
    assert first.mesh.position.shape == scene.mesh.position.shape
    assert divided.mesh.position.shape == direct.mesh.position.shape == result.mesh.position.shape
    assert len(result.mesh.position) > len(first.mesh.position)
    plain = precompute(scene, bounces=1)
    assert_equal(result, plain)
    assert_equal(direct, plain.without_bounces())
    assert not any(preview.bounces for preview in previews)
    # The plane hides the lower half of the white sky from the ball: below it is dark, and without shadows it is not.
    color, height = np.asarray(first.radiance(white, eye=first.camera.eye))[:, 0], np.asarray(first.mesh.position)[:, 1]
    ball = np.asarray(first.mesh.region) == 0
    assert color[ball & (height > 0.9)].min() > 0.45
    assert color[ball & (height < -0.9)].max() < 0.3
    exact = np.asarray(direct.radiance(white, eye=first.camera.eye))[direct.file_vertex]
    assert prt.image.relative_l2(np.asarray(first.radiance(white, eye=first.camera.eye)), exact) < 0.2


def test_stored_work_has_no_coarse_preview(scene, fewer, tmp_path):
    previews = []
    precompute(scene, refine=False, path=tmp_path / "store", preview=previews.append)
    assert len(previews) == 1
    precompute(scene, refine=False, path=tmp_path / "store", preview=previews.append)
    assert len(previews) == 1


def test_progress_is_told_by_name_and_an_error_ends_the_work(scene):
    told = []
    precompute(scene, refine=False, progress=lambda label, share: told.append((label, share)))
    assert {label for label, _ in told} == {"visibility"}
    shares = [share for _, share in told]
    assert (min(shares), max(shares)) == (0.0, 1.0)

    def stop(label, share):
        raise InterruptedError(label)

    with pytest.raises(InterruptedError, match="visibility"):
        precompute(scene, refine=False, progress=stop)


def test_few_rays_give_every_texel_the_visibility_of_the_larger_one_that_contains_it(scene):
    mesh = scene.mesh
    fine, coarse = (
        prt.visibility.precompute(mesh, size=SIZE, run=Run(progress=False, texels=texels)).seen(np.arange(32))
        for texels in (None, COARSE)
    )
    step, normal = SIZE // COARSE, np.asarray(mesh.normal)[:32]
    tiles = coarse.reshape(32, 6, COARSE, step, COARSE, step)
    above = (normal @ rays._tables(SIZE).area.T > 0).reshape(tiles.shape)
    largest = tiles.max((3, 5), keepdims=True)
    np.testing.assert_array_equal(tiles, np.where(above, largest, 0))
    assert np.abs(fine.astype(float) - coarse).mean() < 0.15 * rays.LEVELS


def test_few_rays_are_not_stored(tmp_path):
    with pytest.raises(ValueError, match="texels must be None with a path, which stores whole results, got 4"):
        Run(tmp_path, texels=4)
    with pytest.raises(ValueError, match="texels must be at least 1, got 0"):
        Run(texels=0)
