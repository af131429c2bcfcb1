"""Refines the meshes of a scene where shadows are finer than the vertices."""

import pathlib
from collections.abc import Sequence

import equinox as eqx
import filelock
import jax
import numpy as np
from jaxtyping import Int

from jaxprt import require
from jaxprt.brdf.varying import PerVertex
from jaxprt.files import objects
from jaxprt.relit import shadows
from jaxprt.scene import Camera, Environment, Mesh, Scene, subdivision
from jaxprt.scene.subdivision import Division
from jaxprt.visibility import blocks, refinement
from jaxprt.visibility.occluder import check

ERROR, TOLERATED = 0.008, 0.015  # of pictures, by default, and above which the default warns
_ROOM = 5_000  # vertices that division may add to a scene of few, by default


class MeshDivision(eqx.Module):
    """How the meshes of a scene were divided.

    Attributes:
        key: Fingerprint of the scene before, and of the settings.
        face: For each step, the triangles after it.
        origin: For each step, the triangle from which each was cut.
        parent: For each step, the two vertices between which each added vertex lies.
        counts: Number of vertices of each part before.
        error: Relative L2 error of pictures that is left, estimated.
    """

    key: str
    face: tuple[Int[np.ndarray, "_ 3"], ...]
    origin: tuple[Int[np.ndarray, " _"], ...]
    parent: tuple[Int[np.ndarray, "_ 2"], ...]
    counts: tuple[int, ...]
    error: float

    @property
    def steps(self) -> list[Division]:
        """The steps, for `subdivision`."""
        return [Division(*step) for step in zip(self.face, self.origin, self.parent, strict=True)]


def refine(
    scene: Scene,
    *,
    error: float = 0.02,
    vertices: int = 100_000,
    environments: Sequence[Environment] | None = None,
    progress: blocks.Progress = True,
) -> Scene:
    """Subdivides triangles where shadows vary between vertices. Call it before `jaxprt.precompute`.

    All parts cast shadows on each other. Parts that share a border are subdivided alike along it. `visibility.refine`
    defines the error.

    Args:
        scene: Scene from `jaxprt.load_scene`, or built from `jaxprt.Part`.
        error: Largest relative L2 error that linear interpolation between vertices may cause in pictures from the
            scene's cameras, and from some around it and its parts, as if surfaces were white and diffuse. 0 subdivides
            until the number of vertices is reached.
        vertices: Largest number of vertices after refinement. If this is too few for the error, the triangles with the
            largest errors are subdivided first, and a warning is given. A scene that already has more is returned
            unchanged.
        environments: Environments under which the error must hold. If None, light with the power spectrum of natural
            scenes, from any direction. Sharp shadows of a sun require the environment that contains it.
        progress: Whether to show a progress bar, or a function; see `jaxprt.Run`.

    Returns:
        The scene with the same surfaces, images and materials, and more vertices.

    Raises:
        TypeError: `scene` is not a `Scene`, `environments` is not a list of `Environment`, or a part has a material
            with one BRDF for each vertex.
        ValueError: `error` is negative or not finite; `vertices` is below 1; `environments` is empty or contains a
            batch; or rays cannot be traced, for the reasons that `visibility.Occluder` gives.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    require.number("error", error, 0.0)
    require.count("vertices", vertices, least=1)
    options = {"error": error, "vertices": vertices, "environments": environments, "progress": progress}
    return subdivision.subdivide_scene(scene, _divisions(scene, **options)[0])


def divided(
    scene: Scene,
    wanted: bool | float,
    *,
    vertices: int | None,
    environments: Sequence[Environment] | None,
    folder: pathlib.Path | None,
    progress: blocks.Progress,
) -> tuple[Scene, MeshDivision | None]:
    """A scene divided as `jaxprt.precompute` asks for, and how; None if it stays as it is.

    Args:
        scene: The scene.
        wanted: Largest relative L2 error; True for the default, False to keep the meshes.
        vertices: Largest number of vertices; None for the default.
        environments: Lights, as in `refine`. Their brightest texels do not count, because pictures trace their shadows.
        folder: Folder in which the division is stored.
        progress: Whether to show a progress bar, or a function; see `jaxprt.Run`.
    """
    if isinstance(wanted, bool | np.bool_):
        if not wanted:
            return scene, None
        wanted, tolerated = ERROR, TOLERATED
    else:
        require.number("refine", wanted, 0.0)
        tolerated = float(wanted)
    count = sum(scene.counts)
    most = 2 * count + _ROOM if vertices is None else vertices
    require.count("vertices", most, least=1)
    if any(isinstance(part.material, PerVertex) for part in scene.parts) or not any(
        len(part.mesh.face) for part in scene.parts
    ):
        return scene, None
    lights = None if environments is None else [shadows.untraced(light) for light in environments]
    options = {"error": float(wanted), "vertices": most, "environments": lights, "progress": progress}
    options |= {"tolerated": tolerated}
    division = _stored(scene, folder, options)
    return (subdivision.subdivide_scene(scene, division.steps), division) if division.face else (scene, None)


def _stored(scene: Scene, folder: pathlib.Path | None, options: dict) -> MeshDivision:
    """The division of a scene, made once for a folder."""
    if folder is None:
        return _division(scene, "", options)
    lights = [np.asarray(light.radiance) for light in options["environments"] or ()]
    cameras = [np.concatenate([np.ravel(value) for value in jax.tree.leaves(camera)]) for camera in scene.cameras]
    settings = np.asarray([options["error"], options["vertices"], refinement.ALGORITHM], np.float64)
    key = blocks.fingerprint(*_geometry(scene), settings, *cameras, *lights)
    with filelock.FileLock(folder / ".division.lock"):
        path = folder / "division"
        if path.exists():
            division = objects.load(path)
            if not isinstance(division, MeshDivision):
                raise ValueError(f"{path} is damaged: it must hold a division, got a {type(division).__name__}")
            if division.key != key:
                raise ValueError(
                    f"{path} divides another scene, or for other cameras, lights, `refine` or `vertices`: name another "
                    "path or delete it"
                )
            return division
        division = _division(scene, key, options)
        objects.save(path, division)
        return division


def _geometry(scene: Scene) -> list[np.ndarray]:
    mesh = scene.mesh
    arrays = mesh.position, mesh.normal, mesh.face, mesh.region, *jax.tree.leaves(mesh.opacity)
    return [np.asarray(array) for array in arrays]


def _division(scene: Scene, key: str, options: dict) -> MeshDivision:
    steps, error = _divisions(scene, **options)
    face, origin, parent = zip(*steps, strict=True) if steps else ((), (), ())
    counts = tuple(scene.counts)
    return MeshDivision(key, face, origin, parent, counts, error)


def _divisions(scene: Scene, *, error: float, **options) -> tuple[list[Division], float]:
    mesh, options = scene.mesh, {"tolerated": error, **options}
    return refinement.divisions(mesh, mesh, views=_views(scene, mesh), error=error, **options)


def interpolation_error(scene: Scene) -> float:
    """Relative L2 error of pictures by visibility that is interpolated between vertices, as `refine` estimates it."""
    mesh = scene.mesh
    return refinement.interpolation_error(mesh, views=_views(scene, mesh))


def _views(scene: Scene, mesh: Mesh) -> list[Camera]:
    check(mesh, "mesh of the scene")
    return refinement.cameras(mesh, scene.cameras, [part.mesh for part in scene.parts])
