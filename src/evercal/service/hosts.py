"""Who may reach a service or a page: addresses to listen on, and requests of a browser."""

import hmac
import ipaddress
import socket
from typing import Any
from urllib.parse import urlsplit

from evercal.errors import InputError


def is_local(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def foreign(host: str, origin: str | None, local: bool) -> str | None:
    """Why a request comes from a web page of another address, or None.

    A page that a browser shows can ask any address. It cannot choose `Origin`, and after its own
    name was bound to this machine, `Host` still holds that name.

    Args:
        host: The header `Host`.
        origin: The header `Origin`; None if it is missing.
        local: Whether only names of this machine are right.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if local and not is_local(name):
        return f"host {host[:100]!r} is not this machine"
    if origin is not None and origin.partition("://")[2].lower() != host.lower():
        return "requests of other web pages are refused"
    return None


def refusal(path: str, headers: Any, key: str, local: bool) -> str | None:
    """Why a page's request, or the handshake of its connection, is refused; None if it is not.

    `headers` are those of the standard library or of websockets.
    """
    stated = f"{path}/".split("/")[1].partition("?")[0]
    stated = stated.encode("utf-8", "surrogateescape")
    if not hmac.compare_digest(stated, key.encode()):
        return "open the address that evercal printed, with its key"
    hosts = headers.get_all("Host") or []
    origins = headers.get_all("Origin") or []
    if len(hosts) != 1 or len(origins) > 1:
        return "one Host and at most one Origin are needed"
    return foreign(hosts[0], next(iter(origins), None), local)


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens; InputError names `host` or `port` otherwise. Port 0 is any free."""
    if not 0 <= port <= 65_535:  # the resolver takes the remainder
        raise InputError(f"`port` {port}: give 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"`host` {host} `port` {port}: {reason}") from None
    # asyncio sets it only where the protocol of the socket is stated. Without it, each answer on a
    # connection that stays open waits 40 ms.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def url_of(host: str, port: int) -> str:
    """Address that a program on this machine opens."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    if ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{port}"
