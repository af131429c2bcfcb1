"""Transfer tensors: what is decomposed is what arrives, after one bounce and two."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.brdf.models import CookTorrance
from jaxprt.brdf.varying import Channels
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.sphere import cubemap, directions, haar, harmonics
from jaxprt.systems.bounces.tensor import LitTransfer
from jaxprt.visibility import Run

# Edges of cubemap faces: EDGE divides the light, SIZE the rays between surfaces, SEEN the visibility of the light.
EDGE, SIZE, SEEN = 4, 8, 16
BLOCK = 512
ALL = 10**6
FEW = {"components": 8, "modes": 8, "edge": 2, "size": SIZE}


@pytest.fixture(scope="module")
def mesh():
    ball = builtin.sphere(rings=5, sectors=6)
    return join([ball, ground_plane(ball, vertices=25)])


@pytest.fixture(scope="module")
def brdfs():
    """Colors that need two functions, and one."""
    shiny = AshikhminShirley(diffuse=[0.5, 0.2, 0.4], specular=0.5, nu=6, nv=6)
    glossy = separable.factor(shiny, terms=4, resolution=16)
    return [glossy, separable.factor(Lambert([0.9, 0.3, 0.1]), terms=1, resolution=8)]


@pytest.fixture(scope="module")
def whole(mesh, brdfs):
    """Nothing left out but by half precision."""
    return bounces.precompute(mesh, brdfs, components=ALL, modes=ALL, edge=EDGE, size=SIZE)


def light(seed, edge=EDGE):
    """Random texels, constant over the texels of two bounces."""
    value = np.random.default_rng(seed).uniform(size=(6, 2, 1, 2, 1, 3)).astype(np.float32)
    whole = np.broadcast_to(value, (6, 2, edge // 2, 2, edge // 2, 3)).reshape(6, edge, edge, 3)
    return Environment(jax.device_put(whole))


def arriving(tensor, environment, weight=None):
    """SH coefficients of one bounce and of two, [v s c]."""
    lit = bounces.tensor.light_side(tensor, environment)
    if weight is None:
        rows = [np.broadcast_to(each, (len(each), 3)) for each in tensor.factor]
        weight = jnp.asarray(np.concatenate(rows)[np.asarray(tensor.function)])
    both, one = (np.asarray(bounces.tensor.collect(tensor, x, weight)) for x in (lit, LitTransfer(lit.first, None)))
    return one.transpose(2, 0, 1), (both - one).transpose(2, 0, 1)


def relative(value, exact):
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def test_two_bounces_are_a_loop_over_rays_of_rays(mesh, brdfs, whole):
    """From one texel, by glossy and diffuse surfaces, without harmonics between: these leave some percent."""
    seen = visibility.precompute(mesh, size=SEEN).seen(np.arange(len(mesh.position)))
    frame = np.asarray(directions.frame(mesh.normal, mesh.tangent))
    occluder = visibility.Occluder(mesh)
    start, normal, region = visibility.start_points(mesh, occluder), np.asarray(mesh.normal), np.asarray(mesh.region)
    way = np.asarray(cubemap.direction(size=SIZE)).reshape(-1, 3)
    point, through, corner, barycentric, _ = visibility.rays.hemisphere_hits(occluder, start, normal, size=SIZE)
    front = visibility.rays.hits_front(occluder, normal, corner, way[through])
    point, through, corner, barycentric = (each[front] for each in (point, through, corner, barycentric))
    wo = np.einsum("hkij,hj->hki", frame[corner], -way[through])
    wo[..., 2] = np.maximum(wo[..., 2], 1e-3)
    wo /= np.linalg.norm(wo, axis=-1, keepdims=True)
    values = [jax.jit(jax.vmap(lambda wi, wo, brdf=brdf: brdf(wi, jnp.broadcast_to(wo, wi.shape)))) for brdf in brdfs]

    def gather(radiance, size):
        """Radiance [v d c] that arrives after one more reflection of radiance by texels, those with any alone."""
        into, area = (np.asarray(x(size=size)).reshape(-1, 3) for x in (cubemap.direction, cubemap.vector_area))
        met = radiance * np.maximum(normal @ area.T, 0)[..., None]
        lit = np.argsort(~met.any(-1), axis=1, kind="stable")[:, : met.any(-1).sum(1).max()]
        met = np.take_along_axis(met, lit[..., None], 1)
        wi = np.einsum("vij,vdj->vdi", frame, into[lit])
        sent = np.zeros((*corner.shape, 3))
        for number, value in enumerate(values):
            own = np.argwhere(region[corner] == number)
            for first in range(0, len(own), BLOCK):
                h, k = own[np.arange(first, first + BLOCK) % len(own)].T  # Blocks of one shape; some come twice.
                v = corner[h, k]
                factor = np.asarray(value(wi[v].astype(np.float32), wo[h, k].astype(np.float32)))
                sent[h, k] = np.einsum("hdc,hdc->hc", factor, met[v])
        result = np.zeros((len(start), len(way), 3))
        result[point, through] = np.einsum("hk,hkc->hc", barycentric, sent)
        return result

    texel, fold = 6, SEEN // 2  # Of 24, from the side of +y.
    lamp = np.zeros((6, 2, 1, 2, 1), np.float32)
    lamp.reshape(-1)[texel] = 1
    lamp = np.broadcast_to(lamp, (6, 2, fold, 2, fold)).reshape(6, SEEN, SEEN, 1)
    lamp = Environment(jax.device_put(lamp))
    held = np.asarray(cubemap.coarse(lamp.radiance, edge=2)).reshape(6, 2, 1, 2, 1)
    shone = np.broadcast_to(held, (6, 2, fold, 2, fold)).reshape(-1)  # The lamp and some of what is around it.
    once = gather(shone[:, None] * np.asarray(seen)[..., None] / 16 * np.ones(3), SEEN)
    shining = np.asarray(harmonics.evaluate(way, degree=3)) * np.asarray(cubemap.solid_angle(size=SIZE)).reshape(-1, 1)
    twice = np.einsum("vdc,ds->vsc", gather(once, SIZE), shining)
    _, found = arriving(whole, lamp)
    assert np.abs(twice).max() > 1e-3
    assert relative(found, twice) < TWICE


# What 16 harmonics leave of the first bounce, in the second.
TWICE = 0.025


def test_one_bounce_is_linear_in_the_weights_and_two_are_quadratic(whole):
    random = np.random.default_rng(0)
    a, b = (random.uniform(size=(3, 3)).astype(np.float32) for _ in range(2))
    found = {
        name: arriving(whole, light(2), jnp.asarray(x)) for name, x in {"a": a, "b": b, "+": a + b, "-": a - b}.items()
    }
    np.testing.assert_allclose(found["+"][0], found["a"][0] + found["b"][0], atol=1e-6)
    parallelogram = found["+"][1] + found["-"][1]
    np.testing.assert_allclose(parallelogram, 2 * (found["a"][1] + found["b"][1]), atol=1e-6)
    np.testing.assert_allclose(
        arriving(whole, light(2), jnp.asarray(3 * a))[1], 9 * found["a"][1], rtol=1e-4, atol=1e-6
    )


def test_fewer_components_and_modes_err_as_they_say(mesh, brdfs, whole):
    options = {"edge": EDGE, "size": SIZE}
    cut = bounces.precompute(mesh, brdfs, components=20, modes=24, bounces=1, **options)
    # Without patches, of which components are a small part.
    short, long = (eqx.tree_at(lambda each: each.patches, each, None).nbytes for each in (cut, whole))
    assert short < long / 10
    assert cut.second is None
    # A color for each wavelet and function.
    texels, functions = 6 * EDGE**2, 3
    spectrum = np.tile(np.asarray(haar.area(size=EDGE)).ravel(), 6) ** 0.4
    faces = np.repeat(np.diag(spectrum), functions, axis=1).reshape(6, EDGE, EDGE, -1).astype(np.float32)
    lamp = Environment(haar.inverse(jax.device_put(faces)))
    weight = jnp.tile(jnp.diag(bounces.tensor.scales(whole.factor)), texels)
    exact, found = (arriving(each, lamp, weight)[0] for each in (whole, cut))
    assert float(cut.error[0]) > 0.01
    # Besides, gathering by 36 modes of the light of 96 texels leaves a little, and never less.
    assert 0.999 < relative(found, exact) / float(cut.error[0]) < 1.03


@pytest.fixture(scope="module")
def changing():
    """Functions of several BRDFs, and a diffuse one."""
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.4, 0.6)]
    return bounces.functions.shared(members, functions=2, terms=6, resolution=12)[0]


def test_what_brings_little_is_left_out_and_told(mesh, changing, capsys):
    dark = separable.factor(Lambert(0.01), terms=1, resolution=8)
    options = FEW
    every = bounces.precompute(mesh, [changing, dark], **options)
    few = bounces.precompute(mesh, [changing, dark], least=0.05, **options)
    assert len(every.function) == 4
    assert every.second is not None
    assert few.second is None
    assert len(few.function) < 4
    assert few.nbytes < every.nbytes
    told = capsys.readouterr()
    assert "dropped the second bounce" in told.out + told.err
    assert f"of {len(every.function)} path functions" in told.out + told.err
    np.testing.assert_allclose(few.worth[0], every.worth[0], rtol=1e-5)
    assert few.worth[1] < 0.05


def test_channels_with_weights_are_worth_what_the_brdf_is_that_they_add_up_to(mesh):
    """In the brightest of three colors; without weights the channels would count as colors."""
    weight = jnp.array([[0.3, 0.1, 0.4], [0.2, 0.3, 0.5]])
    glossy = {"diffuse": 0.3, "specular": 0.7, "roughness": 0.5, "f0": 0.5}
    whole = CookTorrance(**glossy | {"diffuse": 0.4 + 0.5 * 0.3, "specular": 0.5 * 0.7})
    brdfs = Channels((Lambert(1.0), CookTorrance(**glossy)), jnp.ones(2)), whole
    channels, alone = (separable.factor(each, terms=8, resolution=12) for each in brdfs)
    options = {"components": ALL, "modes": ALL, "edge": 2, "size": SIZE}
    exact = bounces.precompute(mesh, [alone, alone], **options).worth
    found = bounces.precompute(mesh, [alone, channels], weights=[None, weight], **options).worth
    np.testing.assert_allclose(found, exact, rtol=0.01)
    assert np.all(bounces.precompute(mesh, [alone, channels], **options).worth > 1.1 * exact)


@pytest.mark.parametrize(("size", "kept"), [(4, 0.05), (8, 0.025)])
def test_a_coarse_light_keeps_the_flux_and_the_middle_of_a_sun_in_place(size, kept):
    """Within .04 of a coarse texel; in the middle of one alone it would be off by up to .7."""
    area, fine = np.asarray(cubemap.solid_angle(size=size)).ravel(), 64
    point, fine_point = (np.asarray(cubemap.point(size=n)).reshape(-1, 3) for n in (size, fine))
    texel = np.random.default_rng(2).integers(0, fine**2, 60)
    sun = np.zeros((6 * fine**2, len(texel)), np.float32)
    sun[texel, np.arange(len(texel))] = 1  # a color for each
    flux = np.asarray(cubemap.coarse(jax.device_put(sun.reshape(6, fine, fine, -1)), edge=size)) * area[:, None]
    at = fine_point[texel]
    own = np.sort(np.abs(at))[:, 1] <= 1 - 1 / size  # Others are shared with other faces.
    flux, at = flux[:, own], at[own]
    off = np.linalg.norm(flux.T @ point / flux.sum(0)[:, None] - at, axis=1) / (2 / size)
    np.testing.assert_allclose(flux.sum(0), np.asarray(cubemap.solid_angle(size=fine)).ravel()[texel[own]], rtol=kept)
    assert len(off) > 20
    assert max(off) < 0.04
    some = jax.device_put(np.random.default_rng(1).uniform(size=(6, size, size, 3)).astype(np.float32))
    np.testing.assert_allclose(cubemap.coarse(some, edge=size), some.reshape(-1, 3), rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=f"the light's faces, {size}, got 5"):
        cubemap.coarse(some, edge=5)


def test_a_stopped_precomputation_goes_on(mesh, brdfs, tmp_path):
    options = FEW | {"run": Run(tmp_path / "bounce")}
    first, again = (bounces.precompute(mesh, brdfs, **options) for _ in range(2))
    np.testing.assert_array_equal(first.core, again.core)
    np.testing.assert_array_equal(first.second.core, again.second.core)
    with pytest.raises(ValueError, match="computed from other inputs"):
        bounces.precompute(mesh, brdfs[::-1], **options)


@pytest.mark.usefixtures("unchecked")
def test_what_makes_no_tensor_is_refused(mesh, brdfs):
    one, two, three = jnp.ones(3), jnp.ones((2, 3)), jnp.full((3, 1), jnp.nan)
    for given, options, message in (
        (brdfs[:1], {}, r"one for each of the regions \[0, 1\], got 1"),
        (brdfs, {"components": 0}, "a power of two, got 0, 64, 8 and 16"),
        (brdfs, {"edge": 6}, "a power of two, got 32, 64, 6 and 16"),
        (brdfs, {"weights": [None]}, "one entry, an array or None, for each of 2 regions, got 1"),
        (brdfs, {"weights": [None, two]}, r"the weights of region 1 must be \[3 channels, c\], got \[2, 3\]"),
        (brdfs, {"weights": [one, None]}, r"the weights of region 0 must be \[3 channels, c\], got \[3\]"),
        (brdfs, {"weights": [three, None]}, r"the weights of region 0 must be finite, got 3 of 3"),
    ):
        with pytest.raises(ValueError, match=message):
            bounces.precompute(mesh, given, **options)
