"""What vertices see of the distant sphere: rays, hits, stored visibility, and the loop over blocks."""

from jaxprt.visibility import blocks, hits, points, rays, stored
from jaxprt.visibility.points import point_starts
from jaxprt.visibility.rays import LEVELS, Occluder, exhaustive, fractional, start_points
from jaxprt.visibility.stored import StoredVisibility, precompute

__all__ = [
    "LEVELS",
    "Occluder",
    "StoredVisibility",
    "blocks",
    "exhaustive",
    "fractional",
    "hits",
    "point_starts",
    "points",
    "precompute",
    "rays",
    "start_points",
    "stored",
]
