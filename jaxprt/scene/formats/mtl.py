"""Materials of OBJ files (Wavefront MTL), including the metallic-roughness statements of newer exporters."""

import functools
import math
import pathlib
import re
import warnings
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import obj, text
from jaxprt.scene.formats.obj import statement
from jaxprt.scene.formats.texture_images import TextureImages
from jaxprt.scene.material import Texture, TexturedMaterial

_COLORS = {"Kd": "base_color", "Ke": "emissive", "Ks": "Ks"}
_NUMBERS = {"Ns", "Ni", "Pr", "Pm", "illum"}
# Target of each map: field, channels, and whether it holds sRGB colors.
_MAPS = {
    "map_Kd": ("base_color_texture", (0, 1, 2), True),
    "map_Ke": ("emissive_texture", (0, 1, 2), True),
    "map_Pr": ("roughness_texture", (0,), False),
    "map_Pm": ("metallic_texture", (0,), False),
    "norm": ("normal_texture", (0, 1, 2), False),
}
_ARGUMENTS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # most values of map options; all other options have one
_SILENT = {"Ka", "map_Ka", "Tf", "sharpness"}  # ambient light is computed; the others concern refraction
_OPACITY = {"d", "Tr", "map_d"}
_BLENDER = re.compile(
    r"# Blender (v?)(\d+)\.(\d+)"
)  # first line of OBJ files by Blender; the v is from its older exporter


def of_regions(
    path: pathlib.Path, plain: TexturedMaterial, *, outside: bool = False
) -> tuple[list[str], list[TexturedMaterial]]:
    """Names and materials of the regions of an OBJ file, in the order of their first faces.

    A single warning names everything that is missing (MTL files, materials, images) or not supported. Missing materials
    are replaced by `plain`. Materials that no face has are not read. Textures of one image share it.

    Args:
        path: The OBJ file.
        plain: Material of faces without one.
        outside: Whether MTL files and images may be outside of the folder of the OBJ file.

    Raises:
        ValueError: An MTL file or an image is outside of the folder, whether it exists or not.
    """
    source = obj.content(path)
    order, files = obj.used_materials(source)
    materials: dict[str, TexturedMaterial] = {}
    ignored: set[str] = set()
    first = text.name(source.partition(b"\n")[0])
    pictures = TextureImages()
    read_already: set[pathlib.Path] = set()
    refer = functools.partial(inputs.reference, folder=path.parent, outside=outside)
    for file in files:
        named = refer(file, path.parent, owner=f"{path}, mtllib")
        words = file.split() if _absence(named) else []
        for library in [refer(word, path.parent, owner=f"{path}, mtllib") for word in words] or [named]:
            absence = _absence(library)
            if absence:
                ignored.add(f"mtllib ({library}, {absence})")
            elif (target := library.resolve()) not in read_already:
                read_already.add(target)
                wanted = {label or "" for label in order} - materials.keys()
                material, more = read(library, wanted, blender=_exponent(first), refer=refer, pictures=pictures)
                materials, ignored = material | materials, ignored | more
    ignored |= {f"usemtl {label} (no such material)" for label in order if label is not None and label not in materials}
    if ignored:
        warnings.warn(f"{path}: not supported and ignored are {', '.join(sorted(ignored))}", stacklevel=3)
    return [label or "default" for label in order], [materials.get(label or "", plain) for label in order]


def _exponent(line: str) -> float | None:
    """The exponent Ns that this version of Blender writes for a roughness of 0, from the first line of the OBJ file.

    None for other programs, and for Blender before 2.80, which had Phong materials.
    """
    found = _BLENDER.match(line)
    if found is None or (version := (int(found[2]), int(found[3]))) < (2, 80):
        return None
    return 1000.0 if version >= (3, 3) and not found[1] else 900.0


def read(
    path: pathlib.Path,
    wanted: Collection[str],
    *,
    blender: float | None = None,
    refer: Callable[..., pathlib.Path],
    pictures: TextureImages,
) -> tuple[dict[str, TexturedMaterial], set[str]]:
    """Reads some materials of an MTL file.

    Kd is the base color, multiplied by map_Kd. If there is Pr or Pm (roughness and metalness), these and Ni determine
    the rest. Otherwise the material is a Phong material, which is converted to a dielectric. Its reflectance at normal
    incidence is Ks, or zero for illum 0 and 1 or without Ks. Its roughness is that of the microfacet distribution
    closest to the lobe of exponent Ns: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha) (Walter et al. 2007,
    "Microfacet models for refraction through rough surfaces", section 5.2).

    The opacity is d (or 1 - Tr) times map_d, a share of the light. It is read whatever illum says.

    Blender 2.80 and newer writes its principled material differently: Ns = `blender` (1 - roughness)^2, Ks = 12.5 times
    the reflectance at normal incidence, and metalness as Ka if illum is 3 or 6. Its textures replace the factors, and
    map_Bump is a normal map. Factors that accompany Pr and Pm are read in this way too.

    Args:
        path: The file.
        wanted: Names of the materials that are read, if the file has them.
        blender: Exponent that Blender writes for a roughness of 0, if the first line of the OBJ file names Blender;
            None for files of other programs.
        refer: `inputs.reference` with the folder in which images must be.
        pictures: Reads the images.

    Returns:
        Materials by name; and names of unsupported statements and of missing or damaged images.

    Raises:
        ValueError: A number is damaged or out of range, or an image is outside of the folder. The message states where.
    """
    ignored: set[str] = set()
    named: dict[str, dict[str, list[str]]] = {}
    statements: dict[str, list[str]] = {}
    lines = [text.name(line) for line in text.read(path, "an MTL file").split(b"\n")]
    if not lines or not lines[0].startswith("# Blender"):
        blender = None
    for line in lines:
        key, *rest = statement(line).split() or [""]
        if key == "newmtl":
            named[" ".join(rest)] = statements = {}
        elif key:
            statements[key] = rest if key in _MAPS or key == "map_d" else " ".join(rest).partition("#")[0].split()
    material = {
        name: _material(named[name], path, name, ignored, blender, refer, pictures) for name in named if name in wanted
    }
    return material, ignored


def _material(
    statements: dict[str, list[str]],
    path: pathlib.Path,
    name: str,
    ignored: set[str],
    blender: float | None,
    refer: Callable[..., pathlib.Path],
    pictures: TextureImages,
) -> TexturedMaterial:
    """The material from the statements after one newmtl."""
    if blender is not None:
        statements = {"norm" if key == "map_Bump" else key: words for key, words in statements.items()}
    keys = [*_COLORS, *_NUMBERS, *([] if blender is None else ["Ka"])]
    value = {key: _number(statements, key, path, name) for key in keys if key in statements}
    for key in value.keys() & {"Kd", "Ks", "Pr", "Pm"}:
        if np.max(value[key]) > 1:
            ignored.add(f"{key} above 1")
            value[key] = np.minimum(value[key], 1)
    field: dict[str, Any] = {_COLORS[key]: value[key] for key in ("Kd", "Ke") if key in value}
    for key, words in statements.items():
        if key in _MAPS or key == "map_d":
            options, words = _options(words)
            owner = f"{path}, {key} of material {name!r}"
            file = refer(" ".join(words), path.parent, owner=owner)
            _add_map(field, key, options, file, owner, ignored, pictures)
        elif key not in value and key not in _SILENT | _OPACITY:
            ignored.add(key)
    field |= _opacity(statements, "alpha_texture" in field, path, name, ignored)
    if blender is not None:
        field |= _principled(value, field.keys(), blender)
        return _checked(field, path, name)
    # A Phong lobe of exponent n corresponds to alpha = sqrt(2 / (n + 2)); roughness is the square root of alpha.
    roughness = (2 / (max(0.0, value.get("Ns", 0.0)) + 2)) ** 0.25
    if (value.keys() | statements.keys()) & {"Pr", "Pm", "map_Pr", "map_Pm"}:
        field["roughness"] = value.get("Pr", 1.0 if "roughness_texture" in field else roughness)
        field["metallic"] = value.get("Pm", 1.0 if "metallic_texture" in field else 0.0)
        field["ior"] = max(1.0, value.get("Ni", 1.5))
    elif "Ks" not in value or value.get("illum", 2) < 2:
        field |= {"metallic": 0.0, "roughness": roughness, "specular": 0.0}
    else:  # with the default index of refraction the reflectance is 4 % times the color
        field |= {"metallic": 0.0, "roughness": roughness, "specular_color": value["Ks"] / 0.04}
    return _checked(field, path, name)


def _opacity(
    statements: dict[str, list[str]], textured: bool, path: pathlib.Path, name: str, ignored: set[str]
) -> dict[str, Any]:
    """The opacity of a material: d, or 1 - Tr without d. An opaque material without map_d has none."""
    alpha = 1.0
    key = "d" if "d" in statements else "Tr"
    if key in statements:
        number = _number(statements, key, path, name)
        if not 0 <= number <= 1:
            ignored.add(f"{key} below 0 or above 1")
        alpha = min(max(number if key == "d" else 1 - number, 0.0), 1.0)
    if alpha == 1 and not textured:
        return {}
    return {"alpha": alpha, "alpha_mode": "blend"}


def _principled(value: dict[str, Any], given: Collection[str], exponent: float) -> dict[str, Any]:
    """Factors of Blender's principled material, from the values that Blender's exporter writes.

    Blender's importer uses the same inverse: source/blender/io/wavefront_obj/importer/obj_import_mtl.cc.
    """
    shine = min(max(value.get("Ns", 0.0) / exponent, 0.0), 1.0)
    metallic = min(max(value.get("Ka", 0.0), 0.0), 1.0) if value.get("illum", 2) in (3, 6) else 0.0
    specular = value.get("Ks", np.full(3, 0.5))
    factor: dict[str, Any] = {
        "roughness": value.get("Pr", 1 - math.sqrt(shine)),
        "metallic": value.get("Pm", metallic),
        "specular": float(np.max(specular) > 0),
        "specular_color": 2 * specular,  # Blender reflects 4 % at 0.5, this package at 1
    }
    return factor | {
        key: 1.0 for key in ("base_color", "roughness", "metallic", "emissive") if f"{key}_texture" in given
    }


def _checked(field: dict[str, Any], path: pathlib.Path, name: str) -> TexturedMaterial:
    """Makes the material. Errors name the file and the material."""
    try:
        with np.errstate(over="ignore"):  # materials refuse what is not finite
            return TexturedMaterial(**field)
    except ValueError as error:
        raise ValueError(f"{path}, material {name!r}: {error}") from error


def _number(statements: dict[str, list[str]], key: str, path: pathlib.Path, name: str) -> Any:
    """The number or color of a statement. A single number stands for a gray."""
    words = statements[key]
    if key == "d" and words[:1] == ["-halo"]:
        words = words[1:]
    try:
        if not words or words[0] in ("spectral", "xyz"):
            raise ValueError
        number = [float(word) for word in words[: 3 if key in _COLORS else 1]]
        if not all(math.isfinite(each) for each in number):
            raise ValueError
    except ValueError:
        got = " ".join([key, *words])
        raise ValueError(f"{path}, material {name!r}: {key} must have finite numbers, got {got!r}") from None
    if key not in _COLORS:
        return number[0]
    return np.array(number if len(number) == 3 else number[:1] * 3)


def _add_map(
    field: dict[str, Any],
    key: str,
    options: dict[str, list[str]],
    file: pathlib.Path,
    owner: str,
    ignored: set[str],
    pictures: TextureImages,
) -> None:
    """Adds the texture of a statement. If it cannot be read, adds the reason to `ignored`.

    The opacity of map_d is the alpha of an image that has one, and otherwise its first channel.
    """
    name, channels, decoded = _MAPS.get(key, ("alpha_texture", (3,), False))
    try:
        absence = _absence(file)
        if absence:
            raise ValueError(f"{file}, {absence}")
        image = pictures.read(file, channels, decoded=decoded)
        if key == "map_d" and np.min(image) == 1:
            image = pictures.read(file, (0,), decoded=False)
    except ValueError as error:
        ignored.add(f"{key} ({error})")
        return
    honored = {"-o", "-s", "-clamp"}
    strength = options.get("-bm", [])
    if name == "normal_texture" and len(strength) == 1 and _is_number(strength[0]):
        honored |= {"-bm"}
        field["normal_scale"] = float(strength[0])
    ignored |= {f"option {each} of maps" for each in options.keys() - honored}
    scale, offset = (_pair(options.get(each, []), plain) for each, plain in (("-s", 1.0), ("-o", 0.0)))
    wrap = "clamp" if options.get("-clamp") == ["on"] else "repeat"
    with np.errstate(over="ignore"):  # textures refuse what is not finite
        transform = np.array([[scale[0], 0, offset[0]], [0, scale[1], offset[1]]]).astype(np.float32)
    try:
        field[name] = Texture(image, transform, 0, (wrap, wrap))
    except ValueError as error:
        raise ValueError(f"{owner}: {error}") from error


def _absence(path: pathlib.Path) -> str:
    """Why a path is not that of a regular file; empty if it is."""
    try:
        inputs.check(path, "a file")
    except FileNotFoundError:
        return "which does not exist"
    except ValueError:
        return "which is not a regular file"
    return ""


def _options(words: list[str]) -> tuple[dict[str, list[str]], list[str]]:
    """The options of a map, and the words of its file name, which follow them."""
    options: dict[str, list[str]] = {}
    place = 0
    while place < len(words) - 1 and words[place].startswith("-"):
        key, end = words[place], place + 1
        while end < len(words) - 1 and end - place <= _ARGUMENTS.get(key, 1):
            if key in _ARGUMENTS and not _is_number(words[end]):
                break
            end += 1
        options[key] = words[place + 1 : end]
        place = end
    return options, words[place:]


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _pair(words: list[str], plain: float) -> list[float]:
    """The first two numbers of an option of up to three."""
    return [*(float(word) for word in words[:2]), plain, plain][:2]
