"""A ball on the ground, and what its vertices see, made once for the files that share them."""

import functools

from jaxprt import lobe, visibility
from jaxprt.scene import Mesh, builtin
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.visibility import StoredVisibility

SIZE = 16


@functools.cache
def ball_on_ground() -> Mesh:
    """Vertices with contact shadows, and ground vertices near them."""
    ball = builtin.sphere(rings=8, sectors=10)
    return join([ball, ground_plane(ball, vertices=36)])


@functools.cache
def seen_on_ground() -> StoredVisibility:
    """The visibility of the ball on the ground."""
    return visibility.precompute(ball_on_ground(), size=SIZE)


@functools.cache
def pyramids_on_ground() -> lobe.LobeTransport:
    """The visibility pyramids of the ball on the ground."""
    return lobe.compress(seen_on_ground())
