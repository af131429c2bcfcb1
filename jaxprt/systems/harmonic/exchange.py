"""Files of transfer vectors and matrices for exchange with other tools, in the SH convention of each tool.

    file        contents                                                        arrays
    .npz        vectors or matrices, with convention, positions and frames      `coefficient` and others
    .npy        vectors or matrices only; to read it, give the convention       one
    .ply        vectors of vertices, with convention, positions and faces       properties `sh_<index>_<color>`

Vectors are [v, lm, c], one per vertex, or [f, 3, lm, c], one per triangle corner. Matrices are [v, c, o, i]: they map
coefficients i of the light in the world to coefficients o of the arriving light in the vertex's frame.
"""

import dataclasses
import json
import os
import pathlib
import zipfile
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.files import inputs, outputs
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import directions, harmonics
from jaxprt.sphere.low_frequency import Convention
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector

_AGREE = 1e-4  # tolerance, relative to the largest coefficient or to the size of the mesh
_COMMENT = "jaxprt convention "


def export_transfer(
    path: str | os.PathLike,
    transport: TransferVector | TransferMatrix,
    mesh: Mesh,
    *,
    convention: Convention = Convention(),  # noqa: B008
    corners: bool = False,
) -> None:
    """Writes transfer vectors or matrices in the convention of another tool.

    Args:
        path: Name of the file, with suffix .npz, .npy or .ply. PLY files hold vectors of vertices only.
        transport: Transfer of all vertices of the mesh.
        mesh: The mesh. Its positions and faces are written in the tool's axes.
        convention: SH convention of the tool, such as `jaxprt.sphere.low_frequency.TOOLS["Mitsuba 3"]`; the default is
            that of jaxprt.
        corners: Whether to write a vector for each corner of each triangle instead of each vertex.

    Raises:
        TypeError: The transport is neither a `TransferVector` nor a `TransferMatrix`.
        ValueError: The suffix is another one, the mesh has another number of vertices than the transport, or the file
            format cannot hold the transport.
    """
    kind = _suffix(path)
    require.kind("the transport", transport, TransferVector, TransferMatrix, source="jaxprt.harmonic.precompute")
    if len(transport.position) != len(mesh.position):
        raise ValueError(
            f"the transport must have all {len(mesh.position)} vertices of the mesh, got {len(transport.position)}"
        )
    matrix = isinstance(transport, TransferMatrix)
    if (matrix and corners) or (kind == ".ply" and (matrix or corners)):
        raise ValueError(
            "matrices must be of vertices, not corners, and a .ply file must hold vectors of vertices, got "
            f"{'matrices' if matrix else 'vectors'} of {'corners' if corners else 'vertices'} for {kind}: write "
            "matrices of vertices, or vectors of corners, to .npz or .npy files"
        )
    if isinstance(transport, TransferMatrix):
        inner = convention.write(np.asarray(transport.matrix), axis=3)
        value = convention.write(inner, axis=2, world=False)
    else:
        value = convention.write(np.asarray(transport.vector), axis=0).transpose(2, 0, 1)
        value = value if convention.over_pi else value * np.asarray(np.pi, value.dtype)
        value = value[np.asarray(mesh.face)] if corners else value
    position = np.asarray(mesh.position)
    if any(mesh.origin):  # in the coordinates of the mesh's file, which float32 would round
        position = position.astype(np.float64) + mesh.origin
    position = position @ convention.turn.T.astype(position.dtype)
    name = json.dumps(dataclasses.asdict(convention))
    if kind == ".npy":
        with outputs.replacing(path) as new, new.open("wb") as file:  # NumPy would add a suffix to some names.
            np.save(file, value)
    elif kind == ".npz":
        arrays: dict[str, Any] = {"coefficient": value, "position": position, "face": np.asarray(mesh.face)}
        arrays["what"] = "matrices" if matrix else "vectors of corners" if corners else "vectors"
        arrays["convention"] = name
        if isinstance(transport, TransferMatrix):
            arrays["frame"] = np.asarray(transport.frame) @ convention.turn.T.astype(np.float32)
        with outputs.replacing(path) as new, new.open("wb") as file:
            np.savez(file, **arrays)
    else:
        _write_ply(path, position, np.asarray(mesh.face), value, name)


def import_transfer(
    path: str | os.PathLike,
    mesh: Mesh,
    *,
    convention: Convention | None = None,
    what: str | None = None,
) -> TransferVector | TransferMatrix:
    """Reads transfer vectors or matrices that another tool or `export_transfer` wrote for a mesh.

    Args:
        path: Name of a .npz, .npy or .ply file; the top of this module lists its arrays.
        mesh: The mesh in the axes of jaxprt, with its vertices in the order of the file.
        convention: SH convention of the file. None if the file states it; a convention that differs from the one that
            the file states is refused.
        what: Contents of the file: "vectors", "vectors of corners" or "matrices". If None, it is read from the file;
            the default is "vectors".

    Returns:
        Transfer vectors for `DiffuseSystem`, or matrices for `HarmonicSystem` in the frames of the mesh.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, the convention is not known, arrays have other axes or another number of
            vertices, values are not finite, positions or frames differ from those of the mesh, or vectors of corners at
            one vertex differ.
        MemoryError: The arrays do not fit into memory.
    """
    kind, source = _suffix(path), str(path)
    held = _read(pathlib.Path(path), kind)
    if "coefficient" not in held:
        raise ValueError(f"{source} must hold an array `coefficient`, got {', '.join(sorted(held)) or 'none'}")
    stated = _parse_convention(source, str(held["convention"])) if "convention" in held else convention
    if stated is None:
        raise ValueError(
            f"{source} does not say its convention: give convention=jaxprt.sphere.low_frequency.Convention(..)"
        )
    if convention not in (None, stated):
        raise ValueError(f"the convention must be that of {source} or None, got {convention}: the file says {stated}")
    convention = stated
    what = str(held.get("what", "vectors")) if what is None else what
    value = _numbers(source, "coefficient", held["coefficient"])
    turn = convention.turn.astype(np.float32)
    if "position" in held:
        position = _numbers(source, "position", held["position"], np.float64, axes=3)
        _require_same(f"positions of {source}", position @ convention.turn - mesh.origin, np.asarray(mesh.position))
    if what == "matrices":
        frame = directions.frame(mesh.normal, mesh.tangent)
        if "frame" in held:
            axes = _numbers(source, "frame", held["frame"], axes=3)
            _require_same(f"frames of {source}", axes @ turn, np.asarray(frame))
        return TransferMatrix(jnp.asarray(_matrices(source, value, mesh, convention)), mesh.position, frame)
    if what not in ("vectors", "vectors of corners"):
        raise ValueError(f'what must be "vectors", "vectors of corners" or "matrices", got {what!r}')
    rows = (len(mesh.face), 3) if what == "vectors of corners" else (len(mesh.position),)
    value = value[..., None] if value.ndim == len(rows) + 1 else value
    if value.ndim != len(rows) + 2 or value.shape[: len(rows)] != rows:
        axes = ", ".join(map(str, rows))
        raise ValueError(f"{what} of {source} must be [{axes}, lm] or [{axes}, lm, c], got {list(value.shape)}")
    if what == "vectors of corners":
        value = _join_corners(source, value, np.asarray(mesh.face), len(mesh.position))
    value = convention.read(value, axis=1) / np.float32(1 if convention.over_pi else np.pi)
    return TransferVector(jnp.asarray(value.transpose(1, 2, 0)), mesh.position)


def _read(path: pathlib.Path, kind: str) -> dict[str, np.ndarray]:
    """The arrays of a file, by name. Nothing in it is unpickled."""
    inputs.check(path, "a file of transfer vectors or matrices")
    try:
        if kind == ".ply":
            return _read_ply(path)
        if kind == ".npy":
            return {"coefficient": np.array(np.load(path, mmap_mode="r"))}
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        require.memory(f"the arrays of {path}", size, "free some memory")
        with np.load(path) as archive:
            arrays = dict(archive)
        if not all(isinstance(value, np.ndarray) for value in arrays.values()):  # NumPy returns other members as bytes
            raise ValueError("it holds something that is no array")
        return arrays
    except MemoryError as error:
        raise MemoryError(f"{path} does not fit into memory: {error}") from error
    except Exception as error:  # the readers raise many kinds of errors for damaged files
        raise ValueError(
            f"{path} must be an undamaged {kind} file with arrays of numbers, got another: {error}"
        ) from error


def _numbers(
    source: str, name: str, value: np.ndarray, dtype: type = np.float32, *, axes: int | None = None
) -> np.ndarray:
    """An array of a file as finite numbers of a type, with `axes` entries along its last axis."""
    if value.dtype.kind not in "iuf":
        raise ValueError(f"{source}: `{name}` must be of real numbers, got {value.dtype}")
    if axes is not None and (value.ndim < 2 or value.shape[-1] != axes):
        raise ValueError(f"{source}: `{name}` must be [.., {axes}], got {list(value.shape)}")
    with np.errstate(over="ignore"):  # refused as infinite
        value = np.asarray(value, dtype)
    require.finite(f"the {name}s of {source}", value)
    return value


def _parse_convention(source: str, text: str) -> Convention:
    """The convention that a file states."""
    try:
        convention = Convention(**json.loads(text))
        if not (type(convention.condon_shortley) is bool and type(convention.over_pi) is bool):
            raise TypeError("condon_shortley and over_pi must be true or false")
        return convention
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"the convention in {source} must be one that export_transfer writes, got {text[:200]}"
        ) from error


def _matrices(source: str, value: np.ndarray, mesh: Mesh, convention: Convention) -> Float[np.ndarray, "v c o i"]:
    value = value[:, None] if value.ndim == 3 else value
    if value.ndim != 4 or len(value) != len(mesh.position) or value.shape[2] != value.shape[3]:
        count = len(mesh.position)
        raise ValueError(
            f"matrices of {source} must be [{count}, lm, lm] or [{count}, c, lm, lm], got {list(value.shape)}"
        )
    harmonics.degree_of(value.shape[2])
    return convention.read(convention.read(value, axis=3), axis=2, world=False)


def _join_corners(source: str, value: np.ndarray, face: np.ndarray, count: int) -> np.ndarray:
    """Coefficients of vertices from those of triangle corners, which must agree at each vertex."""
    result = np.full((count, *value.shape[2:]), np.nan, value.dtype)
    result[face] = value
    wrong = np.abs(result[face] - value).max((2, 3)) > _AGREE * np.abs(value).max()
    if wrong.any():
        first = face[wrong][0]
        raise ValueError(
            f"corners of {source} must agree where they share a vertex, got {len(np.unique(face[wrong]))} vertices "
            f"where they do not, first {first}: give a mesh that has a vertex of its own for each corner"
        )
    unread = np.flatnonzero(np.isnan(result).any((1, 2)))
    if len(unread):
        raise ValueError(f"each vertex must be in a triangle, got {len(unread)} that are in none, first {unread[0]}")
    return result


def _require_same(name: str, actual: np.ndarray, wanted: np.ndarray) -> None:
    """Refuses positions or frames in a file that differ from those of the mesh."""
    if actual.shape != wanted.shape:
        raise ValueError(
            f"{name} must have the shape of those of the mesh, {list(wanted.shape)}, got {list(actual.shape)}"
        )
    off = np.abs(actual - wanted).reshape(len(actual), -1).max(1)
    wrong = np.flatnonzero(~(off <= _AGREE * max(float(np.abs(wanted).max()), 1e-30)))
    if len(wrong):
        raise ValueError(
            f"{name} must be those of the mesh, in the axes of jaxprt, got {len(wrong)} of {len(off)} that are not, "
            f"first {wrong[0]}: {actual[wrong[0]].tolist()} instead of {wanted[wrong[0]].tolist()}"
        )


def _suffix(path: str | os.PathLike) -> str:
    require.path("path", path)
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".npz", ".npy", ".ply"):
        raise ValueError(f"the file must end in .npz, .npy or .ply, got {os.fspath(path)!r}")
    return suffix


def _write_ply(path, position: np.ndarray, face: np.ndarray, value: np.ndarray, convention: str) -> None:
    """Writes a binary PLY file with one property for each coefficient and color."""
    count, terms, colors = value.shape
    names = [f"sh_{i}_{c}" for i in range(terms) for c in range(colors)]
    number = "double" if position.dtype == np.float64 else "float"
    properties = [f"property {number} {axis}" for axis in "xyz"] + [f"property float {name}" for name in names]
    head = ["ply", "format binary_little_endian 1.0", f"comment {_COMMENT}{convention}", f"element vertex {count}"]
    head += [*properties, f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    corner = np.zeros(len(face), [("count", "u1"), ("vertex", "<i4", (3,))])
    corner["count"], corner["vertex"] = 3, face
    rows = np.empty(count, [("position", "<f8" if number == "double" else "<f4", 3), ("value", "<f4", terms * colors)])
    rows["position"], rows["value"] = position, value.reshape(count, -1)
    outputs.write(path, "\n".join(head).encode() + rows.tobytes() + corner.tobytes())


def _read_ply(path) -> dict[str, np.ndarray]:
    """Reads positions, coefficients and, if a comment states it, the convention."""
    import trimesh  # imported here, because importing takes a second

    loaded = trimesh.load(path, process=False)
    elements = loaded.metadata["_ply_raw"]
    data = elements["vertex"]["data"]
    place = sorted(tuple(map(int, name.split("_")[1:])) for name in data.dtype.names if name.startswith("sh_"))
    if not place:
        return {}
    terms, colors = place[-1][0] + 1, 1 + max(color for _, color in place)
    value = np.stack([np.asarray(data[f"sh_{i}_{c}"], np.float32) for i in range(terms) for c in range(colors)], 1)
    held = {
        "coefficient": value.reshape(-1, terms, colors),
        "position": np.stack([data[axis] for axis in "xyz"], 1),
    }
    head = pathlib.Path(path).read_bytes().split(b"end_header")[0].decode("ascii", "replace").splitlines()
    said = [line.partition(_COMMENT)[2] for line in head if line.startswith(f"comment {_COMMENT}")]
    return {**held, **({"convention": np.array(said[0])} if said else {})}
