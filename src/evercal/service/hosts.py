"""Addresses to listen on, and which of them other machines can reach."""

import ipaddress
import socket

from evercal.errors import InputError


def is_local(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens; one line about --host or --port if it cannot. Port 0 is any free."""
    if not 0 <= port <= 65_535:  # the resolver takes the remainder
        raise InputError(f"--port {port}: give 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--host {host} --port {port}: {reason}") from None
