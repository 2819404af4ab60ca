"""Latency of the HTTP service beside direct calls, and with several clients."""

import json
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from benchmarks.rows import Row, save
from evercal import InputError, Map, Recording, load_recording
from evercal.processes import python_command
from evercal.recordings.images import decode_image, encode_jpeg

_WARM = 10
"""Requests before the first one that counts."""


def run(
    store: Path,
    scenes: tuple[Path, ...],
    requests: int = 200,
    clients: int = 8,
    out: Path = Path("runs/serve.csv"),
) -> None:
    """Time requests of 640x480 JPEG images.

    Args:
        store: Folder for a new map.
        scenes: Recordings that are learned first; one test image of each is located.
        requests: Requests of each measurement.
        clients: Clients that ask at the same time.
        out: File of the rows.
    """
    opened, images = Map.open(store), []
    for path in scenes:
        recording = load_recording(path)
        if recording.name not in opened.scenes:
            opened.learn(recording)
        images.append(_located(opened, recording))
    command = python_command("-m", "evercal", "serve", str(store), "--port", "0", "--json")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = json.loads(process.stdout.readline())["url"]
            rows = _measured(opened, url, images, requests, clients)
        finally:
            process.terminate()
    save(out, rows, {"requests": requests, "clients": clients})


def _located(opened: Map, recording: Recording) -> bytes:
    files = []
    for frame in recording.test:
        resized = cv2.resize(frame.read_image(), (640, 480), interpolation=cv2.INTER_CUBIC)
        files.append(encode_jpeg(np.asarray(resized, np.uint8), quality=90))
    estimates = [opened.localize(_decoded(data)) for data in files]
    best = max(range(len(files)), key=lambda i: estimates[i].support)
    if estimates[best].scene != recording.name:
        raise InputError(f"{recording.name}: no test image is located")
    return files[best]


def _decoded(data: bytes) -> np.ndarray:
    image = decode_image(np.frombuffer(data, np.uint8))
    assert image is not None, "it was encoded here"
    return image


def _measured(opened: Map, url: str, images: list[bytes], requests: int, clients: int) -> list[Row]:
    import urllib3

    pool = urllib3.PoolManager(maxsize=16)

    def posted(number: int) -> float:
        """Ask once and return the milliseconds."""
        began = time.perf_counter()
        fields = {"image": ("image.jpg", images[number % len(images)], "image/jpeg")}
        answer = pool.request("POST", f"{url}/localize", fields=fields)
        assert answer.status == 200, answer.data
        return 1000 * (time.perf_counter() - began)

    def direct(number: int) -> float:
        began = time.perf_counter()
        opened.localize(_decoded(images[number % len(images)]))
        return 1000 * (time.perf_counter() - began)

    # By turns, so that other programs disturb both alike.
    both = np.array([(direct(i), posted(i)) for i in range(_WARM + requests)])[_WARM:].T
    began = time.perf_counter()
    with ThreadPoolExecutor(clients) as threads:
        shared = list(threads.map(posted, range(requests)))
    rate = requests / (time.perf_counter() - began)
    return [
        _row("direct call", both[0]),
        _row("POST /localize", both[1]),
        _row("POST minus direct call, by pairs", both[1] - both[0]),
        _row(f"{clients} clients", np.array(shared)) | {"per_second": rate},
    ]


def _row(name: str, milliseconds: np.ndarray) -> Row:
    p50, p95, p99 = np.percentile(milliseconds, [50, 95, 99])
    return {"measured": name, "requests": len(milliseconds), "p50": p50, "p95": p95, "p99": p99}
