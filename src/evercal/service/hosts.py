"""Who may reach a service or a page: addresses to listen on, and requests of a browser."""

import ipaddress
import socket
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


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens; InputError names `host` or `port` otherwise. Port 0 is any free."""
    if not 0 <= port <= 65_535:  # the resolver takes the remainder
        raise InputError(f"`port` {port}: give 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"`host` {host} `port` {port}: {reason}") from None


def url_of(host: str, port: int) -> str:
    """Address that a program on this machine opens."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    if ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{port}"
