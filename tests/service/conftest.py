"""A service in a thread of the test's process."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi")


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    body: bytes
    headers: dict[str, str]

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def refusal(self) -> tuple[int, str]:
        """Status and error, which is the only entry and one line."""
        ((key, error),) = self.json.items()
        assert (key, "\n" in error) == ("error", False)
        return self.status, error


@dataclass(frozen=True)
class Running:
    """A service that runs."""

    url: str
    map: Path
    service: Any
    server: Any = None

    @property
    def connections(self) -> list[Any]:
        """Protocols of the open connections."""
        return list(self.server.server_state.connections)

    def get(self, path: str, **headers: str) -> Answer:
        return self.ask("GET", path, headers=headers)

    def post(self, path: str, headers: Any = None, **parts: Any) -> Answer:
        """Send a form; a path stands for the file, a list for several parts of one name."""
        from urllib3 import encode_multipart_formdata

        fields = []
        for name, values in parts.items():
            for value in values if isinstance(values, list) else [values]:
                if isinstance(value, Path):
                    value = (value.name, value.read_bytes())
                fields.append((name, value))
        body, kind = encode_multipart_formdata(fields)
        return self.ask("POST", path, body, {**(headers or {}), "Content-Type": kind})

    def connected(self, data: bytes) -> socket.socket:
        """A connection on which these bytes were sent."""
        host, port = self.url.removeprefix("http://").split(":")
        connection = socket.create_connection((host, int(port)), timeout=30)
        connection.sendall(data)
        return connection

    def ask(
        self, method: str, path: str, body: Any = None, headers: Any = None
    ) -> Answer:
        address = self.url.removeprefix("http://")
        connection = http.client.HTTPConnection(address, timeout=60)
        try:
            connection.request(method, path, body, headers or {})
            got = connection.getresponse()
            return Answer(got.status, got.read(), dict(got.getheaders()))
        finally:
            connection.close()


Serve = Callable[..., Any]


@contextmanager
def running(map: Path, **options: Any) -> Iterator[Running]:
    """Serve a map."""
    from evercal.service.server import (
        ServeOptions,
        bound_socket,
        make_app,
        server_of,
        url_of,
    )

    chosen = ServeOptions(map, port=0, **options)
    ready = threading.Event()
    with bound_socket(chosen) as listener:
        app = make_app(chosen, lambda _: ready.set())
        server = server_of(app, chosen.limits)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            assert ready.wait(30)
            yield Running(url_of(listener), map, app.state.service, server)
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture
def serve() -> Serve:
    return running


@pytest.fixture(scope="session")
def hall_store(hall_map, tmp_path_factory) -> Path:
    """A map of `hall`; tests do not change it."""
    from evercal.mapping.store import MapStore

    root = tmp_path_factory.mktemp("service") / "hall.evercal"
    MapStore.create(root).commit(hall_map.scenes[0], {"scene": "hall"})
    return root


@pytest.fixture
def copy(hall_store, tmp_path) -> Path:
    return Path(shutil.copytree(hall_store, tmp_path / "map"))


@pytest.fixture(scope="session")
def hall_service(hall_store) -> Iterator[Running]:
    """A service whose map is not changed."""
    with running(hall_store) as service:
        yield service


@pytest.fixture(scope="session")
def image(hall, tmp_path_factory) -> Path:
    """An image of the hall."""
    from evercal.recordings import write_image

    path = tmp_path_factory.mktemp("images") / "hall.png"
    write_image(path, hall.test[7].read_image())
    return path
