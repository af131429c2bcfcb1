"""Sun et al. 2007: Figures 4 to 7, and the principal components of section 4.3.

A tensor of a set of BRDFs is [BRDF, view, light]. Two norms tell what a decomposition of it leaves. The published one
is Frobenius' norm of the samples on the orthographic disk. Ours is that of the light of natural spectrum which the
BRDFs reflect. Errors are squared and relative, as the paper prints them.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.figures import drawing
from benchmarks.figures.run import Clock, Run
from benchmarks.published import maps
from benchmarks.published.lobes import BrdfSet, SetMember, mirror_lobes
from benchmarks.published.tensors import hooi
from jaxprt import dynamic, image
from jaxprt.brdf import navigation
from jaxprt.decompose import tucker
from jaxprt.scene import Environment, Mesh, builtin, camera
from jaxprt.scene.environment import background
from jaxprt.sphere import cubemap, directions
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.separable.factorization import tabulate

SETS = (1, 2, 3, 4, 5, 6)  # n_h
TERMS = (4, 8, 12, 16, 20, 24, 28, 32)  # n_wi = n_wo
ANGLES = (0, 7, 14, 21)
RESOLUTION = 24  # of maps, in texels
SEPARATED = (0.02, 0.09)  # roughness of the materials of Figure 4
ANGLE = np.radians(np.linspace(-89.5, 89.5, 359))
MEMBERS = 20  # of the set of Figure 6, at equal steps of their order by roughness
NODES = 16  # of tables of lobes over the view angle
# What the paper prints: no lobes at the finest ranks, and five functions of the two sets.
FINEST, PRINCIPAL = 0.952465, {"Cook-Torrance": 6.23e-4, "Blinn-Phong": 1.61e-7}


def measured(run: Run) -> navigation.Family:
    """The fits of Ngan et al.; the embedded grid in a quick run, with a few BRDFs."""
    path = harness.data() / "brdf" / "ngan2005_cooktorrance.csv"
    if not run.quick:
        return navigation.cook_torrance(path=path)
    return navigation.cook_torrance(point=np.array([(f, m) for f in (0.05, 1.0) for m in (0.1, 0.2, 0.5)]))


def place_of(brdf: Any) -> tuple[float, float]:
    """Fresnel reflectance and roughness of one of the set."""
    return float(brdf.f0[0]), float(brdf.roughness)


def figure_4(run: Run) -> Iterator[dict[str, Any]]:
    """Two measured materials on a ball and in the plane of incidence: whole, without lobes, and lobes one by one."""
    family, light = measured(run), run.light("grace", size=64)
    edge, rings = (16, 8) if run.quick else (208, 80)
    ball = builtin.sphere(rings=rings, sectors=2 * rings)
    view = camera.orbit(ball, elevation=0.2, width=edge, height=edge)
    rows, captions = [], []
    for roughness in SEPARATED:
        number = min(
            range(len(family.brdf)), key=lambda index: abs(np.log(place_of(family.brdf[index])[1] / roughness))
        )
        brdf = family.brdf[number]
        table = mirror_lobes(brdf, angles=ANGLES, resolution=8 if run.quick else NODES)
        color = components(brdf, table, ball, light, np.asarray(view.eye))
        values, titles, pictures = incidence(brdf, table), [], []
        for name, radiance in color.items():
            share, norm = (float(size(radiance) / size(color["original"])) for size in (np.sum, np.linalg.norm))
            label = f"{family.name[number]}\nm = {place_of(brdf)[1]:.3g}" if name == "original" else name
            titles.append(label if name == "original" else f"{label}\n{100 * share:.0f} % of the light")
            drawn = image.render(ball, jnp.asarray(radiance), view)
            pictures.append(np.asarray(drawn))
            yield {"material": family.name[number], "component": name, "share": share, "norm": norm}
        rows.append([drawing.shown(picture, like=pictures[0]) for picture in pictures])
        rows.append([slice_of(values[name], values["original"], edge) for name in color])
        captions += [titles, [""] * len(titles)]
    drawing.sheet(run.picture("sun2007_figure_4.jpg"), rows, captions)


def components(brdf: Any, table: LobeBrdf, ball: Mesh, light: Environment, eye: np.ndarray) -> dict[str, np.ndarray]:
    """Radiance [v 3] of a ball without shadows: of a BRDF, of what lobes leave, and of its lobes; 0 where unseen."""
    toward = directions.normalize(jnp.asarray(eye) - ball.position)
    seen = np.flatnonzero(np.sum(np.asarray(ball.normal) * np.asarray(toward), 1) > 0)
    axes = directions.frame(ball.normal, ball.tangent)[seen]
    wo = jnp.einsum("vij,vj->vi", axes, toward[seen])
    mirror = np.asarray(jnp.einsum("vij,vi->vj", axes, wo * jnp.array([-1, -1, 1])))
    lobes = table.lookup(wo)
    sent = {}
    for index, angle in enumerate(ANGLES):
        weight = np.asarray(lobes.weight[:, index]).T
        sent[f"{angle}°"] = weight * blurred(light, mirror, float(lobes.concentration[index, 0]))
    whole = np.broadcast_to(drawing.unshadowed(ball, brdf, light, eye, seen), (len(seen), 3))
    parts = {"original": whole, "without lobes": whole - sum(sent.values()), **sent}
    blank = np.zeros((len(ball.position), 3), np.float32)
    result = {name: blank.copy() for name in parts}
    for name, radiance in parts.items():
        result[name][seen] = radiance
    return result


def blurred(light: Environment, direction: np.ndarray, concentration: float) -> np.ndarray:
    """Means of the light, weighted by a lobe around each direction [v 3]; the light itself if texels are wider."""
    size = light.radiance.shape[-2]
    if concentration > size**2 * 4:
        return np.asarray(background(light, jnp.asarray(direction)))
    texel = np.asarray(cubemap.direction(size=size)).reshape(-1, 3)
    radiance, area = np.asarray(light.radiance).reshape(-1, 3), np.asarray(cubemap.solid_angle(size=size)).ravel()
    result = []
    for block in np.array_split(direction, max(1, len(direction) // 512)):
        weight = np.exp(concentration * (block @ texel.T - 1)) * area
        result.append(weight @ radiance / weight.sum(1, keepdims=True))
    return np.concatenate(result)


def incidence(brdf: Any, table: LobeBrdf) -> dict[str, np.ndarray]:
    """BRDF x cosine over `ANGLE` in the plane of incidence of a view at 45 degrees: whole, left by lobes, and lobes."""
    wi = jnp.asarray(np.stack([np.sin(ANGLE), 0 * ANGLE, np.cos(ANGLE)], -1), jnp.float32)
    wo = jnp.broadcast_to(jnp.asarray([-np.sqrt(0.5), 0, np.sqrt(0.5)], jnp.float32), wi.shape)
    whole, lobes = np.asarray(brdf(wi, wo))[:, 0] * np.asarray(wi[:, 2]), table.lookup(wo)
    sent = {}
    for index, angle in enumerate(ANGLES):
        alone = (jnp.arange(len(ANGLES)) == index)[:, None]
        one = eqx.tree_at(lambda lobe: lobe.weight, lobes, lobes.weight * alone)
        sent[f"{angle}°"] = np.asarray(one.evaluate(wi))[0]
    return {"original": whole, "without lobes": whole - sum(sent.values()), **sent}


def slice_of(value: np.ndarray, whole: np.ndarray, edge: int) -> np.ndarray:
    """A polar plot over `ANGLE`: the square root as radius, so that wide lobes are seen; red where it is negative."""
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(edge / 100, 0.55 * edge / 100), dpi=100)
    axis = figure.add_axes((0, 0, 1, 1))
    most = np.sqrt(whole.max())
    for part, color in ((whole, "0.8"), (np.maximum(value, 0), "C0"), (np.maximum(-value, 0), "C3")):
        radius = np.sqrt(part) / most
        axis.fill(np.sin(ANGLE) * radius, np.cos(ANGLE) * radius, color=color)
    axis.plot([-1, 1], [0, 0], color="0.4", linewidth=1)
    axis.plot([0, -0.7], [0, 0.7], color="0.4", linewidth=1, linestyle=":")
    axis.set(xlim=(-0.85, 0.85), ylim=(-0.08, 0.86))
    axis.set_aspect("equal")
    axis.set_axis_off()
    figure.canvas.draw()
    drawn = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0  # pyright: ignore[reportAttributeAccessIssue]
    pyplot.close(figure)
    return drawn


def figure_5(run: Run) -> Iterator[dict[str, Any]]:
    """What 48 settings leave, in both norms, without lobes and with the published ones."""
    brdfs = measured(run).brdf
    sets, terms = ((1, 2), (4, 8)) if run.quick else (SETS, TERMS)
    resolution = 8 if run.quick else RESOLUTION
    lobes = separated(run, brdfs, ANGLES)
    lines = []
    for name, table in (("none", None), ("published", lobes)):
        for norm, make in (("disk", samples), ("natural light", reflected)):
            tensor, whole = make(brdfs, table, resolution=resolution)
            clock = Clock()
            left = settings(tensor, whole, sets, terms)
            most = (max(sets), max(terms), max(terms))
            swept = best(tensor, whole, most)
            for (count, rank), squared in left.items():
                lines.append({"lobes": name, "norm": norm, "n_h": count, "n_w": rank, "squared_error": squared})
                yield {**lines[-1], "brdfs": len(brdfs), "seconds": clock.seconds}
            yield {"lobes": name, "norm": norm, "ranks": list(most), "iterated_squared_error": swept}
    plot_5(lines, run)
    for edge in (8,) if run.quick else (16, 24, 32, 48):
        yield {"norm": "disk", "lobes": "none", "resolution": edge, **sharpest(brdfs, edge, max(terms))}


def sharpest(brdfs: Sequence, resolution: int, terms: int) -> dict[str, float]:
    """Squared relative error of the sharpest BRDF alone by some terms, and the share of squares at grazing views."""
    brdf = min(brdfs, key=lambda each: place_of(each)[1])
    table, whole = samples([brdf], None, resolution=resolution)
    matrix = np.asarray(table[0], np.float64)
    square = np.linalg.svd(matrix, compute_uv=False)[:terms] ** 2
    direction = maps.texel_direction(resolution=resolution).reshape(-1, 3)
    inside = np.flatnonzero(np.asarray(maps.texel_area(resolution=resolution)).ravel())
    grazing = np.asarray(direction)[inside, 2] < np.cos(np.radians(70))
    return {
        "terms": terms,
        "texels": len(matrix),
        "squared_error": float(1 - np.sum(square) / whole),
        "beyond_70_degrees": float(np.sum(matrix[grazing] ** 2) / whole),
    }


def separated(run: Run, brdfs: Sequence, angles: tuple[int, ...]) -> LobeBrdf:
    """The published lobes of a set, which the store keeps."""
    nodes = 8 if run.quick else NODES
    name = f"mirror_{len(angles)}_{nodes}_{len(brdfs)}"
    return run.kept(name, lambda: mirror_lobes(BrdfSet.of(brdfs), angles=angles, resolution=nodes))


def samples(brdfs: Sequence, table: LobeBrdf | None, *, resolution: int) -> tuple[jax.Array, float]:
    """Samples on the disk, less the lobes if there are any, and the squared norm of the whole.

    The lobes of the table are narrower than texels. So they are fitted anew to the samples, see `sampled_lobes`.
    """
    direction = maps.texel_direction(resolution=resolution).reshape(-1, 3)
    inside = np.flatnonzero(np.asarray(maps.texel_area(resolution=resolution)).ravel())
    direction = direction[inside]
    tensor = jnp.asarray(np.stack([np.asarray(tabulate(brdf, direction)[0]) for brdf in brdfs]))
    whole = squared_norm(tensor)
    return (tensor, whole) if table is None else (sampled_lobes(tensor, direction), whole)


@jax.jit
def sampled_lobes(tensor: jax.Array, direction: jax.Array) -> jax.Array:
    """What lobes leave of samples [BRDF, view, light]: Gaussians of fixed widths around the mirror direction.

    EM finds their weights for each BRDF and view, beside a uniform density that stands for the rest. A lobe's sum over
    the texels is one; that of 0 degrees is the mirror texel alone.
    """
    width = jnp.radians(jnp.asarray(ANGLES[1:])) / 3

    def view(argument):
        wo, rows = argument
        angle = 2 * jnp.arcsin(jnp.clip(jnp.linalg.norm(direction - wo * jnp.array([-1, -1, 1]), axis=1) / 2, 0, 1))
        wide = jnp.exp(-((angle[:, None] / width) ** 2) / 2)
        mirror = (jnp.arange(len(angle)) == jnp.argmin(angle)).astype(wide.dtype)[:, None]
        density = jnp.concatenate([mirror, wide, jnp.ones_like(mirror)], 1)
        density = density / jnp.sum(density, 0)
        total = jnp.sum(rows, 1, keepdims=True)

        def step(weight, _):
            whole = weight @ density.T  # Zero where a BRDF is: then it has no mass.
            return weight * (jnp.where(whole > 0, rows / jnp.where(whole > 0, whole, 1), 0) @ density), None

        start = jnp.broadcast_to(total / density.shape[1], (len(rows), density.shape[1]))
        weight = jax.lax.scan(step, start, None, length=100)[0]
        return rows - weight[:, :-1] @ density[:, :-1].T

    return jnp.moveaxis(jax.lax.map(view, (direction, jnp.moveaxis(tensor, 1, 0))), 0, 1)


def reflected(brdfs: Sequence, table: LobeBrdf | None, *, resolution: int) -> tuple[jax.Array, float]:
    """What the BRDFs reflect of natural light, less the lobes, and the squared norm of the whole."""
    lobes = None
    if table is not None:  # an axis of the one BRDF, whose channels are the set
        rows = table.mean[:, :, None], table.scale[:, None], table.weight[:, :, None], table.diffuse[:, None]
        lobes = LobeBrdf(*rows, (jnp.zeros(1),), table.error)
    sent = dynamic.reflected.reflect([BrdfSet.of(brdfs)], lobes, resolution=resolution)
    inside = np.flatnonzero(np.asarray(sent.area))
    tensor = sent.tensor[0][:, inside] * jnp.sqrt(sent.area[inside])[:, None]
    return tensor, float(sent.whole)


def settings(tensor: jax.Array, whole: float, sets: Sequence[int], terms: Sequence[int]) -> dict:
    """Squared relative errors of truncated higher-order SVDs, all from one core of the highest ranks."""
    ranks = (max(sets), max(terms), max(terms))
    core = np.asarray(tucker.hosvd(tensor, ranks=ranks).core, np.float64)
    norm = squared_norm(tensor)
    return {(h, n): (norm - np.sum(core[:h, :n, :n] ** 2)) / whole for h in sets for n in terms}


def best(tensor: jax.Array, whole: float, ranks: tuple[int, int, int]) -> float:
    """Squared relative error of the finest setting after two sweeps of the iteration that the paper cites."""
    core = np.asarray(hooi(tensor, ranks=ranks, sweeps=2)[0].core, np.float64)
    return float((squared_norm(tensor) - np.sum(core**2)) / whole)


def squared_norm(tensor: jax.Array) -> float:
    """Sum of squares, in float64 on the host."""
    return float(sum(np.sum(np.square(np.asarray(each, np.float64))) for each in tensor))


def principal(run: Run) -> Iterator[dict[str, Any]]:
    """What four specular functions leave of both sets, in four norms; the fifth function is the diffuse part."""
    resolution = 8 if run.quick else RESOLUTION
    exponents = (1, 5, 20, 100) if run.quick else range(1, 201)
    families = {"Cook-Torrance": measured(run), "Blinn-Phong": navigation.blinn_phong(exponents=exponents)}
    for name, family in families.items():
        disk = samples(family.brdf, None, resolution=resolution)[0].reshape(len(family.brdf), -1)
        light = reflected(family.brdf, None, resolution=resolution)[0].reshape(len(family.brdf), -1)
        of_disk, of_light = (np.asarray(each @ each.T, np.float64) for each in (disk, light))
        norm, peak = np.sqrt(np.diag(of_disk)), np.asarray(jnp.max(disk, 1), np.float64)
        for what, product in {
            "disk": of_disk,
            "disk, BRDFs of equal norm": of_disk / norm / norm[:, None],
            "disk, BRDFs of equal peak": of_disk / peak / peak[:, None],
            "natural light": of_light,
        }.items():
            value = np.maximum(np.linalg.eigvalsh(product)[::-1], 0)
            left = 1 - np.cumsum(value) / np.sum(value)
            yield {
                **{"set": name, "norm": what, "brdfs": len(family.brdf)},
                **{"squared_error": left[:6].tolist(), "paper": PRINCIPAL[name]},
            }


def figure_7(run: Run) -> Iterator[dict[str, Any]]:
    """The measured points in the plane of Fresnel reflectance and roughness, and its triangles."""
    from matplotlib import pyplot

    family = measured(run)
    place = np.array([place_of(each) for each in family.brdf])
    triangle = getattr(family.navigation, "triangle", None)
    figure, axis = pyplot.subplots(figsize=(8, 6), dpi=110)
    if triangle is not None:
        axis.triplot(*place.T, np.asarray(triangle), color="0.75", linewidth=0.7)
    axis.plot(*place.T, "k.", markersize=5)
    axis.set(xlabel="Fresnel reflectance at normal incidence F0", ylabel="roughness m", yscale="log")
    figure.tight_layout()
    figure.savefig(run.picture("sun2007_figure_7.png"))
    pyplot.close(figure)
    low, high = place.min(0), place.max(0)
    yield {
        **{"materials": len(place), "f0": [low[0], high[0]], "m": [low[1], high[1]]},
        **{"median_f0": float(np.median(place[:, 0])), "median_m": float(np.median(place[:, 1]))},
        "below_m_0.02": int(np.sum(place[:, 1] < 0.02)),
        "triangles": 0 if triangle is None else len(triangle),
    }


def figure_6(run: Run) -> Iterator[dict[str, Any]]:
    """Balls of four measured materials by the tensor alone, and with one to four published lobes."""
    family, light = measured(run), run.light("grace", size=32)
    chosen = shininess(family, 2 if run.quick else 4)
    members = sorted({*chosen, *shininess(family, 4 if run.quick else MEMBERS)})
    brdfs = [family.brdf[number] for number in members]
    resolution, edge = (8, 16) if run.quick else (RESOLUTION, 384)
    rings = 8 if run.quick else 80
    ball = builtin.sphere(rings=rings, sectors=2 * rings)
    view = camera.orbit(ball, elevation=0.2, width=edge, height=edge)
    number = np.flatnonzero(np.sum(np.asarray(ball.normal) * (np.asarray(view.eye) - np.asarray(ball.position)), 1) > 0)
    sets: dict[str, Any] = {"no lobes": 0}
    for count in (1, 4) if run.quick else (1, 2, 3, 4):
        sets[" ".join(f"{k}°" for k in ANGLES[:count])] = separated(run, brdfs, ANGLES[:count])
    ranks = (2, 4, 4) if run.quick else (4, 8, 8)
    left = {name: remaining([family.brdf[n] for n in chosen], name, run) for name in sets}
    made = {
        name: dynamic.tabulate(BrdfSet.of(brdfs), lobes=lobes, ranks=ranks, resolution=resolution)
        for name, lobes in sets.items()
    }
    rows, captions = [], []
    for material in chosen:
        exact = drawing.unshadowed(ball, family.brdf[material], light, view.eye, number)
        name = f"{family.name[material]}, m = {place_of(family.brdf[material])[1]:.3g}"
        radiance, row, titles = {"exact": exact}, [], []
        for lobes, table in made.items():
            member = SetMember(table, jnp.asarray(members.index(material)))
            radiance[lobes] = drawing.unshadowed(ball, member, light, view.eye, number)
        for lobes, color in radiance.items():
            wrong = float(np.linalg.norm(color - exact) / np.linalg.norm(exact))
            row.append(np.asarray(image.render(ball, jnp.zeros((len(ball.position), 3)).at[number].set(color), view)))
            titles.append(f"{name}\nexact" if lobes == "exact" else f"{lobes}\n{100 * wrong:.0f} % off")
            if lobes != "exact":
                f0, m = place_of(family.brdf[material])
                rest = float(left[lobes][chosen.index(material)])
                yield {
                    "material": family.name[material],
                    "lobes": lobes,
                    "error": wrong,
                    "f0": f0,
                    "m": m,
                    "left": rest,
                }
        rows.append([drawing.shown(each, like=row[0]) for each in row])
        captions.append(titles)
    drawing.sheet(run.picture("sun2007_figure_6.jpg"), rows, captions)


def remaining(brdfs: Sequence, name: str, run: Run) -> np.ndarray:
    """What lobes leave of each BRDF before the tensor: relative norm of what is reflected of natural light.

    `name` has the angles of the lobes, as in "0° 7°", or none.
    """
    angles = tuple(angle for angle in ANGLES if f"{angle}°" in name.split())
    table = separated(run, brdfs, angles) if angles else None
    resolution = 8 if run.quick else RESOLUTION
    rest, whole = (np.asarray(reflected(brdfs, t, resolution=resolution)[0], np.float64) for t in (table, None))
    return np.sqrt(np.sum(rest**2, (1, 2)) / np.sum(whole**2, (1, 2)))


def shininess(family: navigation.Family, count: int) -> list[int]:
    """Materials from the roughest to the sharpest, at equal steps in their order."""
    order = np.argsort([-place_of(each)[1] for each in family.brdf])
    return [int(order[place]) for place in np.linspace(0, len(order) - 1, count).astype(int)]


def plot_5(lines: Sequence[Mapping[str, Any]], run: Run) -> None:
    """Squared errors against the rank, a panel for each norm."""
    from matplotlib import pyplot

    rows = list(lines)
    norms, kinds = (list(dict.fromkeys(line[key] for line in rows)) for key in ("norm", "lobes"))
    figure, axes = pyplot.subplots(1, len(norms), figsize=(11, 4.4), dpi=100, squeeze=False)
    for axis, norm in zip(axes[0], norms, strict=True):
        for kind, style in zip(kinds, ("--", "-"), strict=True):
            for place, count in enumerate(dict.fromkeys(line["n_h"] for line in rows)):
                one = [x for x in rows if (x["norm"], x["lobes"], x["n_h"]) == (norm, kind, count)]
                label = f"n_h = {count}" if kind == kinds[-1] else None
                values = [x["squared_error"] for x in one]
                axis.semilogy([x["n_w"] for x in one], values, style, marker=".", color=f"C{place}", label=label)
        axis.set(title=f"norm: {norm}", xlabel="n_wi = n_wo", ylabel="squared relative error")
    axes[0, -1].legend(fontsize=8, title="solid: published lobes\ndashed: none")
    figure.tight_layout()
    figure.savefig(run.picture("sun2007_figure_5.png"))
    pyplot.close(figure)
