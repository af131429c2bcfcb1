"""The viewer: a scene to play with, in a notebook or in a browser."""

from collections.abc import Mapping
from typing import Any

from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.view.baked import export_baked
from jaxprt.view.piece import Piece, export
from jaxprt.view.server import Server
from jaxprt.view.session import Session

__all__ = ["Piece", "Server", "Session", "export", "export_baked", "serve", "view"]


def view(
    scene: RelitScene | Mapping[str, RelitScene],
    *,
    environments: Mapping[str, Environment] | None = None,
    height: int = 480,
) -> Any:
    """A viewer in a notebook. It needs the extra `jaxprt[view]`.

    Args:
        scene: From `jaxprt.precompute`; or the same scene by several systems, by their names.
        environments: Lights by names, all of the size of the scene's transport; the scene's own or the two embedded
            ones if None.
        height: Of the viewer in pixels of the page.

    Returns:
        The widget, which the notebook shows where it is a cell's last value.

    Raises:
        ImportError: anywidget is not installed.
        TypeError: No relit scenes, or no environments.
        ValueError: There are none, they are of different scenes, or lights are of several sizes.
    """
    try:
        from jaxprt.view.widget import Viewer
    except ImportError as error:
        raise ImportError("a viewer in a notebook needs anywidget: pip install 'jaxprt[view]'") from error
    return Viewer(Session(scene, environments=environments), height=height)


def serve(
    scene: RelitScene | Mapping[str, RelitScene],
    *,
    environments: Mapping[str, Environment] | None = None,
    port: int = 0,
) -> Server:
    """A viewer for a browser on this machine: open its `url`, and `close` it in the end.

    Arguments and errors are those of `view`.

    Args:
        scene: As in `view`.
        environments: As in `view`.
        port: Of this machine; a free one if 0.

    Returns:
        The server, which serves already.
    """
    return Server(Session(scene, environments=environments), port=port)
