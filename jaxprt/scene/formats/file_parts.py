"""Conversion of the geometry of a file to parts: one for each region, with the tangents that its material needs."""

import pathlib
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxprt.scene import texture
from jaxprt.scene.formats.geometry import Geometry, rows_of
from jaxprt.scene.material import TexturedMaterial
from jaxprt.scene.mesh import Mesh, brush, from_file, split
from jaxprt.scene.scene import Part, numbered


def split_parts(
    geometry: Geometry, names: Sequence[str], materials: Sequence[TexturedMaterial], path: pathlib.Path
) -> list[Part]:
    """Splits the geometry of a file into parts.

    If a material needs tangents and the file has none, they point along the texture coordinate u. Missing texture
    coordinates are 0.

    Args:
        geometry: The whole geometry. Region i becomes part i.
        names: Names of the regions. Equal names are numbered.
        materials: Materials of the regions.
        path: The file.
    """
    meshes = split(from_file(geometry, path))
    if len(meshes) != len(names):
        raise ValueError(f"{path} must have {len(names)} materials, got {len(meshes)}")
    region = np.zeros(len(geometry.position), int) if geometry.region is None else geometry.region
    vertices = rows_of(region, np.arange(len(names)))
    return [
        _part(name, mesh, material, geometry, own)
        for name, mesh, material, own in zip(numbered(names), meshes, materials, vertices, strict=True)
    ]


def _part(name: str, mesh: Mesh, material: TexturedMaterial, geometry: Geometry, own: np.ndarray) -> Part:
    """A part of some vertices of a file's geometry."""

    def rows(value: np.ndarray | None, plain: int) -> np.ndarray | None:
        """The part's rows of a vertex attribute; None if all have the default value."""
        return None if value is None or (value[own] == plain).all() else value[own]

    second, side = rows(geometry.second, 0), rows(geometry.handedness, 1)
    sets = {each.set for each in material.textures}
    if 1 in sets and second is None:
        second = np.zeros((len(mesh.position), 2))
    if 0 in sets and mesh.texture is None:
        zero = _array(np.zeros((len(mesh.position), 2)))
        mesh = eqx.tree_at(lambda each: each.texture, mesh, zero, is_leaf=lambda each: each is None)
    source = material.normal_texture or material.anisotropy_texture
    place = second if source is not None and source.set else mesh.texture
    if place is not None and (source is not None or material.anisotropy > 0):
        given = np.zeros(len(place), bool) if geometry.tangent is None else (geometry.tangent[own] != 0).any(axis=1)
        mesh, side = _with_tangents(mesh, place, given, side)
    alpha = None if material.alpha_mode == "opaque" else rows(geometry.alpha, 1)
    return Part(name, mesh, material, _array(rows(geometry.color, 1)), _array(second), _array(side), _array(alpha))


def _with_tangents(
    mesh: Mesh, place: np.ndarray | Array, given: np.ndarray, side: np.ndarray | None
) -> tuple[Mesh, np.ndarray]:
    """The mesh with tangents along u where the file has none, and the handedness of all vertices."""
    image = Mesh(mesh.position, mesh.face, mesh.normal, mesh.tangent, mesh.region, jnp.asarray(place, jnp.float32))
    along = np.where(given[:, None], mesh.tangent, texture.dpdu(image))
    return brush(mesh, along), np.where(given, 1 if side is None else side, texture.handedness(image))


def _array(value: np.ndarray | Array | None) -> Array | None:
    """An array on the device, in the precision of meshes."""
    return None if value is None else jax.device_put(np.asarray(value, np.float32))
