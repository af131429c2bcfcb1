"""The viewer in a browser: a server that only this machine can reach, and the page that it serves."""

import contextlib
import http.server
import pathlib
import secrets
import socket
import threading
from collections.abc import Iterator
from typing import Any

from jaxprt.view import messages
from jaxprt.view.session import Session

MODULE = pathlib.Path(__file__).with_name("viewer.js")
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>jaxprt</title><link rel="icon" href="data:,">
<body style="margin:0;height:100vh;background:#1a1a1a"><div id="viewer" style="height:100%"></div>
<script type="module">
import { mount, unpack } from "./viewer.js";
async function ask(content, buffers = []) {
  const lengths = buffers.map((each) => each.byteLength);
  let head = new TextEncoder().encode(JSON.stringify({ content, lengths }));
  const padded = new Uint8Array(head.length + ((8 - ((head.length + 4) % 8)) % 8)).fill(32);
  padded.set(head);
  const length = new Uint8Array(new Uint32Array([padded.length]).buffer);
  const pieces = buffers.flatMap((each) => [each, new Uint8Array((8 - (each.byteLength % 8)) % 8)]);
  const response = await fetch("./ask", { method: "POST", body: new Blob([length, padded, ...pieces]) });
  if (!response.ok) throw new Error(`the server says ${response.status}`);
  return unpack(await response.arrayBuffer());
}
const close = mount(document.getElementById("viewer"), ask);
window.addEventListener("pagehide", (event) => { if (!event.persisted) close(); });
</script></body></html>
"""
# The page loads nothing from other hosts, and no other page may embed or read it.
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' data: blob:; frame-ancestors 'none'",
}


class Server:
    """Serves a viewer on this machine until it is closed. Its address contains a random token.

    Attributes:
        url: The address.
    """

    def __init__(self, session: Session, *, port: int = 0):
        """Starts the server in a new thread.

        Args:
            session: The session to show.
            port: Port of this machine; 0 chooses a free one.

        Raises:
            OSError: The port is in use or not permitted.
        """
        token = secrets.token_urlsafe(16)
        self._server = _Listener(port, session, token)
        self.url = f"http://127.0.0.1:{self._server.server_port}/{token}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="jaxprt-view", daemon=True)
        self._thread.start()

    def close(self, *, patience: float = 10.0) -> None:
        """Stops the server and releases the port. Unfinished pictures are abandoned.

        Args:
            patience: Seconds to wait for answers that are being computed. A thread that still computes when the
                interpreter exits would end the process with an error.
        """
        self._server.session.end()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        self._server.idle.wait(patience)

    def wait(self) -> None:
        """Waits until the server is closed."""
        self._thread.join()


class _Listener(http.server.ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, port: int, session: Session, token: str):
        self.session, self.token = session, token
        self.idle, self._answers, self._count = threading.Event(), 0, threading.Lock()
        self.idle.set()
        self._open: set[socket.socket] = set()
        super().__init__(("127.0.0.1", port), _Handler)

    @contextlib.contextmanager
    def answering(self) -> Iterator[None]:
        """Counts the answers that are being computed."""
        with self._count:
            self._answers += 1
            self.idle.clear()
        try:
            yield
        finally:
            with self._count:
                self._answers -= 1
                if not self._answers:
                    self.idle.set()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Records the connection, because browsers keep connections open."""
        self._open.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Removes the record of a connection that ends."""
        self._open.discard(request)
        super().shutdown_request(request)

    def server_close(self) -> None:
        """Closes open connections too."""
        super().server_close()
        for each in list(self._open):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints nothing: errors come from tabs that were closed before their answer."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 600
    server: _Listener  # pyright: ignore[reportIncompatibleVariableOverride]

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing, because addresses contain the token."""

    def do_GET(self) -> None:
        """Serves the page and its module."""
        if not self._allowed():
            return
        pages = {"": (_PAGE.encode(), "text/html; charset=utf-8")}
        pages["viewer.js"] = MODULE.read_bytes(), "text/javascript; charset=utf-8"
        found = pages.get(self.path.split("?")[0].removeprefix(f"/{self.server.token}/"))
        if found is None:
            self._send(404, b"there is no such page", "text/plain")
        else:
            self._send(200, *found)

    def do_POST(self) -> None:
        """Answers a message of the page."""
        if not self._allowed():
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > messages.MOST_BYTES:
            self.close_connection = True
            self._send(413, b"a message must say its length, and be less than 512 MiB", "text/plain")
            return
        data = self.rfile.read(int(length))
        if self.path != f"/{self.server.token}/ask":
            self._send(404, b"there is no such page", "text/plain")
            return
        try:
            content, buffers = messages.unpack(data)
        except ValueError as error:
            self._send(400, str(error).encode(), "text/plain")
            return
        with self.server.answering():
            answer = messages.pack(*self.server.session.answer(content, buffers))
        self._send(200, answer, "application/octet-stream")

    def _allowed(self) -> bool:
        """Refuses wrong tokens, other names for this machine, and pages of other origins."""
        port = self.server.server_port
        hosts = [f"127.0.0.1:{port}", f"localhost:{port}"]
        origin = self.headers.get("Origin")
        right = secrets.compare_digest(
            self.path.encode()[: len(self.server.token) + 2], f"/{self.server.token}/".encode()
        )
        known = self.headers.get("Host") in hosts and (origin is None or origin in [f"http://{x}" for x in hosts])
        if right and known:
            return True
        self.close_connection = True
        self._send(403, b"this address is not the viewer's", "text/plain")
        return False

    def _send(self, status: int, data: bytes, kind: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(data)), **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
