"""Refines the meshes of a scene where shadows are finer than the vertices."""

from collections.abc import Sequence

from jaxprt import require
from jaxprt.scene import Environment, Scene, subdivision
from jaxprt.visibility import refinement, shown


def refine(
    scene: Scene,
    *,
    error: float = 0.02,
    vertices: int = 100_000,
    environments: Sequence[Environment] | None = None,
    progress: bool = True,
) -> Scene:
    """Subdivides triangles where shadows vary between vertices. Call it before `jaxprt.precompute`.

    All parts cast shadows on each other. Parts that share a border are subdivided alike along it. `visibility.refine`
    defines the error.

    Args:
        scene: Scene from `jaxprt.load_scene`, or built from `jaxprt.Part`.
        error: Largest relative L2 error that linear interpolation between vertices may cause in the radiance of the
            whole scene's surface, as if it were white and diffuse. 0 subdivides until the number of vertices is
            reached.
        vertices: Largest number of vertices after refinement. If this is too few for the error, the triangles with the
            largest errors are subdivided first, and a warning is given. A scene that already has more is returned
            unchanged.
        environments: Environments under which the error must hold. If None, light with the power spectrum of natural
            scenes, from any direction. Sharp shadows of a sun require the environment that contains it.
        progress: Whether to show a progress bar.

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
    mesh = scene.mesh
    views = shown.cameras(mesh, scene.cameras, [part.mesh for part in scene.parts])
    options = {"error": error, "vertices": vertices, "environments": environments, "progress": progress}
    return subdivision.subdivide_scene(scene, refinement.divisions(mesh, mesh, views=views, **options)[0])
