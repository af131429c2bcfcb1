"""How right are light and material found from pictures that another program has drawn, and how soon?

    python -m benchmarks.inverse [--quick] [--store FOLDER] [--output FILE]

The bunny (36,000 vertices), pictures of 256 x 256 pixels by Mitsuba 3's path tracer, direct light. `error` is relative
L2 of what was found, `residual` that of the pictures, `rank` how many combinations of numbers they determine, `known`
how many numbers by themselves. Precomputation is `precompute_seconds`, and `table_seconds` of the lobes, and not in
`seconds`, which compile.

Lines `light`: 25 spherical harmonics of the light in three colors from one picture, of what the pictures determine:
under light that has no more of them, and under Grace, whose finer light the fit has no numbers for. `peer` is Mitsuba's
own differentiable path tracer (prb, Adam on the same 75 numbers, 16 paths a pixel): the time until it is 3 % off, or of
all its steps, and the error that it then has.

Lines `material`: Ashikhmin and Shirley's parameters (diffuse color, specular, both exponents) from three pictures under
Grace, without noise and with 2 % of the picture's root mean square. `peer` is prb with Adam on their logarithms.

Line `jointly`: the same of a broader lobe, and 25 harmonics of a light of as many, beside a ground of known color.

With --quick, or where LLVM 17 is missing, which Mitsuba needs, pictures are of `jaxprt.reference` instead.
"""

import pathlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxprt as prt
from benchmarks import harness, path_tracing, prb
from jaxprt import bright_texels, harmonic, inverse, lobe, reference, scene
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.image import interpolate, raster
from jaxprt.scene import Camera, Environment, Mesh, builtin, camera, load_environment, load_mesh
from jaxprt.sphere import cubemap, harmonics
from jaxprt.systems.lobe import LobeBrdf

DEGREE = 4
TEXELS = 16
SAMPLES = 256
ALBEDO = 0.5
TRUE = {"diffuse": [0.35, 0.2, 0.1], "specular": 0.3, "nu": 20.0, "nv": 150.0}
BROAD = TRUE | {"nu": 10.0, "nv": 40.0}  # no sharper than light of degree 4 determines
START = {"diffuse": [0.5, 0.5, 0.5], "specular": 0.1, "nu": 50.0, "nv": 50.0}
LOWER = {"diffuse": 0.0, "specular": 0.0, "nu": 8.0, "nv": 8.0}
UPPER = {"diffuse": 1.0, "specular": 1.0, "nu": 400.0, "nv": 400.0}
KNOTS = np.geomspace(8, 400, 6)
NOISE = 0.02
FINE = 6  # degree of the base's harmonics
PATCH = 0.5  # albedo of the ground
ASKED = 0.03
DETERMINED = 0.025  # relative L2 to which combinations of harmonics count as determined
PEER_SAMPLES, PEER_RATE = 16, 0.05  # of prb
LIGHT_STEPS, MATERIAL_STEPS = 600, 150


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    arguments = parser.parse_args(options)
    for line in measure(arguments.quick, arguments.store):
        harness.report({"benchmark": "inverse", **line}, arguments.output)


def measure(quick: bool, store: pathlib.Path | None):
    """All lines."""
    path, (size, edge, rings) = harness.data(), (16, 32, 12) if quick else (64, 256, 16)
    real = path.is_dir() and not quick
    mesh = load_mesh(path / "meshes" / "stanford_bunny.ply") if real else builtin.sphere(rings=rings, sectors=2 * rings)
    sky = load_environment(path / "env" / "grace_cross.hdr", size=size) if real else builtin.daylight(size=size)
    views = [camera.orbit(mesh, azimuth=a, elevation=0.3, width=edge, height=edge) for a in (0.3, 2.4, 4.5)]
    exact = path_tracing.available() and not quick
    yield from lights(mesh, sky, views[0], exact, store, quick)
    start = time.perf_counter()
    lobes = tabulated(quick)
    seconds = time.perf_counter() - start
    case = Case(mesh, sky, views, lobes, exact, store, quick)
    for line in materials(case):
        yield {**line, "table_seconds": seconds}
    yield together(case)


def lights(mesh: Mesh, sky: Environment, view: Camera, exact: bool, store: pathlib.Path | None, quick: bool):
    """From one picture."""
    start = time.perf_counter()
    table = harmonic.tabulate(Lambert(ALBEDO), degree=DEGREE, resolution=16)
    vectors = harmonic.precompute(mesh, degree=DEGREE, run=prt.Run(store and store / "harmonic", progress=False))
    ready = time.perf_counter() - start

    def radiance(light, eye):
        return prt.radiance(harmonic.HarmonicSystem(vectors, table), light, eye=eye)

    for name, light in list({"of degree 4": band_limited(sky), "Grace": sky}.items())[: 1 if quick else None]:
        true = harmonic.project(light, degree=DEGREE)
        image = drawn(mesh, [Lambert(ALBEDO)], light, view, exact, seed=0)
        pixels = inverse.observe(mesh, [inverse.Picture(image, view)])
        start = time.perf_counter()
        found = inverse.light(radiance, jnp.zeros_like(true), pixels, error=DETERMINED)
        seconds = time.perf_counter() - start
        finite = np.isfinite(found.deviation)
        line = {
            **{"case": f"light, {name}, {len(mesh.position)} vertices", "seconds": seconds, "compile_seconds": 0.0},
            **{
                "error": wrong(found.determined, found.value, true),
                "residual": float(found.residual[-1]),
                "rank": found.rank,
            },
            **{"known": int(finite.sum()), "bytes": vectors.nbytes, "precompute_seconds": ready},
        }
        if exact:
            path, seconds = prb.fit_light(
                mesh, ALBEDO, image, view, degree=DEGREE, steps=LIGHT_STEPS, samples=PEER_SAMPLES, rate=PEER_RATE
            )
            line |= peer([wrong(found.determined, each, true) for each in path], seconds)
        yield line


def band_limited(sky: Environment) -> Environment:
    """A light of 25 coefficients, nowhere negative: blurred, and lifted."""
    coefficient = harmonics.project(sky.radiance, degree=DEGREE)
    size = sky.radiance.shape[1]
    value = harmonics.evaluate(cubemap.direction(size=size), degree=DEGREE) @ coefficient
    return Environment(value - jnp.minimum(jnp.min(value), 0) * 1.01)


class Case(NamedTuple):
    """What pictures are drawn of, and what explains them."""

    mesh: Mesh
    sky: Environment
    views: list[Camera]
    lobes: LobeBrdf
    exact: bool
    store: pathlib.Path | None
    quick: bool


class Fresnel(eqx.Module):
    """The lobe of Ashikhmin and Shirley's model where the surface reflects all at normal incidence, and where none.

    It is linear in that reflectance: between the two in one table.
    """

    nu: Array
    nv: Array

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
        """Value in 1/sr."""
        models = (AshikhminShirley(diffuse=0.0, specular=s, nu=self.nu, nv=self.nv) for s in (1.0, 0.0))
        return jnp.concatenate([each(wi, wo) for each in models], -1)


def base(wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b 1"]:
    """What is under the lobe, of albedo 1."""
    return AshikhminShirley(diffuse=1.0, specular=0.0)(wi, wo) - AshikhminShirley(diffuse=0.0, specular=0.0)(wi, wo)


def tabulated(quick: bool) -> LobeBrdf:
    """Over logarithms of the exponents, powers of which lobes narrow with."""
    knot = np.log(KNOTS[::2] if quick else KNOTS)
    lobes = 3 if quick else 8
    nodes = 12 if quick else 32
    return lobe.tabulate(lambda u, v: Fresnel(jnp.exp(u), jnp.exp(v)), lobes=lobes, resolution=nodes, knot=[knot, knot])


class Coated:
    """Radiance of Ashikhmin and Shirley's model for all of its parameters: lobes over a base of harmonics."""

    def __init__(self, mesh: Mesh, lobes: LobeBrdf, size: int, degree: int, store: pathlib.Path | None):
        start = time.perf_counter()
        self.lobes = lobes
        self.seen = lobe.precompute(mesh, size=size, run=prt.Run(store and store / "lobe", progress=False))
        name = store and store / f"harmonic{degree}"
        self.shadows = harmonic.precompute(mesh, degree=degree, run=prt.Run(name, progress=False))
        self.base = harmonic.tabulate(base, degree=degree, resolution=16)
        self.seconds = time.perf_counter() - start

    def radiance(self, material, light: lobe.blurred_light.LobeLight, coefficient, eye):
        """Under a light, prefiltered and as harmonics."""
        table, s = self.lobes.at(jnp.log(material["nu"]), jnp.log(material["nv"])), material["specular"]
        weight, diffuse = (s * each[:1] + (1 - s) * each[1:] for each in (table.weight, table.diffuse))
        table = eqx.tree_at(lambda each: (each.weight, each.diffuse), table, (weight, diffuse))
        glossy = lobe.system.combine(light, lobe.system.view_lobes(self.seen, table, eye=eye))
        under = prt.radiance(harmonic.HarmonicSystem(self.shadows, self.base), coefficient, eye=eye)
        return glossy + material["diffuse"] * (1 - s) * under


def materials(case: Case):
    """From three pictures under known light."""
    mesh, sky, views, lobes, exact, store, quick = case
    coated = Coated(mesh, lobes, sky.radiance.shape[1], FINE, store)
    texel, excess, rest = bright_texels.split(sky, count=TEXELS)
    blurred, coefficient = lobe.blurred_light.prefilter(rest), harmonic.project(rest, degree=FINE)

    def radiance(material, eye):
        single = bright_texels.radiance(coated.seen, AshikhminShirley(**material), texel, excess, eye=eye)
        return single + coated.radiance(material, blurred, coefficient, eye)

    images = [drawn(mesh, [AshikhminShirley(**TRUE)], sky, view, exact, seed=n) for n, view in enumerate(views)]
    for noise in (NOISE,) if quick else (0.0, NOISE):
        random = np.random.default_rng(0)
        scale = noise * np.sqrt(np.mean(np.square([each[each.any(-1)].mean() for each in images])))
        noisy = [np.maximum(each + scale * random.normal(size=each.shape), 0).astype(np.float32) for each in images]
        pixels = observed(mesh, noisy, views)
        start = time.perf_counter()
        found = inverse.material(radiance, arrays(START), pixels, lower=LOWER, upper=UPPER)
        seconds = time.perf_counter() - start
        line = {
            **{"case": f"material, {noise:.0%} noise, {len(mesh.position)} vertices", "seconds": seconds},
            **{"compile_seconds": 0.0, **away(found.value, TRUE), "residual": float(found.residual[-1])},
            **{"steps": len(found.residual) - 1, "bytes": coated.seen.nbytes + coated.shadows.nbytes},
            "precompute_seconds": coated.seconds,
        }
        if exact and not noise:
            path, each = prb.fit_material(
                mesh,
                *(AshikhminShirley(**START), sky, images, views),
                **{"steps": MATERIAL_STEPS, "samples": PEER_SAMPLES, "rate": PEER_RATE},
            )
            line |= peer([away(value, TRUE)["error"] for value in path], each)
        yield line


def together(case: Case):
    """Light and material from three pictures, beside a ground of known color."""
    mesh, sky, views, lobes, exact, store, quick = case
    ground = scene.mesh.ground_plane(mesh, vertices=64 if quick else 4000, extent=1.5)
    whole = scene.mesh.join([mesh, ground])
    light, size = band_limited(sky), sky.radiance.shape[1]
    coated = Coated(whole, lobes, size, DEGREE, store and store / "ground")
    plain = harmonic.tabulate(Lambert(PATCH), degree=DEGREE, resolution=16)
    value = harmonics.evaluate(cubemap.direction(size=size), degree=DEGREE)
    known = (whole.region == 1)[:, None]

    def radiance(coefficient, material, eye):
        blurred = lobe.blurred_light.prefilter(Environment(value @ coefficient))
        own = coated.radiance(material, blurred, coefficient, eye)
        return jnp.where(known, prt.radiance(harmonic.HarmonicSystem(coated.shadows, plain), coefficient, eye=eye), own)

    models = [AshikhminShirley(**BROAD), Lambert(PATCH)]
    images = [drawn(whole, models, light, view, exact, seed=n) for n, view in enumerate(views)]
    pixels = observed(whole, images, views)
    true = harmonic.project(light, degree=DEGREE)
    start = time.perf_counter()
    first = (jnp.zeros_like(true).at[0].set(norm(true) / np.sqrt(3)), arrays(START))
    found = inverse.jointly(radiance, first, pixels, lower=LOWER, upper=UPPER, scale=False, steps=12 if quick else 50)
    seconds = time.perf_counter() - start
    errors = away(found.value[1], BROAD) | {"light_error": norm(found.value[0] - true) / norm(true)}
    return {
        **{"case": f"jointly, {len(whole.position)} vertices", "seconds": seconds, "compile_seconds": 0.0},
        **{**errors, "error": max(errors.values()), "residual": float(found.residual[-1]), "rank": found.rank},
        **{"steps": len(found.residual) - 1, "bytes": coated.seen.nbytes + coated.shadows.nbytes},
        "precompute_seconds": coated.seconds,
    }


def arrays(values: dict) -> dict:
    """Of lists and numbers."""
    return {key: jnp.asarray(value) for key, value in values.items()}


def away(value: dict, true: dict) -> dict[str, float]:
    """Errors of a material's parameters in units of each, and the largest."""
    errors = {
        f"{key}_error": float(np.max(np.abs(np.asarray(value[key]) - np.asarray(each)) / np.max(each)))
        for key, each in true.items()
    }
    return {"error": max(errors.values()), **errors}


def observed(mesh: Mesh, images: list[np.ndarray], views: list[Camera]) -> inverse.Observations:
    """What pictures show."""
    return inverse.observe(mesh, [inverse.Picture(image, view) for image, view in zip(images, views, strict=True)])


def drawn(mesh: Mesh, models: Sequence[Any], light: Environment, view: Camera, exact: bool, *, seed: int) -> np.ndarray:
    """A picture of direct light."""
    if exact:
        return path_tracing.picture(mesh, models, light, view, depth=2, samples=SAMPLES, seed=seed)
    fragments = raster.rasterize(mesh, view)
    shown = np.unique(np.asarray(mesh.face)[np.unique(np.asarray(fragments.triangle))[1:]])
    region = np.asarray(mesh.region)[shown]
    color = np.zeros((len(mesh.position), 3), np.float32)
    for number, model in enumerate(models):
        own = shown[region == number]
        color[own] = reference.radiance(mesh, model, light, eye=view.eye, vertex=own)
    return np.asarray(interpolate(fragments, mesh.face, jnp.asarray(color)))


def wrong(determined, found, true) -> float:
    """Relative L2 error of the combinations of numbers that the pictures determine."""
    return norm(determined @ np.ravel(found - true)) / norm(determined @ np.ravel(true))


def peer(error: list[float], seconds: float) -> dict:
    """Mitsuba's errors after each step: the last, and the time until the asked error, if it was reached."""
    import mitsuba

    good = np.flatnonzero(np.asarray(error) <= ASKED)
    count = int(good[0]) + 1 if good.size else len(error)
    name = f"Mitsuba {mitsuba.__version__} prb, {count} steps"
    return {"peer": name, "peer_seconds": seconds * count, "peer_error": error[count - 1], "peer_least": min(error)}


def norm(array) -> float:
    """L2."""
    return float(np.linalg.norm(array))


if __name__ == "__main__":
    main()
