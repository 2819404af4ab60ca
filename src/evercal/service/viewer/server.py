"""The server of a page, and its address."""

import contextlib
import io
import socket

import viser

from evercal.errors import InputError


class _Server(viser.ViserServer):
    """A server that is not shared over viser's public relay, whatever a visitor asks for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def start_server(host: str, port: int, label: str) -> viser.ViserServer:
    """An empty page with z up.

    Raises:
        InputError: The address cannot be used; viser alone would take the next free port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or "give a port from 0 to 65535"
        raise InputError(f"--host {host} --port {port}: {reason}") from None
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a frame with its address
        server = _Server(host, port, label=label, verbose=False)
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_width="large"
    )
    return server


def address_of(server: viser.ViserServer) -> str:
    """Address that a browser on this machine opens."""
    host = server.get_host() or "127.0.0.1"
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
