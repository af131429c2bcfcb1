"""Interactive viewer for relit scenes, in a notebook or in a browser."""

from collections.abc import Mapping
from typing import Any

from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.view.gltf import export_baked, export_gltf
from jaxprt.view.piece import Piece, export
from jaxprt.view.server import Server
from jaxprt.view.session import Session

__all__ = ["Piece", "Server", "Session", "export", "export_baked", "export_gltf", "serve", "view"]


def view(
    scene: RelitScene | Mapping[str, RelitScene],
    *,
    environments: Mapping[str, Environment] | None = None,
    height: int = 480,
) -> Any:
    """Makes an interactive viewer for a notebook. It needs the extra `jaxprt[view]`.

    Args:
        scene: The result of `jaxprt.precompute`, or a dictionary from names to results of several systems for the same
            scene.
        environments: Dictionary from names to lights. Their size must be that of the scene's transport. If None, the
            scene's own lights or the two embedded ones.
        height: Height of the viewer in pixels of the page.

    Returns:
        A widget. The notebook displays it if it is the last value of a cell.

    Raises:
        ImportError: anywidget is not installed.
        TypeError: `scene` holds something other than relit scenes, or `environments` something other than lights.
        ValueError: There is no scene or no light, the scenes differ, or the lights have different sizes.
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
    address: str | None = None,
) -> Server:
    """Starts a viewer for a browser. Open its `url`, and call `close` when done.

    Only this machine can reach the server. For a browser on another machine, tunnel or proxy the port, and give the
    address by which the browser then comes. Requests from pages of other addresses, and without the token in `url`, are
    refused.

    Args:
        scene: The result of `jaxprt.precompute`, or a dictionary from names to results of several systems for the same
            scene.
        environments: Dictionary from names to lights. Their size must be that of the scene's transport. If None, the
            scene's own lights or the two embedded ones.
        port: Port of this machine; 0 chooses a free one.
        address: Address by which the browser comes, if it is not that of this machine: "http://localhost:9000" for an
            ssh tunnel from port 9000, or "https://hub.example.org/user/me/proxy/8765" behind jupyter-server-proxy.

    Returns:
        The running server.

    Raises:
        TypeError: `scene` holds something other than relit scenes, or `environments` something other than lights.
        ValueError: There is no scene or no light, the scenes differ, the lights have different sizes, or `address` is
            not an address of http or https.
        OSError: The port is in use or not permitted.
    """
    return Server(Session(scene, environments=environments), port=port, address=address)
