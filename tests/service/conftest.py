"""A service in a thread of the test's process."""

from __future__ import annotations

import http.client
import json
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("fastapi")

if TYPE_CHECKING:
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings.frame import Recording

Part = tuple[str, bytes] | str


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    body: bytes
    headers: dict[str, str]

    @property
    def json(self) -> Any:
        return json.loads(self.body)


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

    def ask(
        self,
        method: str,
        path: str,
        parts: Sequence[tuple[str, Part]] | None = None,
        body: Any = None,
        headers: dict[str, str] | None = None,
    ) -> Answer:
        from urllib3 import encode_multipart_formdata

        headers = dict(headers or {})
        if parts is not None:
            body, headers["Content-Type"] = encode_multipart_formdata(list(parts))
        address = self.url.removeprefix("http://")
        connection = http.client.HTTPConnection(address, timeout=60)
        try:
            connection.request(method, path, body, headers)
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
def hall_store(hall_map: MapContents, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of `hall`; tests do not change it."""
    from evercal.mapping.store import MapStore

    root = tmp_path_factory.mktemp("service") / "hall.evercal"
    MapStore.create(root).commit(hall_map.scenes[0], {"scene": "hall"})
    return root


@pytest.fixture
def copy(hall_store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(hall_store, tmp_path / "map"))


@pytest.fixture(scope="session")
def hall_service(hall_store: Path) -> Iterator[Running]:
    """A service whose map is not changed."""
    with running(hall_store) as service:
        yield service


@pytest.fixture(scope="session")
def image(hall: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of the hall."""
    from evercal.recordings import write_image

    path = tmp_path_factory.mktemp("images") / "hall.png"
    write_image(path, hall.test[7].read_image())
    return path
