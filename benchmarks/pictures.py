"""What error has a picture after how many seconds? Relit scenes beside Mitsuba 3 and Intel's denoiser.

    python -m benchmarks.pictures [--quick] [--only TEXT] [--system NAME] [--edge N] [--store FOLDER] [--plot FILE]
        [--pictures FOLDER]

Objects stand on a matte ground, in direct light. Judge is Mitsuba's converged picture of the same triangles, normals
and materials, and of the pixels of the light's file in 6 x 256 x 256 texels: see `benchmarks.denoised`. `error` is
relative L2 over the pixels that surfaces fill, without the background; two pictures of unlike seeds stand for the
converged one, so that its noise, `noise`, has no part in it. `flip` is FLIP. Pixels are means over their squares on
both sides. `seconds` are of the picture that is judged, with a new light and a new view.

Lines of Mitsuba have its picture by `samples` samples per pixel, bare and denoised (also with `clean` albedo and
normals, a larger network), compiling left out. Lines of ours name it as their peer: `peer_seconds` is the time at which
the denoised pictures have the error of ours, so that `ratio` is at equal error. `peer_time` says how it was found:
"interpolated" on the curve, "extrapolated" past its end, or "cheapest" where the fastest picture is no worse.
`light_seconds` are of a new light for a view that stays. "Refined" scenes have twice the vertices, where shadows need
them, and four times the single texels.

Meshes and lights are those of JAXPRT_DATA. What is precomputed and the converged pictures are kept in the store.
"""

import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import denoised, harness
from benchmarks.scenes import file_name
from jaxprt import RelitScene, files, image, memory, precompute
from jaxprt.brdf import AshikhminShirley, Lambert, MetallicRoughness
from jaxprt.relit import Harmonics, Lobes, Terms, refine
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, builtin, load_environment, load_mesh
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import finer
from jaxprt.scene.mesh import ground_plane

EDGE = 512
SAMPLES = (1, 4, 16, 64, 256)
# Of the converged picture: relative L2, a third of the largest error that ours should have; and the most samples.
NOISE, NOISE_ELSEWHERE, MOST = {"grace": 0.01, "eucalyptus": 0.01}, 0.0066, 8192
GROUND = 10000  # vertices
REFINED, TEXELS = 2, 64  # times the vertices, and single texels, of scenes that are refined
COARSE = 25_000  # vertices up to which they are
MESHES = {"spot": ("spot.obj", 2.6), "rocker arm": ("rocker_arm.ply", 0.5), "bunny": ("stanford_bunny.ply", 0.35)}
LIGHTS = {
    "grace": "grace_cross.hdr",
    "eucalyptus": "eucalyptus_rnl_cross.hdr",
    "courtyard": "polyhaven_courtyard_1k.exr",
    "studio": "polyhaven_studio_1k.exr",
    "sunrise": "polyhaven_sunrise_1k.exr",
}
GOLD = [0.8, 0.6, 0.4]
BRDFS = {
    "exponent 20": AshikhminShirley(diffuse=0.5, specular=0.25, nu=20, nv=20),
    "exponent 100": AshikhminShirley(diffuse=0.5, specular=0.25, nu=100, nv=100),
    "plastic": MetallicRoughness(GOLD, metallic=0.0, roughness=0.4),
    **{
        f"metal {alpha}": MetallicRoughness(GOLD, metallic=1.0, roughness=alpha**0.5)
        for alpha in (0.3, 0.1, 0.05, 0.0225)
    },
}
LADDER = (
    *((mesh, light, "exponent 100") for mesh in MESHES for light in ("grace", "eucalyptus")),
    *(("spot", light, "exponent 100") for light in ("courtyard", "studio", "sunrise")),
    *(("spot", "grace", name) for name in BRDFS if name not in ("exponent 100", "plastic")),
    # Soft boxes, and highlights that change within a pixel.
    *(("rocker arm", "studio", f"metal {alpha}") for alpha in (0.3, 0.1, 0.0225)),
    ("bunny", "studio", "exponent 20"),
    ("spot", "studio", "plastic"),
    ("bunny", "sunrise", "metal 0.0225"),
    ("rocker arm", "courtyard", "metal 0.0225"),
)


class Case(NamedTuple):
    """What is seen.

    Attributes:
        names: Of the mesh, the light and the BRDF.
        scene: The object on its ground.
        light: The light.
        camera: From where.
    """

    names: tuple[str, str, str]
    scene: Scene
    light: Environment
    camera: Camera


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="TEXT", default="", help="cases whose names have TEXT, as 'spot, grace'")
    parser.add_argument("--system", choices=tuple(systems(quick=False)), help="one system; all if not given")
    parser.add_argument(
        "--edge", type=int, metavar="N", default=EDGE, help=f"pixels along an edge; {EDGE} if not given"
    )
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed and converged")
    parser.add_argument("--plot", type=pathlib.Path, metavar="FILE", help="error against time, a panel for each case")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write ours, Mitsuba's, 4 x difference")
    arguments = parser.parse_args(options)
    lines = []
    for case in cases(arguments.quick, arguments.only, arguments.edge):
        recipes = systems(arguments.quick)
        chosen = {name: each for name, each in recipes.items() if arguments.system in (None, name)}
        for line in measure(case, chosen, arguments.quick, arguments.store, arguments.pictures):
            lines.append(harness.report(line, arguments.output))
    if arguments.plot is not None:
        plot(lines, arguments.plot)


def cases(quick: bool, only: str, edge: int) -> Iterator[Case]:
    """What is measured; without real data, embedded scenes."""
    folder = harness.data()
    if quick or not folder.is_dir():
        ball, size = builtin.sphere(rings=12, sectors=16), 8 if quick else 64
        scene, light = (
            standing("sphere", ball, BRDFS["exponent 20"], 100 if quick else GROUND),
            builtin.studio(size=size),
        )
        yield Case(("sphere", "studio", "exponent 20"), scene, light, view(ball, 0.5, 16 if quick else edge))
        return
    for names in LADDER:
        if only in ", ".join(names):
            file, azimuth = MESHES[names[0]]
            mesh, light = load_mesh(folder / "meshes" / file), load_environment(folder / "env" / LIGHTS[names[1]])
            yield Case(names, standing(names[0], mesh, BRDFS[names[2]], GROUND), light, view(mesh, azimuth, edge))


def standing(name: str, mesh: Mesh, brdf: Any, vertices: int) -> Scene:
    """An object on a matte ground."""
    ground = ground_plane(mesh, vertices=vertices)
    return Scene([Part(name, mesh, brdf), Part("ground", ground, Lambert(0.5))])


def view(mesh: Mesh, azimuth: float, edge: int) -> Camera:
    """From where an object is seen: a little from above."""
    return orbit(mesh, azimuth=azimuth, elevation=0.3, width=edge, height=edge)


def systems(quick: bool) -> dict[str, Any]:
    """Recipes by name, as `jaxprt.precompute` takes them."""
    if quick:
        return {"lobe": Lobes(lobes=3, texels=0)}
    return {"lobe": Lobes(), "harmonic": Harmonics(laplacian=0.4), "separable": Terms()}


def relit(case: Case, recipe: Any, path: pathlib.Path | None) -> Iterator[tuple[str, RelitScene, Callable]]:
    """Where radiance is made, the relit scene, and the function of no arguments that makes its picture."""
    size, light, camera = case.light.radiance.shape[-2], case.light, case.camera
    made = precompute(case.scene, system=recipe, size=size, path=path, progress=False)
    yield "vertices", made, lambda: image.render(made.mesh, made.radiance(light, eye=camera.eye), camera)
    yield "pixels", made, lambda: made.picture(light, camera)
    if isinstance(recipe, Lobes) and made.vertices <= COARSE:
        finer = refine(case.scene, environments=[light], error=0.0, vertices=REFINED * made.vertices, progress=False)
        path, more = (
            path and path.with_name(f"{path.name}_divided"),
            Lobes(recipe.lobes, min(TEXELS, 4 * recipe.texels)),
        )
        divided = precompute(finer, refine=False, system=more, size=size, path=path, progress=False)
        yield "pixels, refined", divided, lambda: divided.picture(light, camera)


def measure(
    case: Case, recipes: dict[str, Any], quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None
) -> Iterator[dict]:
    """Lines of one case: Mitsuba's, then ours."""
    parts = [(part.mesh, part.material) for part in case.scene.parts]
    seen = denoised.View(parts, finer(case.light), case.camera)
    path = store and store / f"{file_name(*case.names, str(case.camera.width))}.npz"
    noise = 0.02 if quick else NOISE.get(case.names[1], NOISE_ELSEWHERE)
    most, block = (144, 36) if quick else (MOST, denoised.BLOCK)
    truth = denoised.converged(seen, noise=noise, most=most, block=block, path=path)
    curve = denoised.points(seen, truth, (4, 16) if quick else SAMPLES)
    for point in curve:
        more = {"samples": point.samples, "variant": seen.variant}
        held = seen.bytes + point.picture.nbytes
        name = f"{point.method}, {point.samples} samples"
        yield line(case, point.method, name, point.timing, truth, point.picture, held) | more
    smooth = [(each.timing.seconds, each.error) for each in curve if "denoised" in each.method]
    for system, recipe in recipes.items():
        path = store and store / file_name(*case.names, system)
        for where, made, draw in relit(case, recipe, path):
            timing, drawn = harness.measure(draw, repeats=3 if quick else 9), np.asarray(draw())
            more = {} if where == "vertices" else {"light_seconds": new_light(case, made, 3 if quick else 9)}
            error = truth.error(drawn)
            seconds, how = denoised.seconds_at(max(error, 1e-6), smooth)
            yield {
                **line(case, system, f"{system} at {where}", timing, truth, drawn, memory(made)),
                **{"where": where, "peer": "mitsuba, denoised", "peer_seconds": seconds, "peer_error": error},
                **{"peer_time": how, "variant": seen.variant, "vertices": made.vertices, **more},
            }
            if pictures is not None:
                write(pictures / f"{file_name(*case.names, system, where)}.png", drawn, truth)
    if pictures is not None:
        for point in curve:
            write(pictures / f"{file_name(*case.names, point.method, str(point.samples))}.png", point.picture, truth)


def new_light(case: Case, made: RelitScene, repeats: int) -> float:
    """Seconds of a picture in a new light, of a view that stays."""
    kept = made.picture_view(case.camera)
    return harness.measure(lambda: kept.picture(case.light), repeats=repeats).seconds


def line(
    case: Case,
    system: str,
    name: str,
    timing: harness.Timing,
    truth: denoised.Truth,
    drawn: np.ndarray,
    held: int,
) -> dict[str, Any]:
    """What is reported of a picture."""
    return {
        **{"benchmark": "pictures", "case": ", ".join((*case.names, name))},
        **dict(zip(("mesh", "light", "brdf"), case.names, strict=True)),
        **{"system": system, **timing.line(), "error": truth.error(drawn), "flip": truth.flip(drawn)},
        **{"bias": truth.bias(drawn), "noise": truth.noise, "bytes": held},
    }


def write(path: pathlib.Path, drawn: np.ndarray, truth: denoised.Truth) -> None:
    """Writes a picture, Mitsuba's, and four times the difference, with the exposure that Mitsuba's asks for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mine = np.where(truth.inside[..., None], drawn[..., :3], 0)
    row = jnp.asarray(np.concatenate([mine, truth.mean, 4 * np.abs(mine - truth.mean)], 1), jnp.float32)
    stops = image.automatic_exposure(jnp.asarray(truth.mean))
    files.write_png(path, np.asarray(image.display(image.expose(row, stops=stops))))


def plot(lines: list[dict], path: pathlib.Path) -> None:
    """Error against seconds of a picture, one panel for each case."""
    from matplotlib import pyplot

    every = list(dict.fromkeys((line["mesh"], line["light"], line["brdf"]) for line in lines))
    columns = min(4, len(every))
    rows = -(-len(every) // columns)
    size = {"figsize": (3.6 * columns, 3.2 * rows), "sharex": True, "sharey": True, "squeeze": False}
    figure, axes = pyplot.subplots(rows, columns, **size)
    for panel in axes.ravel()[len(every) :]:
        panel.axis("off")
    for panel, names in zip(axes.ravel(), every, strict=False):
        mine = [line for line in lines if (line["mesh"], line["light"], line["brdf"]) == names]
        for method in dict.fromkeys((line["system"], line.get("where")) for line in mine):
            chosen = [(x["seconds"], x["error"]) for x in mine if (x["system"], x.get("where")) == method]
            label = method[0] if method[1] is None else f"{method[0]} at {method[1]}"
            panel.loglog(*zip(*chosen, strict=True), "o-" if method[1] is None else "s", markersize=4, label=label)
        panel.set_title(", ".join(names), fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel("seconds of a picture")
    for panel in axes[:, 0]:
        panel.set_ylabel("relative L2 error")
    axes[0, 0].legend(fontsize=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    pyplot.close(figure)


if __name__ == "__main__":
    main()
