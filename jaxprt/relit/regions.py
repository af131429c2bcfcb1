"""Pictures of systems whose parts are the regions of one mesh: the dynamic system, alone or with bounces."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxprt.image import rasterize, shading_points
from jaxprt.relit.canvas import Canvas, drawn, lay_out, points_of, rows_of
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.scene.camera import localized
from jaxprt.scene.points import Points
from jaxprt.systems.protocol import System


class RegionsView(eqx.Module):
    """All of a picture that does not depend on the light, for a system of regions; `of_regions` makes it.

    Attributes:
        system: The system.
        materials: Materials of the regions, in the form that `System.view` takes.
        camera: The camera.
        canvas: The points that are shaded, and their pixels.
        points: For each row that is shaded at once, the points on each region.
        kept: View of each row, in the form of the system; None if it is recomputed for each light.
    """

    system: System
    materials: PyTree
    camera: Camera
    canvas: Canvas
    points: tuple[tuple[Points, ...], ...]
    kept: tuple[PyTree, ...] | None

    def picture(self, environment: Environment) -> Float[Array, "h w c"]:
        """Renders the picture under an environment, in linear radiance.

        Raises:
            TypeError: `environment` is not an `Environment`.
            ValueError: The environment is a batch, or has another size than the system requires.
        """
        arriving, rows = self.system.shade(self.system.light(environment), self.materials), []
        for number, points in enumerate(self.points):
            system = self.system.at(points)
            view = system.view(jnp.asarray(self.camera.eye), self.materials) if self.kept is None else self.kept[number]
            rows.append(system.combine(arriving, view))
        return drawn(self.canvas, rows, environment)


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
    mesh, camera = localized(mesh, camera)
    pixels = shading_points(rasterize(mesh, camera, samples=samples), mesh, camera)
    region, face, triangle = (np.asarray(each) for each in (mesh.region, mesh.face, pixels.triangle))
    owner = np.where(triangle >= 0, region[face[triangle, 0]], -1)
    every = [np.flatnonzero(owner == number) for number in range(region.max() + 1)]
    rows, width = rows_of(owner == np.argmax([len(each) for each in every])).shape
    index = np.stack([np.pad(each, (0, rows * width - len(each)), constant_values=-1) for each in every])
    index = jnp.asarray(index.reshape(len(every), rows, width).swapaxes(0, 1))
    # Index of each vertex among those of its region.
    place = np.zeros(len(region), np.int32)
    for number in range(len(every)):
        member = np.flatnonzero(region == number)
        place[member] = np.arange(len(member))
    corner = jnp.asarray(place[face])
    points = tuple(tuple(points_of(pixels, corner, 0, each) for each in row) for row in index)
    kept = tuple(system.at(row).view(jnp.asarray(camera.eye), materials) for row in points) if keep else None
    return RegionsView(system, materials, camera, lay_out(pixels, list(index), camera), points, kept)
