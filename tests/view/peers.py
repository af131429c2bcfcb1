"""What the tests of the server talk to: a session that computes nothing, a reverse proxy, and raw connections."""

import http.client
import http.server
import socket
import threading
import time
import urllib.parse

from jaxprt.view import Session
from jaxprt.view.messages import Reply


class Echo(Session):
    """Answers a message by its own fields; a kind of "fault" raises."""

    def __init__(self):
        pass

    def end(self):
        pass

    def answer(self, message, buffers=()):
        if message.get("kind") == "fault":
            raise KeyError("part")
        if message.get("kind") == "nothing":
            return Reply({"kind": "color", "scale": float("inf")}, [])
        if message.get("kind") == "wrong":
            return Reply({"kind": "error", "of": "wrong", "message": "what was required"}, [])
        return Reply({"kind": "color", "came": list(message), "bytes": [len(data) for data in buffers]}, [])


class Proxy(http.server.ThreadingHTTPServer):
    """A reverse proxy: it serves a path of its own from a server, as a tunnel or jupyter-server-proxy does.

    Args:
        path: Path before that of the server; the proxy removes it.
        host: The header Host that the server gets; None passes on that of the browser.
    """

    daemon_threads = True

    def __init__(self, path="", host=None):
        self.path, self.host, self.target = path, host, 0
        super().__init__(("127.0.0.1", 0), _Passing)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def address(self):
        return f"http://localhost:{self.server_port}{self.path}"


class _Passing(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Proxy

    def log_message(self, format, *args):
        pass

    def do_GET(self):
        self.do_POST()

    def do_POST(self):
        assert self.path.startswith(self.server.path)
        data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        headers = {name: value for name, value in self.headers.items() if name not in ("Connection", "Accept-Encoding")}
        if self.server.host is not None:
            headers["Host"] = self.server.host.replace("{port}", str(self.server.target))
        inner = http.client.HTTPConnection("127.0.0.1", self.server.target, timeout=60)
        inner.request(self.command, self.path.removeprefix(self.server.path), data or None, headers)
        answer = inner.getresponse()
        content = answer.read()
        inner.close()
        self.send_response(answer.status)
        for name, value in answer.getheaders():
            if name not in ("Date", "Server", "Connection"):
                self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)


def exchange(made, data, *, parts=(), wait=0.0, end=True):
    """Status and text of the answer to raw bytes."""
    place = urllib.parse.urlsplit(made.url)
    with socket.create_connection((place.hostname or "", place.port or 0), timeout=20) as connection:
        connection.sendall(data)
        for part in parts:
            time.sleep(wait)
            connection.sendall(part)
        if end:
            connection.shutdown(socket.SHUT_WR)
        answer = b""
        while part := connection.recv(1 << 16):
            answer += part
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 "), answer[:200]
    return int(head.split()[1]), body.decode("utf-8", "replace")
