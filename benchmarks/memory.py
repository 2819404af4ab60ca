"""Resident memory of a service and of a tracker over many images."""

import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from evercal import InputError, Map, load_recording
from evercal.recordings.images import encode_jpeg
from evercal.storage import write_json


def run(
    store: Path,
    recording: Path,
    requests: int = 20_000,
    frames: int = 20_000,
    clients: int = 8,
    out: Path = Path("runs/memory.json"),
) -> None:
    """Memory after a tenth of the images, and after all of them.

    Args:
        store: Folder of a map that has learned the recording.
        recording: Its images are sent and tracked again and again.
        requests: Requests to the service.
        frames: Frames of the tracker.
        clients: Clients of the service at the same time.
        out: File for the rows, JSON.
    """
    loaded = load_recording(recording)
    images = [np.asarray(frame.read_image()) for frame in (*loaded.train, *loaded.test)]
    rows = [_service(store, images, requests, clients), _tracker(store, images, frames)]
    write_json(out, {"settings": {"recording": loaded.name, "images": len(images)}, "rows": rows})
    print(tabulate(rows, headers="keys", floatfmt=".1f"))


def _service(store: Path, images: list[np.ndarray], count: int, clients: int) -> dict[str, object]:
    import urllib3

    files = [encode_jpeg(image, quality=90) for image in images]
    command = [sys.executable, "-m", "evercal", "serve", str(store), "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = json.loads(process.stdout.readline())["url"]
            pool = urllib3.PoolManager(maxsize=clients)

            def ask(number: int) -> int:
                fields = {"image": ("image.jpg", files[number % len(files)], "image/jpeg")}
                return pool.request("POST", f"{url}/localize", fields=fields).status

            def sizes() -> Iterator[tuple[float, int]]:
                with ThreadPoolExecutor(clients) as threads:
                    for start in tqdm(range(0, count, count // 10), unit_scale=count // 10):
                        answers = threads.map(ask, range(start, start + count // 10))
                        errors = sum(status != 200 for status in answers)
                        yield _megabytes(process.pid), errors

            return _row("service", count, list(sizes()))
        finally:
            process.terminate()


def _tracker(store: Path, images: list[np.ndarray], count: int) -> dict[str, object]:
    order = [*images, *images[::-1]]  # to and fro, so that the camera never jumps
    opened, sizes, lost = Map.open(store), [], 0
    tracked = opened.track(order[i % len(order)] for i in range(count))
    for number, frame in enumerate(tqdm(tracked, total=count, mininterval=10), 1):
        lost += frame.state == "lost"
        if number % (count // 10) == 0:
            sizes.append((_megabytes("self"), lost))
            lost = 0
    return _row("tracker", count, sizes)


def _row(name: str, images: int, sizes: list[tuple[float, int]]) -> dict[str, object]:
    megabytes = [size for size, _ in sizes]
    return {
        "process": name,
        "images": images,
        "errors_or_lost": sum(bad for _, bad in sizes),
        "mb_after_a_tenth": megabytes[0],
        "mb_after_half": megabytes[4],
        "mb_after_all": megabytes[-1],
        "largest_mb": max(megabytes),
    }


def _megabytes(process: int | str) -> float:
    status = Path(f"/proc/{process}/status")
    if not status.exists():
        raise InputError(f"{status}: no such file; this benchmark needs Linux")
    line = next(x for x in status.read_text().splitlines() if x.startswith("VmRSS"))
    return int(line.split()[1]) / 1000
