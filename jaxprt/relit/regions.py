"""Pictures of systems whose parts are the regions of one mesh: the dynamic system, alone or with bounces."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxprt.compile import put
from jaxprt.image import raster, rasterize, shading_points
from jaxprt.image.pixels import Pixels
from jaxprt.relit import canvas
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.scene.camera import localize
from jaxprt.scene.points import Points
from jaxprt.systems.protocol import System


class RegionsView(eqx.Module):
    """All of a picture that does not depend on the light, for a system of regions; `of_regions` makes it.

    Attributes:
        system: The system.
        materials: Materials of the regions, in the form that `System.view` takes.
        camera: The camera.
        pixels: The points of the picture.
        ray: Unit direction in world space from the eye through the center of each pixel.
        index: For each row that is shaded at once, the indices of the points on each region; -1 in padding.
        points: The points of each row on each region.
        kept: View of each row, in the form of the system; None if it is recomputed for each light.
    """

    system: System
    materials: PyTree
    camera: Camera
    pixels: Pixels
    ray: Float[Array, "h w 3"]
    index: tuple[Int[np.ndarray, "r p"], ...]
    points: tuple[tuple[Points, ...], ...]
    kept: tuple[PyTree, ...] | None

    def picture(self, environment: Environment) -> Float[Array, "h w c"]:
        """Renders the picture under an environment, in linear radiance.

        Raises:
            TypeError: `environment` is not an `Environment`.
            ValueError: The environment is a batch, or has another size than the system requires.
        """
        arriving, colors = self.system.shade(self.system.light(environment), self.materials), []
        for number, points in enumerate(self.points):
            system = self.system.at(points)
            view = system.view(jnp.asarray(self.camera.eye), self.materials) if self.kept is None else self.kept[number]
            colors.append(system.combine(arriving, view))
        most = max([environment.radiance.shape[-1], *(each.shape[-1] for each in colors)])
        picture = canvas.sky(environment, self.camera, self.ray, self.pixels.background, colors=most)
        for index, color in zip(self.index, colors, strict=True):
            picture = canvas.drawn(picture, self.pixels, index.reshape(-1), color)
        return picture


def of_regions(
    system: System, mesh: Mesh, camera: Camera, *, materials: PyTree = None, samples: int = 4, keep: bool = False
) -> RegionsView:
    """Prepares a picture of a mesh by a system of its regions: the dynamic system, alone or with bounces.

    Radiance is computed at every pixel. Not for use inside `jax.jit`.

    Args:
        system: The system of the mesh.
        mesh: The mesh.
        camera: The camera.
        materials: Materials of the regions, in the form that the system takes.
        samples: Number of coverage samples of each pixel: 4 or 1.
        keep: Whether to store what depends on the view, for many lights: about a kilobyte for each point.
    """
    mesh, camera = localize(mesh, camera)
    pixels = shading_points(rasterize(mesh, camera, samples=samples), mesh, camera)
    region, face, triangle = (np.asarray(each) for each in (mesh.region, mesh.face, pixels.triangle))
    owner = np.where(triangle >= 0, region[face[triangle, 0]], -1)
    every = [canvas.rows_of(owner == number) for number in range(region.max() + 1)]
    most = max(len(rows) for rows in every)
    index = np.stack([np.pad(rows, ((0, most - len(rows)), (0, 0)), constant_values=-1) for rows in every], 1)
    # Index of each vertex among those of its region.
    place = np.zeros(len(region), np.int32)
    for number in range(len(every)):
        member = np.flatnonzero(region == number)
        place[member] = np.arange(len(member))
    shift = np.arange(len(region)) - place
    points = tuple(tuple(_points(pixels, face, shift, each) for each in row) for row in index)
    kept = tuple(system.at(row).view(jnp.asarray(camera.eye), materials) for row in points) if keep else None
    return RegionsView(system, materials, camera, pixels, raster.ray_direction(camera), tuple(index), points, kept)


def _points(pixels: Pixels, face: np.ndarray, shift: np.ndarray, index: np.ndarray) -> Points:
    """Points on a region. A row of padding alone lies on the first vertex of the region."""
    if index[0] < 0:
        corner = np.zeros((3, len(index)), np.int32)
        weight = np.zeros((3, len(index)), pixels.barycentric.dtype)
        weight[0] = 1
        return put(Points(corner, weight, np.zeros((2, *weight.shape), weight.dtype)))
    return canvas.points_of(pixels, face, shift, index)[1]
