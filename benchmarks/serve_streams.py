"""Streams of frames to the HTTP service: what is lost, and how late answers are."""

import json
import threading
import time
from itertools import cycle, islice
from pathlib import Path

import numpy as np
from websockets.sync.client import ClientConnection, connect

from benchmarks.rows import Row, save
from benchmarks.serve import Service, served
from evercal import Map, load_recording
from evercal.recordings.images import encode_jpeg


def run(
    store: Path,
    scene: Path,
    rates: tuple[float, ...] = (5, 30, 100),
    seconds: float = 60.0,
    out: Path = Path("runs/serve_streams.csv"),
) -> None:
    """Send the frames of a recording, forwards and backwards.

    The client sets no deadline for its pings, which are answered after the frames before them.

    Args:
        store: Folder for a new map.
        scene: Recording that is learned first.
        rates: Frames per second.
        seconds: Length of each stream.
        out: File of the rows.
    """
    opened = Map.open(store)
    recording = load_recording(scene)
    if recording.name not in opened.scenes:
        opened.learn(recording)
    frames = []
    for frame in recording.train:
        frames.append(encode_jpeg(frame.read_image(), quality=90))
    frames += frames[::-1]
    rows = []
    for rate in rates:
        sent = list(islice(cycle(frames), int(rate * seconds)))
        for words in ("", "?newest=1"):
            with served(store) as service:
                rows.append({"per_second": rate, **_row(service, sent, rate, words)})
            print(rows[-1], flush=True)
    save(out, rows, {"seconds": seconds})


def _row(service: Service, frames: list[bytes], rate: float, words: str) -> Row:
    url = service.url.replace("http", "ws") + "/track" + words
    times: list[float] = []
    delays = []
    waiting = []
    lost = 0
    with connect(url, ping_timeout=None) as socket:
        sending = threading.Thread(target=_send, args=(socket, frames, rate, times))
        sending.start()
        number = -1
        while number < len(frames) - 1:
            row = json.loads(socket.recv(300))
            # Frames that were dropped are stated, and all others are answered in order.
            lost += row["frame"] - number - 1 - row["dropped"]
            number = row["frame"]
            delays.append(time.perf_counter() - times[number])
            waiting.append(row["waiting"])
        sending.join()
    p50, p95 = np.percentile(delays, [50, 95])
    return {
        "option": words.strip("?=1") or "in order",
        "sent": len(frames),
        "in_s": times[-1] - times[0],
        "answered": len(delays),
        "dropped": len(frames) - len(delays) - lost,
        "lost": lost,
        "delay_p50_s": float(p50),
        "delay_p95_s": float(p95),
        "delay_most_s": max(delays),
        "most_waiting": max(waiting),
        "peak_mb": service.peak_mb,
    }


def _send(
    socket: ClientConnection, frames: list[bytes], rate: float, times: list[float]
) -> None:
    began = time.perf_counter()
    for number, frame in enumerate(frames):
        time.sleep(max(began + number / rate - time.perf_counter(), 0.0))
        times.append(time.perf_counter())
        socket.send(frame)
