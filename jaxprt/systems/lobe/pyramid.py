"""Visibility pyramids: visibility of each vertex at all scales, for lobes of any direction and width, in six kilobytes.

A pyramid stores the visibility of cubemap texels as one bit each, and means over larger and larger texels as bytes. The
visibility of a lobe is read from a few texels at the scale of its width. Pyramids do not depend on the BRDF.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import require, visibility
from jaxprt.compile import isolated, jit
from jaxprt.files.arrays import Header, Layout
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.points import VERTICES, Points
from jaxprt.sphere import cubemap, haar
from jaxprt.systems.lobe import diffuse
from jaxprt.visibility import StoredVisibility
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "lobe": 2}
_BITS = 2  # largest number of scales that are read from the bits
# Fewest texels along an edge of such a scale. Bits have no border, so that slopes jump at the edges of the cube.
_FINE = 16
_TAPS = 3  # texels along an axis from which visibility is interpolated
_BYTE = 255
_COLUMNS = 128  # vertices or points of a block, whose pyramids are read together
_R2 = 0.7548776662466927, 0.5698402909980532  # steps of a sequence that fills squares evenly
_BLOCK = 1024


class LobeTransport(eqx.Module):
    """Visibility pyramids, and transfer vectors for the diffuse part of BRDFs.

    Attributes:
        pyramid: For each vertex, first the bits of all texels, with 2 x 2 neighbors in each half of a byte; then the
            means at a quarter of the resolution and below, as bytes, each face with a border of its neighbors' texels.
            Scales with fewer than 16 texels along an edge are always bytes.
        vector: Transfer vectors for diffuse light, as bytes; see `jaxprt.systems.lobe.diffuse`.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        size: Edge of the cubemap faces in texels.
    """

    pyramid: UInt8[Array, "v n"]
    vector: UInt8[Array, "h v"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    size: int = eqx.field(static=True)

    @property
    def nbytes(self) -> int:
        """Bytes of pyramids and vectors."""
        return self.pyramid.nbytes + self.vector.nbytes

    @property
    def packed(self) -> UInt8[np.ndarray, "v n"]:
        """The bits of the texels of each vertex."""
        return np.asarray(self.pyramid)[:, : 6 * self.size**2 // 8]

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t v"]:
        """1 where a vertex sees at least half of a texel, 0 elsewhere; one row for each of the given texels."""
        byte, bit = _bit(*_split(texel, self.size), self.size)
        value = self.pyramid.at[:, byte].get(mode="promise_in_bounds")
        return ((value >> bit.astype(jnp.uint8)) & 1).T.astype(self.position.dtype)

    def cells(self, cell: Int[Array, " t"], *, edge: int) -> Float[Array, "t v"]:
        """Visible share of each of the given cells of faces with an edge of so many cells, for every vertex."""
        scale, (face, row, column) = scales(self.size), _split(cell, edge)
        number = scale.edge.tolist().index(edge)
        if number < scale.bits:  # four texels are half of a byte
            byte, bit = _bit(face, 2 * row, 2 * column, self.size)
            four = self.pyramid.at[:, byte].get(mode="promise_in_bounds") >> bit.astype(jnp.uint8) & 15
            return jax.lax.population_count(four).T.astype(self.position.dtype) / 4
        place = int(scale.start[number]) + (face * (edge + 2) + row + 1) * (edge + 2) + column + 1
        return self.pyramid.at[:, place].get(mode="promise_in_bounds").T.astype(self.position.dtype) / _BYTE

    def lobe_visibility(
        self,
        face: Int[Array, "l v"],
        s: Float[Array, "l v"],
        t: Float[Array, "l v"],
        spread: Float[Array, "l v"],
        points: Points = VERTICES,
    ) -> tuple[Float[Array, "l v"], Float[Array, "l v"], Float[Array, "l v"]]:
        """Mean visibility over each lobe of each vertex, horizon included, and its derivatives.

        Lookup is by quadratic B-splines at the two scales next to the lobe's width, and linear in the spread between
        them, so that the derivatives are continuous. At points, visibility at the three corners of the triangle is
        interpolated, for the lobes of the point itself.

        Args:
            face: Cubemap face of each lobe's direction, from `jaxprt.sphere.cubemap.project`.
            s: Column coordinate of the direction on the face, from -1 to 1.
            t: Row coordinate of the direction on the face, from -1 to 1.
            spread: Mean of 1 - cos of the angle to the lobe's direction, from `jaxprt.decompose.mixture.drop`.
            points: Points that the lobes belong to.

        Returns:
            Mean visibility of each lobe, from 0 to 1, and its derivatives with respect to s and t.
        """
        # Split into separate programs: XLA vectorizes CPU code only without gathers, and recomputes a value for each
        # use. In blocks, what a few neighboring vertices read stays in the cache, and no array is transposed.
        count = face.shape[1]
        face, s, t, spread = (_blocks(array) for array in (face, s, t, spread))
        down, right, bit = _addresses(face, s, t, spread, size=self.size)
        read = tuple(_bytes(self.pyramid, _blocks(row[None]), down, right) for row in points.corners(count))
        weight = None if points.all_vertices else _blocks(points.weight.astype(spread.dtype))
        seen, by_s, by_t = _decode(read, weight, bit, s, t, spread, size=self.size)
        return _columns(seen, count), _columns(by_s, count), _columns(by_t, count)


def _blocks(value: Array | np.ndarray) -> Array:
    """Columns in blocks: [l v] as [b l m], with zeros after the last one."""
    rows, count = value.shape
    block = max(min(_COLUMNS, count), 1)
    blocks = -(-count // block)
    wide = jnp.pad(value, ((0, 0), (0, blocks * block - count)))
    return jnp.swapaxes(wide.reshape(rows, blocks, block), 0, 1)


def _columns(value: Array, count: int) -> Array:
    """The inverse of `_blocks`."""
    return jnp.swapaxes(value, 0, 1).reshape(value.shape[1], -1)[:, :count]


@partial(isolated, static=("size",))
def _addresses(face: Array, s: Array, t: Array, spread: Array, *, size: int) -> tuple[Array, Array, tuple]:
    """Row and column numbers [b 2 3 l m] of the bytes that each lobe reads, 3 x 3 texels at two scales; and of bits."""
    scale = scales(size)
    number, _ = between(scale, spread)
    # An address is the sum of one number for its row and one for its column. So is the bit, for scales stored as bits.
    address, bit = [], []
    for step in (0, 1):
        edge, start = (of_scale(x, number + step) for x in (scale.edge, scale.start))
        in_bits, fine = number + step < scale.bits, jnp.where(number + step == 0, 0, 1)
        place = []
        for center in (_nearest(edge, t), _nearest(edge, s)):
            rim = [center + offset for offset in (-1, 0, 1)]  # counted from the border
            place.append((rim, [jnp.clip(x - 1, 0, edge - 1) << fine for x in rim]))
        (row, first), (column, second) = place
        width = size // 4  # bytes of two rows of texels
        down = [
            jnp.where(in_bits, (face * (size // 2) + (x >> 1)) * width, start + (face * (edge + 2) + y) * (edge + 2))
            for x, y in zip(first, row, strict=True)
        ]
        right = [jnp.where(in_bits, x >> 2, y) for x, y in zip(second, column, strict=True)]
        address.append((jnp.stack(down, 1), jnp.stack(right, 1)))
        bit += [(x & 1) << 1 for x in first] + [((x & 2) << 1) + (x & 1) for x in second]
    down, right = (jnp.stack(axis, 1) for axis in zip(*address, strict=True))
    return down, right, tuple(bit)


@isolated
def _bytes(
    pyramid: UInt8[Array, "v n"], vertex: Int[Array, "b 1 m"], down: Array, right: Array
) -> UInt8[Array, "b 2 3 3 l m"]:
    address = down[:, :, :, None] + right[:, :, None]
    vertex = jnp.broadcast_to(vertex[:, None, None, None], address.shape)
    return pyramid.at[vertex, address].get(mode="promise_in_bounds")


@partial(isolated, static=("size",))
def _decode(
    read: tuple, corner_weight: Array | None, bit: tuple, s: Array, t: Array, spread: Array, *, size: int
) -> tuple[Array, Array, Array]:
    """Visibility and its derivatives with respect to s and t, from the 18 bytes of each corner."""
    scale = scales(size)
    number, upper = between(scale, spread)
    result = [jnp.zeros_like(spread)] * 3
    for step, part in ((0, 1 - upper), (1, upper)):
        first, edge = bit[2 * step * _TAPS :], of_scale(scale.edge, number + step)

        def seen(i, j, step=step, bit=first, number=number + step):
            place = bit[i] + bit[_TAPS + j]
            value = [_level(corner[:, step, i, j], place, number, bits=scale.bits) for corner in read]
            if corner_weight is None:
                return value[0].astype(spread.dtype)
            weights = jnp.moveaxis(corner_weight[:, :, None], 1, 0)
            return reduce(jnp.add, (x * w for x, w in zip(value, weights, strict=True)))

        sums = _smooth(seen, edge, s, t, rim=number + step >= scale.bits)
        unit = part / _levels(number + step, bits=scale.bits).astype(spread.dtype)
        result = [total + value * unit for total, value in zip(result, sums, strict=True)]
    return result[0], result[1], result[2]


def _smooth(seen: Callable[[int, int], Array], edge: Array, s: Array, t: Array, *, rim: Array) -> list[Array]:
    """Quadratic B-spline over 3 x 3 texels, and its derivatives with respect to s and t."""
    half = edge.astype(s.dtype) / 2
    (down, by_down, outside_down), (right, by_right, outside_right) = (_spline(edge, x, rim) for x in (t, s))
    total, by_s, by_t = [jnp.zeros_like(s)] * 3
    for j in range(_TAPS):
        column = [seen(i, j) for i in range(_TAPS)]
        mean = reduce(jnp.add, (x * w for x, w in zip(column, down, strict=True)))
        parts = [x * w for x, w in zip(column, by_down, strict=True)]
        slope = parts[0] + parts[1] + parts[2]
        outside = parts[0] * outside_down[0] + parts[2] * outside_down[1]
        # A border texel holds the next face's in the same row, but lines of constant t have a kink of slope t there.
        # The texel that continues the face is t / edge farther in: its difference is taken off, for continuous slopes.
        across = mean if j == 1 else mean - slope * (outside_right[j // 2] * t / 2)
        total = total + mean * right[j]
        by_s = by_s + across * by_right[j]
        by_t = by_t + slope * right[j] - outside * (by_right[j] * s / 2)
    return [total, by_s * half, by_t * half]


def _spline(edge: Array, x: Array, rim: Array) -> tuple[list[Array], list[Array], list[Array]]:
    """Weights of three texels around a coordinate, their derivatives in texels, and which outer ones are border."""
    center = _nearest(edge, x)
    off = (x + 1) * (edge.astype(x.dtype) / 2) + 0.5 - center
    weight = [(0.5 - off) ** 2 / 2, 0.75 - off**2, (0.5 + off) ** 2 / 2]
    outside = [(rim & (center == end)).astype(x.dtype) for end in (1, edge)]
    return weight, [off - 0.5, -2 * off, off + 0.5], outside


def _nearest(edge: Array, x: Array) -> Int[Array, "..."]:
    """Index of the texel in which a coordinate lies, the border counted."""
    place = jax.lax.stop_gradient((x + 1) * (edge.astype(x.dtype) / 2))
    return jnp.clip(place.astype(jnp.int32), 0, edge - 1) + 1


def _level(byte: UInt8[Array, "..."], bit: Array, number: Array, *, bits: int) -> Int[Array, "..."]:
    """Visibility that a byte encodes, in units of `_levels`; the first `bits` scales are read from bits."""
    value = byte.astype(jnp.int32)
    if not bits:
        return value
    # One bit at scale 0, the sum of four bits at scale 1, and a mean as byte beyond.
    four = value >> bit & jnp.where(number == 0, 1, 15)
    pair = (four & 5) + (four >> 1 & 5)
    return jnp.where(number < bits, (pair & 3) + (pair >> 2), value)


def _levels(number: Array, *, bits: int) -> Int[Array, "..."]:
    """The unit in which a scale holds visibility: its value where all is visible."""
    return jnp.where(number >= bits, _BYTE, jnp.where(number == 0, 1, 4))


class Scales(NamedTuple):
    """Scales of a pyramid: face edge, spread (mean of 1 - cos) and offset of each scale, and the total length.

    `bits` is the number of finest scales that are read from single bits.
    """

    edge: np.ndarray
    spread: np.ndarray
    start: np.ndarray
    total: int
    bits: int = 0


def between(scale: Scales, spread: Array) -> tuple[Array, Array]:
    """Index of the scale below each spread, and the weight of the scale above."""
    known = np.asarray(scale.spread, spread.dtype)
    number = reduce(jnp.add, ((spread >= least).astype(jnp.int32) for least in known[1:-1]))
    low, high = of_scale(known[:-1], number), of_scale(known[1:], number)
    return number, jnp.clip((spread - low) / (high - low), 0, 1)


def of_scale(table: np.ndarray, number: Int[Array, "*b"]) -> Array:
    """What a table says of scales. XLA on CPUs vectorizes comparisons with all of them, but no gathers."""
    return reduce(lambda value, row: jnp.where(number >= row[0], row[1], value), enumerate(table), table[0])


def corners(edge: Array, s: Array, t: Array) -> tuple[Array, Array, list]:
    """The four texels around a point, for bilinear lookup in faces with a border.

    Returns:
        Row and column of the first texel; and for each of the four its offset, weight, and derivatives of the weight
        with respect to s and t.
    """
    half = edge.astype(s.dtype) / 2
    column, row = (jax.lax.stop_gradient(jnp.clip(jnp.floor((x + 1) * half + 0.5), 0, edge)) for x in (s, t))
    right, down = (s + 1) * half + 0.5 - column, (t + 1) * half + 0.5 - row
    weights = [
        ((i, j), (v * u, v * (half if j else -half), (half if i else -half) * u))
        for i, v in ((0, 1 - down), (1, down))
        for j, u in ((0, 1 - right), (1, right))
    ]
    return row.astype(jnp.int32), column.astype(jnp.int32), weights


@lru_cache(maxsize=8)
def scales(size: int) -> Scales:
    """Scales of a visibility pyramid, from single texels to whole faces. `size` is the edge of the finest faces."""
    if size < 8 or size & (size - 1):
        raise ValueError(f"size must be a power of two, at least 8, got {size}")
    edge = np.array([size >> k for k in range(size.bit_length())], np.int32)
    # A texel's box and the spline together have a variance of a third of its solid angle along each axis.
    spread = 4 * np.pi / (6 * edge.astype(np.float64) ** 2) / 3
    bits = int(np.sum(edge[:_BITS] >= _FINE))
    count = 6 * (edge[bits:] + 2) ** 2
    start = np.concatenate([[0] * bits, 6 * size * size // 8 + np.cumsum(count) - count])
    return Scales(edge, spread, start.astype(np.int32), 6 * size * size // 8 + int(count.sum()), bits)


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    *,
    size: int = 64,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    apart: bool = False,
    run: Run = Run(),
) -> LobeTransport:
    """Precomputes the visibility pyramid of every vertex by ray tracing, for any BRDF.

    A pyramid takes about six kilobytes per vertex at 6 x 64 x 64 texels.

    Args:
        mesh: The mesh to light.
        size: Edge of the light's cubemap faces in texels; a power of two, at least 8.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        apart: Whether the regions of the mesh are separate surfaces: rays start off the faces of their own region.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        Pyramids and transfer vectors of the vertices.

    Raises:
        ValueError: The size or a vertex index is out of range, positions or normals are not finite, or the folder holds
            results of other inputs.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.
    """
    scales(size)
    job = _Job.make(mesh, occluder, vertex, size, apart=apart)
    result = visibility.blocks.compute(job, run, label="visibility")
    position = visibility.rays.place(mesh, vertex)
    levels, vector, frame = (jax.device_put(array) for array in (result["pyramid"], result["vector"], job.frame))
    return LobeTransport(levels, vector, position, frame, size)


def compress(direct: StoredVisibility) -> LobeTransport:
    """Makes visibility pyramids from stored visibility, without tracing rays.

    Args:
        direct: Visibility of the vertices, from `jaxprt.visibility.precompute`.

    Raises:
        ValueError: The cubemap faces have an edge of less than 8 texels.
    """
    scales(direct.size)
    frame = np.asarray(direct.frame)
    pyramids, vectors = [], []
    for first in range(0, len(frame), _BLOCK):
        part = np.arange(first, min(first + _BLOCK, len(frame)))
        seen = jax.device_put(direct.seen(part))
        pyramids.append(np.asarray(pyramid(seen)))
        vectors.append(np.asarray(diffuse.vectors(seen, direct.frame[part])))
    levels, vector = jax.device_put(np.concatenate(pyramids)), jax.device_put(np.concatenate(vectors, 1))
    return LobeTransport(levels, vector, direct.position, direct.frame, direct.size)


def bits(transport: LobeTransport) -> LobeTransport:
    """The transport with only the bits, about half of its bytes: enough for the visibility of single texels."""
    finest = transport.pyramid[:, : 6 * transport.size**2 // 8]
    return LobeTransport(finest, transport.vector[:0], transport.position, transport.frame, transport.size)


def from_bits(transport: LobeTransport) -> LobeTransport:
    """The transport with the means of its bits in place of the means of finer visibility."""
    scale, rows = scales(transport.size), []
    for first in range(0, len(transport.position), _BLOCK):
        byte = np.asarray(transport.packed[first : first + _BLOCK])
        half = transport.size // 2
        bit = np.unpackbits(byte, axis=1, bitorder="little").reshape(len(byte), 6, half, half // 2, 2, 2, 2)
        seen = bit.transpose(0, 1, 2, 5, 3, 4, 6).reshape(len(byte), -1) * np.uint8(visibility.LEVELS)
        rows.append(np.asarray(pyramid(jnp.asarray(seen))))
    levels = np.concatenate(rows) if rows else np.zeros((0, scale.total), np.uint8)
    return dataclasses.replace(transport, pyramid=jax.device_put(levels))


class TexelBits(eqx.Module):
    """Visibility of single texels as one bit each, ordered by texel first: fast to read for many texels of a light.

    Attributes:
        bit: Bits of eight texels in each byte, in the order of `LobeTransport`, for all vertices.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        size: Edge of the cubemap faces in texels.
    """

    bit: UInt8[Array, "n v"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    size: int = eqx.field(static=True)

    @property
    def nbytes(self) -> int:
        """Bytes of the bits."""
        return self.bit.nbytes

    @property
    def packed(self) -> UInt8[np.ndarray, "v n"]:
        """The bits of the texels of each vertex."""
        return np.asarray(self.bit).T

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t v"]:
        """1 where a vertex sees at least half of a texel, 0 elsewhere; one row for each of the given texels."""
        byte, bit = _bit(*_split(texel, self.size), self.size)
        value = self.bit.at[byte].get(mode="promise_in_bounds")
        return ((value >> bit.astype(jnp.uint8)[:, None]) & 1).astype(self.position.dtype)

    def cells(self, cell: Int[Array, " t"], *, edge: int) -> Float[Array, "t v"]:
        """Share of each of the given cells, of faces with an edge of so many cells, in texels that a vertex sees."""
        fold, (face, row, column) = self.size // edge, _split(cell, edge)
        first, bit = _bit(face, fold * row, fold * column, self.size)
        if fold == 2:  # half of a byte
            half = self.bit.at[first].get(mode="promise_in_bounds") >> bit.astype(jnp.uint8)[:, None] & 15
            return jax.lax.population_count(half).astype(self.position.dtype) / 4
        place = np.arange(fold // 2)[:, None] * (self.size // 4) + np.arange(fold // 4)
        rows = (self.bit.at[first + step].get(mode="promise_in_bounds") for step in place.ravel())
        seen = reduce(jnp.add, (jax.lax.population_count(row).astype(self.position.dtype) for row in rows))
        return seen / fold**2


def texel_bits(transport: LobeTransport) -> TexelBits:
    """The bits of a transport, transposed so that those of one texel are contiguous for all vertices."""
    turned = jax.device_put(np.ascontiguousarray(transport.packed.T))
    return TexelBits(turned, transport.position, transport.frame, transport.size)


@jit
def pyramid(seen: UInt8[Array, "b d"]) -> UInt8[Array, "b n"]:
    """Visibility pyramids in the layout of `LobeTransport.pyramid`.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.

    Raises:
        ValueError: d is not 6 n n for a power of two n of at least 8.
    """
    size = haar.face_edge(seen.shape[1])
    scale, count = scales(size), len(seen)
    clear = (seen >= visibility.LEVELS // 2).reshape(count, 6, size // 2, 2, size // 4, 2, 2)
    place = jnp.asarray([[[0, 1], [4, 5]], [[2, 3], [6, 7]]], jnp.uint8)  # row, half of the byte, column
    bits = jnp.sum(clear.astype(jnp.uint8) << place[:, None], (3, 5, 6), dtype=jnp.uint8)
    parts = [bits.reshape(count, -1)]
    area = cubemap.solid_angle(size=size)
    value = seen.reshape(count, 6, size, size).astype(area.dtype) * (area / visibility.LEVELS)
    for edge in scale.edge.tolist()[scale.bits :]:
        fold = size // edge
        mean, whole = (jnp.sum(x.reshape(-1, 6, edge, fold, edge, fold), (3, 5)) for x in (value, area[None]))
        faces = jnp.moveaxis(cubemap.pad(jnp.moveaxis(mean / whole, 0, -1)), -1, 0)
        parts.append(jnp.round(255 * faces.reshape(count, -1)).astype(jnp.uint8))
    return jnp.concatenate(parts, 1)


def _bit(face: Array, row: Array, column: Array, size: int) -> tuple[Array, Array]:
    """Byte and bit of a texel. Each half of a byte holds 2 x 2 texels."""
    byte = (face * (size // 2) + row // 2) * (size // 4) + column // 4
    return byte, (column // 2 % 2) * 4 + row % 2 * 2 + column % 2


def _split(texel: Array, size: int) -> tuple[Array, Array, Array]:
    """Face, row and column of texels, from their indices."""
    return texel // (size * size), texel // size % size, texel % size


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Job that computes blocks of pyramids; see `blocks.Job`."""

    @property
    def header(self) -> Header:
        return self.made_by("lobe", ALGORITHM)

    @property
    def layout(self) -> Mapping[str, Layout]:
        return {
            "pyramid": Layout((visibility.rays.BLOCK, scales(self.size).total), 0, "uint8"),
            "vector": Layout((diffuse.count(self.size), visibility.rays.BLOCK), 1, "uint8"),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        seen, count = self.seen(block)
        vector = diffuse.vectors(seen, self.frame[self.part(block)])
        pyramids = np.array(pyramid(seen))
        if self.rays.blends:
            bits = 6 * self.size**2 // 8
            pyramids[:, :bits] = np.asarray(pyramid(dither(seen)))[:, :bits]
        return {"pyramid": pyramids, "vector": np.asarray(vector)}, count.rays


def dither(seen: UInt8[np.ndarray, "b d"]) -> UInt8[np.ndarray, "b d"]:
    """Visibility of 0 or 16 sixteenths, whose mean over neighboring texels is that of `seen`, by ordered dithering.

    The finest level has one bit for each texel. Behind a translucent surface half-visible texels are no border between
    light and shadow, where it does not matter on which side they count. Thresholds depend on the texel alone, so that
    neighboring vertices do not differ.
    """
    size = haar.face_edge(seen.shape[1])
    row, column = np.divmod(np.arange(seen.shape[1]), size)
    threshold = visibility.LEVELS * ((_R2[0] * row + _R2[1] * column) % 1)
    return np.where(seen > threshold, visibility.LEVELS, 0).astype(np.uint8)
