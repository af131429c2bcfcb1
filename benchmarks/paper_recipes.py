"""Scenes like those of Sun et al. 2007: their meshes, what they are made of, and the rows of the paper's Table 1."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.published import interiors
from jaxprt.scene import Mesh, builtin, load_mesh
from jaxprt.scene.mesh import ground_plane, join, make_mesh
from jaxprt.scene.occluder import simplify

ROOM = (0, 1, 2, 2, 2, 3, 4, 5, 6, 7, 8, 9)  # its walls are one region
Look = Mapping[int, tuple[Any, Any, Any]]  # of some regions: diffuse color, specular weight, place in the set


class Published(NamedTuple):
    """A row of the paper's Table 1.

    Attributes:
        name: Name of the scene and number of its figure.
        adjustable: Number of BRDFs that change.
        vertices: Number of vertices.
        megabytes: Storage.
        hours: Precomputation and compression.
        fps: Frames a second with a new view, new view and BRDFs, and new view, BRDFs and light.
    """

    name: str
    adjustable: int
    vertices: int
    megabytes: float
    hours: tuple[float, float]
    fps: tuple[float, float, float]


TWEETY = Published("Tweety (Fig. 11)", 2, 13_000, 148, (2.6, 4.0), (121.58, 28.73, 5.82))
AIRPLANE = Published("Airplane (Fig. 13)", 2, 13_100, 144, (2.5, 6.4), (139.50, 30.79, 5.91))
INDOOR = Published("Indoor (Fig. 12)", 2, 35_700, 311, (4.2, 15.1), (74.52, 12.57, 3.40))
VENUS = Published("Venus (Fig. 1)", 1, 39_700, 389, (5.0, 7.3), (57.09, 10.94, 2.62))
CHESS = Published("Chess (Fig. 15)", 2, 53_900, 539, (13.7, 10.5), (48.30, 8.23, 1.67))
WATCH = Published("Watch (Fig. 14)", 2, 62_100, 603, (15.7, 14.3), (43.06, 7.23, 1.53))


class Recipe(NamedTuple):
    """How a scene is made.

    Attributes:
        mesh: Function (quick) -> mesh.
        space: "CT" or "BP": the set of BRDFs that its free regions move in.
        free: Diffuse color, specular weight and place in the set of each region whose BRDF changes, by number.
        fixed: Albedos of the other regions, by number.
        light: Name of the light: a file of the data folder, or "daylight".
        camera: Eye and target over the diagonal of the scene, from its middle, and the angle of view.
        published: The paper's row; None where there is none.
        options: Options of `bounces.precompute` that differ from the benchmark's defaults. "direct" is the edge of the
            cubemap faces of direct light, in texels.
    """

    mesh: Callable[[bool], Mesh]
    space: str
    free: Look
    fixed: dict[int, Any]
    light: str
    camera: tuple[Sequence[float], Sequence[float], float]
    published: Published | None
    options: Mapping[str, Any] = MappingProxyType({})


def _scan(file: str, faces: int, quick: bool, axes: str = "xyz") -> Mesh:
    """A scan of the data folder, simplified; a sphere where there is none. Its axes become x, y and z in this order."""
    path = harness.data() / "meshes" / file
    if quick or not path.is_file():
        return builtin.sphere(rings=6, sectors=9)
    mesh = simplify(load_mesh(path), faces=faces)
    position = np.asarray(mesh.position, np.float64)
    columns = [{"x": 0, "y": 1, "z": 2}[each.lower()] for each in axes]
    sign = [-1.0 if each.isupper() else 1.0 for each in axes]
    return make_mesh(position[:, columns] * sign, mesh.face, name=file)


def _room(quick: bool) -> Mesh:
    """The room with its three walls as one region; a quick one is as many balls."""
    if quick:
        ball = builtin.sphere(rings=4, sectors=6)
        place = np.stack(np.divmod(np.arange(max(ROOM) + 1), 4), -1) @ np.array([[0, 3.0, 0], [3.0, 0, 0]])
        return join([make_mesh(np.asarray(ball.position) + each, ball.face) for each in place])
    mesh = interiors.room()
    region = jnp.asarray(ROOM, jnp.int32)[mesh.region]
    return eqx.tree_at(lambda each: each.region, mesh, region)


def _grounded(mesh: Mesh, quick: bool, vertices: int, extent: float = 3.0) -> Mesh:
    """A scan as one region on a ground."""
    return join([mesh, ground_plane(mesh, vertices=25 if quick else vertices, extent=extent)])


_GRAY = np.array([0.3, 0.28, 0.25])
_RED = np.array([0.7, 0.08, 0.06])
_ABOVE = (0.0, 0.0, 0.0)
RECIPES = {
    "room": Recipe(
        _room,
        "BP",
        {
            0: ([0.45, 0.3, 0.18], 0.2, 60.0),
            1: ([0.55, 0.08, 0.06], 0.1, 20.0),
            2: ([0.7, 0.7, 0.65], 0.05, 6.0),
        },
        {
            **{3: 0.8, 4: [0.2, 0.3, 0.6], 5: [0.4, 0.25, 0.15], 6: [0.8, 0.75, 0.6], 7: [0.5, 0.5, 0.55]},
            **{8: [0.3, 0.4, 0.3], 9: [0.7, 0.6, 0.2]},
        },
        "daylight",
        ([0.05, 0.03, 0.72], [0.0, -0.06, 0.0], 0.75),
        INDOOR,
    ),
    "walls": Recipe(
        lambda quick: interiors.corner(_scan("spot.obj", 6000, quick, "XyZ"), cells=4 if quick else 66),
        "CT",
        {0: (_GRAY, 0.6, [0.15, 0.2]), 3: (_RED, 0.3, [0.05, 0.4])},
        {1: 0.6, 2: 0.6},
        "grace_cross.hdr",
        ([-0.4, 0.2, 0.75], [0.05, -0.1, -0.05], 0.75),
        None,
    ),
    "ring": Recipe(
        lambda quick: interiors.ring(spacing=4.0 if quick else 1.0),
        "BP",
        {0: (0.02, [0.9, 0.7, 0.35], 200.0)},
        {1: 0.4},
        "daylight",
        ([0.1, 0.66, 0.56], _ABOVE, 0.6),
        None,
        {"direct": 64, "edge": 16, "modes": 96, "terms": 48},
    ),
    "chess": Recipe(
        lambda quick: (
            interiors.corner(builtin.sphere(rings=6, sectors=9), cells=4) if quick else interiors.chess_sides()
        ),
        "CT",
        {0: ([0.35, 0.05, 0.04], 0.6, [0.1, 0.2]), 1: ([0.6, 0.55, 0.4], 0.6, [0.1, 0.2])},
        {2: [0.65, 0.55, 0.4], 3: [0.12, 0.08, 0.06]},
        "grace_cross.hdr",
        ([0.2, 0.38, 0.75], _ABOVE, 0.6),
        CHESS,
    ),
    "bust": Recipe(
        lambda quick: interiors.corner(_scan("nefertiti.ply", 16_000, quick, "xzY"), cells=4 if quick else 48),
        "CT",
        {0: ([0.25, 0.18, 0.1], 0.7, [0.5, 0.2])},
        {1: 0.6, 2: 0.6, 3: 0.6},
        "grace_cross.hdr",
        ([-0.4, 0.2, 0.75], [0.05, -0.05, -0.05], 0.75),
        VENUS,
    ),
    "bird": Recipe(
        lambda quick: _grounded(_scan("stanford_bunny.ply", 19_200, quick), quick, 3364),
        "CT",
        {0: ([0.7, 0.55, 0.1], 0.3, [0.05, 0.4]), 1: ([0.1, 0.2, 0.6], 0.5, [0.1, 0.2])},
        {},
        "grace_cross.hdr",
        ([0.15, 0.2, 0.5], _ABOVE, 0.6),
        TWEETY,
    ),
    "airplane": Recipe(
        lambda quick: _grounded(_scan("dragon_100k.ply", 19_400, quick), quick, 3364),
        "BP",
        {0: (_RED, 0.3, 20.0), 1: (0.3, 0.5, 20.0)},
        {},
        "grace_cross.hdr",
        ([0.15, 0.2, 0.5], _ABOVE, 0.6),
        AIRPLANE,
    ),
    "watch": Recipe(
        lambda quick: interiors.watch(step=0.5 if quick else 0.07),
        "CT",
        {0: (0.02, [0.8, 0.8, 0.82], [0.9, 0.2]), 1: (0.02, [0.8, 0.8, 0.82], [0.9, 0.25])},
        {2: [0.04, 0.06, 0.2], 3: 0.6},
        "grace_cross.hdr",
        ([0.12, 0.22, 0.6], [0.0, 0.02, 0.03], 0.55),
        WATCH,
    ),
}
