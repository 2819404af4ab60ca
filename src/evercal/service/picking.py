"""A page in the browser to pick points in images, served on this machine only."""

import json
import os
import secrets
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from evercal.bounds import RequestBounds
from evercal.calibration.picked_points import write_picks
from evercal.recordings.images import encode_jpeg, read_image
from evercal.service.hosts import refusal, url_of

_HOST = "127.0.0.1"
_MOST_BYTES = RequestBounds().text_bytes
_PAGE = Path(__file__).parents[1] / "reports" / "templates" / "pick.html"
_SECURE = {
    "Content-Security-Policy": "default-src 'self'; script-src 'unsafe-inline';"
    " style-src 'unsafe-inline'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


class PickServer(HTTPServer):
    """Shows images until their picks are written."""

    def __init__(self, images: Sequence[Path], points: Sequence[str], out: Path):
        super().__init__((_HOST, 0), _Handler)
        self.images = images
        self.out = out
        folder = out.absolute().parent
        self.names = [
            Path(os.path.relpath(image.absolute(), folder)).as_posix()
            for image in images
        ]
        self.points = [*dict.fromkeys(points)]
        self.key = secrets.token_urlsafe(16)
        self.done = False

    @property
    def url(self) -> str:
        """Address of the page, with its key."""
        return f"{url_of(_HOST, self.server_port)}/{self.key}/"

    def wait(self) -> None:
        """Serve until the picks are written."""
        while not self.done:
            self.handle_request()


class _Handler(BaseHTTPRequestHandler):
    server: Any
    timeout = RequestBounds().wait_s

    def do_GET(self) -> None:
        """Answer with the page or an image."""
        server = self.server
        path = self._path()
        files = {f"image/{i}": file for i, file in enumerate(server.images)}
        if path == "":
            given = {"images": server.names, "points": server.points, "picks": []}
            text = json.dumps(given).replace("<", "\\u003c")
            page = _PAGE.read_text("utf-8").replace("GIVEN", text, 1)
            self._answer(200, page.encode(), "text/html; charset=utf-8")
        elif path in files:
            image = encode_jpeg(read_image(files[path]), quality=95)
            self._answer(200, image, "image/jpeg")
        elif path is not None:
            self._answer(404, b"not found")

    def do_POST(self) -> None:
        """Write the picks."""
        server = self.server
        path = self._path()
        length = self.headers.get("Content-Length", "")
        if path is None:
            return
        if path != "picks" or not length.isdecimal() or int(length) > _MOST_BYTES:
            return self._answer(400, b"send a list of picks")
        try:
            rows = json.loads(self.rfile.read(int(length)))
            count = write_picks(server.out, rows, server.names)
        except (ValueError, TypeError, RecursionError) as error:
            return self._answer(400, str(error).encode())
        server.done = True
        self._answer(200, f"wrote {count} picks; close this page".encode())

    def _path(self) -> str | None:
        """Path below the key; None after a request was refused."""
        reason = refusal(self.path, self.headers, self.server.key, local=True)
        if reason:
            return self._answer(403, f"{reason}\n".encode())
        return self.path.removeprefix(f"/{self.server.key}/")

    def _answer(self, status: int, body: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        for name, value in {**_SECURE, "Content-Type": kind}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: requests hold the key."""
