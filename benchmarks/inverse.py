"""How right are light and material found from pictures that another program has drawn, and how soon?

    python -m benchmarks.inverse [--quick] [--store FOLDER] [--output FILE]

The bunny (36,000 vertices), pictures of 256 x 256 pixels by Mitsuba 3's path tracer, direct light. `error` is relative
L2 of what was found, `residual` that of the pictures; `deviation` is the largest of the numbers' deviations relative to
their norm, as the fit itself says. Precomputation is `precompute_seconds` and not in `seconds`.

Lines `light`: 25 spherical harmonics of the light in three colors from one picture, of what the pictures determine:
under light that has no more of them, and under Grace, whose finer light the fit has no numbers for. `peer` is Mitsuba's
own differentiable path tracer (prb, Adam on the same 75 numbers, 16 paths a pixel), at the error that it then has.

Lines `material`: five numbers of Cook and Torrance's model (diffuse color, specular weight, roughness) from three
pictures under Grace, without noise and with 2 % of the picture's root mean square; Mitsuba has no Ashikhmin-Shirley.

With --quick, or where LLVM 17 is missing, which Mitsuba needs, pictures are of `jaxprt.relight.reference` instead.
"""

import pathlib
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import harness, path_tracing
from jaxprt import brdf, inverse, relight, transport
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.image import raster
from jaxprt.relight import reference
from jaxprt.scene import Camera, Environment, Mesh, builtin, camera, load_environment, load_mesh
from jaxprt.sphere import cubemap, harmonics

DEGREE = 4
TEXELS = 16
SAMPLES = 256
ALBEDO = 0.5
TRUE = {"diffuse": [0.35, 0.2, 0.1], "specular": 0.6, "roughness": 0.22}
START = {"diffuse": [0.5, 0.5, 0.5], "specular": 0.3, "roughness": 0.4}
LOWER = {"diffuse": 0.0, "specular": 0.0, "roughness": 0.1}
UPPER = {"diffuse": 1.0, "specular": 2.0, "roughness": 0.6}
F0 = 0.3
KNOTS = np.array([0.1, 0.14, 0.2, 0.28, 0.4, 0.6])
NOISE = 0.02
PEER_STEPS, PEER_SAMPLES, PEER_RATE = 150, 16, 0.05


def main() -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    arguments = parser.parse_args()
    for line in measure(arguments.quick, arguments.store):
        harness.report({"benchmark": "inverse", **line}, arguments.output)


def measure(quick: bool, store: pathlib.Path | None):
    """All lines."""
    path, size, edge = harness.data(), 16 if quick else 64, 64 if quick else 256
    real = path.is_dir() and not quick
    mesh = load_mesh(path / "meshes" / "stanford_bunny.ply") if real else builtin.sphere(rings=24, sectors=48)
    sky = load_environment(path / "env" / "grace_cross.hdr", size=size) if real else builtin.daylight(size=size)
    views = [camera.orbit(mesh, azimuth=a, elevation=0.3, width=edge, height=edge) for a in (0.3, 2.4, 4.5)]
    exact = path_tracing.available() and not quick
    yield from lights(mesh, sky, views[0], exact, store)
    yield from materials(mesh, sky, views, exact, store, quick)


def lights(mesh: Mesh, sky: Environment, view: Camera, exact: bool, store: pathlib.Path | None):
    """From one picture."""
    start = time.perf_counter()
    table = brdf.harmonic.tabulate(Lambert(ALBEDO), degree=DEGREE, resolution=16)
    vectors = transport.harmonic.precompute(mesh, degree=DEGREE, path=store and store / "harmonic", progress=False)
    ready = time.perf_counter() - start

    def radiance(light, eye):
        return relight.harmonic.radiance(vectors, table, light, eye=eye)

    for name, light in {"of degree 4": band_limited(sky), "Grace": sky}.items():
        true = relight.harmonic.project(light, degree=DEGREE)
        image = drawn(mesh, Lambert(ALBEDO), light, view, exact, seed=0)
        pixels = inverse.observe(mesh, [inverse.Picture(image, view)])
        start = time.perf_counter()
        found = inverse.light(radiance, jnp.zeros_like(true), pixels)
        seconds = time.perf_counter() - start
        finite = np.isfinite(found.deviation)
        line = {
            **{"case": f"light, {name}, {len(mesh.position)} vertices", "seconds": seconds, "compile_seconds": 0.0},
            **{
                "error": wrong(found.told, found.value, true),
                "residual": float(found.residual[-1]),
                "rank": found.rank,
            },
            **{"deviation": float(np.max(found.deviation[finite], initial=0)) / norm(true), "bytes": vectors.nbytes},
            "precompute_seconds": ready,
        }
        if exact:
            line |= peer(mesh, image, view, found.told, true)
        yield line


def band_limited(sky: Environment) -> Environment:
    """A light of 25 coefficients, nowhere negative: blurred, and lifted."""
    coefficient = harmonics.project(sky.radiance, degree=DEGREE)
    size = sky.radiance.shape[1]
    value = harmonics.evaluate(cubemap.direction(size=size), degree=DEGREE) @ coefficient
    return Environment(value - jnp.minimum(jnp.min(value), 0) * 1.01)


def materials(mesh: Mesh, sky: Environment, views: list[Camera], exact: bool, store: pathlib.Path | None, quick: bool):
    """From three pictures under known light."""
    start = time.perf_counter()
    size = sky.radiance.shape[1]
    seen = transport.lobe.precompute(mesh, size=size, path=store and store / "lobe", progress=False)

    def sharp(roughness):
        return CookTorrance(diffuse=0.0, specular=1.0, roughness=roughness, f0=F0)

    table = brdf.lobe.tabulate(sharp, lobes=4 if quick else 8, knot=[KNOTS[::2] if quick else KNOTS])
    ready = time.perf_counter() - start
    texel, excess, rest = relight.direct.split(sky, count=TEXELS)
    blurred = relight.lobe.prefilter(rest)
    matte = relight.direct.irradiance(seen, texel, excess) + (blurred.coefficient.T @ seen.vector).T

    def radiance(material, eye):
        view = relight.lobe.look(seen, table.at(material["roughness"]), eye=eye)
        single = relight.direct.radiance(seen, sharp(material["roughness"]), texel, excess, eye=eye)
        glossy = relight.lobe.combine(blurred, view) + single
        facing = jnp.sum(seen.frame[:, 2] * (eye - seen.position), 1) > 0
        return material["specular"] * glossy + material["diffuse"] * matte * facing[:, None]

    true, first = ({key: jnp.asarray(value) for key, value in each.items()} for each in (TRUE, START))
    model = CookTorrance(f0=F0, **TRUE)
    images = [drawn(mesh, model, sky, view, exact, seed=n) for n, view in enumerate(views)]
    for noise in (NOISE,) if quick else (0.0, NOISE):
        random = np.random.default_rng(0)
        scale = noise * np.sqrt(np.mean(np.square([each[each.any(-1)].mean() for each in images])))
        noisy = [np.maximum(each + scale * random.normal(size=each.shape), 0).astype(np.float32) for each in images]
        pictures = [inverse.Picture(image, view) for image, view in zip(noisy, views, strict=True)]
        pixels = inverse.observe(mesh, pictures)
        start = time.perf_counter()
        found = inverse.material(radiance, first, pixels, lower=LOWER, upper=UPPER)
        seconds = time.perf_counter() - start
        away = {key: np.abs(np.asarray(found.value[key] - true[key])) / np.max(true[key]) for key in true}
        yield {
            **{"case": f"material, {noise:.0%} noise, {len(mesh.position)} vertices", "seconds": seconds},
            **{"compile_seconds": 0.0, "error": float(max(np.max(each) for each in away.values()))},
            **{f"{key}_error": float(np.max(each)) for key, each in away.items()},
            **{"residual": float(found.residual[-1]), "steps": len(found.residual) - 1, "bytes": seen.nbytes},
            "precompute_seconds": ready,
        }


def drawn(mesh: Mesh, model: Any, light: Environment, view: Camera, exact: bool, *, seed: int) -> np.ndarray:
    """A picture of direct light."""
    if exact:
        return path_tracing.picture(mesh, [model], light, view, depth=2, samples=SAMPLES, seed=seed)
    fragments = raster.rasterize(mesh, view)
    shown = np.unique(np.asarray(mesh.face)[np.unique(np.asarray(fragments.triangle))[1:]])
    color = np.zeros((len(mesh.position), 3), np.float32)
    color[shown] = reference.radiance(mesh, model, light, eye=view.eye, vertex=shown)
    return np.asarray(raster.interpolate(fragments, mesh.face, jnp.asarray(color)))


def wrong(told, found, true) -> float:
    """Of the combinations of numbers that the picture tells, in units of these."""
    return norm(told @ np.ravel(found - true)) / norm(told @ np.ravel(true))


def peer(mesh: Mesh, image: np.ndarray, view: Camera, told, true) -> dict:
    """Mitsuba's gradients on the same numbers: the texels of an environment map are harmonics times coefficients."""
    import mitsuba

    found, seconds = path_tracing.fit_light(
        mesh, ALBEDO, image, view, degree=DEGREE, steps=PEER_STEPS, samples=PEER_SAMPLES, rate=PEER_RATE
    )
    name = f"Mitsuba {mitsuba.__version__} prb, {PEER_STEPS} steps"
    return {"peer": name, "peer_seconds": seconds, "peer_error": wrong(told, found, true)}


def norm(array) -> float:
    """L2."""
    return float(np.linalg.norm(array))


if __name__ == "__main__":
    main()
