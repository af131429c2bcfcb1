"""Files of daylight simulation: Radiance scenes, sensor grids, and the model folders of Honeybee.

Radiance's axes are x east, y north, z up. Results are in jaxprt's axes, +y up: (x, y, z) becomes (x, z, -y).
"""

import collections
import os
import pathlib
import re
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.scene.formats import geometry, text
from jaxprt.scene.mesh import make_mesh

Path = str | os.PathLike[str]
Sensors = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]

_ARGUMENTS = {"plastic": (5,), "metal": (5,), "trans": (7,), "glass": (3, 4), "mirror": (3,)}
_LAMPS = {"light", "glow", "spotlight"}
_SHAPES = {"source", "sphere", "bubble", "polygon", "cone", "cup", "cylinder", "tube", "ring", "instance", "mesh"}
_OTHERS = """illum prism1 prism2 plastic2 metal2 trans2 mist dielectric interface antimatter ashik2 plasfunc metfunc
transfunc plasdata metdata transdata BRTDfunc BSDF aBSDF WGMDfunc texfunc texdata colorfunc brightfunc colordata
brightdata colorpict colortext brighttext spectrum specfile specfunc specdata specpict mixfunc mixdata mixpict
mixtext"""
_TYPES = {*_SHAPES, *_OTHERS.split(), *_LAMPS, *_ARGUMENTS, "alias"}
_CLEAREST = 1.0886  # largest transmissivity in files: that of a transmittance of 1, by the formula of Radiance
_THIN = 1e-12  # area of a polygon relative to its squared extent, below which it is rounding error
_CROSSED = 0.01  # relative error of the area of a polygon's triangles from which on its edges cross


class _Primitive(NamedTuple):
    """A material or surface of a Radiance scene; `where` names its file and line."""

    modifier: str
    type: str
    name: str
    strings: list[str]
    numbers: list[float]
    where: str


def load_rad(*paths: Path) -> tuple[Scene, dict[str, float]]:
    """Reads a Radiance scene of polygons, from files in the order in which `oconv` would get them.

    Each material becomes one part of its name, lit from both sides. Polygons may be concave and may have holes that
    coincident edges connect to the outline. Only diffuse reflection is kept: `plastic` and `metal` with specularity s
    reflect (1 - s) of their color, a `mirror` is black, and `trans` is opaque. Lamps and skies (`light`, `glow`,
    `spotlight`, `source`), surfaces of `void`, and polygons without area are left out. A warning counts these and the
    materials of type `metal`, `mirror` and `trans`.

    Args:
        paths: The files.

    Returns:
        The scene; and for each part of `glass` its transmissivity, the mean of the three colors: the share of light
        that one pass through the glass leaves at normal incidence, without the reflections at its two faces.

    Raises:
        ValueError: A file has syntax errors, commands (`!xform`), shapes other than polygons, or polygons of other
            materials than those named above. The message names the file and the line.
    """
    return _load([_checked(path) for path in paths])


def load_sensors(path: Path) -> Sensors:
    """Reads sensors from a `.pts` file: lines `x y z nx ny nz`, separated by white space or commas.

    Args:
        path: The file. `#` starts a comment.

    Returns:
        Positions in the file's unit of length and unit normals, in jaxprt's axes and float64.

    Raises:
        ValueError: A line does not have six finite numbers, a normal is zero, or there are no sensors.
    """
    path = _checked(path)
    rows: list[list[float]] = []
    for line, content in enumerate(text.name(text.read(path, "a file of sensors")).split("\n"), 1):
        words = content.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{path}, line {line}"
        if len(words) != 6:
            raise ValueError(f"{where}: a sensor must have six numbers, x y z nx ny nz, got {len(words)}")
        rows.append([_number(word, where) for word in words])
        if not any(rows[-1][3:]):
            raise ValueError(f"{where}: the normal of a sensor must have a length, got {' '.join(words[3:])}")
    if not rows:
        raise ValueError(f"{path} must hold sensors, got none")
    sensor = np.array(rows, np.float64)
    normal = _to_y_up(sensor[:, 3:])
    normal /= np.abs(normal).max(1, keepdims=True)  # squares of tiny numbers would be zero
    return _to_y_up(sensor[:, :3]), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def load_honeybee(folder: Path) -> tuple[Scene, dict[str, float], dict[str, Sensors]]:
    """Reads the model folder that honeybee-radiance writes: `scene`, `aperture` and `grid`.

    Args:
        folder: The folder `model`, or the one that contains it.

    Returns:
        The scene and the transmissivities of its glass, as `load_rad` returns them; and the sensors of each grid by
        the path of its file in `grid`, without the suffix `.pts`.

    Raises:
        FileNotFoundError: There is no such folder, or no `.rad` file in its `scene` and `aperture`.
        ValueError: A file is wrong, or the model has aperture groups or dynamic geometry, which have several states.
    """
    folder = _checked(folder)
    model = folder / "model" if (folder / "model").is_dir() else folder
    for dynamic in ("aperture_group", "aperture_group/interior", "scene_dynamic", "scene_dynamic/indoor"):
        states = model / dynamic / "states.json"
        if states.exists() and inputs.json_object(states, "the states of dynamic geometry"):
            raise ValueError(
                f"{model} must have static geometry only, got {states}: move the files of the state to compute into "
                f"{model / 'aperture'} or {model / 'scene'}, and remove {states.name}"
            )
    # In order of names, so that x.mat comes before x.rad.
    files = [path for part in ("scene", "aperture") for path in sorted((model / part).glob("*"))]
    files = [path for path in files if path.suffix in (".mat", ".rad")]
    if not any(path.suffix == ".rad" for path in files):
        raise FileNotFoundError(f"{model} must be a model folder of Honeybee with scene/*.rad, and has no such file")
    grid = model / "grid"
    sensors = {
        path.relative_to(grid).with_suffix("").as_posix(): load_sensors(path) for path in sorted(grid.rglob("*.pts"))
    }
    return *_load(files), sensors


def _checked(path: Path) -> pathlib.Path:
    require.path("path", path)
    return pathlib.Path(path)


def _to_y_up(vector: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Vectors in jaxprt's axes from Radiance's."""
    return np.stack([vector[:, 0], vector[:, 2], -vector[:, 1]], -1)


def _number(word: str, where: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not abs(value) <= require.LARGEST or "_" in word:  # Python takes 1_000
        raise ValueError(f"{where}: expected a finite number, got {inputs.shortened(word)!r}")
    return value


def _load(paths: Sequence[pathlib.Path]) -> tuple[Scene, dict[str, float]]:
    """The scene of files and the transmissivity of its glass."""
    if not paths:
        raise ValueError("load_rad must have one or more files, got none")
    omitted: collections.Counter[str] = collections.Counter()
    surfaces = _surfaces(paths, omitted)
    parts, glass, names = [], {}, collections.Counter()
    for (name, kind, values), polygons in surfaces.items():
        material = _material(kind, values)
        names[name] += 1  # a later file may define the name again
        label = name if names[name] == 1 else f"{name} ({names[name]})"
        part = _part(label, material, polygons, omitted)
        if part is None:
            continue
        parts.append(part)
        if kind == "glass":
            glass[label] = float(np.mean(values[:3]))
        elif kind != "plastic":
            omitted[f"materials of type {kind} but for their diffuse reflection"] += 1
    if omitted:
        counts = ", ".join(f"{count} {what}" for what, count in omitted.items())
        warnings.warn(f"{paths[0]}{' and others' if paths[1:] else ''}: left out {counts}", stacklevel=3)
    if not parts:
        raise ValueError(f"{paths[0]} must hold polygons of materials, got none")
    return Scene(parts), glass


def _surfaces(
    paths: Sequence[pathlib.Path], omitted: collections.Counter[str]
) -> dict[tuple[str, str, tuple[float, ...]], list[_Primitive]]:
    """Polygons by name, type and numbers of their material."""
    modifiers: dict[str, _Primitive] = {}
    surfaces: dict[tuple[str, str, tuple[float, ...]], list[_Primitive]] = {}
    for item in (item for path in paths for item in _primitives(path)):
        if item.type not in _SHAPES and item.type != "alias":
            modifiers[item.name] = item
            continue
        name = item.strings[0] if item.type == "alias" else item.modifier
        material = modifiers.get(name)
        if material is None and name != "void":
            raise ValueError(f"{item.where}: material {name!r} must be defined before its use, and is not")
        if item.type == "alias" and material:
            inherits = item.modifier in ("void", "inherit")
            modifiers[item.name] = material if inherits else material._replace(modifier=item.modifier)
        elif item.type == "source":
            omitted["surfaces of type source"] += 1
        elif material is None or material.type in _LAMPS:
            omitted[f"surfaces of {material.type if material else 'void'}"] += 1
        elif item.type != "polygon":
            raise ValueError(f"{item.where}: shapes must be polygons, got a {item.type}, {item.name!r}")
        elif material.type not in _ARGUMENTS or material.modifier != "void":
            kinds = f"unmodified materials of type {', '.join(_ARGUMENTS)}"
            got = f"{material.type} with modifier {material.modifier!r}, {material.name!r} of {material.where}"
            raise ValueError(f"{item.where}: polygons must have {kinds}, got {got}")
        else:
            surfaces.setdefault((material.name, material.type, tuple(material.numbers)), []).append(item)
    return surfaces


def _primitives(path: pathlib.Path) -> Iterator[_Primitive]:
    """The primitives of a file, with their arguments counted and converted."""
    lines = text.name(text.read(path, "a Radiance scene")).split("\n")
    # A comment starts with a word: identifiers may contain #.
    rows = (re.sub(r"(^|\s)#.*", "", line).split() for line in lines)
    words = [(word, line) for line, row in enumerate(rows, 1) for word in row]
    position = 0

    def take(count: int, what: str) -> list[str]:
        nonlocal position
        position += count
        if position > len(words):
            raise ValueError(f"{where}: the primitive must have {what}, and the file ends before")
        return [word for word, _ in words[position - count : position]]

    while position < len(words):
        where = f"{path}, line {words[position][1]}"
        if words[position][0].startswith("!"):
            command = inputs.shortened(lines[words[position][1] - 1].strip())
            raise ValueError(f"{where}: the scene must have no commands, got {command!r}: flatten it with xform -e")
        modifier, kind, name = take(3, "a modifier, a type and an identifier")
        if kind not in _TYPES:
            raise ValueError(
                f"{where}: expected a modifier, a type of Radiance and an identifier, got {kind!r} as type"
            )
        if kind == "alias":
            yield _Primitive(modifier, kind, name, take(1, "the name of a material"), [], where)
            continue
        arguments = []
        for what in ("strings", "integers", "numbers"):
            line = words[min(position, len(words) - 1)][1]
            count = take(1, f"a count of {what}")[0]
            if not re.fullmatch(r"\d{1,9}", count):
                raise ValueError(f"{path}, line {line}: {name!r} must have a count of {what}, got {count!r}")
            start = position
            values = take(int(count), f"{count} {what}")
            if what == "numbers":
                values = [_number(word, f"{path}, line {words[start + i][1]}") for i, word in enumerate(values)]
            arguments.append(values)
        yield _checked_arguments(_Primitive(modifier, kind, name, arguments[0], arguments[2], where))


def _checked_arguments(item: _Primitive) -> _Primitive:
    """Refuses wrong counts and ranges of the numbers of polygons and materials."""
    count = len(item.numbers)
    if item.type == "polygon" and (count < 9 or count % 3):
        raise ValueError(f"{item.where}: a polygon must have three numbers for each of 3 or more corners, got {count}")
    if item.type == "polygon":
        _check_holes(item)
    allowed = _ARGUMENTS.get(item.type)
    if allowed and count not in allowed:
        raise ValueError(f"{item.where}: {item.type} must have {' or '.join(map(str, allowed))} numbers, got {count}")
    shares = [0, 1, 2, 3, 5, 6] if item.type == "trans" else range(4 if count == 5 else 3)
    most = _CLEAREST if item.type == "glass" else 1.0
    if allowed and any(not 0 <= item.numbers[index] <= most for index in shares):
        raise ValueError(f"{item.where}: {item.type} must have shares of light from 0 to {most:g}, got {item.numbers}")
    return item


def _check_holes(polygon: _Primitive) -> None:
    """Refuses holes that run in the direction of the outline: Radiance sees them, ear clipping would fill them."""
    corners = [tuple(polygon.numbers[index : index + 3]) for index in range(0, len(polygon.numbers), 3)]
    if len(set(corners)) == len(corners):
        return
    loops, open_loop = [], []
    for corner in corners:
        if corner in open_loop:
            start = open_loop.index(corner)
            loops.append(np.array(open_loop[start:]))
            del open_loop[start:]
        open_loop.append(corner)
    loops.append(np.array(open_loop))
    normals = np.array([np.cross(loop - loop[0], np.roll(loop, -1, 0) - loop[0]).sum(0) for loop in loops])
    outline = int(np.linalg.norm(normals, axis=1).argmax())
    x, y = np.argsort(np.abs(normals[outline]))[:2]
    start, end = loops[outline], np.roll(loops[outline], -1, 0)
    for index in np.flatnonzero(normals @ normals[outline] > 0):
        point = loops[index].mean(0)
        crossed = (start[:, y] > point[y]) != (end[:, y] > point[y])
        run, rise = (end - start)[crossed].T[[x, y]]
        right = start[crossed, x] + (point[y] - start[crossed, y]) / rise * run > point[x]
        if index != outline and right.sum() % 2:
            raise ValueError(f"{polygon.where}: a hole must run opposite to the outline, got one along it")


def _material(kind: str, values: Sequence[float]) -> TexturedMaterial:
    """The diffuse part of a material; glass transmits its color."""
    color = np.minimum(values[:3], 1)
    if kind in ("plastic", "metal", "trans"):
        color *= 1 - values[3]
    if kind == "trans":
        color *= 1 - values[5]
    if kind == "mirror":
        color *= 0
    transmission = float(kind == "glass")
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0, transmission=transmission, back="lit")


def _part(
    name: str, material: TexturedMaterial, polygons: Sequence[_Primitive], omitted: collections.Counter[str]
) -> Part | None:
    """The part of a material, with vertices of its own for each polygon; None if no polygon has an area."""
    size = np.array([len(polygon.numbers) // 3 for polygon in polygons])
    position = _to_y_up(np.concatenate([polygon.numbers for polygon in polygons]).reshape(-1, 3))
    start = np.cumsum(size) - size
    point = position - np.repeat(position[start], size, 0)
    following = np.arange(1, len(point) + 1)
    following[start + size - 1] = start
    normal = np.add.reduceat(np.cross(point, point[following]), start)  # Newell's, twice the area
    area = np.linalg.norm(normal, axis=1)
    solid = area > _THIN * np.maximum.reduceat(np.abs(point).max(1), start) ** 2
    omitted += collections.Counter({"polygons without area": int((~solid).sum())})
    if not solid.any():
        return None
    corner = np.flatnonzero(np.repeat(solid, size))
    position, size, normal, area = position[corner], size[solid], normal[solid] / area[solid, None], area[solid]
    polygon = geometry.Polygons(np.arange(len(position)), size)
    triangle = geometry.triangulate(position, polygon, name)
    first, second, third = np.moveaxis(position[triangle.corner], 1, 0)
    cross = np.cross(second - first, third - first)
    covered = np.bincount(triangle.polygon, np.abs(np.sum(cross * normal[triangle.polygon], 1)), len(size))
    wrong = np.flatnonzero(np.abs(covered - area) > _CROSSED * area)
    if wrong.size:
        where = polygons[int(np.flatnonzero(solid)[wrong[0]])].where
        warnings.warn(f"{where}: {wrong.size} polygons of {name!r} cross themselves, this is the first", stacklevel=4)
    return Part(name, make_mesh(position, triangle.corner, normal=np.repeat(normal, size, 0), name=name), material)
