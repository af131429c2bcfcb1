import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.image import tonemap


def test_a_stop_doubles_the_radiance():
    radiance = jnp.asarray([[0.0, 0.25, 3.0]])
    np.testing.assert_allclose(tonemap.expose(radiance, stops=1.0), 2 * radiance, rtol=1e-6)
    np.testing.assert_allclose(tonemap.expose(radiance, stops=-2.0), radiance / 4, rtol=1e-6)


@pytest.mark.usefixtures("unchecked")
def test_pictures_of_integers_are_exposed_by_parts_of_stops():
    np.testing.assert_allclose(tonemap.expose(jnp.array([1, 2]), stops=0.5), np.sqrt(2) * np.array([1, 2]), rtol=1e-6)
    image = jnp.arange(1, 61).reshape(4, 5, 3)
    assert tonemap.automatic_exposure(image) == tonemap.automatic_exposure(image.astype(jnp.float32))


def test_srgb_equals_the_published_values():
    # IEC 61966-2-1: the end of the linear part, middle gray (encoded 0.5 is linear 0.21404114), white.
    linear = jnp.asarray([0.0, 0.0031308, 0.21404114, 1.0])
    np.testing.assert_allclose(tonemap.encode_srgb(linear), [0, 0.0404499, 0.5, 1], atol=1e-5)


def test_decoding_undoes_encoding_also_outside_the_display_range():
    linear = jnp.concatenate([jnp.linspace(-0.5, 4, 1001), jnp.asarray([1e-7, 0.0031, 0.0032])])
    np.testing.assert_allclose(tonemap.decode_srgb(tonemap.encode_srgb(linear)), linear, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("function", [tonemap.encode_srgb, tonemap.decode_srgb])
def test_the_srgb_gradient_is_finite_everywhere(function):
    at = jnp.asarray([-1.0, 0.0, 1e-30, 0.0031308, 0.04045, 0.5, 1.0, 100.0])
    slope = jax.vmap(jax.grad(function))(at)
    assert np.all(np.isfinite(slope))
    assert np.all(slope > 0)
    high, low = function(at + 1e-2), function(at - 1e-2)
    np.testing.assert_allclose(slope[5:7], ((high - low) / 2e-2)[5:7], rtol=2e-3)


def test_automatic_exposure_brings_the_percentile_of_lit_pixels_to_white():
    image = np.zeros((20, 30, 3), np.float32)
    image[:10] = np.random.default_rng(0).exponential(7.0, (10, 30, 1))
    image = jnp.asarray(image)
    shown = tonemap.expose(image, stops=tonemap.automatic_exposure(image, percentile=95.0, white=0.8))
    assert np.percentile(np.asarray(shown)[:10, :, 0], 95) == pytest.approx(0.8, rel=1e-4)


def test_automatic_exposure_of_black_is_zero_stops():
    assert tonemap.automatic_exposure(jnp.zeros((4, 5, 3))) == 0
    assert tonemap.automatic_exposure(-jnp.ones((4, 5, 3))) == 0


def test_automatic_exposure_with_coverage_is_of_the_surfaces_alone():
    image = np.full((6, 8, 3), 50.0, np.float32)  # a bright window
    coverage = np.zeros((6, 8), np.float32)
    image[2:4, 2:6], coverage[2:4, 2:6] = 0.3, 1
    image[1, 2:6], coverage[1, 2:6] = 25, 0.5  # edges, which show the window too
    stops = tonemap.automatic_exposure(jnp.asarray(image), coverage=jnp.asarray(coverage), white=0.9)
    assert float(stops) == pytest.approx(np.log2(0.9 / 0.3), rel=1e-5)
    # A picture without surfaces is exposed as a whole.
    nothing = tonemap.automatic_exposure(jnp.asarray(image), coverage=jnp.zeros((6, 8)))
    assert nothing == tonemap.automatic_exposure(jnp.asarray(image))


@pytest.mark.usefixtures("unchecked")
def test_coverage_of_another_size_is_refused():
    image = jnp.ones((6, 8, 3))
    with pytest.raises(ValueError, match=r"coverage must be \[6, 8\] as the image is, got \[8, 6\]"):
        tonemap.automatic_exposure(image, coverage=jnp.zeros((8, 6)))


# Linear Rec. 709 from black to far above white, saturated colors and grays.
COLORS = np.array(
    [[0, 0, 0], [0.18, 0.18, 0.18], [1, 1, 1], [4, 4, 4], [0.9, 0.1, 0.05], [0, 0, 3], [0.02, 0.5, 0.01], [30, 8, 1]]
)


def three_aces(color):
    """ACESFilmicToneMapping of three.js r170, tonemapping_pars_fragment.glsl, by hand: columns of its matrices."""
    first = np.array([[0.59719, 0.07600, 0.02840], [0.35458, 0.90834, 0.13383], [0.04823, 0.01566, 0.83777]])
    last = np.array([[1.60475, -0.10208, -0.00327], [-0.53108, 1.10813, -0.07276], [-0.07367, -0.00605, 1.07602]])
    v = (np.asarray(color) / 0.6) @ first
    return np.clip(((v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)) @ last, 0, 1)


def three_agx(color):
    """AgXToneMapping of three.js r170, by hand, with the older rounded matrix from Rec. 709 and the outset of r162."""
    into = np.array([[0.6274, 0.0691, 0.0164], [0.3293, 0.9195, 0.0880], [0.0433, 0.0113, 0.8956]])
    back = np.array([[1.6605, -0.1246, -0.0182], [-0.5876, 1.1329, -0.1006], [-0.0728, -0.0083, 1.1187]])
    inset = np.array(
        [
            [0.856627153315983, 0.137318972929847, 0.11189821299995],
            [0.0951212405381588, 0.761241990602591, 0.0767994186031903],
            [0.0482516061458583, 0.101439036467562, 0.811302368396859],
        ]
    )
    outset = np.array(
        [
            [1.1271005818144368, -0.1413297634984383, -0.14132976349843826],
            [-0.11060664309660323, 1.157823702216272, -0.11060664309660294],
            [-0.016493938717834573, -0.016493938717834257, 1.2519364065950405],
        ]
    )
    v = np.log2(np.maximum(np.maximum(np.asarray(color) @ into, 0) @ inset, 1e-10))
    x = np.clip((v + 12.47393) / (4.026069 + 12.47393), 0, 1)
    curve = 15.5 * x**6 - 40.14 * x**5 + 31.96 * x**4 - 6.868 * x**3 + 0.4298 * x**2 + 0.1191 * x - 0.00232
    return np.clip(np.maximum(curve @ outset, 0) ** 2.2 @ back, 0, 1)


def hable(color):
    """Hable, Filmic Tonemapping Operators, 2010: A, B, C, D, E, F, W as printed there."""
    a, b, c, d, e, f, white = 0.15, 0.50, 0.10, 0.20, 0.02, 0.30, 11.2
    curve = lambda x: (x * (a * x + c * b) + d * e) / (x * (a * x + b) + d * f) - e / f  # noqa: E731
    return np.clip(curve(2 * np.asarray(color)) / curve(white), 0, 1)


def three_neutral(color):
    """NeutralToneMapping of three.js r187, by hand for one color at a time."""

    def curve(color):
        least = min(color)
        color = color - (least - 6.25 * least * least if least < 0.08 else 0.04)
        peak, start, distance = max(color), 0.8 - 0.04, 1 - (0.8 - 0.04)
        if peak < start:
            return color
        new = 1 - distance * distance / (peak + distance - start)
        pale = 1 - 1 / (0.15 * (peak - new) + 1)
        return color * (new / peak) * (1 - pale) + new * pale

    return np.array([curve(row) for row in np.asarray(color, float)])


PUBLISHED = {
    "srgb": lambda color: np.clip(color, 0, 1),
    "filmic": hable,
    "agx": three_agx,
    "aces": three_aces,
    "neutral": three_neutral,
}
# Matrices of AgX are printed with four digits there and inverted here.
TONE_BOUND = {"srgb": 1e-6, "filmic": 1e-5, "agx": 1e-3, "aces": 1e-5, "neutral": 1e-5}


@pytest.mark.parametrize("tone", tonemap.TONES)
def test_tones_are_the_published_curves(tone):
    shown = tonemap.display(jnp.asarray(COLORS / 4, jnp.float32), tone=tone, stops=2.0)
    np.testing.assert_allclose(tonemap.decode_srgb(shown), PUBLISHED[tone](COLORS), atol=TONE_BOUND[tone], err_msg=tone)
    by_numpy = tonemap.apply_curve(COLORS, tone, np)
    np.testing.assert_allclose(by_numpy, PUBLISHED[tone](COLORS), atol=TONE_BOUND[tone])


@pytest.mark.parametrize("tone", tonemap.TONES)
def test_tones_map_anything_to_the_display_and_gray_to_increasing_gray(tone):
    gray = np.concatenate([[-1.0, 0], np.geomspace(1e-6, 1e6, 200), [np.inf]])
    shown = tonemap.apply_curve(np.repeat(gray[:, None], 3, 1), tone, np)
    assert shown.min() >= 0
    assert shown.max() <= 1
    np.testing.assert_allclose(shown - shown[:, :1], 0, atol=2e-3)  # rounded matrices
    assert np.all(np.diff(shown, axis=0) >= -1e-9)
    slope = jax.grad(lambda color: jnp.sum(tonemap.display(color, tone=tone)))(jnp.asarray(COLORS, jnp.float32))
    assert np.all(np.isfinite(slope))


def test_tones_are_refused_by_name_and_without_three_colors():
    with pytest.raises(ValueError, match="tone must be one of srgb, filmic, agx, aces, neutral, got 'reinhard'"):
        tonemap.display(jnp.ones((2, 3)), tone="reinhard")
    for tone in ("agx", "neutral"):
        with pytest.raises(ValueError, match=rf"must have three colors for the tone '{tone}', got \[4, 4, 1\]"):
            tonemap.display(jnp.ones((4, 4, 1)), tone=tone)
