"""A ball over a ground under a sky of lobes, and Mitsuba's renderings of it, for the files that compare with them."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh

import jaxprt as prt

EYE = np.array([0.8, 2.4, 3.1])
RENDERINGS = 16
# A rendering of this many samples is made live. Seeds are the same as in what is kept, which must differ by less: a
# path that rounding sends elsewhere changes one sample of 64.
LIVE = 64
STALE = 0.01
SKY = np.array([0.05, 0.06, 0.08])
LOBES = [  # Direction and color.
    ((1.0, 0.4, 0.1), (3.0, 0.2, 0.1)),
    ((-0.9, 0.5, 0.3), (0.1, 2.0, 0.3)),
    ((0.2, 1.0, -0.1), (0.6, 0.5, 1.5)),
    ((0.1, 0.3, 1.0), (0.1, 0.4, 3.0)),
    ((-0.2, 0.2, -1.0), (1.5, 1.5, 0.1)),
    ((0.3, -1.0, 0.4), (0.2, 1.0, 1.0)),
]


def sky(direction: np.ndarray, sharpness: Any) -> np.ndarray:
    """Radiance from some directions, of lobes of one sharpness or of one each."""
    total = np.broadcast_to(SKY, direction.shape)
    for (axis, color), sharp in zip(LOBES, np.broadcast_to(sharpness, len(LOBES)), strict=True):
        total = total + np.exp(sharp * (direction @ (np.array(axis) / np.linalg.norm(axis)) - 1))[..., None] * color
    return total


def pictures(rows: int, sharpness: Any) -> tuple[np.ndarray, np.ndarray]:
    """The sky as pictures twice as wide as high, from +y to -y, with +z in the center column and +x beside it.

    Ours are boxes that fill the sphere, Mitsuba's are samples of which the first and last are poles.
    """
    longitude = np.pi * (1 - (np.arange(2 * rows) + 0.5) / rows)
    result = []
    for row in (np.pi * (0.5 - (np.arange(rows) + 0.5) / rows), np.linspace(np.pi / 2, -np.pi / 2, rows)):
        latitude, around = np.meshgrid(row, longitude, indexing="ij")
        across = np.cos(latitude)
        direction = np.stack([np.sin(around) * across, np.sin(latitude), np.cos(around) * across], -1)
        result.append(sky(direction, sharpness).astype(np.float32))
    return result[0], result[1]


class Scene(NamedTuple):
    """What both sides see."""

    position: np.ndarray
    face: np.ndarray
    normal: np.ndarray
    vertex: np.ndarray

    def mesh(self) -> prt.scene.Mesh:
        """One region, with Wang's tangents."""
        normal = jnp.asarray(self.normal)
        tangent = prt.sphere.directions.tangent(normal)
        region = jnp.zeros(len(normal), jnp.int32)
        return prt.scene.Mesh(jnp.asarray(self.position), jnp.asarray(self.face), normal, tangent, region)


def ball_over_ground(*, subdivisions: int, height: float) -> Scene:
    """A sphere of radius 0.5 that floats over a ground of 13 x 13 vertices; vertices in light, penumbra and shadow."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    center = np.array([0.0, height, 0.0])
    side = 13
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, side), np.linspace(-1.5, 1.5, side), indexing="ij")
    ground = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()[:, None]
    first, second = corner + np.array([0, 1, side]), corner + np.array([1, side + 1, side])
    position = np.concatenate([ground, ball.vertices + center])
    face = np.concatenate([first, second, ball.faces + len(ground)])
    up = np.broadcast_to([0.0, 1.0, 0.0], ground.shape)
    normal = np.concatenate([up, ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)])
    # Under the sphere, beside it, away from it; and around the visible side of the sphere.
    asked = np.array([[0.0, 0, 0.25], [0.5, 0, 0], [-0.5, 0, 0.25], [0.25, 0, 0.75], [-0.75, 0, -0.5], [1.25, 0, 1.25]])
    angle = np.array(
        [[0.1, 1.2], [0.9, 0.9], [-0.8, 0.7], [0.3, 0.3], [1.6, 0.5], [0.2, -0.3], [-1.0, 0.1], [1.0, -0.1]]
    )
    longitude, latitude = angle.T
    around = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], -1
    )
    asked = np.concatenate([asked, center + 0.5 * around])
    vertex = np.array([np.argmin(np.linalg.norm(position - point, axis=1)) for point in asked])
    return Scene(position.astype(np.float32), face.astype(np.int32), normal.astype(np.float32), vertex)


def render(mi, scene: Scene, picture: np.ndarray, *, bsdf: dict, samples: int, seeds, bounces: int = 0) -> np.ndarray:
    """Radiance towards the eye from points next to the vertices, in independent renderings, [rendering, v, 3]."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("mesh", len(scene.position), len(scene.face), has_vertex_normals=True, props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.position.ravel()
    parameters["vertex_normals"] = scene.normal.ravel()
    parameters["faces"] = scene.face.ravel()
    parameters.update()
    sensors = {f"sensor{i:02}": _meter(*ray) for i, ray in enumerate(rays(scene))}
    world = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2 + bounces, "rr_depth": 100},
            "sensor": {"type": "batch", "film": _film(len(sensors)), **sensors},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(picture)},
            "mesh": mesh,
        }
    )
    return np.stack([np.array(mi.render(world, spp=samples, seed=i))[0] for i in seeds])


def rays(scene: Scene):
    """From a little off the surface, on the way from the eye, to a point just inside a triangle at each vertex."""
    for vertex in scene.vertex:
        point, normal = scene.position[vertex].astype(float), scene.normal[vertex]
        face = scene.face[np.flatnonzero((scene.face == vertex).any(1))[0]]
        target = point + 1e-3 * (scene.position[face].mean(0) - point)
        assert normal @ (EYE - point) > 0.1, "the vertex must look at the eye"
        yield target + 0.02 * (EYE - point), target


def _meter(origin, target):
    direction = (target - origin).tolist()
    return {"type": "radiancemeter", "origin": origin.tolist(), "direction": direction, "film": _film(1)}


def _film(width):
    return {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
