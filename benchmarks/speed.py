"""Time of learning, of localization, of SARS and of import."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.rows import save
from evercal.localization.parallel import in_parallel
from evercal.map import Map
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.processes import cores, output_of, python_command
from evercal.recordings.samples import sample_rooms

_WARM = 5
"""Images located before the first one that counts."""


def run(out: Path = Path("runs/speed.csv"), repeat: int = 3) -> None:
    """Time learning of the packaged rooms and localization of their test images.

    Images are decoded before. Also timed: SARS on 10,000 poses, and import.

    Args:
        out: File of rows to write.
        repeat: Times that a room is learned; the median counts.
    """
    rooms = [room.scene for room in sample_rooms()]
    learned: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for room in rooms:
            seconds = []
            for attempt in range(repeat):
                fresh = Map.open(Path(scratch) / f"{room.name}-{attempt}")
                seconds.append(_milliseconds(lambda r=room, m=fresh: m.learn(r), 1)[0] / 1000)
            learned[room.name] = float(np.median(seconds))
        cell = Map.open(Path(scratch) / "all")
        for room in rooms:
            cell.learn(room)
        rows = []
        for room in rooms:
            images = [frame.read_image() for frame in room.test]
            for image in images[:_WARM]:
                cell.localizer.localize(image)
            began = time.process_time()
            times = [
                _milliseconds(lambda i=image: cell.localizer.localize(i), 1) for image in images
            ]
            busy = 1000 * (time.process_time() - began) / len(images)
            (whole,) = _milliseconds(
                lambda many=images: list(in_parallel(cell.localizer.localize, many)), 1
            )
            rows.append(
                {
                    "room": room.name,
                    "learn_s": learned[room.name],
                    "locate_ms": float(np.median(times)),
                    "locate_90_%_ms": float(np.percentile(times, 90)),
                    "processor_ms": busy,
                    "batch_images_per_s": 1000 * len(images) / whole,
                }
            )
    settings = {"threads": cores(), "scenes": len(rooms), "repeat": repeat}
    save(out, rows, settings)
    _others()


def _others() -> None:
    """Print the time of SARS and of import."""
    rng = np.random.default_rng(0)
    positions = np.cumsum(rng.normal(0, 0.01, (10_000, 3)), 0)
    quaternions = rng.normal(size=(10_000, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    (sars,) = _milliseconds(
        lambda: select_sars(positions, quaternions, 1000, SarsOptions(radius=0.0)), 1
    )
    print(f"SARS, 10,000 poses, N_b 1,000, r 0: {sars / 1000:.2f} s")
    for name, arguments in (
        ("import evercal", ["-c", "import evercal"]),
        ("evercal --help", ["-m", "evercal", "--help"]),
    ):
        command = python_command(*arguments)
        times = _milliseconds(lambda c=command: output_of(*c), 5)
        print(f"{name}: median {np.median(times) / 1000:.2f} s")


def _milliseconds(work: Callable[[], object], repeat: int) -> list[float]:
    times = []
    for _ in range(repeat):
        began = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - began))
    return times
