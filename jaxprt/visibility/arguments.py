"""Checks of the arguments that all precomputations share, for `require.arguments`."""

from typing import Any

from jaxprt import require
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.mesh_arrays import check_kinds

_MOST = 1 << 15  # texels along the edge of a face: 80 GB for one vertex
_SOURCE = "jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh"


def _mesh(value: Any) -> None:
    require.kind("the mesh", value, Mesh, source=_SOURCE)
    check_kinds(value, "the mesh")


def _occluder(value: Any) -> None:
    if value is not None:
        require.kind("the occluder", value, Mesh, source=_SOURCE)
        check_kinds(value, "the occluder")


def _vertex(value: Any) -> None:
    if value is not None:
        wrong = require.unreal(value)
        if wrong and wrong != "booleans":
            raise TypeError(f"vertex must be a mask or indices, got {wrong}")


def _path(value: Any) -> None:
    if value is not None:
        require.path("path", value)


def _size(value: Any) -> None:
    require.whole("size", value)  # Systems say which smaller sizes they take.
    if value > _MOST:
        raise ValueError(f"size must be at most {_MOST}, got {value}")


PRECOMPUTE = {
    "mesh": _mesh,
    "occluder": _occluder,
    "vertex": _vertex,
    "path": _path,
    "executor": require.executor,
    "size": _size,
}
