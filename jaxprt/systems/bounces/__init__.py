"""Bounces: reflected light by precomputed transfer tensors, with materials that can change (Sun et al. 2007)."""

from jaxprt.systems.bounces import build, exported, functions, gather, jobs, parts, patches, tensor, traced
from jaxprt.systems.bounces.build import precompute
from jaxprt.systems.bounces.parts import GroupBounces, ReflectingPart
from jaxprt.systems.bounces.patches import Patches
from jaxprt.systems.bounces.tensor import SecondBounce, TransferTensor

__all__ = [
    "GroupBounces",
    "Patches",
    "ReflectingPart",
    "SecondBounce",
    "TransferTensor",
    "build",
    "exported",
    "functions",
    "gather",
    "jobs",
    "parts",
    "patches",
    "precompute",
    "tensor",
    "traced",
]
