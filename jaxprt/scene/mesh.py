"""Triangle meshes: the type, loading from files, joining and splitting by region."""

import equinox as eqx
from jaxtyping import Array, Float, Int


class Mesh(eqx.Module):
    """A triangle mesh with one shading frame per vertex.

    Attributes:
        position: Vertex positions in world units.
        face: Vertex indices of each triangle; counter-clockwise seen from the front.
        normal: Unit shading normals.
        tangent: Unit tangents, orthogonal to the normals.
        region: Number of the material region that each vertex belongs to, from 0.
    """

    position: Float[Array, "v 3"]
    face: Int[Array, "f 3"]
    normal: Float[Array, "v 3"]
    tangent: Float[Array, "v 3"]
    region: Int[Array, " v"]
