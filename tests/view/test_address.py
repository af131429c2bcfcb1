"""The address by which the browser comes: through a tunnel or a proxy, and not by names that others point here."""

import http.client
import urllib.parse

import pytest
from click.testing import CliRunner

from jaxprt.cli import play
from jaxprt.view import Server, messages
from jaxprt.view.server import parse
from tests.view.peers import Echo, Proxy, exchange

GOOD = messages.pack({"kind": "look"}, [])


WAYS = {
    "a tunnel": {},
    "a path that the proxy removes": {"path": "/user/me/proxy/8765"},
    "a proxy that names the server": {"path": "/p", "host": "127.0.0.1:{port}"},
}


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
    for inner in (b'"./viewer.js"', b'"./ask"'):
        assert inner in page
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


@pytest.mark.parametrize(
    ("text", "hosts", "origin", "path"),
    [
        ("http://localhost:9000", ("localhost:9000",), "http://localhost:9000", ""),
        ("http://localhost:9000/", ("localhost:9000",), "http://localhost:9000", ""),
        ("https://Hub.Example.org/a/b/", ("hub.example.org", "hub.example.org:443"), "https://hub.example.org", "/a/b"),
        ("https://hub.example.org:443", ("hub.example.org", "hub.example.org:443"), "https://hub.example.org", ""),
        ("http://hub.example.org:443", ("hub.example.org:443",), "http://hub.example.org:443", ""),
        ("http://[::1]:9000", ("[::1]:9000",), "http://[::1]:9000", ""),
        ("http://10.0.0.5:80/x", ("10.0.0.5", "10.0.0.5:80"), "http://10.0.0.5", "/x"),
    ],
)
def test_addresses_are_taken_apart_as_browsers_write_them(text, hosts, origin, path):
    assert parse(text) == (f"{origin}{path}", hosts, origin, path)


WRONG = [
    "",
    "localhost:9000",
    "localhost",
    "ftp://a",
    "http://",
    "http://*",
    "http://a b",
    "http://a/?x",
    "http://a/#x",
]
WRONG += [
    "http://user@a",
    "http://a:port",
    "http://a:70000",
    "http://a/\r\nX: y",
    "http://a\x00",
    "//a",
    "http://[a",
    "*",
]
WRONG += ["http://a/<script>", "http://a/\u00e9", "http://.", "http://-", "javascript:alert(1)"]


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_address_is_refused_before_anything_is_computed(text, monkeypatch):
    with pytest.raises(ValueError, match="the address must be that in the browser's bar"):
        parse(text)
    with pytest.raises(ValueError, match="the address must be that"):
        Server(Echo(), address=text)
    monkeypatch.setattr(play, "ready", None)
    found = CliRunner().invoke(play.command, ["--address", text])
    assert "--address: the address must be that in the browser's bar" in str(found.exception)


def test_the_command_line_prints_the_address_and_opens_no_browser(monkeypatch):
    opened = []
    monkeypatch.setattr(play.webbrowser, "open", opened.append)
    monkeypatch.setattr(play, "ready", lambda given: ({}, {}))
    monkeypatch.setattr(play, "serve", lambda made, environments, port, address: Server(Echo(), address=address))
    monkeypatch.setattr(Server, "wait", lambda self: self.close())
    found = CliRunner().invoke(play.command, ["--address", "http://localhost:9000"])
    assert found.exception is None
    assert "jaxprt: http://localhost:9000/" in found.output
    assert not opened
