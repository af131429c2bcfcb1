"""Scenes made ready to be relit, by any of the systems."""

from jaxprt.relit import build, channels, recipes, scene
from jaxprt.relit.build import precompute
from jaxprt.relit.recipes import Clusters, Harmonics, Lobes, Terms
from jaxprt.relit.scene import RelitScene

__all__ = [
    "Clusters",
    "Harmonics",
    "Lobes",
    "RelitScene",
    "Terms",
    "build",
    "channels",
    "precompute",
    "recipes",
    "scene",
]
