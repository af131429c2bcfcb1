"""The names of `import jaxprt`. They are imported when the first of them is used."""

from jaxprt import brdf, daylight, decompose, files, image, inverse, relit, scene, sensors, sphere, view, visibility
from jaxprt.relit import RelitScene, plan, precompute, refine, register
from jaxprt.scene import Camera, Environment, Part, Scene, load_environment, load_mesh, load_scene
from jaxprt.sensors import transport
from jaxprt.systems import bounces, bright_texels, dynamic, harmonic, lamps, lobe, reference, separable
from jaxprt.systems.devices import shard
from jaxprt.systems.protocol import Blend, System, memory, radiance, total
from jaxprt.visibility import Run

__all__ = [
    "Blend",
    "Camera",
    "Environment",
    "Part",
    "RelitScene",
    "Run",
    "Scene",
    "System",
    "bounces",
    "brdf",
    "bright_texels",
    "daylight",
    "decompose",
    "dynamic",
    "files",
    "harmonic",
    "image",
    "inverse",
    "lamps",
    "load_environment",
    "load_mesh",
    "load_scene",
    "lobe",
    "memory",
    "plan",
    "precompute",
    "radiance",
    "reference",
    "refine",
    "register",
    "relit",
    "scene",
    "sensors",
    "separable",
    "shard",
    "sphere",
    "total",
    "transport",
    "view",
    "visibility",
]
