"""Bounces: reflected light by precomputed transfer tensors, with materials that can change (Sun et al. 2007)."""

from jaxprt.systems.bounces import (
    between,
    build,
    functions,
    gather,
    jobs,
    parts,
    patches,
    relight,
    system,
    tensor,
    traced,
)
from jaxprt.systems.bounces.build import precompute
from jaxprt.systems.bounces.functions import factor
from jaxprt.systems.bounces.parts import GroupBounces, ReflectingPart
from jaxprt.systems.bounces.patches import Patches
from jaxprt.systems.bounces.relight import arriving, combine, light_side, radiance, view_side
from jaxprt.systems.bounces.system import BouncesSystem
from jaxprt.systems.bounces.tensor import SecondBounce, TransferTensor

__all__ = [
    "BouncesSystem",
    "GroupBounces",
    "Patches",
    "ReflectingPart",
    "SecondBounce",
    "TransferTensor",
    "arriving",
    "between",
    "build",
    "combine",
    "factor",
    "functions",
    "gather",
    "jobs",
    "light_side",
    "parts",
    "patches",
    "precompute",
    "radiance",
    "relight",
    "system",
    "tensor",
    "traced",
    "view_side",
]
