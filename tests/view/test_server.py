"""The server: its page and answers for who has the token, on this machine, and nothing for others."""

import http.client
import urllib.parse

import pytest

from jaxprt.view import Server, messages


@pytest.fixture
def server(session):
    made = Server(session)
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


def test_the_page_and_its_module_are_served_and_nothing_is_fetched_from_elsewhere(server):
    for path, kind in (("", "text/html"), ("viewer.js", "text/javascript")):
        status, headers, data = request(server, path)
        assert (status, headers["Content-Type"].split(";")[0]) == (200, kind)
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert b"http://" not in data
        assert b"https://" not in data


def test_a_question_is_answered(server, look):
    status, headers, data = request(server, "ask", method="POST", body=messages.pack(look, []))
    content, buffers = messages.unpack(data)
    assert (status, headers["Content-Type"]) == (200, "application/octet-stream")
    assert content["kind"] == "color"
    assert len(buffers[0]) == 6 * content_vertices(server)


def content_vertices(server) -> int:
    data = request(server, "ask", method="POST", body=messages.pack({"kind": "scene"}, []))[2]
    return messages.unpack(data)[0]["vertices"]


def test_the_server_is_of_this_machine_alone(server):
    assert urllib.parse.urlsplit(server.url).hostname == "127.0.0.1"
    assert server._server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("path", ["/", "/wrong/", "/wrong/viewer.js", "/wrong/ask", "/../"])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_wrong_token_gets_403(server, path, method):
    status, _, data = request(server, path, method=method, body=messages.pack({"kind": "scene"}, []))
    assert status == 403
    assert b"lacks the viewer's token" in data
    assert urllib.parse.urlsplit(server.url).path.strip("/").encode() not in data


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "https://example.org"}, {"Origin": "null"}, {"Host": "example.org"}, {"Host": "127.0.0.1:1"}],
)
def test_pages_of_another_origin_get_nothing(server, headers):
    for path, method in (("", "GET"), ("ask", "POST")):
        status, found, data = request(server, path, method=method, body=messages.pack({"kind": "scene"}, []), **headers)
        assert status == 403
        assert "Access-Control-Allow-Origin" not in found
        assert urllib.parse.urlsplit(server.url).path.strip("/").encode() not in data


def test_what_is_no_message_is_refused_and_the_server_goes_on(server, look):
    assert request(server, "ask", method="POST", body=b"hello")[0] == 400
    assert request(server, "ask", method="POST", body=b"", Content_Length=str(1 << 30))[0] == 413
    assert request(server, "other")[0] == 404
    assert request(server, "other", method="POST", body=b"")[0] == 404
    assert request(server, "ask", method="POST", body=messages.pack(look, []))[0] == 200


def test_tokens_differ_and_ports_come_back(session):
    first, second = Server(session), Server(session)
    assert urllib.parse.urlsplit(first.url).path != urllib.parse.urlsplit(second.url).path
    port = urllib.parse.urlsplit(first.url).port
    first.close()
    second.close()
    Server(session, port=port).close()
