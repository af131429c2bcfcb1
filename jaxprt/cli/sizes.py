"""Recipes of systems from their names and the options for sizes."""

from collections.abc import Sequence
from types import SimpleNamespace

from jaxprt.relit import Clusters, Harmonics, Lobes, Terms
from jaxprt.relit.recipes import Recipe

LAPLACIAN = {"none": 1.0, "laplacian": 0.4}  # fraction of the squared Laplacian that each window preserves
NAMES = ("lobe", "harmonic", "separable", "clusters")
_COUNT = 12  # default number of lobes
_TAKEN = {
    "lobes": ("lobe",),
    "texels": ("lobe", "clusters"),
    "terms": ("separable", "clusters", "dynamic"),
    "keep": ("separable", "clusters"),
    "components": ("clusters",),
    "modes": ("clusters",),
}


def check(options: SimpleNamespace, systems: Sequence[str], texels: int) -> None:
    """Refuses size options that none of the systems uses, or that exceed the size of the light.

    Raises:
        ValueError: A size belongs to another system, or there are more wavelet coefficients than texels.
    """
    for name, takers in _TAKEN.items():
        if getattr(options, name) is not None and not set(takers) & set(systems):
            raise ValueError(f"--{name} needs --system {' or '.join(takers)}, got {','.join(systems)}")
    if options.keep is not None and options.keep > texels:
        raise ValueError(f"--keep must be at most {texels}, got {options.keep}")


def recipes(system: str, options: SimpleNamespace, *, lobes: int = _COUNT) -> dict[str, Recipe]:
    """The recipes for a system and the options, by names that are used for folders and files."""
    if system == "lobe":
        counts = options.lobes or (lobes,)
        more = {} if options.texels is None else {"texels": options.texels}
        names = [system] if len(counts) == 1 else [f"lobe_{count}" for count in counts]
        return {name: Lobes(count, **more) for name, count in zip(names, counts, strict=True)}
    if system == "harmonic":
        return {system: Harmonics(options.order - 1, LAPLACIAN[options.window])}
    names = ("terms", "keep") if system == "separable" else ("terms", "keep", "components", "modes", "texels")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    return {system: Terms(**given) if system == "separable" else Clusters(**given)}
