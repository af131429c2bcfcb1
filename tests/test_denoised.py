"""The judge of pictures is judged: its light, its noise, its store, its denoiser, and times at equal error."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import cubemap_light, denoised, path_tracing
from jaxprt.brdf import Lambert
from jaxprt.scene import Camera, Environment, builtin
from jaxprt.scene.mesh import ground_plane
from jaxprt.sphere import cubemap

SIZE = 8
traced = pytest.mark.skipif(not path_tracing.available(), reason="drjit finds no LLVM of version 17 or newer")


@pytest.fixture(scope="module")
def light():
    """Texels of unlike colors, some black, one a thousand times as bright as the others."""
    radiance = np.random.default_rng(0).random((6, SIZE, SIZE, 3), np.float32)
    radiance[np.random.default_rng(1).random((6, SIZE, SIZE)) < 0.3] = 0
    radiance[2, 3, 5] = 1000, 500, 100
    return Environment(jnp.asarray(radiance))


@pytest.fixture(scope="module")
def camera():
    return Camera([0.0, 2.5, 6.0], [0, 0, 0], [0, 1, 0], 0.5, 16, 12)


@pytest.fixture
def emitter(light):
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba, drjit, cubemap_light.emitter(light, reach=10.0)


@traced
def test_light_is_constant_over_texels(emitter, light):
    mitsuba, drjit, made = emitter
    fine = np.asarray(cubemap.direction(size=4 * SIZE)).reshape(-1, 3)
    seen = drjit.zeros(mitsuba.SurfaceInteraction3f, len(fine))
    seen.wi = mitsuba.Vector3f(-fine.T)
    found = np.array(made.eval(seen)).T.reshape(6, SIZE, 4, SIZE, 4, 3)
    np.testing.assert_array_equal(found, np.broadcast_to(light.radiance[:, :, None, :, None], found.shape))


@traced
def test_samples_of_the_light_follow_their_density_and_weigh_its_flux(emitter, light):
    mitsuba, drjit, made = emitter
    count = 1 << 18
    random = np.random.default_rng(0).random((2, count), np.float32)
    drawn, weight = made.sample_direction(drjit.zeros(mitsuba.Interaction3f, count), mitsuba.Point2f(random))
    direction, weight = np.array(drawn.d).T, np.array(weight).T
    face, place = (np.asarray(each) for each in cubemap.coordinates(jnp.asarray(direction)))
    column, row = np.moveaxis(np.clip(((place + 1) * SIZE / 2).astype(int), 0, SIZE - 1), -1, 0)
    area = np.asarray(cubemap.solid_angle(size=SIZE))
    flux = np.asarray(light.radiance) * area[..., None]
    found = np.zeros((6, SIZE, SIZE, 3))
    np.add.at(found, (face, row, column), weight / count)
    # The bright texel has most of the samples.
    np.testing.assert_allclose(found[2, 3, 5], flux[2, 3, 5], rtol=2e-3)
    np.testing.assert_allclose(found.sum((0, 1, 2)), flux.sum((0, 1, 2)), rtol=4e-3)
    # Each texel's share is lit evenly: the mean of directions is that of the closed form.
    mean = np.einsum("fijc,fija->ca", light.radiance, cubemap.vector_area(size=SIZE))
    assert np.all(np.linalg.norm(weight.T @ direction / count - mean, axis=1) < 0.02 * np.linalg.norm(mean, axis=1))
    np.testing.assert_allclose(np.mean(1 / np.array(drawn.pdf)), 4 * np.pi, rtol=0.1)


@traced
def test_convex_white_body_has_the_radiance_of_its_white_light(camera):
    white = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    view = denoised.View([(builtin.sphere(rings=24, sectors=32), Lambert(1.0))], white, camera)
    found = view.radiance(256, 1)
    inside = found[..., 3] > 0.999
    assert 20 < inside.sum() < 150
    np.testing.assert_allclose(found[inside][:, :3].mean(), 1, rtol=0.01)


@traced
def test_no_light_reaches_the_inside_of_a_closed_body(light, camera):
    # Shadow rays must be longer than the scene.
    ball, shell = builtin.sphere(rings=12, sectors=16), builtin.sphere(rings=12, sectors=16)
    shell = shell.__class__(50 * shell.position, shell.face, shell.normal, shell.tangent, shell.region)
    view = denoised.View([(ball, Lambert(1.0)), (shell, Lambert(1.0))], light, camera)
    assert not view.radiance(64, 1)[..., :3].any()
    alone = denoised.View([(ball, Lambert(1.0))], light, camera)
    assert alone.radiance(64, 1)[..., :3].any()


@traced
def test_denoiser_removes_most_of_the_noise_and_keeps_brightness_and_edges(light, camera):
    ball = builtin.sphere(rings=24, sectors=32)
    parts = [(ball, Lambert([0.8, 0.2, 0.1])), (ground_plane(ball, vertices=100), Lambert([0.1, 0.6, 0.3]))]
    view = denoised.View(parts, light, Camera(camera.eye, camera.target, camera.up, camera.field_of_view, 48, 48))
    truth = denoised.converged(view, noise=0.02, most=2048, block=256)
    noisy, features = view.radiance(4, 1), view.features(1)
    np.testing.assert_allclose(features[0][24, [24, 2]], [[0.8, 0.2, 0.1], [0.1, 0.6, 0.3]], rtol=1e-5)
    for clean in (False, True):
        smooth = denoised.denoise(noisy, *features, clean=clean)
        assert truth.error(smooth) < 0.6 * truth.error(noisy)
        assert abs(truth.bias(smooth)) < 0.1
        assert truth.flip(smooth) < truth.flip(noisy)


class Fake:
    """A view whose pictures are planted: constant radiance with noise on some pixels, and a background."""

    def __init__(self, key="a"):
        self.key, self.calls = key, []

    def radiance(self, samples, seed):
        self.calls.append(seed)
        noise = np.random.default_rng(seed).normal(0, 1 / samples**0.5, (64, 64, 3))
        result = np.concatenate([2 + noise, np.ones((64, 64, 1))], -1)
        result[:8] = 0
        return result


def test_noise_of_the_truth_is_told_and_falls_out_of_errors():
    truth = denoised.converged(Fake(), noise=0.0, most=8, block=2)
    # Eight samples of variance 1 over a mean of 2.
    assert truth.samples == 8
    assert truth.noise == pytest.approx(8**-0.5 / 2, rel=0.05)
    assert truth.inside.sum() == 56 * 64
    exact = np.full((64, 64, 3), 2.0)
    assert truth.error(exact) < 0.04
    assert truth.error(1.1 * exact) == pytest.approx(0.1, rel=0.1)
    assert truth.bias(1.1 * exact) == pytest.approx(0.1, rel=0.1)
    exact[:8] = 100  # not compared
    assert truth.error(exact) < 0.04


def test_converging_stops_at_the_noise_that_is_asked_for_and_goes_on_from_its_file(tmp_path):
    path, view = tmp_path / "folder" / "truth.npz", Fake()
    first = denoised.converged(view, noise=0.13, most=64, block=2, path=path)
    assert first.noise <= 0.13
    assert 12 <= first.samples <= 20
    count = len(view.calls)
    again = denoised.converged(view, noise=0.13, most=64, block=2, path=path)
    assert len(view.calls) == count
    np.testing.assert_allclose(again.mean, first.mean, rtol=1e-6)
    more = denoised.converged(view, noise=0.09, most=64, block=2, path=path)
    assert more.noise <= 0.09
    assert len(view.calls) == more.samples // 2  # none was traced again
    assert len(set(view.calls)) == len(view.calls)
    other = Fake("b")
    denoised.converged(other, noise=0.13, most=64, block=2, path=path)
    assert other.calls


def test_truth_without_surfaces_is_refused():
    with pytest.raises(ValueError, match="must see surfaces"):
        denoised.Truth(np.zeros((2, 4, 4, 4)), 2)


def test_seconds_at_an_error_follow_a_power_law_past_both_points():
    law = [(t, 0.3 * t**-0.4) for t in (16.0, 1.0, 4.0)]
    for seconds, how in ((2.7, "interpolated"), (16.0, "interpolated"), (100.0, "extrapolated")):
        found = denoised.seconds_at(0.3 * seconds**-0.4, law)
        assert found[0] == pytest.approx(seconds)
        assert found[1] == how


def test_seconds_at_an_error_are_the_least_where_any_picture_will_do():
    assert denoised.seconds_at(0.5, [(1.0, 0.3), (4.0, 0.1)]) == (1.0, "cheapest")


def test_slower_and_worse_pictures_do_not_count():
    good = [(1.0, 0.3), (4.0, 0.1)]
    bad = [(1.5, 0.4), (4.0, 0.2), (20.0, 0.1)]
    assert denoised.front(good + bad) == good
    for error in (0.2, 0.05):
        assert denoised.seconds_at(error, bad + good) == denoised.seconds_at(error, good)


def test_a_single_picture_is_extrapolated_as_monte_carlo_converges():
    assert denoised.seconds_at(0.1, [(2.0, 0.3)]) == (pytest.approx(18.0), "extrapolated")
