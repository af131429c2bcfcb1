"""What is looked at: meshes, environments, cameras, embedded scenes."""

from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh

__all__ = ["Camera", "Environment", "Mesh"]
