"""OBJ files (Wavefront): their geometry, and their materials from MTL files."""

import functools
import io
import itertools
import math
import pathlib
import re
import warnings
from collections.abc import Callable, Collection, Set
from typing import Any, NamedTuple

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import geometry, text
from jaxprt.scene.formats.file_parts import TextureImages
from jaxprt.scene.formats.geometry import Geometry, MeshContent, split_corners
from jaxprt.scene.material import Fields, Texture, TexturedMaterial
from jaxprt.scene.mesh import CLEAR

Values = dict[str, Any]  # numbers and colors of a material, by keyword

_WHITE = re.compile(r"[ \t]+")
_COMMENT = re.compile(r"^#.*|\s#(\s.*)?$")  # names may contain a #, such as Blender's "Material_#25"
_COMMENT_PATH = re.compile(rb"^[^\S\n]*#[^\n]*\\$", re.MULTILINE)
_WHOLE = re.compile(rb"[+-]?\d{1,40}")  # of words with more digits, Python would refuse some
_CONTINUED = b" \v"  # replaces the line end after a backslash; \v is white space, and counts such lines for messages
_BLOCK = 1 << 16  # lines whose words are in memory at once
_LEAST = {b"v": 3, b"vt": 1, b"vn": 3}  # fewest numbers of a statement
_MOST = 8  # numbers of a statement that are looked at
# Statements without effect on triangles, besides those that are read. Smoothing groups (s) matter without normals.
_HARMLESS = {b"o", b"g", b"usemtl", b"mtllib", b"lod", b"bevel", b"c_interp", b"d_interp", b""}
_LISTED = 8  # unknown statements that a warning names
_NONE = -1 << 62  # index that a corner does not have
_WRONG = -1 << 61  # index that is no number or refers to nothing
_COLORS = {"Kd": "base_color", "Ke": "emissive", "Ks": "Ks"}
_NUMBERS = {"Ns", "Ni", "Pr", "Pm", "Pc", "Pcr", "Ps", "aniso", "illum"}
_UP_TO_1 = {"Kd", "Ks", "Pr", "Pm", "Pc", "Pcr", "Ps"}
# Target of each map: field, channels, and whether it holds sRGB colors.
_MAPS = {
    "map_Kd": ("base_color_texture", (0, 1, 2), True),
    "map_Ke": ("emissive_texture", (0, 1, 2), True),
    "map_Pr": ("roughness_texture", (0,), False),
    "map_Pm": ("metallic_texture", (0,), False),
    "map_Ps": ("sheen_color_texture", (0, 1, 2), False),
    "map_d": ("alpha_texture", (3,), False),
    "norm": ("normal_texture", (0, 1, 2), False),
}
_BUMPS = {"map_Bump", "map_bump", "bump"}  # heights, or normals as norm has them
_MAP_OF = {"Kd": "map_Kd", "Ke": "map_Ke", "Pr": "map_Pr", "Pm": "map_Pm", "Ps": "map_Ps"}  # what multiplies a factor
_ARGUMENTS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # most values of map options; all other options have one
_NEUTRAL = {"-blendu": ["on"], "-blendv": ["on"], "-cc": ["off"], "-mm": [0, 1], "-t": [0, 0, 0]}  # no effect
_SCALARS = {"r": (0,), "g": (1,), "b": (2,), "m": (3,)}  # channels of -imfchan for maps of one channel
# Ambient light is computed, sharpness is that of reflection maps, and anisor turns what aniso states.
_SILENT = {"Ka", "map_Ka", "sharpness", "anisor", "map_aat"}
_REFLECTING = {0, 1, 2, 3, 5, 8}  # illum of opaque surfaces
_REFRACTING = {4, 6, 7, 9}
_SHEEN = 0.5  # roughness of sheens, for which MTL has no statement: Blender's default
_UNIT, _NORMALS = 0.1, 0.9  # deviation of normals from unit length, and the least share of pixels that have them
_BLUISH = 0.1  # by which the mean height of normals exceeds their slopes
_SAMPLED = 1 << 18  # pixels of which normal maps are recognized
_OPACITY = {"d", "Tr"}
_CONTRADICTS = 0.01  # deviation of d + Tr from 1
_BLENDER = re.compile(
    r"# Blender (v?)(\d+)\.(\d+)"
)  # first line of OBJ files by Blender; the v is from its older exporter


class _Rows(NamedTuple):
    """The numbers [n k] of all statements of one kind, NaN where a row has fewer than others; and each row's line."""

    value: np.ndarray
    line: np.ndarray


class _Faces(NamedTuple):
    """The corners [c 3] of all faces, and the number of corners, the line and the region of each face."""

    corner: np.ndarray  # indices of the vertex, texture coordinates and normal
    size: np.ndarray
    line: np.ndarray
    region: np.ndarray


class _Source(NamedTuple):
    """The text of a file, and its path for messages."""

    path: pathlib.Path
    content: bytes

    def place(self, line: int) -> str:
        """The statement in a line and the number of the line in the file."""
        lines = self.content.split(b"\n")
        number = line + 1 + sum(before.count(b"\v") for before in lines[:line])
        return f"{text.name(lines[line].strip().replace(_CONTINUED, b' '))[:80]!r} in line {number}"


def _statement(line: str) -> str:
    """A line of an OBJ or MTL file without its comment. A comment starts with a # that stands alone or first."""
    return _COMMENT.sub("", line.strip()).strip()


def _content(path: pathlib.Path) -> bytes:
    """The text of an OBJ file with continued lines joined."""
    source = text.read(path, "an undamaged OBJ file")
    if b"\\\n" not in source:
        return source
    # Comments do not continue. They may end in a path of Windows.
    return _COMMENT_PATH.sub(lambda line: line[0] + b" ", source).replace(b"\\\n", _CONTINUED)


def read(path: pathlib.Path, *, groups: bool) -> MeshContent:
    """Reads the geometry of an OBJ file, and the names of its materials. Colors are NaN where vertices have none.

    Args:
        path: The file.
        groups: Whether regions are objects and groups, instead of materials.

    Raises:
        ValueError: A statement is damaged. The message names the file and the line.
    """
    source = _Source(path, _content(path))
    rows, faces, regions, libraries, ignored = _statements(source, groups=groups)
    if not len(faces.size):
        extra = f" ({', '.join(sorted(ignored))} are not read)" if ignored else ""
        raise ValueError(f"{path} must hold vertices and faces, got no faces{extra}")
    geometry = _geometry(rows, _absolute_indices(faces, rows, source), source)
    ignored |= _extra_numbers(rows[0].value)
    names = [region[0] or None for region in regions]
    return MeshContent(geometry, names, ignored, libraries, text.name(source.content.partition(b"\n")[0]))


def _statements(
    source: _Source, *, groups: bool
) -> tuple[list[_Rows], _Faces, list[tuple[str, ...]], list[str], set[str]]:
    """The numbers of v, vt and vn, the faces, the names of regions and of MTL files, and what is not read."""
    rows: dict[bytes, list[_Rows]] = {kind: [] for kind in _LEAST}
    faces: list[_Faces] = []
    regions: dict[tuple[str, ...], int] = {}
    unread: dict[bytes, None] = {}
    libraries: list[str] = []
    names = {b"o": "", b"g": ""} if groups else {b"usemtl": ""}
    region, start = -1, 0
    group, smoothed = b"", set[bytes]()
    stream = io.BytesIO(source.content)
    # In blocks of lines, so that not all words are in memory at once.
    while lines := list(itertools.islice(stream, _BLOCK)):
        tails: dict[bytes, list[bytes]] = {kind: [] for kind in (*_LEAST, b"f")}
        places: dict[bytes, list[int]] = {kind: [] for kind in tails}
        region_of = []
        for place, line in enumerate(lines, start):
            kind, _, tail = line.partition(b" ")
            if kind not in tails:
                kind, tail = [*line.split(None, 1), b"", b""][:2]
            if kind in tails:
                tails[kind].append(tail.partition(b"#")[0])
                places[kind].append(place)
                if kind == b"f":
                    region = regions.setdefault(tuple(names.values()), len(regions)) if region < 0 else region
                    region_of.append(region)
                    smoothed.add(group)
            elif kind in names:
                names[kind], region = _name(tail), -1
            elif kind == b"mtllib":
                libraries.append(_name(tail))
            elif kind == b"s":
                group = tail.partition(b"#")[0].strip()
            elif kind not in _HARMLESS and not kind.startswith(b"#"):
                unread[kind] = None
        for kind, parts in rows.items():
            if tails[kind]:
                parts.append(_Rows(_numbers(tails[kind], kind, places[kind], source), np.array(places[kind])))
        if region_of:
            faces.append(_Faces(*_indices(tails[b"f"]), np.array(places[b"f"]), np.array(region_of)))
        start += len(lines)
    ignored = {f"statements {inputs.shortened(text.name(kind))}" for kind in itertools.islice(unread, _LISTED)}
    ignored |= {f"{len(unread) - _LISTED} statements more"} if len(unread) > _LISTED else set()
    empty = _Faces(np.zeros((0, 3), np.int64), *np.zeros((3, 0), np.int64))
    joined = _Faces(*map(np.concatenate, zip(empty, *faces, strict=True)))
    if (smoothed & {b"off", b"0"} or len(smoothed) > 1) and (joined.corner[:, 2] == _NONE).any():
        ignored.add("smoothing groups (s) of faces without normals")
    return [_rows(parts) for parts in rows.values()], joined, list(regions), libraries, ignored


def _name(tail: bytes) -> str:
    return _statement(text.name(tail.replace(b"\t", b" ")))


def _numbers(tails: list[bytes], kind: bytes, places: list[int], source: _Source) -> np.ndarray:
    """The numbers of statements of one kind [n k]; NaN where a statement has fewer than others."""
    words = text.words(tails)
    try:
        short = np.flatnonzero(words.per_row < _LEAST[kind])
        if short.size:
            raise text.RowError(int(short[0]))
        number = text.numbers(words)
    except text.RowError as error:
        raise ValueError(
            f"{source.path} must be an undamaged OBJ file, in which {kind.decode()} has {_LEAST[kind]} or more "
            f"numbers, got {source.place(places[error.row])}"
        ) from None
    width = min(words.per_row.max(), _MOST)
    value = np.full((len(tails), width), np.nan)
    column = np.arange(len(number)) - np.repeat(np.cumsum(words.per_row) - words.per_row, words.per_row)
    read = column < width
    value[np.repeat(np.arange(len(tails)), words.per_row)[read], column[read]] = number[read]
    return value


def _rows(parts: list[_Rows]) -> _Rows:
    """Joins blocks of rows. Shorter rows end with NaN."""
    if not parts:
        return _Rows(np.zeros((0, 3)), np.zeros(0, np.int64))
    width = max(part.value.shape[1] for part in parts)
    value = [np.pad(part.value, ((0, 0), (0, width - part.value.shape[1])), constant_values=np.nan) for part in parts]
    return _Rows(np.concatenate(value), np.concatenate([part.line for part in parts]))


def _indices(tails: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """The indices of the corners of faces as they are in the file [c 3], and the number of corners of each face."""
    words = text.words(tails)
    index = np.full((len(words.start), 3), _NONE)
    slash = np.frombuffer(words.text, np.uint8) == ord("/")
    slashes = np.add.reduceat(slash, words.start, dtype=int) if len(words.start) else np.zeros(1, int)
    columns = slashes[0] + 1
    if columns <= 3 and (slashes == slashes[0]).all():
        separate = text.words(words.text.replace(b"//", b"/%d/" % _NONE).replace(b"/", b" ").split(b"\n"))
        if (separate.per_row == columns * words.per_row).all():
            try:
                index[:, :columns] = text.numbers(separate, kind=int).reshape(-1, columns)
            except text.RowError:
                pass
            else:
                return index, words.per_row
    return np.array([_corner(word) for word in words.text.split()], np.int64).reshape(-1, 3), words.per_row


def _corner(word: bytes) -> list[int]:
    """The indices of a corner; `_WRONG` if there are more than three."""
    numbers = word.split(b"/")
    if len(numbers) > 3:
        return [_WRONG] * 3
    return [_whole(number) if number else _NONE for number in [*numbers, b"", b""][:3]]


def _whole(word: bytes) -> int:
    """An index; `_WRONG` if it is not a whole number that a file could count."""
    if not _WHOLE.fullmatch(word):  # Python would take "1_0" too
        return _WRONG
    return number if abs(number := int(word)) < -_WRONG else _WRONG


def _absolute_indices(faces: _Faces, rows: list[_Rows], source: _Source) -> _Faces:
    """Faces with indices from 0; -1 where a face has none or refers to something that does not exist."""
    index = faces.corner
    for column, row in enumerate(rows):
        number = index[:, column]
        before = np.repeat(np.searchsorted(row.line, faces.line), faces.size)  # relative indices count back from here
        number = np.where(number < 0, np.where(number > _WRONG, number + before, number), number - 1)
        missing = (faces.corner[:, column] <= _NONE) & (column > 0)
        index[:, column] = np.where(missing, -1, np.where((number < 0) | (number >= len(row.line)), _WRONG, number))
    face = np.repeat(np.arange(len(faces.size)), faces.size)

    def wrong_faces(column: int) -> np.ndarray:
        return np.unique(face[index[:, column] == _WRONG])

    def described(wrong: np.ndarray) -> str:
        first = source.place(int(faces.line[wrong[0]]))
        return f"got {len(wrong)} of {len(faces.size)} faces that do not, the first is {first}"

    wrong = np.union1d(wrong_faces(0), np.flatnonzero(faces.size < 3)).astype(int)
    if wrong.size:
        raise ValueError(
            f"{source.path}: faces must refer to three or more of the vertices 1 to {len(rows[0].line)}, "
            f"{described(wrong)}"
        )
    for column, what in ((1, "texture coordinates"), (2, "normals")):
        wrong = wrong_faces(column)
        if wrong.size:
            warnings.warn(
                f"{source.path}: faces should refer to {what} 1 to {len(rows[column].line)} or none, "
                f"{described(wrong)}: these faces are loaded without {what}",
                stacklevel=6,
            )
            index[np.isin(face, wrong), column] = -1
    return faces


def _geometry(rows: list[_Rows], faces: _Faces, source: _Source) -> Geometry:
    """The triangles. Vertices are split where corners differ in region, texture coordinates or normal."""
    vertex, place, direction = (row.value for row in rows)
    index = faces.corner
    triangle = geometry.triangulate(vertex[:, :3], geometry.Polygons(index[:, 0], faces.size), str(source.path))
    region = np.repeat(faces.region, faces.size)
    columns = [column for column in (region, *index.T) if column.any()]
    first, corner = split_corners(columns or [index[:, 0]])
    at, at_texture, at_normal = index[first].T
    position = vertex[at, :3]
    wrong = np.flatnonzero(~np.isfinite(position).all(1))
    if wrong.size:
        raise ValueError(
            f"{source.path}: positions must be finite, got {wrong.size} of {len(position)} that are not, the first is "
            f"{source.place(int(rows[0].line[at[wrong[0]]]))}, at vertex {wrong[0]}"
        )
    normal = texture = color = None
    if (at_normal >= 0).any():
        normal = np.where(at_normal[:, None] >= 0, direction[at_normal, :3], np.nan)
    if (at_texture >= 0).any():
        # There may be one coordinate, with v = 0, or a third, which is not used.
        texture = np.zeros((len(position), 2))
        texture[:, : place.shape[1]] = np.where(at_texture[:, None] >= 0, place[at_texture, :2], 0)
        texture[~np.isfinite(texture)] = 0
    if vertex.shape[1] >= 6 and np.isfinite(vertex[:, 3:6]).all(1).any():
        color = geometry.linear_color(vertex[at, 3:6])
    return Geometry(position, corner[triangle.corner], normal, None, None, texture, None, color, region[first])


def _extra_numbers(vertex: np.ndarray) -> set[str]:
    """What the numbers after the positions and colors of vertices are: only rational curves and alpha use them."""
    finite = np.isfinite(vertex)
    count = vertex.shape[1] - finite[:, ::-1].argmax(1)
    ignored: set[str] = set()
    if (vertex[count == 4, 3:4] != 1).any():
        ignored.add("the fourth number of vertices, a weight (polygons have none)")
    if vertex.shape[1] >= 6:
        ignored |= geometry.beyond_range(vertex[:, 3:6])
    if (count == 5).any() or not np.isin(vertex[count > 6, 6:], (1, 255)).all():
        ignored.add("numbers of vertices beyond x y z w and x y z r g b")
    return ignored


def materials_of_regions(
    path: pathlib.Path, content: MeshContent, plain: TexturedMaterial, *, outside: bool
) -> tuple[list[TexturedMaterial], set[str]]:
    """The material of each region of an OBJ file, and what is missing (MTL files, materials, images) or not read.

    Materials that no face has are not read. Textures of one image share it.

    Args:
        path: The OBJ file.
        content: What the file holds.
        plain: Material of faces without one.
        outside: Whether MTL files and images may be outside of the folder of the OBJ file.
    """
    materials: dict[str, TexturedMaterial] = {}
    ignored, wanted = set(content.ignored), {name or "" for name in content.names}
    earlier: dict[str, dict[str, list[str]]] = {}
    pictures, blender = TextureImages(), _exponent(content.comment)
    read_already: set[pathlib.Path] = set()
    refer = functools.partial(inputs.reference, folder=path.parent, outside=outside)
    for file in content.libraries:
        named = refer(file, path.parent, owner=f"{path}, mtllib")
        words = file.split() if inputs.absence(named) else []
        for library in [refer(word, path.parent, owner=f"{path}, mtllib") for word in words] or [named]:
            absence = inputs.absence(library)
            if absence:
                ignored.add(f"mtllib ({library}, {absence})")
            elif (target := library.resolve()) not in read_already:
                read_already.add(target)
                material, more = read_mtl(library, wanted, earlier, blender=blender, refer=refer, pictures=pictures)
                materials, ignored = material | materials, ignored | more
    ignored |= {f"usemtl {name} (no such material)" for name in content.names if name and name not in materials}
    return [materials.get(name or "", plain) for name in content.names], ignored


def _exponent(line: str) -> float | None:
    """The Ns that Blender writes for a roughness of 0, by the first line of the OBJ file; None for other programs."""
    match = _BLENDER.match(line)
    if match is None or (version := (int(match[2]), int(match[3]))) < (2, 80):
        return None  # Blender before 2.80 had Phong materials
    return 1000.0 if version >= (3, 3) and not match[1] else 900.0


def read_mtl(
    path: pathlib.Path,
    wanted: Set[str],
    earlier: dict[str, dict[str, list[str]]],
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

    A factor of 0 beside its map would hide the map. Some programs write that, so the factor is then 1, with a warning.

    The opacity is d (or 1 - Tr) times map_d, a share of the light. It is read whatever illum says. Nothing is
    refracted. Pc and Pcr are a clear coat and its roughness; Ps is a white sheen. map_Bump is read where its image
    holds normals, as norm does, and -bm scales their slopes. Heights are not read.

    Blender 2.80 and newer writes its principled material differently: Ns = `blender` (1 - roughness)^2, Ks = 12.5 times
    the reflectance at normal incidence, and metalness as Ka if illum is 3 or 6. Its textures replace the factors.
    Factors that accompany Pr and Pm are read in this way too.

    Args:
        path: The file.
        wanted: Names of the materials that are read, if the file has them.
        earlier: Statements of materials in files before this one, which come first. Those of this file are added.
        blender: Exponent that Blender writes for a roughness of 0, if the first line of the OBJ file names Blender;
            None for files of other programs.
        refer: `inputs.reference` with the folder in which images must be.
        pictures: Reads the images.

    Returns:
        Materials by name; and names of unsupported statements and of missing or damaged images.
    """
    ignored: set[str] = set()
    named: dict[str, dict[str, list[str]]] = {}
    several: dict[str, dict[str, list[str]]] = {}
    name = ""
    statements: dict[str, list[str]] = {}
    lines = [text.name(line) for line in text.read(path, "an MTL file").split(b"\n")]
    if not lines or not lines[0].startswith("# Blender"):
        blender = None
    for line in lines:
        key, rest = [*_WHITE.split(_statement(line), maxsplit=1), ""][:2]
        if key == "newmtl":
            name = _statement(rest.replace("\t", " "))
            previous = named.get(name)
            named[name] = statements = {}
            several |= {name: previous} if previous else {}
        elif key:
            words = [rest] if key in _MAPS or key in _BUMPS else rest.partition("#")[0].split()
            if statements.get(key, words) != words and name in wanted:
                ignored.add(f"all but the last {key} of material {name!r}")
            statements[key] = words
            if not named:
                ignored.add(f"{key} before the first newmtl")
    ignored |= {f"all but the last newmtl {name}" for name in wanted & several.keys() if several[name] != named[name]}
    material = {}
    for name in [name for name in named if name in wanted]:
        if earlier.setdefault(name, named[name]) is named[name]:
            material[name] = _material(named[name], path, name, ignored, blender, refer, pictures)
        elif earlier[name] != named[name]:
            ignored.add(f"newmtl {name} of {path} (a file before it has another)")
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
    keys = [*_COLORS, *_NUMBERS, *([] if blender is None else ["Ka"])]
    value = {key: _number(statements, key, path, name) for key in keys if key in statements}
    ignored |= {f"{key} below {least}" for key, least in (("Ni", 1), ("Ns", 0)) if value.get(key, least) < least}
    for key in value.keys() & _UP_TO_1:
        if np.max(value[key]) > 1:
            ignored.add(f"{key} above 1")
            value[key] = np.minimum(value[key], 1)
    field: Fields = {}
    for key, words in statements.items():
        if key in _BUMPS and "norm" in statements:
            ignored.add(f"{key} beside norm")
        elif key in _MAPS or key in _BUMPS:
            options, image = _options(words[0])
            if not image:
                ignored.add(f"{key} without a file")
                continue
            owner = f"{path}, {key} of material {inputs.shortened(name)!r}"
            file = refer(image, path.parent, owner=owner)
            _add_map(field, key, options, file, owner, ignored, pictures)
        elif key not in value and key not in _SILENT | _OPACITY | {"Tf"}:
            ignored.add(key)
    for key, image in _MAP_OF.items():
        if (_MAPS[image][0] in field or image == "map_Kd") and image in statements and not np.any(value.get(key, 0)):
            if key in value and blender is None:
                ignored.add(f"{key} of 0 beside {image} (it counts as 1)")
            value[key] = 1.0
    field |= {_COLORS[key]: value[key] for key in ("Kd", "Ke") if key in value}
    field |= _opacity(statements, path, name, ignored, field.get("alpha_texture"))
    field |= _layers(value, ignored)
    ignored |= _unread_light(statements, value, blender is not None and "alpha_mode" in field)
    if blender is not None:
        field |= _principled(value, field.keys(), blender)
        return _make_material(field, path, name)
    # A Phong lobe of exponent n corresponds to alpha = sqrt(2 / (n + 2)); roughness is the square root of alpha.
    roughness = (2 / (max(0.0, value.get("Ns", 0.0)) + 2)) ** 0.25
    if (value.keys() | statements.keys()) & {"Pr", "Pm", "map_Pr", "map_Pm"}:
        field["roughness"] = value.get("Pr", 1.0 if "roughness_texture" in field else roughness)
        field["metallic"] = value.get("Pm", 1.0 if "metallic_texture" in field else 0.0)
        field["ior"] = max(1.0, value.get("Ni", 1.5))
        ignored |= {"Ks beside Pr and Pm"} if np.ptp(value.get("Ks", 0.0)) else set()
    elif "Ks" not in value or value.get("illum", 2) < 2:
        field |= {"metallic": 0.0, "roughness": roughness, "specular": 0.0}
    else:  # with the default index of refraction the reflectance is 4 % times the color
        field |= {"metallic": 0.0, "roughness": roughness, "specular_color": value["Ks"] / 0.04}
    return _make_material(field, path, name)


def _opacity(
    statements: dict[str, list[str]], path: pathlib.Path, name: str, ignored: set[str], image: Texture | None
) -> Fields:
    """The opacity of a material: d, or 1 - Tr without d. An opaque material without map_d has none."""
    alpha = 1.0
    key = "d" if "d" in statements else "Tr"
    if key in statements:
        number = _number(statements, key, path, name)
        if not 0 <= number <= 1:
            ignored.add(f"{key} below 0 or above 1")
        if key == "d" and "Tr" in statements and abs(number + _number(statements, "Tr", path, name) - 1) > _CONTRADICTS:
            ignored.add("Tr beside d")
        alpha = min(max(number if key == "d" else 1 - number, 0.0), 1.0)
        if statements[key][0] == "-halo" and alpha < 1:
            ignored.add(f"-halo of {key}")
    if alpha == 0 and "map_d" in statements:
        ignored.add(f"{key} {' '.join(statements[key])} beside map_d (it counts as opaque)")
        alpha = 1.0
    if alpha == 1 and image is None:
        return {}
    if alpha * (1 if image is None else float(np.max(image.image))) < CLEAR:
        ignored.add(f"faces of material {name!r} (they are invisible: its opacity is 0)")
    return {"alpha": alpha, "alpha_mode": "blend"}


def _layers(value: Values, ignored: set[str]) -> Fields:
    """The clear coat and the sheen of a material."""
    if value.get("aniso"):
        ignored.add("aniso")
    field = {"clearcoat": value.get("Pc", 0.0), "clearcoat_roughness": value.get("Pcr", 0.0)}
    if not value.get("Ps"):
        return field
    if field["clearcoat"]:
        ignored.add("Ps beside Pc (sheens under clear coats)")
        return field
    return field | {"sheen_color": value["Ps"], "sheen_roughness": _SHEEN}


def _unread_light(statements: dict[str, list[str]], value: Values, transparent: bool) -> set[str]:
    """What passes through a surface and is not read: refraction, and its color."""
    model, ignored = value.get("illum", 2), set()
    # With `transparent`, illum 4 to 9 only say that the surface is transparent, as Blender writes them.
    if model in _REFRACTING and not transparent:
        ignored.add(f"illum {model:g} (glass: nothing is refracted, and only d, Tr and map_d let light through)")
    elif model not in _REFLECTING | _REFRACTING:
        ignored.add(f"illum {model:g}")
    words = statements.get("Tf", ["1"])
    if not all(_is_number(word) and float(word) == 1 for word in words):
        ignored.add(f"Tf {' '.join(words)} (the color of light that passes through)")
    return ignored


def _principled(value: Values, stated: Collection[str], exponent: float) -> Fields:
    """Factors of Blender's principled material, from the values that Blender's exporter writes."""
    # Blender's importer uses the same inverse: source/blender/io/wavefront_obj/importer/obj_import_mtl.cc.
    shine = min(max(value.get("Ns", 0.0) / exponent, 0.0), 1.0)
    metallic = min(max(value.get("Ka", 0.0), 0.0), 1.0) if value.get("illum", 2) in (3, 6) else 0.0
    specular = value.get("Ks", np.full(3, 0.5))
    factor: Fields = {
        "roughness": value.get("Pr", 1 - math.sqrt(shine)),
        "metallic": value.get("Pm", metallic),
        "specular": float(np.max(specular) > 0),
        "specular_color": 2 * specular,  # Blender reflects 4 % at 0.5, this package at 1
    }
    return factor | {
        key: 1.0 for key in ("base_color", "roughness", "metallic", "emissive") if f"{key}_texture" in stated
    }


def _make_material(field: Fields, path: pathlib.Path, name: str) -> TexturedMaterial:
    """Makes the material. Errors name the file and the material."""
    try:
        with np.errstate(over="ignore"):  # materials refuse what is not finite
            return TexturedMaterial(**field)
    except ValueError as error:
        raise ValueError(f"{path}, material {inputs.shortened(name)!r}: {error}") from error


def _number(statements: dict[str, list[str]], key: str, path: pathlib.Path, name: str) -> Any:
    """The number or color of a statement. A single number stands for a gray."""
    words = statements[key]
    if key == "d" and words[:1] == ["-halo"]:
        words = words[1:]
    try:
        if not words or words[0] in ("spectral", "xyz"):
            raise ValueError
        number = [float(word) for word in words[: 3 if key in _COLORS else 1]]
        if not all(math.isfinite(value) for value in number) or len(number) == 2:
            raise ValueError
    except ValueError:
        got, where = inputs.shortened(" ".join([key, *words])), f"{path}, material {inputs.shortened(name)!r}"
        form = " (1 or 3 of linear RGB; spectral curves and CIE XYZ must be converted)" if key in _COLORS else ""
        raise ValueError(f"{where}: {key} must have finite numbers, got {got!r}{form}") from None
    if key not in _COLORS:
        return number[0]
    return np.array(number if len(number) == 3 else number[:1] * 3)


def _add_map(
    field: Fields,
    key: str,
    options: dict[str, list[str]],
    file: pathlib.Path,
    owner: str,
    ignored: set[str],
    pictures: TextureImages,
) -> None:
    """Adds the texture of a statement. If it cannot be read, adds the reason to `ignored`."""
    name, channels, decoded = _MAPS.get(key, _MAPS["norm"])
    chosen = _SCALARS.get(" ".join(options.get("-imfchan", []))) if len(channels) == 1 else None
    try:
        absence = inputs.absence(file)
        if absence:
            raise ValueError(f"{file}, {absence}")
        image = pictures.read(file, chosen or channels, decoded=decoded)
        # The opacity of map_d is the alpha of an image that has one, and otherwise its first channel.
        if key == "map_d" and chosen is None and np.min(image) == 1:
            image = pictures.read(file, (0,), decoded=False)
        if key in _BUMPS and not _holds_normals(np.asarray(image)):
            raise ValueError(f"{file} holds no normals: heights are not read")
    except ValueError as error:
        ignored.add(f"{key} ({error})")
        return
    honored = {"-o", "-s"} | ({"-imfchan"} if chosen else set())
    honored |= {option for option, words in options.items() if _is_neutral(option, words)}
    strength = options.get("-bm", [])
    if name == "normal_texture" and len(strength) == 1 and _is_number(strength[0]):
        honored |= {"-bm"}
        field["normal_scale"] = float(strength[0])
    wrap = "clamp" if options.get("-clamp") == ["on"] else "repeat"
    honored |= {"-clamp"} if options.get("-clamp") in (["on"], ["off"]) else set()
    ignored |= {f"option {option} of maps" for option in options.keys() - honored}
    scale, offset = (_pair(options.get(option, []), plain) for option, plain in (("-s", 1.0), ("-o", 0.0)))
    with np.errstate(over="ignore"):  # textures refuse what is not finite
        transform = np.array([[scale[0], 0, offset[0]], [0, scale[1], offset[1]]]).astype(np.float32)
    try:
        field[name] = Texture(image, transform, 0, (wrap, wrap))
    except ValueError as error:
        raise ValueError(f"{owner}: {error}") from error


def _holds_normals(image: np.ndarray) -> bool:
    """Whether an image [h w 3] is a normal map: mostly bluish, with vectors of unit length that point outward."""
    step = math.ceil(math.sqrt(image.shape[0] * image.shape[1] / _SAMPLED))
    vector = 2 * image[::step, ::step].reshape(-1, 3).astype(np.float64) - 1
    red, green, blue = vector.mean(0)
    normal = (np.abs(np.linalg.norm(vector, axis=1) - 1) < _UNIT) & (vector[:, 2] > 0)
    return bool(blue > max(red, green) + _BLUISH and normal.mean() > _NORMALS)


def _is_neutral(option: str, words: list[str]) -> bool:
    """Whether an option of a map has no effect."""
    if option == "-texres":  # the resolution that an image is scaled to
        return True
    neutral = _NEUTRAL.get(option, [])
    value = [float(word) if _is_number(word) else word for word in words]
    return option in _NEUTRAL and value == neutral[: len(value)]


def _options(statement: str) -> tuple[dict[str, list[str]], str]:
    """The options of a map, and its file name, which follows them."""
    words = [(match[0], match.start()) for match in re.finditer(r"\S+", statement)]
    options: dict[str, list[str]] = {}
    place = 0
    while place < len(words) - 1 and words[place][0].startswith("-"):
        key, end = words[place][0], place + 1
        while end < len(words) - 1 and end - place <= _ARGUMENTS.get(key, 1):
            if key in _ARGUMENTS and not _is_number(words[end][0]):
                break
            end += 1
        options[key] = [word for word, _ in words[place + 1 : end]]
        place = end
    return options, statement[words[place][1] :] if words else ""


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _pair(words: list[str], plain: float) -> list[float]:
    """The first two numbers of an option of up to three."""
    return [*(float(word) for word in words[:2]), plain, plain][:2]
