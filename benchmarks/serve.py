"""Latency of the HTTP service beside direct calls, alone and while a scene is learned."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from tabulate import tabulate

from evercal import Client, InputError, Map, Recording, load_recording
from evercal.recordings.images import decode_image, encode_jpeg


def run(
    store: Path,
    scenes: tuple[Path, ...],
    learn: Path,
    requests: int = 200,
    clients: int = 8,
    out: Path = Path("runs/serve.json"),
) -> None:
    """Time requests of 640x480 JPEG images.

    Args:
        store: Folder for a new map.
        scenes: Recordings that are learned first; one test image of each is located.
        learn: Recording that is learned while images are located.
        requests: Requests of each measurement.
        clients: Clients that ask at the same time.
        out: File for the numbers, JSON.
    """
    opened, images = Map.open(store), []
    for path in scenes:
        recording = load_recording(path)
        if recording.name not in opened.scenes:
            opened.learn(recording)
        images.append((recording.name, _located(opened, recording)))
    command = [sys.executable, "-m", "evercal", "serve", str(store), "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = json.loads(process.stdout.readline())["url"]
            rows = _measured(opened, url, images, learn, requests, clients)
        finally:
            process.terminate()
    print(tabulate(rows, headers="keys", floatfmt=".1f"))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(rows, indent=1))


def _located(opened: Map, recording: Recording) -> bytes:
    """The test image that the map locates best, as a JPEG file."""
    files = [_jpeg(frame.read_image()) for frame in recording.test]
    estimates = [opened.localize(_decoded(data)) for data in files]
    best = max(range(len(files)), key=lambda i: estimates[i].support)
    if estimates[best].scene != recording.name:
        raise InputError(f"{recording.name}: no test image is located")
    return files[best]


def _decoded(data: bytes) -> np.ndarray:
    image = decode_image(np.frombuffer(data, np.uint8))
    assert image is not None, "it was encoded here"
    return image


def _jpeg(image: np.ndarray) -> bytes:
    resized = cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC)
    return encode_jpeg(np.asarray(resized, np.uint8), quality=90)


def _measured(
    opened: Map,
    url: str,
    images: Sequence[tuple[str, bytes]],
    learn: Path,
    requests: int,
    clients: int,
) -> list[dict[str, object]]:
    asking = _Asking(url, images)
    direct, posted = [], []
    for i in range(10 + requests):  # by turns, so that other programs disturb both alike
        began = time.perf_counter()
        estimate = opened.localize(_decoded(images[i % len(images)][1]))
        direct.append(1000 * (time.perf_counter() - began))
        assert estimate.scene == images[i % len(images)][0]
        posted.append(asking.milliseconds(i))
    direct, posted = direct[10:], posted[10:]
    rows = [_row("direct call", direct), _row("POST /localize", posted)]
    differences = np.array(posted) - np.array(direct)
    rows.append(_row("POST minus direct call, by pairs", differences.tolist()))
    rows.append(_row("POST minus its own ms", asking.around[10 : 10 + requests]))
    rows += _throughput(opened, asking, requests, clients)
    done = threading.Event()
    report: list[object] = []

    def learning() -> None:
        report.append(Client(url).learn(learn, name=f"new-{time.time_ns()}"))
        done.set()

    thread = threading.Thread(target=learning)
    began = time.perf_counter()
    thread.start()
    during = []
    while not done.is_set():
        during.append(asking.milliseconds(len(during)))
        time.sleep(0.05)
    thread.join()
    rows.append(
        {**_row("while a scene is learned", during), "seconds": time.perf_counter() - began}
    )
    after = [asking.milliseconds(i) for i in range(requests)]
    rows.append(_row("after it was learned", after))
    print(f"{asking.asked} answers, {asking.wrong} of another scene or pose than the first ones")
    return rows


class _Asking:
    """Requests whose answers are compared with the first ones."""

    def __init__(self, url: str, images: Sequence[tuple[str, bytes]]):
        import urllib3

        self._pool = urllib3.PoolManager(maxsize=16)
        self._url, self.images = url, images
        self._first: dict[int, str] = {}
        self.around: list[float] = []
        """Time of each request outside decoding and localization, milliseconds."""
        self.asked = self.wrong = 0

    def milliseconds(self, number: int) -> float:
        """Ask once and return the time."""
        which = number % len(self.images)
        name, data = self.images[which]
        began = time.perf_counter()
        fields = {"image": ("image.jpg", data, "image/jpeg")}
        answer = self._pool.request("POST", f"{self._url}/localize", fields=fields)
        taken = 1000 * (time.perf_counter() - began)
        row = json.loads(answer.data)
        self.around.append(taken - row.pop("ms", 0.0))
        first = self._first.setdefault(which, json.dumps(row))
        self.asked += 1
        self.wrong += answer.status != 200 or row["scene"] != name or json.dumps(row) != first
        return taken


def _throughput(
    opened: Map, asking: _Asking, requests: int, clients: int
) -> list[dict[str, object]]:
    files = [data for _, data in asking.images]
    began = time.perf_counter()
    pixels = [_decoded(files[i % len(files)]) for i in range(requests)]
    opened.localizer.localize_batch(pixels, [None] * requests)
    batch = requests / (time.perf_counter() - began)
    began = time.perf_counter()
    with ThreadPoolExecutor(clients) as pool:
        times = list(pool.map(asking.milliseconds, range(requests)))
    served = requests / (time.perf_counter() - began)
    return [
        {"measured": "localize_batch", "requests": requests, "per_second": batch},
        {**_row(f"{clients} clients", times), "per_second": served},
    ]


def _row(name: str, milliseconds: Sequence[float]) -> dict[str, object]:
    p50, p95, p99 = np.percentile(milliseconds, [50, 95, 99])
    return {"measured": name, "requests": len(milliseconds), "p50": p50, "p95": p95, "p99": p99}
