"""What is looked at: meshes, environments, cameras, embedded scenes."""

from jaxprt.scene import builtin, camera, environment, interiors, mesh, occluder, texture
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment, load_environment
from jaxprt.scene.mesh import Mesh, load_mesh

__all__ = [
    "Camera",
    "Environment",
    "Mesh",
    "builtin",
    "camera",
    "environment",
    "interiors",
    "load_environment",
    "load_mesh",
    "mesh",
    "occluder",
    "texture",
]
