"""Where does each system fail, and how does that look? Pictures of typical failures beside the exact ones.

    python -m benchmarks.failures [--quick] [--only CASE] [--store FOLDER] [--pictures FOLDER] [--output FILE]

Each case is one scene in one light: pictures by one system at two sizes, and the exact picture, which Mitsuba 3 traces
with the same triangles, normals and materials (`dynamic`: `jaxprt.reference` at the vertices). `error` is relative L2
over the pixels that surfaces fill. Two of Mitsuba's pictures with unlike seeds stand for the exact one, so that noise
has no part in it. `negative` is the share of these pixels in which a color is below zero. `bytes` are those of the
system. Pictures are written side by side, the exact one last. Meshes and lights are those of JAXPRT_DATA.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from benchmarks import denoised, harness, path_tracing
from benchmarks.pictures import BRDFS, LIGHTS, standing
from benchmarks.pictures import view as view_of
from benchmarks.published import interiors
from benchmarks.scenes import averaged, finer, traced_parts
from jaxprt import Blend, Run, bright_texels, dynamic, files, image, memory, precompute, radiance, reference
from jaxprt.brdf import CookTorrance
from jaxprt.image import raster
from jaxprt.relit import Harmonics, Lobes, Terms
from jaxprt.scene import (
    Camera,
    Environment,
    Mesh,
    Part,
    PointLight,
    Scene,
    TexturedMaterial,
    builtin,
    load_environment,
    load_mesh,
)
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import ground_plane, make_mesh, split

EDGE, SAMPLES = 384, 256  # pixels along an edge, and paths of each, twice
_GOLD = TexturedMaterial(base_color=[1.0, 0.766, 0.336], metallic=1.0, roughness=0.3)
_PANEL = make_mesh(  # nine times as long as high
    np.array([[-0.9, 0.3, -0.6], [0.9, 0.3, -0.6], [0.9, 0.5, -0.6], [-0.9, 0.5, -0.6]], np.float32),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
_GLOWING = TexturedMaterial(base_color=0.0, metallic=0.0, roughness=1.0, specular=0.0, emissive=[4.0, 4.0, 4.0])
_MATTE = TexturedMaterial(base_color=0.5, metallic=0.0, roughness=1.0, specular=0.0)


class Pictures(NamedTuple):
    """Pictures of one case.

    Attributes:
        mine: Function that makes a picture, and bytes of the system, by the name of the size.
        exact: The exact picture, twice: of two seeds where it has noise.
        inside: Pixels that are judged.
    """

    mine: dict[str, tuple[Callable[[], Any], int]]
    exact: tuple[np.ndarray, np.ndarray]
    inside: np.ndarray


class Sizes(NamedTuple):
    """How large cases are, and where precomputation is kept."""

    quick: bool
    store: pathlib.Path | None

    @property
    def edge(self) -> int:
        """Pixels along an edge."""
        return 16 if self.quick else EDGE

    def path(self, name: str) -> pathlib.Path | None:
        """The folder of a scene."""
        return self.store and self.store / f"failures_{name}"


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", choices=CASES, help="one case; all if not given")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write pictures, the exact one last")
    arguments = parser.parse_args(options)
    for name in ["harmonic"] if arguments.quick else CASES:
        if arguments.only in (None, name):
            made = CASES[name](Sizes(arguments.quick, arguments.store))
            judge(name, made, arguments.pictures, arguments.output)


def judge(name: str, made: Pictures, pictures: pathlib.Path | None, output: pathlib.Path | None) -> None:
    """Reports the error of each picture, and writes all of them side by side."""
    row, mean = [], (made.exact[0] + made.exact[1]) / 2
    one, other = (each[made.inside] for each in made.exact)
    for size, (function, held) in made.mine.items():
        timing = harness.measure(function, repeats=1)
        drawn = np.asarray(function())[..., :3]
        mine = drawn[made.inside]
        square = np.sum((mine - one) * (mine - other), dtype=np.float64) / np.sum(one * other, dtype=np.float64)
        error = float(max(square, 0) ** 0.5)
        line = {"benchmark": "failures", "case": f"{name}, {size}", **timing.line(), "error": error, "bytes": held}
        harness.report({**line, "negative": float(np.mean(np.any(mine < 0, -1)))}, output)
        row.append(np.where(made.inside[..., None], drawn, 0))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        shown = np.where(made.inside[..., None], mean, 0)
        stops = image.automatic_exposure(jnp.asarray(shown, jnp.float32))
        whole = jnp.asarray(np.concatenate([*row, shown], 1), jnp.float32)
        files.write_png(pictures / f"{name}.png", np.asarray(image.display(image.expose(whole, stops=stops))))


def harmonic(sizes: Sizes) -> Pictures:
    """A small sun: 25 coefficients ring, and a window that removes this blurs the shadow."""
    recipes = {"degree 4": Harmonics(), "degree 4, windowed": Harmonics(laplacian=0.4)}
    return direct("spot", "sunrise", "exponent 20", recipes, sizes)


def separable(sizes: Sizes) -> Pictures:
    """A glossy object: few terms show the lamps too weak and wide, with dark patches beside them."""
    return direct("spot", "grace", "exponent 100", {"4 terms": Terms(4, 96), "16 terms": Terms(16, 96)}, sizes)


def lobe(sizes: Sizes) -> Pictures:
    """A smooth metal: reflections that are half hidden change at vertices, which are too far apart."""
    return direct("spot", "grace", "metal 0.05", {"3 lobes": Lobes(3), "12 lobes": Lobes(12)}, sizes)


def direct(mesh: str, light: str, brdf: str, recipes: dict[str, Any], sizes: Sizes) -> Pictures:
    """An object on a matte ground in direct light, by recipes and by Mitsuba."""
    if sizes.quick:
        shape, lit = builtin.sphere(rings=12, sectors=16), builtin.studio(size=8)
    else:
        shape, lit = load_mesh(harness.data() / "meshes" / "spot.obj"), environment(light)
    scene = standing(mesh, shape, BRDFS[brdf], 100 if sizes.quick else 5000)
    camera, size = view_of(shape, 2.6, sizes.edge), lit.radiance.shape[-2]
    mine = {}
    for name, recipe in recipes.items():
        path = sizes.path(f"{mesh} {name if isinstance(recipe, Terms) else type(recipe).__name__}")
        made = precompute(scene, refine=False, system=recipe, size=size, path=path, progress=False)
        mine[name] = (lambda made=made: made.picture(lit, camera)), memory(made)
    seen, samples = denoised.View(traced_parts(scene), lit, camera), 16 if sizes.quick else SAMPLES
    exact = seen.radiance(samples, 1)[..., :3], seen.radiance(samples, 2)[..., :3]
    return Pictures(mine, exact, inside(scene.mesh, camera))


def changing(sizes: Sizes) -> Pictures:
    """A BRDF halfway between two that are tabulated, which are far apart in roughness or less far."""
    mesh, light = load_mesh(harness.data() / "meshes" / "spot.obj"), environment("eucalyptus")
    camera, mine = view_of(mesh, 2.6, sizes.edge), {}

    def model(log_m):
        return CookTorrance(diffuse=0.0, specular=1.0, roughness=jnp.exp(log_m), f0=0.3)

    log_m, count = np.log(0.14), len(mesh.position)
    blend = Blend(jnp.ones((count, 1, 1)), (jnp.full(count, log_m),))
    for name, ends in {"m .035 and .56": (0.035, 0.56), "m .1 and .196": (0.1, 0.196)}.items():
        table = dynamic.tabulate(model, lobes=8, ranks=None, knot=[np.log(ends)])
        transport = dynamic.precompute(mesh, table, run=Run(progress=False))
        system = bright_texels.BrightTexels(dynamic.DynamicSystem(transport, table), transport.pyramid, model)
        color = radiance(system, light, eye=camera.eye, materials=blend)
        mine[name] = (lambda color=color: image.render(mesh, color, camera)), memory(system)
    exact = reference.radiance(mesh, model(jnp.asarray(log_m)), light, eye=camera.eye)
    exact = np.asarray(image.render(mesh, exact, camera))[..., :3]
    return Pictures(mine, (exact, exact), inside(mesh, camera))


def metal(sizes: Sizes) -> Pictures:
    """A metal ball that mirrors the ground: 16 harmonics of reflected light ring, rays do not."""
    ball = builtin.sphere(rings=36, sectors=72)
    scene = Scene([Part("ball", ball, _GOLD), Part("ground", ground_plane(ball, vertices=2500, extent=2.0), _MATTE)])
    light, camera = environment("grace"), orbit(scene.mesh, elevation=0.3, width=sizes.edge, height=sizes.edge)
    made = precompute(scene, refine=False, system=Lobes(8), bounces=1, path=sizes.path("metal"), progress=False)
    several = {"harmonics": made.with_rays(0), "16 rays": made.with_rays(16)}
    mine = {name: ((lambda each=each: each.picture(light, camera)), memory(each)) for name, each in several.items()}
    return Pictures(mine, reflected(scene, light, camera), inside(scene.mesh, camera))


def caustic(sizes: Sizes) -> Pictures:
    """A metal ring in the sun: its caustic is as wide as a texel of the light that is reflected."""
    ring, table = split(interiors.ring(spacing=2.0))
    scene = Scene([Part("ring", ring, _GOLD), Part("table", table, _MATTE)])
    light = environment("sunrise")
    camera = orbit(ring, azimuth=0.4, elevation=0.9, width=sizes.edge, height=sizes.edge)
    mine = {}
    for bounces in (0, 1):
        path = sizes.path(f"ring_{bounces}")
        made = precompute(scene, refine=False, system=Lobes(8), bounces=bounces, path=path, progress=False)
        mine[f"bounces {bounces}"] = (lambda made=made: made.picture(light, camera)), memory(made)
    return Pictures(mine, reflected(scene, light, camera), inside(scene.mesh, camera))


def reflected(scene: Scene, light: Environment, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pictures with one bounce by Mitsuba, with two seeds."""
    one, other = (
        path_tracing.trace(traced_parts(scene), light, camera, depth=3, samples=SAMPLES, seed=seed) for seed in (1, 2)
    )
    return one, other


def lamp(sizes: Sizes) -> Pictures:
    """A long panel over a polished floor, which shows its shape."""
    camera = Camera([0.0, 1.0, 2.2], [0.0, 0.0, -0.1], [0.0, 1.0, 0.0], 0.75, sizes.edge, sizes.edge)
    parts = [Part("floor", builtin.plane(cells=48), _polished(0.2)), Part("panel", _PANEL, _GLOWING)]
    return lit_by_lamps(Scene(parts), camera, {"refine": False}, "polygon")


def bulb(sizes: Sizes) -> Pictures:
    """The shadow of a ball in a point light, on a floor of four vertices that shows a highlight."""
    light = PointLight("bulb", [-0.6, 1.1, -0.5], [2.0, 2.0, 2.0])
    return lit_by_lamps(Scene(_balls(0.4), point_lights=[light]), _over(sizes), {}, "shadow rays")


def panel(sizes: Sizes) -> Pictures:
    """The half-shadow of a ball before a long panel, on a floor of four vertices that mirrors it."""
    return lit_by_lamps(Scene([*_balls(0.2), Part("panel", _PANEL, _GLOWING)]), _over(sizes), {}, "shadow rays")


def _polished(roughness: float) -> TexturedMaterial:
    return TexturedMaterial(base_color=0.2, metallic=0.0, roughness=roughness)


def _balls(roughness: float) -> list[Part]:
    """A matte ball on a floor of four vertices."""
    ball = builtin.sphere(rings=24, sectors=48)
    ball = make_mesh(0.25 * np.asarray(ball.position) + [0.0, 0.25, 0.0], ball.face, normal=ball.normal)
    return [Part("floor", builtin.plane(cells=1), _polished(roughness)), Part("ball", ball, _MATTE)]


def _over(sizes: Sizes) -> Camera:
    return Camera([0.3, 1.2, 1.9], [0.0, 0.1, 0.0], [0.0, 1.0, 0.0], 0.75, sizes.edge, sizes.edge)


def lit_by_lamps(scene: Scene, camera: Camera, options: dict[str, Any], name: str) -> Pictures:
    """A scene in the light of its lamps and hardly any other, and by Mitsuba; pixels at a lamp are not judged."""
    light = Environment(jnp.full((6, 64, 64, 3), 1e-3))
    made = precompute(scene, system=Lobes(12), progress=False, **options)
    unlit = Scene([part for part in scene.parts if part.material is not _GLOWING])
    number = np.asarray(made.picture(light, camera, layers=["part"])["part"])
    shown = inside(scene.mesh, camera) & np.logical_not(ndimage.binary_dilation(number >= len(unlit.parts)))
    exact = with_lamps(scene, unlit, light, camera)
    return Pictures({name: ((lambda: made.picture(light, camera)), memory(made))}, exact, shown)


def with_lamps(scene: Scene, unlit: Scene, light: Environment, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Parts that do not glow in the light of `_PANEL`, or of a point light if there is one: by Mitsuba, twice."""
    import mitsuba

    from benchmarks import plugins

    mitsuba.set_variant("llvm_ad_rgb" if path_tracing.available() else "scalar_rgb")
    place = mitsuba.ScalarTransform4f().translate([0.0, 0.4, -0.6]).scale([0.9, 0.1, 1.0])
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 4.0}}
    lamps = {"panel": {"type": "rectangle", "to_world": place, "emitter": glow}}
    if scene.point_lights:
        (bulb,) = scene.point_lights
        intensity = {"type": "rgb", "value": np.asarray(bulb.intensity, float).tolist()}
        lamps = {
            "bulb": {"type": "point", "position": np.asarray(bulb.position, float).tolist(), "intensity": intensity}
        }
    shapes = {
        f"part{number}": path_tracing.shape(mitsuba, mesh, plugins.bsdf(material), plugins.attributes(material))
        for number, (mesh, material) in enumerate(traced_parts(unlit))
    }
    world = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "hide_emitters": False},
            "sensor": path_tracing.sensor(mitsuba, camera),
            "light": {"type": "envmap", "bitmap": mitsuba.Bitmap(path_tracing.latlong(light))},
            **lamps,
            **shapes,
        }
    )
    one, other = (np.array(mitsuba.render(world, spp=SAMPLES, seed=mitsuba.UInt32(seed))) for seed in (1, 2))
    return one, other


def environment(name: str) -> Environment:
    """A light of the data folder."""
    return load_environment(harness.data() / "env" / LIGHTS[name])


def inside(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Pixels that surfaces fill."""
    triangle = np.asarray(raster.rasterize(mesh, finer(camera)).triangle)
    return np.asarray(averaged((triangle >= 0)[..., None]))[..., 0] > 1 - 1e-6


CASES = {
    "harmonic": harmonic,
    "separable": separable,
    "lobe": lobe,
    "dynamic": changing,
    "metal": metal,
    "caustic": caustic,
    "lamp": lamp,
    "bulb": bulb,
    "panel": panel,
}


if __name__ == "__main__":
    main()
