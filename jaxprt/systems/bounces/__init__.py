"""Bounces: reflected light by precomputed transfer tensors, materials free (Sun et al. 2007)."""

from jaxprt.systems.bounces import functions, gather, jobs, parts, relight, system, tensor, traced
from jaxprt.systems.bounces.functions import factor
from jaxprt.systems.bounces.parts import PartBounces, ReflectingPart
from jaxprt.systems.bounces.relight import arriving, combine, light_side, radiance, view_side
from jaxprt.systems.bounces.system import BouncesSystem
from jaxprt.systems.bounces.tensor import SecondBounce, TransferTensor, precompute

__all__ = [
    "BouncesSystem",
    "PartBounces",
    "ReflectingPart",
    "SecondBounce",
    "TransferTensor",
    "arriving",
    "combine",
    "factor",
    "functions",
    "gather",
    "jobs",
    "light_side",
    "parts",
    "precompute",
    "radiance",
    "relight",
    "system",
    "tensor",
    "traced",
    "view_side",
]
