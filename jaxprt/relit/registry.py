"""Systems and BRDFs by name: those of jaxprt, and those that other packages register."""

import re
from collections.abc import Mapping
from typing import Any

from jaxprt import brdf, require
from jaxprt.files import extensions
from jaxprt.relit.recipes import Dynamic, Harmonics, Lobes, Recipe, Terms
from jaxprt.scene import TexturedMaterial

SYSTEMS: dict[str, Recipe] = {
    "dynamic": Dynamic(),
    "harmonic": Harmonics(laplacian=0.4),
    "lobe": Lobes(),
    "separable": Terms(),
}
MATERIALS: dict[str, type] = {
    "lambert": brdf.Lambert,
    "phong": brdf.Phong,
    "blinn-phong": brdf.BlinnPhong,
    "ashikhmin-shirley": brdf.AshikhminShirley,
    "ward": brdf.Ward,
    "ward-duer": brdf.WardDuer,
    "cook-torrance": brdf.CookTorrance,
    "lafortune": brdf.Lafortune,
    "poulin-fournier": brdf.PoulinFournier,
    "poulin-fournier-grooves": brdf.PoulinFournierGrooves,
    "ggx": brdf.GGX,
    "ggx-interface": brdf.GGXInterface,
    "charlie": brdf.Charlie,
    "metallic-roughness": TexturedMaterial,
}
_OURS = {*SYSTEMS, "clusters", "planned"}, {*MATERIALS}  # names of systems and materials that stay


def systems() -> Mapping[str, Recipe]:
    """The recipe of each system by name, with those of installed packages."""
    extensions.discover()
    return SYSTEMS


def materials() -> Mapping[str, type]:
    """The class of each analytic material by name, with those of installed packages."""
    extensions.discover()
    return MATERIALS


def register(name: str, extension: Recipe | type) -> None:
    """Registers a system or a BRDF of another package, so that it is used by its name and files may hold it.

    `jaxprt.precompute(scene, system=name)`, `jaxprt.plan` and the option --system take a system, and the option
    --brdf a BRDF. `jaxprt.files.save` and `load` take objects of the registered classes: that of the BRDF, or that
    of the recipe and its `classes`.

    A package that is installed names the module that calls this function as an entry point of the group "jaxprt". It is
    then imported by commands, by `jaxprt.files.load` and by `jaxprt.precompute` where they need it:

        [project.entry-points.jaxprt]
        texels = "texels"

    Args:
        name: Lower-case letters, digits, - and _, with a letter first. Registering a class again replaces it.
        extension: A recipe with its default parameters, or the class of a BRDF.

    Raises:
        TypeError: `extension` is neither, or a class is not a data class.
        ValueError: The name has another form, or belongs to another class.
    """
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_-]*", name):
        raise ValueError(f"the name must consist of a-z, 0-9, - and _, with a letter first, got {require.shown(name)}")
    named: dict[str, Any]
    if isinstance(extension, Recipe):
        named, ours, classes = SYSTEMS, _OURS[0], (type(extension), *extension.classes)
    else:
        _check_brdf(extension)
        named, ours, classes = MATERIALS, _OURS[1], (extension,)
    full = _owner(extension)
    owner = "jaxprt" if name in ours else _owner(named.get(name, extension))
    if owner != full:
        raise ValueError(f"the name {name!r} belongs to {owner}: register {full} by another one")
    extensions.allow(classes)
    named[name] = extension


def _owner(extension: Any) -> str:
    """The full name of a class, or of the class of a recipe."""
    return extensions.full_name(extension if isinstance(extension, type) else type(extension))


def _check_brdf(kind: object) -> None:
    """Refuses anything but the class of a BRDF."""
    required = "a recipe, such as jaxprt.relit.Lobes(), or the class of a BRDF, which has __call__(wi, wo)"
    if not isinstance(kind, type):
        raise TypeError(f"what is registered must be {required}, got {require.shown(kind)}")
    if issubclass(kind, Recipe):
        raise TypeError(
            f"what is registered must be {required}, got the class {kind.__name__}: register {kind.__name__}()"
        )
    if "__call__" not in dir(kind):
        raise TypeError(f"what is registered must be {required}, got the class {kind.__name__}")
