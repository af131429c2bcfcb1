"""How many vertices does a shadow need, spent uniformly and where it is sharp?

    python -m benchmarks.refinement [--quick] [--only SCENE] [--output FILE]

Surfaces are white and diffuse. `error` is the relative L2 of a picture, over pixels of the ground or of the whole
scene: exact radiance of the vertices interpolated, against the exact radiance at the pixels' own points. Meshes are
uniform (all edges halved that are longer than a length), graded (`ground_plane`, denser in its middle) and refined, for
the light of the picture or for any light. `vertices` are those of what is judged, `seconds` those of dividing, and
`bytes` those of the mesh.
"""

import time
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from jaxprt import brdf, reference, refine
from jaxprt.image import raster
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, builtin, load_environment, load_mesh, load_scene
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import bounds, ground_plane, make_mesh
from jaxprt.scene.subdivision import divide

WHITE = brdf.Lambert(1.0)
GROUND, TRUCK = "ground", "truck"
EDGE, PIXELS = 256, 500
ERRORS = {GROUND: (0.02, 0.01, 0.005), TRUCK: (0.05, 0.02, 0.01)}  # for which meshes are refined
LIGHTS = {"sunrise": "polyhaven_sunrise_1k.exr", "courtyard": "polyhaven_courtyard_1k.exr"}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="SCENE", help="ground or truck")
    arguments = parser.parse_args(options)
    for name, scene in scenes(arguments.quick).items():
        if arguments.only not in (None, name):
            continue
        camera = orbit(scene.parts[0].mesh, azimuth=0.6, elevation=0.5, width=EDGE, height=EDGE)
        for light_name, light in lights(arguments.quick).items():
            judge = Judge(scene, light, camera, 60 if arguments.quick else PIXELS)
            for kind, function in meshes(name, scene, light, arguments.quick):
                start = time.perf_counter()
                divided = function()
                seconds = time.perf_counter() - start
                line = {
                    **{"benchmark": "refinement", "case": f"{name}, {light_name}, {kind}", "seconds": seconds},
                    **{
                        "compile_seconds": 0.0,
                        "error": judge.error(divided),
                        "bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(divided.mesh)),
                    },
                }
                harness.report({**line, "vertices": sum(judge.counts(divided))}, arguments.output)


def scenes(quick: bool) -> dict[str, Scene]:
    """An object on a ground of four vertices, of which the ground is judged; and a scene with large triangles."""
    found = {}
    folder = harness.data()
    path = folder / "meshes" / "spot.obj"
    standing = load_mesh(path) if path.is_file() and not quick else builtin.sphere(rings=8, sectors=12)
    ground = ground_plane(standing, vertices=4)
    found[GROUND] = Scene([Part("object", standing, WHITE), Part(GROUND, ground, WHITE)])
    path = folder / "scenes" / "CesiumMilkTruck.glb"
    if path.is_file() and not quick:
        found[TRUCK] = load_scene(path)
    return found


def lights(quick: bool) -> dict[str, Environment]:
    """Lights with smaller suns and larger ones."""
    if quick:
        return {"daylight": builtin.daylight(size=8)}
    paths = {name: harness.data() / "env" / file for name, file in LIGHTS.items()}
    found = {name: load_environment(path) for name, path in paths.items() if path.is_file()}
    return {"daylight": builtin.daylight(), **found}


def meshes(name: str, scene: Scene, light: Environment, quick: bool) -> Iterator[tuple[str, Callable[[], Scene]]]:
    """Kinds of meshes, and what makes them."""
    low, high = bounds(scene.mesh)
    size = float(np.linalg.norm(high - low))
    if not quick:
        yield "as it is", lambda: scene
    for parts in (4,) if quick else (16, 32, 64, 128):
        yield f"uniform, 1 / {parts} of the diagonal", lambda parts=parts: divide(scene, edge=size / parts)
    standing = scene.parts[0]
    if name == GROUND:
        for vertices in (64,) if quick else (1024, 4096, 16384):
            ground = Part(GROUND, ground_plane(standing.mesh, vertices=vertices), WHITE)
            yield f"graded, {vertices} vertices", lambda ground=ground: Scene([standing, ground])
    for error in (0.05,) if quick else ERRORS[name]:
        for kind, given in {"the light": [light], "any light": None}.items():
            yield (
                f"refined for {kind}, error {error:g}",
                lambda error=error, given=given: refine(scene, error=error, environments=given, progress=False),
            )


class Judge:
    """Exact radiance at points of a picture."""

    def __init__(self, scene: Scene, light: Environment, camera: Camera, pixels: int):
        mesh = scene.mesh
        drawn = raster.rasterize(mesh, camera)
        triangle, weight = np.asarray(drawn.triangle), np.asarray(drawn.barycentric)
        self.light, self.camera = light, camera
        self.judged = [number for number, part in enumerate(scene.parts) if part.name == GROUND]
        self.judged = self.judged or list(range(len(scene.parts)))
        inside = (triangle >= 0) & np.isin(np.asarray(mesh.region)[np.asarray(mesh.face)[triangle, 0]], self.judged)
        pixel = np.argwhere(inside)
        self.pixel = pixel[np.random.default_rng(0).permutation(len(pixel))[:pixels]].T
        corner = np.asarray(mesh.face)[triangle[*self.pixel]]
        weight = weight[*self.pixel].astype(np.float64)
        place, normal = (
            np.einsum("pk,pkc->pc", weight, np.asarray(each)[corner]) for each in (mesh.position, mesh.normal)
        )
        # Points are corners of small triangles, as meshes have them.
        at = np.asarray(mesh.position, np.float64)[corner]
        position = np.concatenate([place, *(place + 1e-3 * (at[:, k] - at[:, 0]) for k in (1, 2))])
        face = np.arange(3 * len(place)).reshape(3, -1).T
        points = make_mesh(position, face, normal=np.tile(normal, (3, 1)))
        self.exact = self._radiance(points, np.arange(len(place)), mesh)

    def error(self, scene: Scene) -> float:
        """Relative L2 error of radiance interpolated between the vertices of a divided scene."""
        mesh = scene.mesh
        drawn = raster.rasterize(mesh, self.camera)
        corner = np.asarray(mesh.face)[np.asarray(drawn.triangle)[*self.pixel]]
        used, index = np.unique(corner, return_inverse=True)
        color = self._radiance(mesh, used, mesh)[index.reshape(corner.shape)]
        found = np.einsum("pk,pkc->pc", np.asarray(drawn.barycentric)[*self.pixel], color)
        return float(np.linalg.norm(found - self.exact) / np.linalg.norm(self.exact))

    def counts(self, scene: Scene) -> list[int]:
        """Vertices of the parts that are judged."""
        return [len(scene.parts[number].mesh.position) for number in self.judged]

    def _radiance(self, mesh: Mesh, vertex: np.ndarray, occluder: Mesh) -> np.ndarray:
        eye = jnp.asarray(self.camera.eye)
        made = reference.radiance(mesh, WHITE, self.light, eye=eye, vertex=vertex, occluder=occluder)
        return np.asarray(jax.block_until_ready(made))


if __name__ == "__main__":
    main()
