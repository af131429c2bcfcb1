"""The server: its page and answers for who has the token, on this machine, and nothing for others.

Requests of wrong form: each is answered by a status and words, and the server goes on.

The session behind the server answers without computing anything, so that the tests compile nothing.

The address by which the browser comes: through a tunnel or a proxy, and not by names that others point here.
"""

import http.client
import socket
import struct
import threading
import urllib.parse

import pytest
from click.testing import CliRunner

from jaxprt.cli import play
from jaxprt.view import Server, messages
from jaxprt.view.server import parse
from tests.view.peers import Echo, Proxy, exchange

WAYS = {
    "a tunnel": {},
    "a path that the proxy removes": {"path": "/user/me/proxy/8765"},
    "a proxy that names the server": {"path": "/p", "host": "127.0.0.1:{port}"},
}


@pytest.fixture(scope="module")
def echo():
    made = Server(Echo())
    yield made
    made.close()


def request(server, path, *, method="GET", body=None, **headers):
    """Status, headers and bytes of an answer; `path` follows the token."""
    place = urllib.parse.urlsplit(server.url)
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=60)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, urllib.parse.urljoin(place.path, path), body, named)
        found = connection.getresponse()
        return found.status, dict(found.getheaders()), found.read()
    finally:
        connection.close()


def test_the_page_and_its_module_are_served_and_nothing_is_fetched_from_elsewhere(echo):
    for path, kind in (("", "text/html"), ("page.js", "text/javascript"), ("viewer.js", "text/javascript")):
        status, headers, data = request(echo, path)
        assert (status, headers["Content-Type"].split(";")[0]) == (200, kind)
        assert "default-src 'none'; script-src 'self'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert b"http://" not in data
        assert b"https://" not in data


def test_a_question_is_answered(echo, look):
    status, headers, data = request(echo, "ask", method="POST", body=messages.pack(look, [b"abc"]))
    content, _ = messages.unpack(data)
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    assert (content["kind"], content["came"], content["bytes"]) == ("color", list(look), [3])


def test_wrong_tokens_and_pages_of_another_origin_get_nothing(echo):
    address, body = urllib.parse.urlsplit(echo.url), messages.pack({"kind": "scene"}, [])
    assert address.hostname == echo._server.server_address[0] == "127.0.0.1"
    token = address.path.strip("/").encode()
    for path in ("/", "/wrong/", "/wrong/viewer.js", "/wrong/ask", "/../"):
        for method in ("GET", "POST"):
            status, _, data = request(echo, path, method=method, body=body)
            assert (status, b"lacks the viewer's token" in data, token in data) == (403, True, False)
    for name, value in (
        ("Origin", "https://example.org"),
        ("Origin", "null"),
        ("Host", "example.org"),
        ("Host", "127.0.0.1:1"),
    ):
        for path, method in (("", "GET"), ("ask", "POST")):
            status, found, data = request(echo, path, method=method, body=body, **{name: value})
            assert (status, token in data, "Access-Control-Allow-Origin" in found) == (403, False, False)


def test_what_is_no_message_is_refused_and_the_server_goes_on(echo, look):
    assert request(echo, "ask", method="POST", body=b"hello")[0] == 400
    assert request(echo, "ask", method="POST", body=b"", Content_Length=str(1 << 30))[0] == 413
    assert request(echo, "other")[0] == 404
    assert request(echo, "other", method="POST", body=b"")[0] == 404
    assert request(echo, "ask", method="POST", body=messages.pack(look, []))[0] == 200


def test_tokens_differ_and_ports_come_back():
    first, second = Server(Echo()), Server(Echo())
    assert urllib.parse.urlsplit(first.url).path != urllib.parse.urlsplit(second.url).path
    port = urllib.parse.urlsplit(first.url).port
    first.close()
    second.close()
    Server(Echo(), port=port).close()


@pytest.fixture
def quick(monkeypatch):
    """Short patience with slow clients."""
    monkeypatch.setattr("jaxprt.view.server._BODY", 0.4)
    monkeypatch.setattr("jaxprt.view.server._SLOWEST", 1e9)


def raw_request(made, *, method="POST", path="ask", host=None, body=b"", length=True, extra=()):
    """The bytes of a request."""
    place = urllib.parse.urlsplit(made.url)
    lines = [f"{method} {place.path}{path} HTTP/1.1"]
    lines += [f"Host: {place.netloc}" if host is None else host] if host != "" else []
    lines += [f"Content-Length: {len(body)}"] if length else []
    return "\r\n".join([*lines, "Connection: close", *extra, "", ""]).encode("latin-1") + body


def alive(made):
    status, _ = exchange(made, raw_request(made, body=messages.pack({"kind": "scene"}, [])))
    return status == 200


LOCAL = "Host: 127.0.0.1:{port}"
GOOD = messages.pack({"kind": "look"}, [])
HTTP = {
    "a length of 5,000 digits": ({"extra": ["Content-Length: " + "9" * 5000], "length": False}, 413, "at most"),
    "a negative length": ({"extra": ["Content-Length: -5"], "length": False}, 400, "whole number, got '-5'"),
    "a length in words": ({"extra": ["Content-Length: ten"], "length": False}, 400, "got 'ten'"),
    "two lengths": ({"extra": ["Content-Length: 3"], "body": GOOD}, 400, "must have one Content-Length"),
    "no length": ({"length": False}, 411, "must state its length by Content-Length alone, got none"),
    "chunks": (
        {"extra": ["Transfer-Encoding: chunked"], "length": False, "body": b"3\r\nabc\r\n0\r\n\r\n"},
        411,
        "got Transfer-Encoding 'chunked'",
    ),
    "chunks and a length": ({"extra": ["Transfer-Encoding: chunked"], "body": GOOD}, 400, "Transfer-Encoding"),
    "two hosts": ({"extra": ["Host: example.org"], "body": GOOD}, 400, "one Host"),
    "no host": ({"host": "", "body": GOOD}, 400, "one Host"),
    "another host": ({"host": "Host: example.org:80", "body": GOOD}, 403, "with the Host 'example.org:80'"),
    "a host of letters beyond ASCII": ({"host": "Host: \xe9\xe8", "body": GOOD}, 403, r"Host '\xe9\xe8'"),
    "two origins": (
        {"extra": ["Origin: http://a.org", "Origin: http://b.org"], "body": GOOD},
        400,
        "at most one Origin",
    ),
    "another origin": ({"extra": ["Origin: https://a.org"], "body": GOOD}, 403, "with the Origin 'https://a.org'"),
    "a header without a colon": ({"extra": ["Nonsense"], "body": GOOD}, 400, "headers of the right form"),
    "200 headers": ({"extra": [f"X{number}: a" for number in range(200)], "body": GOOD}, 431, "Too many headers"),
    "a path of 100 kB": ({"path": "a" * 100_000, "body": GOOD}, 414, "Too Long"),
    "an unknown method": ({"method": "BREW", "body": GOOD}, 405, "Unsupported method"),
    "a page with a body": ({"method": "GET", "path": "", "body": b"abc"}, 400, "must have no body"),
    "another page": ({"path": "other", "body": GOOD}, 404, "no such page"),
    "a path upwards": ({"path": "../../etc/passwd", "method": "GET"}, 404, "no such page"),
}


def test_requests_of_wrong_form_get_a_status_and_words(echo):
    port, token = str(urllib.parse.urlsplit(echo.url).port), urllib.parse.urlsplit(echo.url).path.strip("/")
    for case, (options, status, words) in HTTP.items():
        options = options | {"extra": [line.replace("{port}", port) for line in options.get("extra", ())]}
        found, text = exchange(echo, raw_request(echo, **options))
        assert (found, words in text, token in text) == (status, True, False), (case, text)
    for data in (
        b"hello\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET /\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",  # TLS
        b"POST / HTTP/1.1\r\n\r\n",
    ):
        assert exchange(echo, data)[0] == 400
    assert alive(echo)


def body(text, length=None):
    head = text if isinstance(text, bytes) else text.encode()
    return struct.pack("<I", len(head) if length is None else length) + head


DEEP = "[" * 100_000
BODIES = {
    "empty": (b"", "in another form"),
    "a length beyond the end": (body('{"content": {}, "lengths": []}', 2**32 - 1), "in another form"),
    "no JSON": (body("hello"), "in another form"),
    "no UTF-8": (body(b'{"content": {"kind": "\xff\xfe"}, "lengths": []}'), "in another form"),
    "content of pairs": (body('{"content": [["kind", "look"]], "lengths": []}'), "`content`"),
    "a negative array": (body('{"content": {}, "lengths": [-1]}'), "an array has -1 bytes"),
    "an array beyond the end": (body('{"content": {}, "lengths": [8]}'), "an array has 8 bytes"),
    "nested lists": (body('{"content": {"kind": ' + DEEP), "in another form"),
    "an integer of 5,000 digits": (
        body('{"content": {"turn": ' + "9" * 5000 + '}, "lengths": []}'),
        "in the range of float64, got 9999",
    ),
    "a float beyond float64": (body('{"content": {"turn": 1e999}, "lengths": []}'), "must be finite, got 1e999"),
    "not a number": (body('{"content": {"turn": NaN}, "lengths": []}'), "must be finite, got NaN"),
}


def test_messages_of_wrong_form_get_400_and_words_and_faults_500(echo):
    for case, (data, words) in BODIES.items():
        status, text = exchange(echo, raw_request(echo, body=data))
        assert (status, words in text) == (400, True), (case, text)
    for kind in ("fault", "nothing"):
        status, text = exchange(echo, raw_request(echo, body=messages.pack({"kind": kind}, [])))
        assert (status, "the viewer failed" in text) == (500, True)
    assert alive(echo)


def test_several_messages_go_over_one_connection_and_errors_have_status_400(echo):
    whole = raw_request(echo, body=GOOD).replace(b"Connection: close\r\n", b"")
    last = raw_request(echo, body=messages.pack({"kind": "wrong"}, []))
    place = urllib.parse.urlsplit(echo.url)
    with socket.create_connection((place.hostname or "", place.port or 0)) as connection:
        connection.sendall(whole + whole + last)
        answer = b"".join(iter(lambda: connection.recv(1 << 16), b""))
    assert answer.count(b"HTTP/1.1 200 ") == 2
    head, _, data = answer[answer.index(b"HTTP/1.1 400 ") :].partition(b"\r\n\r\n")
    assert messages.unpack(data)[0]["message"] == "what was required", head


def test_a_message_that_stops_is_refused(echo, quick):
    whole = raw_request(echo, body=messages.pack({"kind": "look"}, []))
    status, text = exchange(echo, whole[:-3])
    assert (status, "bytes that it states" in text) == (400, True)
    status, text = exchange(echo, whole[:-3], end=False)
    assert (status, "must arrive within 0.4 seconds" in text) == (408, True)


def test_a_message_that_dribbles_is_refused_and_others_are_served_meanwhile(echo, quick):
    whole = raw_request(echo, body=messages.pack({"kind": "look"}, [bytes(64)]))
    found = []
    slow = threading.Thread(
        target=lambda: found.append(
            exchange(echo, whole[:-40], parts=[whole[k : k + 1] for k in range(-40, -30)], wait=0.1, end=False)
        )
    )
    slow.start()
    assert alive(echo)
    slow.join()
    assert found[0][0] == 408


def test_a_large_message_is_refused_by_the_free_memory_before_it_is_read(echo, monkeypatch):
    monkeypatch.setattr(messages.require, "available_memory", lambda: 4 << 26)
    status, text = exchange(echo, raw_request(echo, length=False, extra=[f"Content-Length: {1 << 27}"]), end=False)
    assert (status, f"at most {1 << 26} bytes" in text) == (413, True)
    data = messages.pack({"kind": "drop"}, [bytes(1 << 20)])
    status, text = exchange(echo, raw_request(echo, body=data))
    assert (status, "[1048576]" in text) == (200, True)


@pytest.fixture(params=WAYS)
def proxied(request):
    """A proxy, and a server behind it."""
    proxy = Proxy(**WAYS[request.param])
    made = Server(Echo(), address=proxy.address)
    proxy.target = made._server.server_port
    yield proxy, made
    made.close()
    proxy.shutdown()
    proxy.server_close()


def ask(url, *, method="POST", data: bytes | None = GOOD, headers=None, **more):
    """Status and bytes of an answer."""
    place = urllib.parse.urlsplit(url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
    connection.request(method, place.path, data, {**(headers or {}), **more})
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_the_page_and_its_messages_come_through_a_proxy(proxied):
    proxy, made = proxied
    assert made.url.startswith(f"{proxy.address}/")
    status, page = ask(made.url, method="GET", data=None)
    assert status == 200
    # Whatever the page loads is relative to it.
    assert b'src="./page.js"' in page
    status, script = ask(f"{made.url}page.js", method="GET", data=None)
    assert status == 200
    for inner in (b'"./viewer.js"', b'"./ask"'):
        assert inner in script
    assert ask(f"{made.url}viewer.js", method="GET", data=None)[0] == 200
    origin = proxy.address.removesuffix(proxy.path)
    status, data = ask(f"{made.url}ask", Origin=origin)
    assert (status, messages.unpack(data)[0]["kind"]) == (200, "color")


def test_other_origins_hosts_and_tokens_are_refused_through_a_proxy(proxied):
    proxy, made = proxied
    origin = proxy.address.removesuffix(proxy.path)
    for wrong in ("http://evil.example", "null", f"{origin}.evil.example", origin.replace("http:", "https:")):
        status, data = ask(f"{made.url}ask", Origin=wrong)
        assert (status, wrong in data.decode()) == (403, True)
    if proxy.host is None:
        for wrong in (
            "evil.example",
            f"localhost:{proxy.server_port + 1}",
            f"localhost:{proxy.server_port}.evil.example",
        ):
            status, data = ask(f"{made.url}ask", Host=wrong)
            assert (status, wrong in data.decode()) == (403, True)
    assert ask(f"{proxy.address}/wrong-token/ask", Origin=origin)[0] == 403
    assert ask(f"{proxy.address}/ask", Origin=origin)[0] == 403


def test_a_proxy_that_keeps_its_path_is_served_too():
    made = Server(Echo(), address="https://hub.example.org/user/me/proxy/absolute/8765/")
    token = urllib.parse.urlsplit(made.url).path.split("/")[-2]
    assert made.url == f"https://hub.example.org/user/me/proxy/absolute/8765/{token}/"
    local = f"http://127.0.0.1:{made._server.server_port}"
    for path, status in (("/user/me/proxy/absolute/8765", 200), ("", 200), ("/user/me", 403)):
        for host in ("hub.example.org", "hub.example.org:443", "HUB.example.org"):
            headers = {"Host": host, "Origin": "https://hub.example.org"}
            assert ask(f"{local}{path}/{token}/ask", headers=headers)[0] == status
    assert ask(f"{local}/{token}/ask", Host="hub.example.org:80", Origin="https://hub.example.org")[0] == 403
    assert ask(f"{local}/{token}/ask")[0] == 200  # this machine is served as before
    made.close()


def test_the_refusal_says_which_host_came_which_are_served_and_which_option_helps():
    made = Server(Echo())
    port, token = made._server.server_port, urllib.parse.urlsplit(made.url).path
    head = f"POST {token}ask HTTP/1.1\r\nHost: localhost:9000\r\nContent-Length: 0\r\n\r\n"
    status, words = exchange(made, head.encode())
    assert status == 403
    for part in ("Host 'localhost:9000'", f"127.0.0.1:{port}, localhost:{port}", "address=URL", "--address URL"):
        assert part in words
    made.close()


ADDRESSES = [
    ("http://localhost:9000/", ("localhost:9000",), "http://localhost:9000", ""),
    ("https://Hub.Example.org/a/b/", ("hub.example.org", "hub.example.org:443"), "https://hub.example.org", "/a/b"),
    ("https://hub.example.org:443", ("hub.example.org", "hub.example.org:443"), "https://hub.example.org", ""),
    ("http://hub.example.org:443", ("hub.example.org:443",), "http://hub.example.org:443", ""),
    ("http://[::1]:9000", ("[::1]:9000",), "http://[::1]:9000", ""),
    ("http://10.0.0.5:80/x", ("10.0.0.5", "10.0.0.5:80"), "http://10.0.0.5", "/x"),
]
WRONG = ["", "localhost:9000", "ftp://a", "http://", "http://*", "http://a b", "http://a/?x", "http://a/#x", "*"]
WRONG += ["http://user@a", "http://a:port", "http://a:70000", "http://a/\r\nX: y", "http://a\x00", "//a", "http://[a"]
WRONG += ["http://a/<script>", "http://a/\u00e9", "http://.", "http://-", "javascript:alert(1)"]


def test_addresses_are_taken_apart_as_browsers_write_them_and_others_refused(monkeypatch):
    for text, hosts, origin, path in ADDRESSES:
        assert parse(text) == (f"{origin}{path}", hosts, origin, path)
    monkeypatch.setattr(play, "prepare", None)  # before anything is computed
    for text in WRONG:
        with pytest.raises(ValueError, match="the address must be that in the browser's bar"):
            Server(Echo(), address=text)
        found = CliRunner().invoke(play.command, ["--address", text])
        assert "--address: the address must be that in the browser's bar" in str(found.exception), text


def test_the_command_line_prints_the_address_and_opens_no_browser(monkeypatch):
    opened = []
    monkeypatch.setattr(play.webbrowser, "open", opened.append)
    monkeypatch.setattr(play, "prepare", lambda session, chosen: session.report("nothing", 1.0))
    monkeypatch.setattr(Server, "wait", lambda self: self.close())
    found = CliRunner().invoke(play.command, ["--address", "http://localhost:9000"])
    assert found.exception is None
    assert "jaxprt: http://localhost:9000/" in found.output
    assert not opened
