"""Precomputes scenes and relights them, with any of the systems."""

from jaxprt.relit import build, channels, exact, measuring, planning, probes, recipes, refinement, registry, scene
from jaxprt.relit.build import precompute
from jaxprt.relit.planning import Plan, plan
from jaxprt.relit.recipes import Clusters, Dynamic, Harmonics, Lobes, Recipe, Target, Terms
from jaxprt.relit.refinement import refine
from jaxprt.relit.registry import register
from jaxprt.relit.scene import RelitScene

__all__ = [
    "Clusters",
    "Dynamic",
    "Harmonics",
    "Lobes",
    "Plan",
    "Recipe",
    "RelitScene",
    "Target",
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
    "register",
    "registry",
    "scene",
]
