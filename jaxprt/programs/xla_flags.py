"""Flags of XLA that right results need, set without importing JAX."""

import importlib.metadata
import os
import sys
import warnings

# jaxlib 0.10.2, the newest for Python 3.11, fuses sums of products wrongly on CPUs (jax-ml/jax#39103). Without these
# fusions it is right, and no slower.
_FLAG = "--xla_cpu_experimental_ynn_fusion_type="


def set_up() -> None:
    """Sets the flag where jaxlib needs it. JAX reads flags when the first array is made."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    if importlib.metadata.version("jaxlib") != "0.10.2" or _FLAG in flags:
        return
    bridge = sys.modules.get("jax._src.xla_bridge")
    chosen = any(flag.startswith(_FLAG) for flag in flags)
    if chosen or (bridge is not None and bridge.backends_are_initialized()):
        warnings.warn(
            f"jaxlib 0.10.2 computes wrong sums on CPUs (jax-ml/jax#39103) unless XLA_FLAGS={_FLAG} is set before the "
            "first array is made: import jaxprt before that, or set the variable",
            stacklevel=3,
        )
    if not chosen:
        os.environ["XLA_FLAGS"] = " ".join([*flags, _FLAG])
