"""How much error for how much time: all-frequency relighting of a glossy object and its ground, the whole front.

    python -m benchmarks.compression [--quick] [--output FILE] [--plot FILE] [--store FOLDER]

The bunny with Ashikhmin-Shirley (10, 100) on a diffuse ground (from JAXPRT_DATA; a sphere on its ground where that is
not set, and with --quick), under each light and from every view, at the vertices that face it, against the integral
over all texels. A configuration is the
number of terms, components, modes and coefficients of the clustered transport, and of texels summed one by one; or a
number of lobes, the ground's light then by spherical harmonics; the published configuration, four sparse terms with 96
coefficients, stands beside. One line for each light: `seconds` is a light change (environment to radiance of all
vertices), `view_seconds` a view change. The peer is the other way to make the picture anew: a light change by the
published configuration. Mitsuba 3's pictures stand in the same plot; see `benchmarks.path_tracing`.
"""

import pathlib
import time
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness, path_tracing
from benchmarks.published.factorization import factor_symmetric
from jaxprt import bright_texels, lobe, reference, separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment, builtin, load_environment, load_mesh
from jaxprt.scene.mesh import Mesh, bounds, ground_plane, join
from jaxprt.systems.lobe import LobeTransport
from jaxprt.systems.separable import ClusteredTransport, SeparableSystem
from jaxprt.visibility import Run, StoredVisibility

LIGHTS = {"Grace": "grace_cross.hdr", "Eucalyptus": "eucalyptus_rnl_cross.hdr", "sun": "polyhaven_sunrise_1k.exr"}
BRDF = AshikhminShirley()
GROUND = Lambert(0.5)
# Terms, components, modes, coefficients, texels.
FRONT = [
    (8, 8, 32, 384, 4),
    (16, 12, 48, 512, 4),
    (32, 16, 64, 768, 8),
    (48, 16, 96, 768, 16),
    (64, 16, 96, 1024, 16),
    (64, 24, 128, 1024, 64),
    (96, 32, 192, 1536, 64),
    (128, 48, 256, 1536, 64),
]
RESOLUTION = 96  # of the BRDF's maps: 48 or 64 cost more error than half of 128 terms
LOBES = [(4, 4), (4, 8), (4, 16), (8, 8), (8, 16), (16, 16), (16, 64)]  # lobes, texels
CLUSTERS = 160
GROUND_KEEP = (16, 48, 768)  # components, modes, coefficients of its one term


class Part:
    """One object: its visibility, BRDF, factored BRDF and transport."""

    def __init__(self, visible: StoredVisibility | LobeTransport, brdf, factored, transport: ClusteredTransport):
        self.visible, self.brdf, self.factored, self.transport = visible, brdf, factored, transport
        self.system = SeparableSystem(transport, factored)


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--plot", type=pathlib.Path, metavar="FILE", help="draw the front")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    arguments = parser.parse_args(options)
    lines = [harness.report(line, arguments.output) for line in measure(arguments.quick, arguments.store)]
    if arguments.plot:
        plot(lines, arguments.plot)


def measure(quick: bool, store: pathlib.Path | None):
    """Lines of all configurations."""
    glossy, ground, lights = scene(quick)
    size = lights[0].radiance.shape[-2]
    whole = join([glossy, ground])
    count = len(glossy.position)
    views = eyes(glossy, 2 if quick else 20)
    front = [(4, 4, 16, 96, 2), (8, 8, 32, 192, 4)] if quick else FRONT
    clusters = 4 if quick else CLUSTERS
    repeats = 3 if quick else 15

    start = time.perf_counter()
    visible = [
        visibility.precompute(whole, size=size, vertex=vertex, run=Run(store and store / f"{name}.prt", progress=False))
        for name, vertex in (("glossy", np.arange(count)), ("ground", np.arange(count, len(whole.position))))
    ]
    rays = time.perf_counter() - start
    exact = [exact_radiance(part, brdf, lights, views) for part, brdf in zip(visible, (BRDF, GROUND), strict=True)]
    start = time.perf_counter()
    seen = [lobe.compress(each) for each in visible]  # Its bits serve single texels as well, in half the bytes.
    rays += time.perf_counter() - start

    start = time.perf_counter()
    most = np.max(front, 0)
    factored = separable.factor(BRDF, terms=int(most[0]), resolution=24 if quick else RESOLUTION)
    limit = (int(most[1]), int(most[2]), int(most[3]))
    parts = [compressed(visible[0], BRDF, factored, clusters, limit, store and store / "glossy-terms.prt")]
    limit = (4, 4, 96) if quick else GROUND_KEEP
    plain = separable.factor(GROUND, terms=1, resolution=8)
    parts.append(compressed(visible[1], GROUND, plain, clusters, limit, store and store / "ground-terms.prt"))
    seconds = rays + time.perf_counter() - start

    published_line, peer = measure_published(glossy, whole, exact, lights, views, quick)
    yield from published_line
    for terms, components, modes, keep, sun in front[:1] if quick else front:
        cut = parts[0].transport.truncate(keep, modes=modes, components=components, terms=terms)
        case = [Part(seen[0], BRDF, factored.truncate(terms), cut), Part(seen[1], GROUND, plain, parts[1].transport)]
        name = f"{terms} terms, {components} components, {modes} modes, {keep} coefficients, {sun} texels"
        stored = cut.nbytes + parts[1].transport.nbytes + sum(part.nbytes for part in seen)
        yield from report_case(name, case, sun, exact, lights, views, stored, seconds, repeats, peer)
    yield from measure_lobes(seen, exact, lights, views, rays, repeats, peer, quick)
    by_name = dict(zip(names(lights), lights, strict=True))
    yield from path_tracing.measure(glossy, ground, by_name, views[0], quick=quick)


def names(lights: list[Environment]) -> list[str]:
    """Of the real lights, or of the embedded ones."""
    return list(LIGHTS) if len(lights) == len(LIGHTS) else ["daylight", "studio"][: len(lights)]


def scene(quick: bool) -> tuple[Mesh, Mesh, list[Environment]]:
    """The glossy object, its ground and the lights."""
    data = harness.data()
    if quick or not data.is_dir():
        ball = builtin.sphere(rings=10, sectors=12)
        lights = [builtin.daylight(size=16), builtin.studio(size=16)]
        return ball, ground_plane(ball, vertices=100), lights[:1] if quick else lights
    bunny = load_mesh(data / "meshes" / "stanford_bunny.ply")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # negative pixels of lossy files
        return bunny, ground_plane(bunny), [load_environment(data / "env" / name) for name in LIGHTS.values()]


def eyes(mesh: Mesh, count: int) -> np.ndarray:
    """Viewers around an object, at four heights above the ground."""
    low, high = bounds(mesh)
    center, reach = (low + high) / 2, 1.6 * np.linalg.norm(high - low)
    turn = 2 * np.pi * np.arange(count) / count + 0.3
    rise = np.resize([0.15, 0.5, 0.3, 0.8], count)
    around = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1)
    return (center + reach * around).astype(np.float32)


class Exact(NamedTuple):
    """Radiance of one object by integration over all texels, and which of its vertices face each view."""

    radiance: np.ndarray  # [light, view, vertex, color]
    facing: np.ndarray  # [view, vertex]

    def squares(self, light: int, view: int, radiance) -> np.ndarray:
        """Squared norms of the error of radiance and of the exact one, over the vertices that face the view."""
        exact = self.radiance[light, view, self.facing[view]].astype(np.float64)
        return np.array([np.sum((np.asarray(radiance)[self.facing[view]] - exact) ** 2), np.sum(exact**2)])


def exact_radiance(visible: StoredVisibility, brdf, lights: list[Environment], views: np.ndarray) -> Exact:
    """What an object sends to all views under all lights."""
    batch = Environment(jnp.stack([light.radiance for light in lights]))
    result = np.zeros((len(lights), len(views), len(visible.position), 3), np.float32)
    for first in range(0, len(visible.position), 1024):
        part = np.arange(first, min(first + 1024, len(visible.position)))
        seen = jnp.asarray(visible.seen(part))
        for number, eye in enumerate(views):
            place, frame = visible.position[part], visible.frame[part]
            result[:, number, part] = reference.integrate(seen, place, frame, brdf, batch, jnp.asarray(eye))
    offset = views[:, None] - np.asarray(visible.position)
    return Exact(result, np.einsum("vi,wvi->wv", visible.frame[:, 2], offset) > 0)


def compressed(visible, brdf, factored, clusters: int, limit: tuple[int, int, int], path) -> Part:
    """Clustered transport of one object."""
    components, modes, keep = limit
    components = min(components, -(-len(visible.position) // clusters))
    modes = min(modes, components * factored.terms, keep)
    transport = separable.clustered.precompute(
        visible,
        factored,
        clusters=clusters,
        components=components,
        modes=modes,
        keep=keep,
        run=Run(path, progress=False),
    )
    return Part(visible, brdf, factored, transport)


@jax.jit
def change_light(system, visible, brdf, rest, texel, excess, view, eye):
    """Radiance of one object after a change of light: the view tuple is kept."""
    smooth = system.combine(system.light(rest), view)
    return smooth + bright_texels.radiance(visible, brdf, texel, excess, eye=eye)


@jax.jit
def change_view(system, visible, brdf, lit, texel, excess, eye):
    """Radiance of one object after a change of view: the light tuple is kept."""
    smooth = system.combine(lit, system.view(eye))
    return smooth + bright_texels.radiance(visible, brdf, texel, excess, eye=eye)


def report_case(name, parts: list[Part], sun, exact, lights, views, stored, precompute, repeats, peer):
    """One line for each light."""
    vertices, named = sum(part.visible.position.shape[0] for part in parts), names(lights)
    for number, light in enumerate(lights):
        texel, excess, rest = bright_texels.split(light, count=sun)
        lit = [part.system.light(rest) for part in parts]
        square = np.zeros(2)
        for place, eye in enumerate(jnp.asarray(views)):
            for at, part in enumerate(parts):
                now = change_view(part.system, part.visible, part.brdf, lit[at], texel, excess, eye)
                square += exact[at].squares(number, place, now)
        eye = jnp.asarray(views[0])
        view = [part.system.view(eye) for part in parts]

        def lighten(light=light, view=view, eye=eye):
            texel, excess, rest = bright_texels.split(light, count=sun)
            return [
                change_light(part.system, part.visible, part.brdf, rest, texel, excess, each, eye)
                for part, each in zip(parts, view, strict=True)
            ]

        def turn(lit=lit, texel=texel, excess=excess, eye=eye):
            return [
                change_view(part.system, part.visible, part.brdf, each, texel, excess, eye)
                for part, each in zip(parts, lit, strict=True)
            ]

        timing, other = harness.compare(lighten, peer[number][0], repeats=repeats)
        yield {
            **{"benchmark": "compression", "case": f"{name}, {named[number]}", "light": named[number]},
            "method": "clustered",
            **timing.line(),
            "view_seconds": harness.measure(turn, repeats=repeats).seconds,
            "error": float(np.sqrt(square[0] / square[1])),
            "bytes": stored,
            "bytes_per_vertex": stored / vertices,
            "precompute_seconds": precompute,
            **{"peer": "published", **other.peer(), "peer_error": peer[number][1]},
        }


def measure_lobes(seen, exact, lights, views, seconds, repeats, peer, quick: bool):
    """Lines of lobes, for the glossy object and for the ground."""
    stored, named = sum(each.nbytes for each in seen), names(lights)
    plain = lobe.tabulate(GROUND, lobes=1, resolution=8)
    for count, sun in [(1, 4)] if quick else LOBES:
        start = time.perf_counter()
        tables = [lobe.tabulate(BRDF, lobes=count, resolution=24 if quick else 32), plain]
        fitted = time.perf_counter() - start
        parts = list(zip(seen, tables, (BRDF, GROUND), strict=True))
        for number, light in enumerate(lights):
            texel, excess, rest = bright_texels.split(light, count=sun)
            blurred = lobe.blurred_light.prefilter(rest)

            def turn(eye=views[0], blurred=blurred, texel=texel, excess=excess, parts=parts):
                eye = jnp.asarray(eye)
                return [
                    lobe.system.combine(blurred, lobe.system.view_lobes(each, table, eye=eye))
                    + bright_texels.radiance(each, brdf, texel, excess, eye=eye)
                    for each, table, brdf in parts
                ]

            square = np.zeros(2)
            for place, each in enumerate(views):
                for at, now in enumerate(turn(eye=each)):
                    square += exact[at].squares(number, place, now)
            eye = jnp.asarray(views[0])
            view = [lobe.system.view_lobes(each, table, eye=eye) for each, table, _ in parts]

            def lighten(light=light, view=view, eye=eye, parts=parts, sun=sun):
                texel, excess, rest = bright_texels.split(light, count=sun)
                blurred = lobe.blurred_light.prefilter(rest)
                return [
                    lobe.system.combine(blurred, look) + bright_texels.radiance(each, brdf, texel, excess, eye=eye)
                    for look, (each, _, brdf) in zip(view, parts, strict=True)
                ]

            timing, other = harness.compare(lighten, peer[number][0], repeats=repeats)
            name = f"{count} lobes, {sun} texels, {named[number]}"
            yield {
                **{"benchmark": "compression", "case": name, "light": named[number], "lobes": count},
                "method": "lobes",
                **timing.line(),
                "view_seconds": harness.measure(turn, repeats=repeats).seconds,
                "error": float(np.sqrt(square[0] / square[1])),
                "bytes": stored,
                "bytes_per_vertex": stored / sum(len(each.position) for each in seen),
                "precompute_seconds": seconds,
                "fit_seconds": fitted,
                **{"peer": "published", **other.peer(), "peer_error": peer[number][1]},
            }


def measure_published(glossy, whole, exact, lights, views, quick: bool):
    """The published configuration: its lines, and for each light the timed change and its error."""
    count = len(glossy.position)
    size = lights[0].radiance.shape[-2]
    start = time.perf_counter()
    factored = [factor_symmetric(BRDF, terms=4, resolution=24 if quick else 48)]
    factored.append(separable.factor(GROUND, terms=1, resolution=8))
    vertex = [np.arange(count), np.arange(count, len(whole.position))]
    parts = [
        SeparableSystem(separable.precompute(whole, brdf, size=size, vertex=part, run=Run(progress=False)), brdf)
        for brdf, part in zip(factored, vertex, strict=True)
    ]
    seconds = time.perf_counter() - start
    eye = jnp.asarray(views[0])
    view = [part.view(eye) for part in parts]
    changes, lines, named = [], [], names(lights)
    for number, light in enumerate(lights):

        def lighten(light=light):
            return [part.combine(part.light(light), each) for part, each in zip(parts, view, strict=True)]

        lit = [part.light(light) for part in parts]

        def turn(eye=eye, lit=lit):
            return [part.combine(each, part.view(eye)) for part, each in zip(parts, lit, strict=True)]

        square = np.zeros(2)
        for place, each in enumerate(jnp.asarray(views)):
            for at, now in enumerate(turn(eye=each)):
                square += exact[at].squares(number, place, now)
        stored = sum(part.transport.nbytes for part in parts)
        error = float(np.sqrt(square[0] / square[1]))
        changes.append((lighten, error))
        lines.append(
            {
                **{"benchmark": "compression", "case": f"published, {named[number]}", "light": named[number]},
                "method": "published",
                **harness.measure(lighten, repeats=5).line(),
                "view_seconds": harness.measure(turn, repeats=5).seconds,
                "error": error,
                "bytes": stored,
                "bytes_per_vertex": stored / len(whole.position),
                "precompute_seconds": seconds,
            }
        )
    return lines, changes


def plot(lines: list[dict], path: pathlib.Path) -> None:
    """Error against milliseconds of a light change, one panel for each light."""
    from matplotlib import pyplot, ticker

    every = list(dict.fromkeys(line["light"] for line in lines))
    figure, axes = pyplot.subplots(1, len(every), figsize=(4.5 * len(every), 4), sharey=True, squeeze=False)
    for panel, light in zip(axes[0], every, strict=True):
        row = [line for line in lines if line["light"] == light]
        for label, method in (
            ("clustered, texels apart", "clustered"),
            ("lobes, texels apart", "lobes"),
            ("published: 4 terms of 96", "published"),
            (f"Mitsuba 3, {path_tracing.SAMPLES[0]} to {path_tracing.SAMPLES[-1]} samples", "Mitsuba 3"),
        ):
            chosen = [line for line in row if line["method"] == method]
            panel.loglog([1e3 * x["seconds"] for x in chosen], [x["error"] for x in chosen], "o-", label=label)
        for rate in (60, 30, 10):
            panel.axvline(1e3 / rate, color="gray", linewidth=0.5)
            panel.text(1e3 / rate, 1, f"{rate}/s", fontsize=7, rotation=90, va="top")
        panel.set(title=light, xlabel="milliseconds per light change")
        panel.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes[0, 0].set_ylabel("relative L2 error of radiance")
    axes[0, -1].legend(fontsize=7)
    figure.savefig(path, dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main()
