"""The HTTP service beside direct calls: latency, throughput, memory, bad requests, its end."""

import json
import os
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import urllib3
from tyro.conf import OmitArgPrefixes

from benchmarks.rows import Row, save
from evercal import InputError, Map, Recording, load_recording
from evercal.processes import cores, python_command
from evercal.recordings.images import decode_image, encode_jpeg
from tests.service.malformed import heavy, malformed

_WARM = 10
"""Requests before the first one that counts."""


@dataclass(frozen=True)
class Load:
    """How many requests a service gets."""

    requests: int = 200
    """Pairs of a direct call and a request."""
    mixed: int = 1000
    """Requests of several clients, one in six malformed."""
    bad: int = 5000
    """Malformed requests, while another client asks for /health."""
    many: int = 20_000
    """Requests over which the memory is compared."""
    clients: int = 8
    """Clients that ask at the same time."""


def run(
    store: Path,
    scenes: tuple[Path, ...],
    load: OmitArgPrefixes[Load],
    out: Path = Path("runs/serve.csv"),
) -> None:
    """Measure a service; the images are test images of the scenes, as they are.

    Args:
        store: Folder for a new map.
        scenes: Recordings that are learned first; one test image of each is located.
        load: How many requests the service gets.
        out: File of the rows.
    """
    opened = Map.open(store)
    images = []
    for path in scenes:
        recording = load_recording(path)
        if recording.name not in opened.scenes:
            opened.learn(recording)
        images.append(_located(opened, recording))
    rows: list[Row] = []

    def keep(*measured: Row) -> None:
        rows.extend(measured)
        for row in measured:
            print(row, flush=True)
        save(out, rows, {"clients": load.clients})

    with served(store) as service:
        keep(*_pairs(opened, service, images, load.requests))
        keep(*_mixed(opened, service, images, load))
        keep(_bad(service, load.bad))
        keep(_memory(service, images, load))
        keep(_end(service, images, load.clients))


@dataclass
class Service:
    """A service in a process of its own."""

    process: subprocess.Popen[str]
    url: str
    pool: urllib3.PoolManager = field(
        default_factory=lambda: urllib3.PoolManager(maxsize=16)
    )

    @property
    def resident_mb(self) -> float:
        """Memory now."""
        return self._memory("VmRSS")

    @property
    def peak_mb(self) -> float:
        """Most memory since `forget_peak`."""
        return self._memory("VmHWM")

    def forget_peak(self) -> None:
        """Measure the peak from now on."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5")

    def _memory(self, name: str) -> float:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return (
            next(float(line.split()[1]) for line in lines if line.startswith(name))
            / 1000
        )

    def localize(self, image: bytes) -> int:
        """Locate an image, and return the status."""
        fields = {"image": ("image.jpg", image, "image/jpeg")}
        return self.pool.request(
            "POST", f"{self.url}/localize", fields=fields, retries=0
        ).status

    def send(self, data: bytes) -> int:
        """Send bytes, and return the status; 0 without an answer."""
        host, port = self.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=60) as connection:
            try:
                connection.sendall(data)
                answer = connection.recv(100)
            except ConnectionError:
                return 0
        return int(answer.split()[1]) if answer else 0


@contextmanager
def served(store: Path) -> Iterator[Service]:
    """Serve a map meanwhile."""
    command = python_command(
        "-m", "evercal", "serve", str(store), "--port", "0", "--json"
    )
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield Service(process, json.loads(process.stdout.readline())["url"])
        finally:
            process.terminate()


def _located(opened: Map, recording: Recording) -> bytes:
    files = [encode_jpeg(frame.read_image(), quality=90) for frame in recording.test]
    estimates = [opened.localize(_decoded(data)) for data in files]
    best = max(range(len(files)), key=lambda i: estimates[i].support)
    if estimates[best].scene != recording.name:
        raise InputError(f"{recording.name}: no test image is located")
    return files[best]


def _decoded(data: bytes) -> np.ndarray:
    image = decode_image(np.frombuffer(data, np.uint8))
    assert image is not None, "it was encoded here"
    return image


def _pairs(
    opened: Map, service: Service, images: list[bytes], requests: int
) -> list[Row]:
    def direct(number: int) -> None:
        opened.localize(_decoded(images[number % len(images)]))

    def posted(number: int) -> None:
        assert service.localize(images[number % len(images)]) == 200

    # By turns, so that other programs disturb both alike.
    both = [(_ms(direct, i), _ms(posted, i)) for i in range(_WARM + requests)][_WARM:]
    one, two = np.array(both).T
    return [
        _row("direct call", one),
        _row("POST /localize", two),
        _row("POST minus direct call, by pairs", two - one),
    ]


def _mixed(
    opened: Map, service: Service, images: list[bytes], load: Load
) -> Iterator[Row]:
    """Throughput of located images, beside direct calls in as many threads as the service has."""
    threads = cores()
    count = load.mixed
    clients = load.clients

    def direct(number: int) -> None:
        opened.localize(_decoded(images[number % len(images)]))

    def ask(number: int) -> None:
        if number % 6:
            assert service.localize(images[number % len(images)]) == 200
        else:
            assert 400 <= service.send(malformed(number)) < 500

    def timed(
        work: Callable[[int], None], count: int, workers: int
    ) -> tuple[np.ndarray, float]:
        began = time.perf_counter()
        with ThreadPoolExecutor(workers) as pool:
            times = np.array(list(pool.map(lambda i: _ms(work, i), range(count))))
        return times, time.perf_counter() - began

    good = count - (count + 5) // 6
    for part, workers, work, number in (
        ("direct calls, before", threads, direct, count // 4),
        (f"{clients} clients, one in six malformed", clients, ask, count),
        ("direct calls, after", threads, direct, count // 4),
    ):
        times, seconds = timed(work, number, workers)
        located = good if work is ask else number
        yield _row(part, times) | {
            "per_second": located / seconds,
            "mb": service.resident_mb,
        }


def _bad(service: Service, count: int) -> Row:
    """Malformed requests one after the other, and /health at the same time."""
    idle = service.resident_mb
    statuses = Counter[str]()
    health = list[float]()
    done = False
    service.forget_peak()

    def ask_health() -> None:
        while not done:
            health.append(
                _ms(lambda _: service.pool.request("GET", f"{service.url}/health"), 0)
            )
            time.sleep(0.02)

    asking = threading.Thread(target=ask_health)
    asking.start()
    times = []

    def send(number: int) -> None:
        status = service.send(malformed(number) if number % 20 else heavy(number))
        statuses[f"{status // 100}xx" if status else "closed"] += 1

    for number in range(count):
        times.append(_ms(send, number))
    done = True
    asking.join()
    return _row(f"malformed, {dict(statuses)}", np.array(times)) | {
        "most": max(times),
        "health_p99": np.percentile(health, 99),
        "health_most": max(health),
        "mb": idle,
        "peak_mb": service.peak_mb,
    }


def _memory(service: Service, images: list[bytes], load: Load) -> Row:
    def ask(number: int) -> float:
        return _ms(lambda i: service.localize(images[i % len(images)]), number)

    marks = []
    times: list[float] = []
    for part in np.array_split(np.arange(load.many), 20):
        with ThreadPoolExecutor(load.clients) as pool:
            times += pool.map(ask, part)
        marks.append(service.resident_mb)
        print(f"{len(times)} requests, {marks[-1]:.0f} MB", flush=True)
    return _row(f"{load.clients} clients", np.array(times)) | {
        "mb": marks[0],
        "peak_mb": max(marks),
    }


def _end(service: Service, images: list[bytes], clients: int) -> Row:
    """SIGTERM while all clients wait: statuses of their requests."""
    statuses = []
    asking = [
        threading.Thread(target=lambda: statuses.append(service.localize(images[0])))
        for _ in range(clients)
    ]
    for thread in asking:
        thread.start()
    time.sleep(0.2)
    began = time.perf_counter()
    os.kill(service.process.pid, signal.SIGTERM)
    for thread in asking:
        thread.join()
    code = service.process.wait(60)
    name = f"SIGTERM: {dict(Counter(statuses))}, exit code {code}"
    return _row(name, np.array([1000 * (time.perf_counter() - began)]))


def _ms(work: Callable[[int], object], number: int) -> float:
    began = time.perf_counter()
    work(number)
    return 1000 * (time.perf_counter() - began)


def _row(name: str, milliseconds: np.ndarray) -> Row:
    p50, p95, p99 = np.percentile(milliseconds, [50, 95, 99])
    return {
        "measured": name,
        "requests": len(milliseconds),
        "p50": p50,
        "p95": p95,
        "p99": p99,
    }
