"""Visibility of the distant sphere from mesh vertices: ray casting, storage, the block loop, and mesh refinement."""

from jaxprt.visibility import blocks, diffuse, hits, members, occluder, points, rays, refinement, stored
from jaxprt.visibility.blocks import Part, UnfinishedError
from jaxprt.visibility.occluder import Occluder
from jaxprt.visibility.points import point_starts
from jaxprt.visibility.rays import LEVELS, exhaustive, fractional
from jaxprt.visibility.refinement import refine
from jaxprt.visibility.starts import start_points
from jaxprt.visibility.stored import StoredVisibility, precompute

__all__ = [
    "LEVELS",
    "Occluder",
    "Part",
    "StoredVisibility",
    "UnfinishedError",
    "blocks",
    "diffuse",
    "exhaustive",
    "fractional",
    "hits",
    "members",
    "occluder",
    "point_starts",
    "points",
    "precompute",
    "rays",
    "refine",
    "refinement",
    "start_points",
    "stored",
]
