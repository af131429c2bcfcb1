"""Relights a scene by one system or more beside exact quadrature: pictures, errors, times and sizes."""

import itertools
import statistics
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxprt import files, image, scene
from jaxprt.brdf import Lambert
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.sphere import harmonics
from jaxprt.systems import bright_texels, harmonic, lobe, separable
from jaxprt.systems import reference as reference_system

TABLE_TERMS = (1, 4, 16, 64)
TABLE_KEEP = (32, 96, 256)
TABLE_ORDERS = (3, 5, 7, 10)
TABLE_LOBES = (4, 12, 24)
TABLE_TEXELS = (0, 16, 64)
_TEXELS = 16  # the brightest of the light, which the lobe system sums one by one
# Share of the squared Laplacian that the window "laplacian" leaves. About half of the negative vertices stay negative,
# at about the same error; the windows "hann" and "lanczos" leave fewer and always raise the error.
_LAPLACIAN = 0.4
WINDOWS: dict[str, Callable[[Array], Array]] = {
    "none": lambda light: jnp.ones(harmonics.degree_of(len(light)) + 1),
    "hann": lambda light: harmonics.hann(degree=harmonics.degree_of(len(light))),
    "lanczos": lambda light: harmonics.lanczos(degree=harmonics.degree_of(len(light))),
    "laplacian": lambda light: harmonics.least_laplacian(light, jnp.asarray(_LAPLACIAN)),
}
_AMPLIFY = 4.0  # brightness of the difference picture beside the others


class Part(NamedTuple):
    """Vertices of one material."""

    name: str
    mesh: Mesh
    brdf: Callable
    terms: int


class Scene(NamedTuple):
    """What the command relights."""

    parts: list[Part]
    lights: dict[str, Environment]
    camera: Camera

    @property
    def mesh(self) -> Mesh:
        """All parts as one mesh."""
        return scene.mesh.join([part.mesh for part in self.parts])


class Relit(NamedTuple):
    """A scene that one system has made ready.

    Attributes:
        light: The light side of every part, or of all as one: what is done again when the light changes.
        view: The view side: what is done again when the camera moves.
        combine: Radiance from the two.
        told: What it took, for the report.
    """

    light: Callable[[Environment], list]
    view: Callable[[], list]
    combine: Callable[[Any, Any], Array]
    told: dict[str, Any]

    def color(self, light: Environment) -> Array:
        """Radiance of all vertices, one part after another."""
        return jnp.concatenate([self.combine(*sides) for sides in zip(self.light(light), self.view(), strict=True)])


def relight_separable(whole: Scene, output: Path, *, keep: int) -> Relit:
    """Makes a scene ready for the separable system; transport is kept in the output folder."""
    factored = []
    ready = []
    told = {}
    for part in whole.parts:
        start = timeit.default_timer()
        factored.append(separable.factor(part.brdf, terms=part.terms))
        middle = timeit.default_timer()
        options = {"keep": keep, "occluder": whole.mesh, "path": _store(output, part, "")}
        ready.append(_kept(separable.precompute, part.mesh, factored[-1], **options))
        told[part.name] = {
            "terms": part.terms,
            "keep": keep,
            "factor_seconds": middle - start,
            "factor_error": float(factored[-1].error),
            **_took(middle, ready[-1]),
        }
    eye = whole.camera.eye
    return Relit(
        lambda light: [separable.light_tuple(each, light) for each in ready],
        lambda: [separable.view_tuple(t, f, eye) for t, f in zip(ready, factored, strict=True)],
        separable.combine,
        told,
    )


def relight_harmonic(whole: Scene, output: Path, *, order: int, window: str) -> Relit:
    """Makes a scene ready for the harmonic system: transfer vectors where it is diffuse, matrices where it is not."""
    degree = order - 1
    tables, ready, told = [], [], {}
    for part in whole.parts:
        options = {"degree": degree, "occluder": whole.mesh, "path": _store(output, part, f"_order_{order}")}
        start = timeit.default_timer()
        diffuse = isinstance(part.brdf, Lambert)
        made = part.brdf.albedo if isinstance(part.brdf, Lambert) else harmonic.tabulate(part.brdf, degree=degree)
        tables.append(made)
        middle = timeit.default_timer()
        precompute = harmonic.precompute_diffuse if diffuse else harmonic.precompute
        ready.append(_kept(precompute, part.mesh, **options))
        told[part.name] = {"coefficients": order**2, "window": window, "table_seconds": middle - start}
        told[part.name] |= _took(middle, ready[-1])
        if not diffuse:
            told[part.name] |= {"table_error": float(tables[-1].error), "table_bytes": tables[-1].nbytes}

    def light_side(light):
        # What is diffuse hardly rings, and a window would raise its error.
        plain, windowed = (harmonic_light(light, order=order, window=each) for each in ("none", window))
        return [
            plain if isinstance(each, harmonic.TransferVector) else harmonic.transferred_light(each, windowed)
            for each in ready
        ]

    def view_side():
        return [
            each.vector * table[:, None]
            if isinstance(each, harmonic.TransferVector)
            else harmonic.view_coefficients(table, each.position, each.frame, eye=whole.camera.eye)
            for each, table in zip(ready, tables, strict=True)
        ]

    return Relit(light_side, view_side, harmonic.combine, told)


def harmonic_light(light: Environment, *, order: int, window: str) -> Array:
    """Windowed coefficients of a light."""
    coefficient = harmonic.project(light, degree=order - 1)
    return harmonics.convolve(coefficient, WINDOWS[window](coefficient))


def relight_lobe(whole: Scene, output: Path, *, lobes: int) -> Relit:
    """Makes a scene ready for the lobe system, the brightest texels summed exactly; its transport fits any BRDF."""
    tables, ready, told = [], [], {}
    for part in whole.parts:
        start = timeit.default_timer()
        tables.append(_lobes(part.brdf, lobes))
        middle = timeit.default_timer()
        options = {"occluder": whole.mesh, "path": _store(output, part, "_lobe")}
        ready.append(_kept(lobe.precompute, part.mesh, **options))
        told[part.name] = {
            "lobes": 0 if isinstance(part.brdf, Lambert) else lobes,
            "exact_texels": _TEXELS,
            "table_seconds": middle - start,
            "table_error": float(tables[-1].error),
            "table_bytes": tables[-1].nbytes,
            **_took(middle, ready[-1]),
        }
    eye, samples = whole.camera.eye, [bright_texels.samples_for(part.brdf) for part in whole.parts]
    return Relit(
        lambda light: [_lobe_light(light, _TEXELS)] * len(ready),
        lambda: [
            _lobe_view(each, table, part.brdf, eye, count)
            for each, table, part, count in zip(ready, tables, whole.parts, samples, strict=True)
        ],
        _lobe_combine,
        told,
    )


def _lobes(model: Callable, lobes: int) -> lobe.LobeBrdf:
    """Lobes of a BRDF; what is diffuse needs none, but one without weight beside the diffuse part."""
    if not isinstance(model, Lambert):
        return lobe.tabulate(model, lobes=lobes)
    albedo = jnp.asarray(model.albedo)[:, None]
    none = jnp.zeros((1, 2), albedo.dtype)
    up = jnp.stack([none, none, none + 1])
    return lobe.LobeBrdf(up, none, 0 * albedo[..., None] + none, albedo + none, (), jnp.zeros((), albedo.dtype))


def _lobe_light(light: Environment, texels: int) -> tuple:
    """A light blurred but for some texels, and those."""
    if not texels:
        return (lobe.prefilter(light),)
    texel, excess, rest = bright_texels.split(light, count=texels)
    return lobe.prefilter(rest), texel, excess


def _lobe_view(ready: lobe.LobeTransport, table: lobe.LobeBrdf, model: Callable, eye: Array, samples: int) -> tuple:
    return lobe.look(ready, table, eye=eye), ready, model, eye, samples


def _lobe_combine(light: tuple, view: tuple) -> Array:
    (blurred, *bright), (look, ready, model, eye, samples) = light, view
    color = lobe.combine(blurred, look)
    return color + bright_texels.radiance(ready, model, *bright, eye=eye, samples=samples) if bright else color


def _store(output: Path, part: Part, suffix: str) -> Path:
    return output / f"{part.name.replace(' ', '_')}{suffix}.prt"


def _kept(precompute: Callable, *arguments: Any, path: Path, **options: Any) -> Any:
    """Precomputes, or says what to do about a folder that holds something else."""
    found = path.exists()
    try:
        return precompute(*arguments, path=path, **options)
    except ValueError as error:
        raise ValueError(f"{error}; here: name another --output" if found else str(error)) from error


def _took(start: float, ready: Any) -> dict[str, Any]:
    return {"transport_seconds": timeit.default_timer() - start, "transport_bytes": ready.nbytes}


def exact(whole: Scene, vertices: list[np.ndarray]) -> list[np.ndarray]:
    """Radiance by quadrature of some vertices of the first parts, [light v c]."""
    lights = _stack(whole.lights)
    options = {"eye": whole.camera.eye, "occluder": whole.mesh, "progress": True}
    return [
        np.asarray(reference_system.radiance(part.mesh, part.brdf, lights, vertex=vertex, **options))
        for part, vertex in zip(whole.parts, vertices, strict=False)
    ]


def visible(whole: Scene) -> np.ndarray:
    """Numbers of the triangles in the picture."""
    triangle = np.unique(np.asarray(image.rasterize(whole.mesh, whole.camera).triangle))
    return triangle[triangle >= 0]


def seen(whole: Scene) -> list[np.ndarray]:
    """Per part, the vertices of the triangles in the picture."""
    vertex = np.unique(np.asarray(whole.mesh.face)[visible(whole)])
    first = np.cumsum([0, *(len(part.mesh.position) for part in whole.parts)])
    return [vertex[(vertex >= a) & (vertex < b)] - a for a, b in itertools.pairwise(first)]


def compare(
    whole: Scene, name: str, ready: dict[str, Relit], truth: list[np.ndarray], vertices: list[np.ndarray], output: Path
) -> dict[str, Any]:
    """Writes the pictures of one light, and returns each system's errors.

    Args:
        whole: The scene.
        name: Name of the light.
        ready: The systems.
        truth: Radiance by quadrature of some vertices of every part.
        vertices: Those vertices: all that the picture shows.
        output: Folder of the pictures.
    """
    light = whole.lights[name]
    sky = scene.environment.background(light, image.ray_direction(whole.camera))
    everything = whole.mesh

    def draw(color):
        return image.render(everything, color, whole.camera, background=sky)

    full = [
        jnp.zeros((len(part.mesh.position), values.shape[-1])).at[vertex].set(values)
        for part, values, vertex in zip(whole.parts, truth, vertices, strict=True)
    ]
    surface = image.render(everything, jnp.ones((len(everything.position), 1)), whole.camera, background=None)
    reference = draw(jnp.concatenate(full))
    stops = image.automatic_exposure(reference * surface)
    told: dict[str, Any] = {"exposure_stops": float(stops)}
    pictures = {}
    for system, each in ready.items():
        color = each.color(light)
        pictures[system] = draw(color)
        parts = jnp.split(color, np.cumsum([len(part.mesh.position) for part in whole.parts])[:-1])
        told[system] = {
            "image_error": float(image.relative_l2(pictures[system] * surface, reference * surface)),
            "vertex_error": {
                part.name: float(image.relative_l2(mine[vertex], values))
                for part, mine, values, vertex in zip(whole.parts, parts, truth, vertices, strict=True)
            },
            "negative_vertices": int(jnp.sum(jnp.any(color < 0, -1))),
        }
        _write(output, f"{name}_{system}_difference", jnp.abs(pictures[system] - reference), stops, _AMPLIFY)
    for kind, picture in (pictures | {"reference": reference}).items():
        _write(output, f"{name}_{kind}", picture, stops, 1.0)
    row = jnp.concatenate([*pictures.values(), reference], 1)
    files.write_png(output / f"{name}.png", np.asarray(image.display(image.expose(row, stops=stops))))
    return told


def _write(output: Path, name: str, picture: Array, stops: Array, gain: float) -> None:
    files.write_exr(output / f"{name}.exr", np.asarray(picture))
    shown = image.display(image.expose(picture * gain, stops=stops))
    files.write_png(output / f"{name}.png", np.asarray(shown))


def times(whole: Scene, ready: Relit) -> dict[str, float]:
    """Median seconds of what a frame needs."""
    light = next(iter(whole.lights.values()))
    lit, seen, color, mesh = ready.light(light), ready.view(), ready.color(light), whole.mesh

    def combined(lights, views):
        return [ready.combine(*each) for each in zip(lights, views, strict=True)]

    return {
        "light_change_seconds": _median(lambda: combined(ready.light(light), seen)),
        "view_change_seconds": _median(lambda: combined(lit, ready.view())),
        "render_seconds": _median(lambda: image.render(mesh, color, whole.camera, background=None)),
    }


def _median(function: Callable[[], Any]) -> float:
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=7))


def sample(whole: Scene, count: int) -> np.ndarray:
    """Some vertices of the first part that face the eye."""
    mesh, eye = whole.parts[0].mesh, whole.camera.eye
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal * (eye - mesh.position)), 1) > 0)
    return np.random.default_rng(0).permutation(facing)[:count]


def table_separable(whole: Scene, vertex: np.ndarray, truth: np.ndarray) -> list[dict[str, Any]]:
    """Error against terms and kept coefficients on some vertices of the first part."""
    part, eye = whole.parts[0], whole.camera.eye
    factored = separable.factor(part.brdf, terms=max(TABLE_TERMS))
    full = separable.precompute(part.mesh, factored, keep=max(TABLE_KEEP), occluder=whole.mesh, vertex=vertex)
    rows = []
    for terms, keep in itertools.product(TABLE_TERMS, TABLE_KEEP):
        few, short = factored.keep(terms), full.keep(keep, terms=terms)
        light = next(iter(whole.lights.values()))
        seconds = _median(lambda t=short, e=light: separable.light_tuple(t, e))
        row = {"system": "separable", "terms": terms, "keep": keep}
        row |= _cost(short.nbytes, seconds, len(vertex))
        for number, (name, each) in enumerate(whole.lights.items()):
            mine = separable.radiance(short, few, each, eye=eye)
            row[f"error {name}"] = float(image.relative_l2(mine, truth[number]))
        rows.append(row)
    return rows


def table_harmonic(whole: Scene, vertex: np.ndarray, truth: np.ndarray) -> list[dict[str, Any]]:
    """Error against the order of the harmonics, windowed and not, on some vertices of the first part."""
    part, eye = whole.parts[0], whole.camera.eye
    degree = max(TABLE_ORDERS) - 1
    table = harmonic.tabulate(part.brdf, degree=degree)
    full = harmonic.precompute(part.mesh, degree=degree, occluder=whole.mesh, vertex=vertex)
    rows = []
    for order, window in itertools.product(TABLE_ORDERS, WINDOWS):
        matrix = full.matrix[..., : order**2, : order**2]
        short = harmonic.TransferMatrix(matrix, full.position, full.frame)
        few = table.truncate(degree=order - 1)
        row = {"system": "harmonic", "coefficients": order**2, "window": window}
        light = harmonic_light(next(iter(whole.lights.values())), order=order, window=window)
        seconds = _median(lambda t=short, e=light: harmonic.transferred_light(t, e))
        row |= _cost(short.nbytes, seconds, len(vertex))
        for number, (name, each) in enumerate(whole.lights.items()):
            light = harmonic_light(each, order=order, window=window)
            mine = harmonic.radiance(short, few, light, eye=eye)
            row[f"error {name}"] = float(image.relative_l2(mine, truth[number]))
        rows.append(row)
    return rows


def table_lobe(whole: Scene, vertex: np.ndarray, truth: np.ndarray) -> list[dict[str, Any]]:
    """Error against lobes and exact texels on some vertices of the first part."""
    part, eye = whole.parts[0], whole.camera.eye
    full = lobe.precompute(part.mesh, occluder=whole.mesh, vertex=vertex)
    samples = bright_texels.samples_for(part.brdf)
    views = {lobes: _lobe_view(full, _lobes(part.brdf, lobes), part.brdf, eye, samples) for lobes in TABLE_LOBES}
    rows = []
    for (lobes, view), texels in itertools.product(views.items(), TABLE_TEXELS):
        light = next(iter(whole.lights.values()))
        seconds = _median(lambda e=light, v=view, t=texels: _lobe_combine(_lobe_light(e, t), v))
        row = {"system": "lobe", "lobes": lobes, "exact_texels": texels}
        row |= _cost(full.nbytes, seconds, len(vertex))
        for number, (name, each) in enumerate(whole.lights.items()):
            mine = _lobe_combine(_lobe_light(each, texels), view)
            row[f"error {name}"] = float(image.relative_l2(mine, truth[number]))
        rows.append(row)
    return rows


def _cost(size: int, seconds: float, count: int) -> dict[str, float]:
    return {"bytes_per_vertex": size / count, "light_change_nanoseconds_per_vertex": seconds / count * 1e9}


def _stack(lights: dict[str, Environment]) -> Environment:
    return jax.tree.map(lambda *each: jnp.stack(each), *lights.values())
