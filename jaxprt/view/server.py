"""The viewer in a browser: a server that only this machine can reach, and the page that it serves."""

import contextlib
import http
import http.server
import re
import secrets
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterator
from typing import Any, NamedTuple

from jaxprt import require
from jaxprt.view import browser, messages
from jaxprt.view.session import Session

_PORTS = {"http": 80, "https": 443}
_IDLE = 600.0  # seconds that a connection may rest
_BODY = 30.0  # seconds that a message may take, beside those of its length
_SLOWEST = 1e5  # bytes a second
_LINGER = 5.0  # most seconds in which bytes that were refused are still received
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>jaxprt</title><link rel="icon" href="data:,">
<body><div id="viewer"></div><script type="module" src="./page.js"></script></body></html>
"""
_SCRIPT = """import { fillPage, mount, unpack } from "./viewer.js";
async function ask(content, buffers = []) {
  const lengths = buffers.map((each) => each.byteLength);
  let head = new TextEncoder().encode(JSON.stringify({ content, lengths }));
  const padded = new Uint8Array(head.length + ((8 - ((head.length + 4) % 8)) % 8)).fill(32);
  padded.set(head);
  const length = new Uint8Array(new Uint32Array([padded.length]).buffer);
  const pieces = buffers.flatMap((each) => [each, new Uint8Array((8 - (each.byteLength % 8)) % 8)]);
  const response = await fetch("./ask", { method: "POST", body: new Blob([length, padded, ...pieces]) });
  const type = response.headers.get("Content-Type") ?? "";
  if (!type.startsWith("application/octet-stream")) throw new Error((await response.text()) || response.status);
  return unpack(await response.arrayBuffer());
}
fillPage(document);
const close = mount(document.getElementById("viewer"), ask, { addressed: true });
window.addEventListener("pagehide", (event) => { if (!event.persisted) close(); });
"""
# The page loads nothing from other hosts, and no other page may embed or read it.
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; connect-src 'self'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}


class Address(NamedTuple):
    """An address by which the browser comes, such as that of an ssh tunnel or of a proxy.

    Attributes:
        url: The address, without a slash at its end.
        hosts: What the header Host may be.
        origin: What the header Origin may be.
        path: Path before that of the viewer, without a slash at its end; empty if there is none.
    """

    url: str
    hosts: tuple[str, ...]
    origin: str
    path: str


def parse(text: str) -> Address:
    """Parses an address such as "http://localhost:9000" or "https://hub.example.org/user/me/proxy/8765"."""
    if not isinstance(text, str):
        raise TypeError(f"the address must be text such as 'http://localhost:9000', got a {type(text).__name__}")
    wrong = ValueError(
        "the address must be that in the browser's bar, such as http://localhost:9000 or "
        f"https://hub.example.org/user/me/proxy/8765, got {text[:200]!r}"
    )
    try:
        parts = urllib.parse.urlsplit(text)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:  # a port that is no number, or brackets that do not match
        raise wrong from error
    name = re.fullmatch(r"[a-z0-9]([a-z0-9._-]*[a-z0-9])?|[0-9a-f:]*:[0-9a-f:.]*", host)
    plain = re.fullmatch(r"[A-Za-z0-9/._~%@:+,=-]*", parts.path)
    if parts.scheme not in _PORTS or not name or not plain or "@" in parts.netloc or "?" in text or "#" in text:
        raise wrong
    host = f"[{host}]" if ":" in host else host
    usual = port in (None, _PORTS[parts.scheme])
    hosts = (host, f"{host}:{_PORTS[parts.scheme]}") if usual else (f"{host}:{port}",)
    origin, path = f"{parts.scheme}://{hosts[0]}", parts.path.rstrip("/")
    return Address(origin + path, hosts, origin, path)


class Server:
    """Serves a viewer on this machine until it is closed. Its address contains a random token.

    Attributes:
        url: The address to open.
        port: The port of this machine, to which a tunnel or a proxy leads.
    """

    def __init__(self, session: Session, *, port: int = 0, address: str | None = None):
        """Starts the server in a new thread.

        Args:
            session: The session to show.
            port: Port of this machine; 0 chooses a free one.
            address: Address by which the browser comes, such as that of a tunnel or a proxy; None for this machine's.

        Raises:
            TypeError: `address` is not text.
            ValueError: `address` is not that of a page.
            OSError: The port is in use or not permitted.
        """
        require.count("port", port, least=0, most=65535)
        token, parsed = secrets.token_urlsafe(16), None if address is None else parse(address)
        self._server = _Listener(port, session, token, parsed)
        self.port = self._server.server_port
        start = f"http://127.0.0.1:{self.port}" if parsed is None else parsed.url
        self.url = f"{start}/{token}/"
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

    def __init__(self, port: int, session: Session, token: str, address: Address | None):
        self.session, self.token, self.address = session, token, address
        self.idle, self._answers, self._count = threading.Event(), 0, threading.Lock()
        self.idle.set()
        self._open: set[socket.socket] = set()
        super().__init__(("127.0.0.1", port), _Handler)
        local = [parse(f"http://{name}:{self.server_port}") for name in ("127.0.0.1", "localhost")]
        known = local if address is None else [*local, address]
        self.hosts = [host for place in known for host in place.hosts]
        self.origins = [place.origin for place in known]

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
        for connection in list(self._open):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints nothing: errors come from tabs that were closed before their answer."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    default_request_version = "HTTP/1.0"  # so that answers to requests without a version have a status too
    timeout = _IDLE
    server: _Listener  # pyright: ignore[reportIncompatibleVariableOverride]

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing, because addresses contain the token."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuses requests that the base class cannot parse."""
        status = {501: 405, 505: 400}.get(code, int(code))
        self._refuse(status, message or http.HTTPStatus(status).phrase)

    def do_GET(self) -> None:
        """Serves the page and its module."""
        place = self._allowed()
        if place is None:
            return
        if self.headers.get("Content-Length", "0") != "0" or "Transfer-Encoding" in self.headers:
            self._refuse(400, "a request for a page must have no body")
            return
        pages = {"": (_PAGE.encode(), "text/html; charset=utf-8")}
        for name, text in (("page.js", _SCRIPT), ("viewer.js", browser.module())):
            pages[name] = text.encode(), "text/javascript; charset=utf-8"
        page = pages.get(place.split("?")[0])
        if page is None:
            self._refuse(404, "there is no such page")
        else:
            self._send(200, *page)

    def do_POST(self) -> None:
        """Answers a message of the page."""
        place = self._allowed()
        if place is None:
            return
        if place != "ask":
            self._refuse(404, "there is no such page")
            return
        data = self._body()
        if data is None:
            return
        try:
            content, buffers = messages.unpack(data)
        except ValueError as error:
            self._refuse(400, str(error))
            return
        with self.server.answering():
            try:
                reply = self.server.session.answer(content, buffers)
                answer = messages.pack(*reply)
            except Exception as error:  # a fault of the viewer; the page shows its words, and the server goes on
                self._refuse(500, f"the viewer failed: {type(error).__name__}: {error}")
                return
        self._send(400 if reply.content["kind"] == "error" else 200, answer, "application/octet-stream")

    def _body(self) -> bytearray | None:
        """The body of a message. None if it was refused."""
        lengths, coding = self.headers.get_all("Content-Length", []), self.headers.get("Transfer-Encoding")
        if coding is not None or not lengths:
            came = "none" if coding is None else f"Transfer-Encoding {coding[:40]!r}"
            self._refuse(
                400 if lengths else 411, f"a message must state its length by Content-Length alone, got {came}"
            )
            return None
        if len(lengths) > 1 or not re.fullmatch(r"[0-9]+", lengths[0]):
            came = ", ".join(repr(length[:40]) for length in lengths[:4])
            self._refuse(400, f"a message must have one Content-Length, a whole number, got {came}")
            return None
        length, most = int(lengths[0][:20]), messages.most_bytes()
        if len(lengths[0]) > 20 or length > most:
            self._refuse(
                413, f"a message must have at most {most} bytes, as many as fit into memory, got {lengths[0][:40]}"
            )
            return None
        data, limit = bytearray(), _BODY + length / _SLOWEST
        deadline = time.monotonic() + limit
        self.connection.settimeout(_BODY)
        try:
            while len(data) < length:
                part = self.rfile.read1(min(length - len(data), 1 << 20))
                if not part:
                    self._refuse(400, f"a message must have the {length} bytes that it states, got {len(data)}")
                    return None
                data += part
                if time.monotonic() > deadline:
                    raise TimeoutError
        except TimeoutError:
            self._refuse(408, f"a message must arrive within {limit:.3g} seconds, got {len(data)} of {length} bytes")
            return None
        self.connection.settimeout(self.timeout)
        return data

    def _allowed(self) -> str | None:
        """The path after the token. None if the request was refused: by its token, its host, or the page's origin."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        if len(hosts) != 1 or len(origins) > 1 or self.headers.defects or self.headers.get_payload():
            self._refuse(
                400, "a request must have headers of the right form, one Host among them, and at most one Origin"
            )
            return None
        place = self._place()
        if place is None:
            self._refuse(
                403, "this address lacks the viewer's token: open the whole address that the viewer has printed"
            )
        elif hosts[0].lower() not in self.server.hosts:
            # A name that an attacker points to this machine would make its page one of this origin; Host has that name.
            self._refuse(403, self._stranger("Host", hosts[0], self.server.hosts))
        elif origins and origins[0] not in self.server.origins:
            self._refuse(403, self._stranger("Origin", origins[0], self.server.origins))
        else:
            return place
        return None

    def _place(self) -> str | None:
        """The path after the token; None for another token. Some proxies remove their own path, others do not."""
        for path in ("", *(() if self.server.address is None else (self.server.address.path,))):
            start = f"{path}/{self.server.token}/"
            if secrets.compare_digest(self.path[: len(start)].encode(), start.encode()):
                return self.path[len(start) :]
        return None

    def _stranger(self, header: str, value: str, known: list[str]) -> str:
        """The refusal of a host or an origin, with the cause and the remedy."""
        return (
            f"the browser came with the {header} {value[:100]!a}, and this viewer answers to {', '.join(known)}. If "
            "you came through a tunnel or a proxy, start the viewer with the address in the browser's bar, without the "
            "token: prt.view.serve(.., address=URL), or jaxprt view --address URL, such as http://localhost:9000"
        )

    def _refuse(self, status: int, words: str) -> None:
        """Answers by words and closes the connection, since bytes of the request may be unread."""
        self.close_connection = True
        self._send(status, words.encode("utf-8", "backslashreplace"), "text/plain; charset=utf-8")
        # A connection that is closed with unread bytes is reset, and the other side may lose the words.
        deadline = time.monotonic() + _LINGER
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(1.0)
            while time.monotonic() < deadline and self.connection.recv(1 << 16):
                pass

    def _send(self, status: int, data: bytes, kind: str) -> None:
        self.send_response(status)
        close = {"Connection": "close"} if self.close_connection else {}
        for name, value in {"Content-Type": kind, "Content-Length": str(len(data)), **close, **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
        self.wfile.flush()
