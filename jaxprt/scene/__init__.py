"""Scenes: meshes, materials, environments, cameras, file formats, and embedded examples."""

from jaxprt.scene import builtin, camera, environment, mesh, occluder
from jaxprt.scene import light_probes as light_probes
from jaxprt.scene import light_samples as light_samples
from jaxprt.scene import material as material
from jaxprt.scene import subdivision as subdivision
from jaxprt.scene import texture as texture
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment, Sun, load_environment, with_suns
from jaxprt.scene.formats.scene_file import load_mesh, load_scene
from jaxprt.scene.light_probes import irradiance, light_probe
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.scene import Part, PointLight, Scene

__all__ = [
    "Camera",
    "Environment",
    "Mesh",
    "Part",
    "PointLight",
    "Scene",
    "Sun",
    "Texture",
    "TexturedMaterial",
    "builtin",
    "camera",
    "environment",
    "irradiance",
    "light_probe",
    "load_environment",
    "load_mesh",
    "load_scene",
    "mesh",
    "occluder",
    "with_suns",
]
