"""The addresses by which a browser may come to a viewer."""

import re
import urllib.parse
from typing import NamedTuple

_PORTS = {"http": 80, "https": 443}


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
    """Parses an address such as "http://localhost:9000" or "https://hub.example.org/user/me/proxy/8765".

    Raises:
        TypeError: The address is not text.
        ValueError: The address has another scheme than http and https, no host, or a user, query or fragment.
    """
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
