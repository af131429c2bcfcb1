"""Mitsuba 3 judges the reference: orientation of the light, frames, shadows, units, and the Ashikhmin-Shirley model.

Both sides get the same picture of the sky (broad lobes of distinct colors around distinct directions), the same mesh
(a sphere over a ground) and the same eye. Mitsuba estimates, by path tracing of direct light with many samples, the
radiance that leaves points next to chosen vertices; its noise is told from the spread of independent renderings. What
it finds is kept beside this file; `make_mitsuba.py` writes it.
"""

import math
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from jaxprt.scene import Environment
from jaxprt.scene.environment import environment_from_image

SIZE = 64  # Texels along the edge of the reference's cubemap.
# A sum over texels and sixteenths of visibility against an integral: with 2^20 samples, 0.1 % of Mitsuba's noise, the
# Lambert values differ by at most 0.6 %, where a vertex sees little light. Three standard errors are added.
TOLERANCE = 0.01
EYE = np.array([0.8, 2.4, 3.1])
RENDERINGS = 16
# A rendering of this many samples is made live. Seeds are the same as in what is kept, which must differ by less: a
# path that rounding sends elsewhere changes one sample of 64.
LIVE = 64
STALE = 0.01
KEPT = pathlib.Path(__file__).with_name("reference_mitsuba.npz")
ALBEDO = [0.8, 0.5, 0.3]
GLOSSY = {"diffuse": 0.5, "specular": 0.75, "nu": 10.0, "nv": 100.0}

SKY = np.array([0.05, 0.06, 0.08])
LOBES = [  # Direction, color, sharpness.
    ((1.0, 0.4, 0.1), (3.0, 0.2, 0.1), 8.0),
    ((-0.9, 0.5, 0.3), (0.1, 2.0, 0.3), 6.0),
    ((0.2, 1.0, -0.1), (0.6, 0.5, 1.5), 10.0),
    ((0.1, 0.3, 1.0), (0.1, 0.4, 3.0), 7.0),
    ((-0.2, 0.2, -1.0), (1.5, 1.5, 0.1), 12.0),
    ((0.3, -1.0, 0.4), (0.2, 1.0, 1.0), 5.0),
]


def sky(direction):
    """Radiance from some directions."""
    total = np.broadcast_to(SKY, direction.shape)
    for axis, color, sharpness in LOBES:
        axis = np.array(axis) / np.linalg.norm(axis)
        total = total + np.exp(sharpness * (direction @ axis - 1))[..., None] * np.array(color)
    return total


def latlong(latitude):
    """The sky as a picture twice as wide as high: centre column +z, a quarter of the width +x; rows as given."""
    width = 2 * len(latitude)
    longitude = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    latitude, longitude = np.meshgrid(latitude, longitude, indexing="ij")
    across = np.cos(latitude)
    return sky(np.stack([np.sin(longitude) * across, np.sin(latitude), np.cos(longitude) * across], -1)).astype(
        np.float32
    )


# Rows from +y to -y: ours are boxes that fill the sphere, Mitsuba's are samples of which the first and last are poles.
IMAGE = latlong(np.pi * (0.5 - (np.arange(256) + 0.5) / 256))
MITSUBA_IMAGE = latlong(np.linspace(np.pi / 2, -np.pi / 2, 256))


class Scene(NamedTuple):
    """What both sides see."""

    position: np.ndarray
    face: np.ndarray
    normal: np.ndarray
    vertex: np.ndarray

    def mesh(self):
        """For the reference, with Wang's tangents."""
        normal = jnp.asarray(self.normal)
        tangent = prt.sphere.directions.tangent(normal)
        region = jnp.zeros(len(normal), jnp.int32)
        return prt.scene.Mesh(jnp.asarray(self.position), jnp.asarray(self.face), normal, tangent, region)


@pytest.fixture(scope="module")
def scene():
    return build_scene()


def build_scene():
    """A sphere of radius 0.5 that floats over a ground of 13 x 13 vertices; vertices in light, penumbra and shadow."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    center = np.array([0.0, 0.6, 0.0])
    side = 13
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, side), np.linspace(-1.5, 1.5, side), indexing="ij")
    ground = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()[:, None]
    first, second = corner + np.array([0, 1, side]), corner + np.array([1, side + 1, side])
    position = np.concatenate([ground, ball.vertices + center])
    face = np.concatenate([first, second, ball.faces + len(ground)])
    up = np.broadcast_to([0.0, 1.0, 0.0], ground.shape)
    normal = np.concatenate([up, ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)])
    # Under the sphere, beside it, away from it; and around the visible side of the sphere.
    asked = np.array([[0.0, 0, 0.25], [0.5, 0, 0], [-0.5, 0, 0.25], [0.25, 0, 0.75], [-0.75, 0, -0.5], [1.25, 0, 1.25]])
    angle = np.array(
        [[0.1, 1.2], [0.9, 0.9], [-0.8, 0.7], [0.3, 0.3], [1.6, 0.5], [0.2, -0.3], [-1.0, 0.1], [1.0, -0.1]]
    )
    longitude, latitude = angle.T
    around = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], -1
    )
    asked = np.concatenate([asked, center + 0.5 * around])
    vertex = np.array([np.argmin(np.linalg.norm(position - point, axis=1)) for point in asked])
    return Scene(position.astype(np.float32), face.astype(np.int32), normal.astype(np.float32), vertex)


@pytest.fixture(scope="module")
def mitsuba():
    return load_mitsuba()


def load_mitsuba():
    """Mitsuba in its scalar variant, with the Ashikhmin-Shirley model as a plugin written from the paper."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    _register_ashikhmin_shirley(mitsuba)
    return mitsuba


def _register_ashikhmin_shirley(mi):
    class AshikhminShirley(mi.BSDF):
        """The published formula in scalar Python; half the samples by the cosine, half by the lobe."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.rd, self.rs, self.nu, self.nv = (props[name] for name in ("diffuse", "specular", "nu", "nv"))
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, sample1, sample2, active=True):
            wo = mi.warp.square_to_cosine_hemisphere(sample2) if sample1 < 0.5 else self.mirrored(si, *sample2)
            result = mi.BSDFSample3f()
            result.wo, result.eta, result.sampled_component = wo, 1.0, 0
            result.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            result.pdf = self.pdf(ctx, si, wo)
            return result, self.eval(ctx, si, wo) / result.pdf if result.pdf > 0 else mi.Color3f(0)

        def pdf(self, ctx, si, wo, active=True):
            if si.wi.z <= 0 or wo.z <= 0:
                return 0.0
            (hu, hv, nh), hk, _, _ = self.angles(si, wo)
            return wo.z / (2 * math.pi) + self.lobe(hu, hv, nh) / (2 * math.pi) / (8 * hk)

        def eval(self, ctx, si, wo, active=True):
            if si.wi.z <= 0 or wo.z <= 0:
                return mi.Color3f(0)
            (hu, hv, nh), hk, n1, n2 = self.angles(si, wo)
            fresnel = self.rs + (1 - self.rs) * (1 - hk) ** 5
            specular = self.lobe(hu, hv, nh) / (8 * math.pi) / (hk * max(n1, n2)) * fresnel
            diffuse = 28 * self.rd / (23 * math.pi) * (1 - self.rs)
            diffuse *= (1 - (1 - n1 / 2) ** 5) * (1 - (1 - n2 / 2) ** 5)
            return mi.Color3f((specular + diffuse) * wo.z)

        def lobe(self, hu, hv, nh):
            power = (self.nu * hu * hu + self.nv * hv * hv) / max(1 - nh * nh, 1e-9)
            return math.sqrt((self.nu + 1) * (self.nv + 1)) * nh**power

        def angles(self, si, wo):
            """Half vector in the frame (u, v, n), and its and the normal's cosines with the directions."""
            u, v, n = axes(si)
            k1, k2 = list(si.to_world(wo)), list(si.to_world(si.wi))
            h = [a + b for a, b in zip(k1, k2, strict=True)]
            length = math.sqrt(dot(h, h))
            h = [a / length for a in h]
            return (dot(h, u), dot(h, v), dot(h, n)), dot(h, k1), dot(n, k1), dot(n, k2)

        def mirrored(self, si, sample1, sample2):
            """The view mirrored at a half vector drawn from the lobe."""
            phi = math.atan2(
                math.sqrt((self.nu + 1) / (self.nv + 1)) * math.sin(2 * math.pi * sample1),
                math.cos(2 * math.pi * sample1),
            )
            power = self.nu * math.cos(phi) ** 2 + self.nv * math.sin(phi) ** 2
            nh = (1 - sample2) ** (1 / (power + 1))
            across = math.sqrt(1 - nh * nh)
            weight = (across * math.cos(phi), across * math.sin(phi), nh)
            h = [dot(weight, component) for component in zip(*axes(si), strict=True)]
            k2 = list(si.to_world(si.wi))
            return si.to_local([2 * dot(h, k2) * a - b for a, b in zip(h, k2, strict=True)])

        def traverse(self, callback):
            pass

        def to_string(self):
            return "AshikhminShirley"

    mi.register_bsdf("published_ashikhmin_shirley", AshikhminShirley)


def axes(si):
    """The frame (u, v, n); u is the tangent of Wang's equation 7, as where a mesh brings none."""
    x, y, z = si.sh_frame.n
    u = (1 - x * x / (1 + y), -x, -x * z / (1 + y))
    return u, (y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]), (x, y, z)


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cases():
    """What Mitsuba renders, by model."""
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
    glossy = {"type": "published_ashikhmin_shirley", **GLOSSY}
    return {
        "matte": {"bsdf": matte, "samples": (1 << 17) // RENDERINGS},
        "glossy": {"bsdf": glossy, "samples": (1 << 14) // RENDERINGS},
    }


def render(mi, scene, *, bsdf, samples, seeds):
    """Radiance towards the eye from points next to the vertices, in independent renderings, [rendering, v, 3]."""
    mesh = mi.Mesh("mesh", len(scene.position), len(scene.face), has_vertex_normals=True, props=_props(mi, bsdf))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.position.ravel()
    parameters["vertex_normals"] = scene.normal.ravel()
    parameters["faces"] = scene.face.ravel()
    parameters.update()
    sensors = {f"sensor{i:02}": _meter(mi, *ray) for i, ray in enumerate(rays(scene))}
    world = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "batch", "film": _film(len(sensors)), **sensors},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(MITSUBA_IMAGE)},
            "mesh": mesh,
        }
    )
    return np.stack([np.array(mi.render(world, spp=samples, seed=i))[0] for i in seeds])


def _props(mi, bsdf):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    return props


def rays(scene):
    """From a little off the surface, on the way from the eye, to a point just inside a triangle at each vertex."""
    for vertex in scene.vertex:
        point, normal = scene.position[vertex].astype(float), scene.normal[vertex]
        face = scene.face[np.flatnonzero((scene.face == vertex).any(1))[0]]
        target = point + 1e-3 * (scene.position[face].mean(0) - point)
        assert normal @ (EYE - point) > 0.1, "the vertex must look at the eye"
        yield target + 0.02 * (EYE - point), target


def _meter(mi, origin, target):
    direction = (target - origin).tolist()
    return {"type": "radiancemeter", "origin": origin.tolist(), "direction": direction, "film": _film(1)}


def _film(width):
    return {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}


def excess(actual, mean, error):
    """By how much values differ beyond the tolerance and three standard errors, singly and in the sum over vertices."""
    single = np.abs(actual - mean) - TOLERANCE * mean - 3 * error
    total, noise = np.sum(actual - mean, 0), np.sqrt(np.sum(error**2, 0))
    return np.append(single, np.abs(total) - TOLERANCE / 2 * np.sum(mean, 0) - 3 * noise)


TURNED = {
    "as it is": lambda image: image,
    "x mirrored": lambda image: image[:, ::-1],
    "y mirrored": lambda image: image[::-1],
    "half a turn": lambda image: np.roll(image, image.shape[1] // 2, 1),
    "a quarter turn": lambda image: np.roll(image, image.shape[1] // 4, 1),
    "5 % brighter": lambda image: 1.05 * image,
}


@pytest.fixture(scope="module")
def skies():
    """The light as it is, and turned: one batch, which serves the tests of Lambert by one program."""
    each = [environment_from_image(turn(IMAGE), size=SIZE).radiance for turn in TURNED.values()]
    return Environment(jax.device_put(np.stack(each)))


@pytest.fixture(scope="module")
def light(skies):
    return Environment(jax.device_put(np.asarray(skies.radiance)[0]))


def reference(scene, brdf, light, occluder=None):
    eye = jnp.asarray(EYE, jnp.float32)
    return np.asarray(
        prt.reference.radiance(scene.mesh(), brdf, light, eye=eye, vertex=scene.vertex, occluder=occluder)
    )


@pytest.fixture(scope="module")
def lambert(scene, skies):
    """Radiance of Lambert by the name of the light."""
    return dict(zip(TURNED, reference(scene, prt.brdf.Lambert(albedo=ALBEDO), skies), strict=True))


def estimate(name):
    """What is kept of a model: mean and its standard error, [v, 3]."""
    with np.load(KEPT) as kept:
        result = kept[name]
    return np.mean(result, 0), np.std(result, 0, ddof=1) / math.sqrt(RENDERINGS)


@pytest.fixture(scope="module")
def matte():
    return estimate("matte")


@pytest.fixture(scope="module")
def glossy():
    return estimate("glossy")


@pytest.mark.parametrize("name", cases())
def test_what_is_kept_is_what_mitsuba_renders(mitsuba, scene, close, name):
    live = render(mitsuba, scene, **cases()[name] | {"samples": LIVE, "seeds": range(1)})
    with np.load(KEPT) as kept:
        close(live, kept[f"{name} live"], tolerance=STALE)


def test_environment_looks_the_same_in_every_direction(mitsuba, light):
    map_of_mitsuba = mitsuba.load_dict({"type": "envmap", "bitmap": mitsuba.Bitmap(MITSUBA_IMAGE)})
    direction = np.random.default_rng(0).normal(size=(200, 3))
    direction = np.concatenate([direction, np.eye(3), -np.eye(3)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    theirs = []
    for each in direction:
        seen = mitsuba.SurfaceInteraction3f()
        seen.wi = -mitsuba.Vector3f(each)
        theirs.append(list(map_of_mitsuba.eval(seen)))
    ours = prt.scene.environment.background(light, jnp.asarray(direction, jnp.float32))
    # Texel means and bilinear interpolation soften the sharpest lobe by so much.
    np.testing.assert_allclose(theirs, sky(direction), rtol=2e-3)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2)


def test_reference_agrees_on_lambert(lambert, matte):
    assert excess(lambert["as it is"], *matte).max() < 0


def test_reference_agrees_on_ashikhmin_shirley(scene, light, glossy):
    assert excess(reference(scene, prt.brdf.AshikhminShirley(**GLOSSY), light), *glossy).max() < 0


@pytest.mark.long
@pytest.mark.parametrize("name", cases())
def test_other_random_numbers_of_mitsuba_agree_within_their_noise(mitsuba, scene, name):
    kept, error = estimate(name)
    other = render(mitsuba, scene, **cases()[name] | {"seeds": range(RENDERINGS, 2 * RENDERINGS)})
    noise = np.hypot(error, other.std(0, ddof=1) / math.sqrt(RENDERINGS))
    assert np.linalg.norm(other.mean(0) - kept) < 3 * np.linalg.norm(noise)


def test_noise_of_mitsuba_is_small_beside_what_is_judged(matte, glossy):
    for (mean, error), bound in ((matte, 0.005), (glossy, 0.02)):
        assert np.linalg.norm(error) < bound * np.linalg.norm(mean)


@pytest.mark.parametrize("change", list(TURNED)[1:])
def test_another_environment_would_be_noticed(lambert, matte, change):
    assert excess(lambert[change], *matte).max() > 0


@pytest.mark.parametrize("change", [{"nu": 100.0, "nv": 10.0}, {"nv": 70.0}, {"specular": 0.7}, {"diffuse": 0.6}])
def test_another_brdf_would_be_noticed(scene, light, glossy, change):
    assert excess(reference(scene, prt.brdf.AshikhminShirley(**GLOSSY | change), light), *glossy).max() > 0


def test_missing_shadows_would_be_noticed(scene, skies, matte):
    far_away = scene._replace(position=scene.position - 100).mesh()
    actual = reference(scene, prt.brdf.Lambert(albedo=ALBEDO), skies, occluder=far_away)
    assert excess(actual[0], *matte).max() > 0
