"""Scenes whose meshes are as fine as their shadows."""

from collections.abc import Sequence

from jaxprt import require
from jaxprt.scene import Environment, Scene, subdivision
from jaxprt.visibility import refinement


def refine(
    scene: Scene,
    *,
    error: float = 0.02,
    vertices: int = 100_000,
    environments: Sequence[Environment] | None = None,
    progress: bool = True,
) -> Scene:
    """Divides the triangles of a scene where its shadows are finer than its vertices, before `jaxprt.precompute`.

    All parts cast shadows on each other, and are divided alike where they share a border. See `visibility.refine` for
    what the error means.

    Args:
        scene: The scene, from `jaxprt.load_scene` or made of `jaxprt.Part`.
        error: Relative L2 error that interpolation between vertices may leave in the radiance of the surface of the
            whole scene, were it white and diffuse. 0 divides until there are as many vertices as allowed.
        vertices: How many the scene may have afterwards. Where that is too few for the error, the largest errors are
            taken away first, with a warning. A scene that has more stays as it is.
        environments: Lights for which the error must hold. If None, light of natural spectrum from any direction; the
            shadows of a sun need the light that it is in.
        progress: Whether to show a progress bar.

    Returns:
        The scene with the same surfaces, images and materials, and more vertices.

    Raises:
        TypeError: There is no scene, the environments are no list of lights, or the material of a part has one BRDF for
            each vertex.
        ValueError: The error is negative or not finite, vertices are fewer than 1, there are no environments or one is
            a batch, or rays cannot be traced as for `visibility.Occluder`.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    mesh = scene.mesh
    options = {"error": error, "vertices": vertices, "environments": environments, "progress": progress}
    return subdivision.subdivide_scene(scene, refinement.divisions(mesh, mesh, **options))
