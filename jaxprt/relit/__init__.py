"""Precomputes scenes and relights them, with any of the systems."""

from jaxprt.relit import build, channels, exact, measuring, planning, probes, recipes, refinement, scene
from jaxprt.relit.build import precompute
from jaxprt.relit.planning import Plan, plan
from jaxprt.relit.recipes import Clusters, Dynamic, Harmonics, Lobes, Terms
from jaxprt.relit.refinement import refine
from jaxprt.relit.scene import RelitScene

__all__ = [
    "Clusters",
    "Dynamic",
    "Harmonics",
    "Lobes",
    "Plan",
    "RelitScene",
    "Terms",
    "build",
    "channels",
    "exact",
    "measuring",
    "plan",
    "planning",
    "precompute",
    "probes",
    "recipes",
    "refine",
    "refinement",
    "scene",
]
