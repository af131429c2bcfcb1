"""Wang, Tran and Luebke 2004: Figures 1, 3 and 4, Table 2, and a surface whose BRDF varies.

The published form: eigenvectors of each color's BRDF matrix on the 48 x 48 disk, 4 terms, 96 wavelet coefficients, and
light of 6 x 64 x 64 texels. Vertices that a picture shows are relit; the picture interpolates them, as in the paper.
Errors are relative L2 of the radiance of vertices, against the integral over all texels with the same visibility.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness, tables
from benchmarks.figures import drawing
from benchmarks.figures.run import Run
from benchmarks.published.factorization import (
    brown_plastic,
    factor_normalized,
    factor_symmetric,
    red_plastic,
    sample_error,
)
from jaxprt import image, reference, separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert, load_lafortune
from jaxprt.scene import Environment, Mesh, builtin, camera
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.sphere import cubemap, directions
from jaxprt.systems.protocol import Blend
from jaxprt.systems.separable import SeparableBrdf, SparseTransport

EDGE, TERMS, KEEP = 512, 4, 96
GLOSSY = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100)
RESOLUTIONS = (16, 24, 32, 48, 64)
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16)
KEEPS = (32, 64, 96, 128, 256, 512, 2048)
_BLOCK = 512  # vertices at once
_FEW = 400  # vertices at which errors are measured


class Stage:
    """A mesh on a ground, and what its vertices that a picture shows see.

    Attributes:
        whole: Both meshes in one.
        drawn: What pictures show: both, or the mesh alone if only its vertices are relit.
        view: The camera.
        shown: Numbers of the vertices that the picture shows, of the mesh or of the ground.
        seen: What these see.
    """

    def __init__(
        self, run: Run, name: str, mesh: Mesh, *, ground: int, azimuth: float, part: str = "both", wide: float = 1.0
    ):
        """Traces what is not in the store."""
        below = ground_plane(mesh, vertices=100 if run.quick else ground)
        self.whole = join([mesh, below])
        self.drawn = mesh if part == "mesh" else self.whole
        edge = 16 if run.quick else EDGE
        self.view = camera.orbit(mesh, azimuth=azimuth, elevation=0.35, width=edge, height=edge)
        self.view = dataclasses.replace(self.view, field_of_view=wide * self.view.field_of_view)
        fragments = image.rasterize(self.whole, self.view, samples=4)
        triangle = np.unique(np.asarray(fragments.triangle))
        vertex = np.unique(np.asarray(self.whole.face)[triangle[triangle >= 0]])
        own = vertex < len(mesh.position)
        self.shown = {"mesh": vertex[own], "ground": vertex[~own], "both": vertex}[part]
        self.own = self.shown < len(mesh.position)
        self.seen = visibility.precompute(
            self.whole,
            size=8 if run.quick else 64,
            vertex=self.shown,
            run=prt.Run(run.keep(f"{name}_{part}_{wide:g}.prt"), progress=False),
        )

    def relit(
        self,
        factored: SeparableBrdf,
        light: Environment,
        number: np.ndarray,
        keep: int = KEEP,
        *,
        weight: np.ndarray | None = None,
    ) -> tuple[np.ndarray, int]:
        """Radiance of some of the shown vertices by sparse transport, and its bytes.

        `weight` has the weights of the BRDF's channels at all shown vertices, [v, k, c].
        """
        result, size, eye = [], 0, jnp.asarray(self.view.eye)
        for first in range(0, len(number), _BLOCK):
            part = np.resize(number[first : first + _BLOCK], _BLOCK)
            transport = self.transport(factored, part, keep)
            size += transport.nbytes
            system = separable.SeparableSystem(transport, factored)
            color = prt.radiance(system, light, eye=eye, materials=None if weight is None else Blend(weight[part]))
            result.append(np.asarray(color)[: len(number) - first])
        return np.concatenate(result), size

    def transport(self, factored: SeparableBrdf, part: np.ndarray, keep: int) -> SparseTransport:
        """Transport of a block of vertices, as published, from stored visibility."""
        level, frame = self.seen.seen(part), self.seen.frame[part]
        index, value = separable.sparse.compress(level, frame, factored, keep=min(keep, level.shape[1]))
        rms = separable.sparse.rms(index, value, level.shape[1])
        return SparseTransport(index, value, self.seen.position[part], frame, rms)

    def exact(self, brdf: Callable, light: Environment, number: np.ndarray) -> np.ndarray:
        """The integral over all texels at some of the shown vertices."""
        result = []
        for first in range(0, len(number), 64):
            part = np.resize(number[first : first + 64], 64)
            frame = (jnp.asarray(self.seen.seen(part)), self.seen.position[part], self.seen.frame[part])
            color = reference.integrate(*frame, brdf, Environment(light.radiance[None]), self.view.eye)
            result.append(np.asarray(color)[0, : len(number) - first])
        return np.concatenate(result)

    def draw(self, color: np.ndarray, *, other: Any = 0.0) -> np.ndarray:
        """A picture of the colors of the shown vertices, with its coverage; others have colors of their own."""
        every = np.zeros((len(self.drawn.position), 3), np.float32) + np.asarray(other, np.float32)
        every[self.shown] = color
        fragments = image.rasterize(self.drawn, self.view, samples=4)
        pixels = image.shading_points(fragments, self.drawn, self.view)
        colors = image.interpolate(pixels, self.drawn.face, jnp.asarray(every))
        drawn = np.asarray(image.resolve(pixels, colors))
        return np.concatenate([drawn, 1 - np.asarray(pixels.background)[..., None]], -1)


def few(number: np.ndarray, run: Run) -> np.ndarray:
    """Some of the numbers, at random."""
    return np.sort(np.random.default_rng(0).permutation(number)[: 20 if run.quick else _FEW])


def off(color: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(color - exact) / np.linalg.norm(exact))


def colored(brdf: AshikhminShirley) -> AshikhminShirley:
    """A gray BRDF in three equal colors."""
    return dataclasses.replace(brdf, diffuse=jnp.full(3, brdf.diffuse[0]), specular=jnp.full(3, brdf.specular[0]))


def figure_1(run: Run) -> Iterator[dict[str, Any]]:
    """The dragon in Uffizi and the bunny in Grace, on diffuse grounds, with 4 terms of 96 coefficients."""
    pictures, captions = [], []
    maps = 12 if run.quick else 48
    ground = factor_normalized(Lambert(0.5), resolution=16)
    for name, file, brdf, light, azimuth in (
        ("dragon", "dragon_100k.ply", GLOSSY, "uffizi", 0.3),
        ("bunny", "stanford_bunny.ply", red_plastic(), "grace", 0.2),
    )[: 1 if run.quick else 2]:
        stage = Stage(run, name, run.mesh(file), ground=22_000, azimuth=azimuth)
        sky = run.light(light)
        factored = factor_symmetric(brdf, terms=TERMS, resolution=maps)
        own, below = np.flatnonzero(stage.own), np.flatnonzero(~stage.own)
        color = np.zeros((len(stage.shown), 3), np.float32)
        color[own], _ = stage.relit(factored, sky, own)
        color[below], _ = stage.relit(ground, sky, below)
        test = few(own, run)
        wrong = off(color[test], stage.exact(brdf, sky, test))
        test = few(below, run)
        flat = off(color[test], stage.exact(Lambert(0.5), sky, test))
        drawn = stage.draw(color)
        pictures.append(drawing.on_white(drawn, stops=image.automatic_exposure(jnp.asarray(drawn[..., :3]))))
        captions.append(f"{name}, {light}: {100 * wrong:.0f} % off, its ground {100 * flat:.0f} %")
        yield {
            **{"mesh": name, "light": light, "error": wrong, "ground_error": flat, "vertices": len(stage.shown)},
            "negative": float(np.mean(np.any(color[own] < 0, -1))),
        }
    drawing.sheet(run.picture("wang2004_figure_1.jpg"), [pictures], [captions])


SUN, RADIUS, STRENGTH, SKY = np.array([-0.62, 0.62, -0.48]), 0.05, 400.0, 0.3
TINT = np.array([1.0, 0.95, 0.9])


def sun(size: int) -> Environment:
    """A sun of three degrees radius in a gray sky."""
    disk = cubemap.direction(size=size) @ directions.normalize(jnp.asarray(SUN)) > np.cos(RADIUS)
    return Environment(jnp.where(disk[..., None], STRENGTH, SKY) * TINT)


def matte(mesh: Mesh) -> np.ndarray:
    """Radiance of matte vertices in the same light without shadows."""
    height = np.maximum(np.asarray(mesh.normal) @ (SUN / np.linalg.norm(SUN)), 0)
    return 0.5 * (STRENGTH * np.sin(RADIUS) ** 2 * height + SKY)[:, None] * TINT


def figure_3(run: Run) -> Iterator[dict[str, Any]]:
    """The bunny's shadow on the ground by the number of wavelet coefficients."""
    stage = Stage(run, "bunny", run.mesh("stanford_bunny.ply"), ground=22_000, azimuth=0.2, part="ground", wide=1.5)
    size = stage.seen.size
    light, number = sun(size), np.arange(len(stage.shown))
    ground = factor_normalized(Lambert(0.5), resolution=16)
    keeps = (8, 32) if run.quick else KEEPS
    blocks: dict[int, list] = {keep: [] for keep in keeps}
    for first in range(0, len(number), _BLOCK):
        part = np.resize(number[first : first + _BLOCK], _BLOCK)
        most = stage.transport(ground, part, max(keeps))
        for keep in keeps:
            cut = dataclasses.replace(most, value=most.value * (np.arange(max(keeps)) < keep)[:, None, None, None])
            color = prt.radiance(separable.SeparableSystem(cut, ground), light, eye=jnp.asarray(stage.view.eye))
            blocks[keep].append(np.asarray(color)[: len(number) - first])
    exact = stage.exact(Lambert(0.5), light, number)
    radiance = {keep: np.concatenate(each) for keep, each in blocks.items()}
    stops, pictures, captions = None, [], []
    lit = np.linalg.norm(exact, axis=-1)
    rim = (lit > 0.15 * lit.max()) & (lit < 0.85 * lit.max())
    for keep, color in [(0, exact), *radiance.items()]:
        drawn = stage.draw(color, other=matte(stage.whole))
        stops = image.automatic_exposure(jnp.asarray(drawn[..., :3])) if stops is None else stops
        pictures.append(drawing.on_white(drawn, stops=stops))
        share = keep / (6 * size**2)
        if keep:
            wrong = off(color, exact)
            captions.append(f"{keep} coefficients ({share:.2%})\n{100 * wrong:.1f} % off")
            yield {"keep": keep, "share": share, "error": wrong, "penumbra_error": off(color[rim], exact[rim])}
    pictures, captions = [*pictures[1:], pictures[0]], [*captions, "all\n"]
    half = -(-len(pictures) // 2)
    drawing.sheet(
        run.picture("wang2004_figure_3.jpg"), [pictures[:half], pictures[half:]], [captions[:half], captions[half:]]
    )


def materials(run: Run) -> dict[str, Callable]:
    """The four BRDFs of Figure 4."""
    path = harness.data() / "brdf" / "lafortune_measured.json"
    named = {"Ashikhmin-Shirley": GLOSSY, "light brown plastic": brown_plastic()}
    if run.quick:
        return named
    return {**named, "Lafortune clay": load_lafortune(path, "clay"), "Lafortune skin": load_lafortune(path, "skin")}


def figure_4(run: Run) -> Iterator[dict[str, Any]]:
    """Cosine-weighted rms error of four BRDFs by number of terms, for five resolutions, and the first eight maps."""
    from matplotlib import pyplot

    resolutions, counts = ((12, 16), (1, 2)) if run.quick else (RESOLUTIONS, COUNTS)
    named = materials(run)
    figure, axes = pyplot.subplots(1, len(named), figsize=(4 * len(named), 3.6), dpi=100)
    rows, captions = [], []
    for axis, (name, brdf) in zip(axes, named.items(), strict=True):
        for resolution in resolutions:
            factored = factor_symmetric(brdf, terms=max(counts), resolution=resolution)
            each = []
            for count in counts:
                kept = (jnp.arange(max(counts)) < count)[:, None, None, None]
                cut = dataclasses.replace(factored, view_map=factored.view_map * kept)
                absolute, relative = sample_error(brdf, cut)
                each.append(float(absolute))
                yield {
                    **{"brdf": name, "resolution": resolution, "terms": count},
                    **{"rms": float(absolute), "relative": float(relative)},
                }
            axis.plot(counts, each, ".-", label=f"{resolution} x {resolution}")
            if resolution == 48 or run.quick:
                rows.append([light_map(factored.light_map[k]) for k in range(min(8, max(counts)))])
                captions.append([name if k == 0 else f"{k + 1}" for k in range(len(rows[-1]))])
        axis.set(title=name, xlabel="terms", ylabel="cosine-weighted rms error in 1/sr", ylim=(0, None))
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(run.picture("wang2004_figure_4_errors.png"))
    pyplot.close(figure)
    drawing.sheet(run.picture("wang2004_figure_4_maps.jpg"), rows, captions)


def light_map(value: Any) -> np.ndarray:
    """Absolute values of a light map, each texel as a square of pixels, white outside the disk."""
    value = np.abs(np.asarray(value))
    edge = len(value)
    inside = np.hypot(*np.mgrid[1 - edge : edge : 2, 1 - edge : edge : 2]) < edge - 1
    color = np.broadcast_to(value / np.quantile(value[inside], 0.97), (edge, edge, 3))
    color = np.where(inside[..., None], np.asarray(image.display(jnp.asarray(color))), 1)
    return np.kron(color, np.ones((4, 4, 1)))


def figure_4_bunny(run: Run) -> Iterator[dict[str, Any]]:
    """The bunny by the first four terms of four BRDFs, each in a light, beside the exact picture."""
    mesh = run.mesh("stanford_bunny.ply")
    stage = Stage(run, "bunny", mesh, ground=22_000, azimuth=0.2, part="mesh")
    number = np.arange(len(stage.shown))
    pictures, captions = [], []
    for (name, brdf), light in zip(
        materials(run).items(), ("grace", "eucalyptus", "st_peters", "uffizi"), strict=False
    ):
        sky = run.light(light)
        factored = factor_symmetric(brdf, terms=TERMS, resolution=12 if run.quick else 48)
        color, _ = stage.relit(factored, sky, number)
        test = few(number, run)
        wrong = off(color[test], stage.exact(brdf, sky, test))
        drawn = stage.draw(color)
        pictures.append(drawing.on_white(drawn, stops=image.automatic_exposure(jnp.asarray(drawn[..., :3]))))
        captions.append(f"{name}, {light}: {100 * wrong:.0f} % off")
        yield {"brdf": name, "light": light, "error": wrong, "terms": TERMS, "vertices": len(number)}
    drawing.sheet(run.picture("wang2004_figure_4_bunny.jpg"), [pictures], [captions])


BASIS = {  # of a surface whose BRDF varies, with the color of each
    "matte": (Lambert(1.0), (0.05, 0.12, 0.35)),
    "brushed across": (AshikhminShirley(diffuse=0.0, specular=0.75, nu=10, nv=100), (1.0, 0.75, 0.35)),
    "brushed along": (AshikhminShirley(diffuse=0.0, specular=0.75, nu=100, nv=10), (0.95, 0.6, 0.5)),
}


def bands(position: np.ndarray) -> np.ndarray:
    """Weights of `BASIS` [v, k, c]: bands that follow one another from below, with soft edges."""
    place = (position - position.min(0)) / np.ptp(position, axis=0).max()
    phase = 22 * (place[:, 1] + 0.06 * np.sin(9 * place[:, 0]) + 0.06 * np.sin(7 * place[:, 2]))
    share = np.exp(6 * np.cos(phase[:, None] - 2 * np.pi * np.arange(len(BASIS)) / len(BASIS)))
    share /= share.sum(1, keepdims=True)
    return (share[..., None] * [color for _, color in BASIS.values()]).astype(np.float32)


def side_by_side(factored: Sequence[SeparableBrdf]) -> SeparableBrdf:
    """The terms of several gray BRDFs, each of which has a channel of its own."""
    channel = jnp.eye(len(factored))
    view = [one.view_map * channel[number] for number, one in enumerate(factored)]
    error = jnp.max(jnp.stack([one.error for one in factored]))
    return SeparableBrdf(
        jnp.concatenate([one.light_map for one in factored]), jnp.concatenate(view), error, factored[0].coordinates
    )


def varying(run: Run) -> Iterator[dict[str, Any]]:
    """The bunny in bands of a matte and two brushed BRDFs: a sum of BRDFs with weights of each vertex, section 3."""
    stage = Stage(run, "bunny", run.mesh("stanford_bunny.ply"), ground=22_000, azimuth=0.2, part="mesh")
    number, sky = np.arange(len(stage.shown)), run.light("grace")
    weight = bands(np.asarray(stage.seen.position))
    parts = [stage.exact(brdf, sky, number) for brdf, _ in BASIS.values()]
    exact = np.sum(weight * np.stack(parts, 1), 1)
    pictures, captions, test = [], [], few(number, run)
    for count in (1, TERMS, 16):
        each = [1 if name == "matte" else count for name in BASIS]
        factored = side_by_side(
            [
                factor_symmetric(brdf, terms=terms, resolution=12 if run.quick else 48)
                for (brdf, _), terms in zip(BASIS.values(), each, strict=True)
            ]
        )
        color, size = stage.relit(factored, sky, number, weight=weight)
        wrong = off(color[test], exact[test])
        pictures.append(stage.draw(color))
        captions.append(f"{count} for each brushed BRDF: {100 * wrong:.0f} % off")
        yield {"terms": sum(each), "of_each": count, "error": wrong, "bytes_of_a_vertex": size // len(number)}
    pictures.append(stage.draw(exact))
    stops = image.automatic_exposure(jnp.asarray(pictures[-1][..., :3]))
    drawing.sheet(
        run.picture("wang2004_varying.jpg"),
        [[drawing.on_white(drawn, stops=stops) for drawn in pictures]],
        [[*captions, "exact"]],
    )


def table_2(run: Run) -> Iterator[dict[str, Any]]:
    """Precomputation, and frames of a new view and a new light, with drawing: `benchmarks.tables`."""
    if run.quick:
        ball = builtin.sphere(rings=8, sectors=16)
        cases = [("ball", ball, ground_plane(ball, vertices=100), 256, None)]
    else:
        cases = [tables.case(name) for name in tables.PUBLISHED]
    for case in cases:
        yield from tables.measure(*case, size=16 if run.quick else tables.SIZE, repeats=3 if run.quick else 9)
