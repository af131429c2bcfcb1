"""Visibility of the distant sphere from mesh vertices: ray casting, storage, the block loop, and mesh refinement."""

from jaxprt.visibility import blocks as blocks
from jaxprt.visibility import diffuse as diffuse
from jaxprt.visibility import members as members
from jaxprt.visibility import occluder as occluder
from jaxprt.visibility import rays as rays
from jaxprt.visibility import refinement as refinement
from jaxprt.visibility import starts as starts
from jaxprt.visibility import stored as stored
from jaxprt.visibility.blocks import Run, Shard, UnfinishedError
from jaxprt.visibility.occluder import Occluder
from jaxprt.visibility.rays import LEVELS as LEVELS
from jaxprt.visibility.rays import exhaustive as exhaustive
from jaxprt.visibility.rays import fractional as fractional
from jaxprt.visibility.refinement import refine
from jaxprt.visibility.starts import point_starts as point_starts
from jaxprt.visibility.starts import start_points as start_points
from jaxprt.visibility.stored import StoredVisibility, precompute

__all__ = [
    "Occluder",
    "Run",
    "Shard",
    "StoredVisibility",
    "UnfinishedError",
    "precompute",
    "refine",
]
