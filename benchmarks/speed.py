"""Time of localization, SARS and import."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from evercal.features.encode import encode_features
from evercal.features.views import ViewOptions, plain_view
from evercal.localization.localizer import Localizer
from evercal.localization.parallel import in_parallel
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.recordings.images import read_image
from evercal.simulation.box_room import default_camera


def run(store: Path, image: Path, repeat: int = 50) -> None:
    """Time localization of one image, alone and in a batch, SARS, and import.

    Args:
        store: A store.
        image: An image of one of its scenes.
        repeat: Repetitions.
    """
    localizer = Localizer.open(store)

    def localize(path: Path = image) -> None:
        localizer.localize(read_image(path))

    _milliseconds(localize, 5)
    began = time.process_time()
    one = _milliseconds(localize, repeat)
    busy = 1000 * (time.process_time() - began) / repeat
    print(
        f"localize, decoding included: median {np.median(one):.1f} ms, worst {max(one):.1f} ms,"
        f" {busy:.1f} ms of processor time on {torch.get_num_threads()} threads"
    )
    encoder, short_side = localizer.contents.encoder, localizer.contents.short_side
    pixels = read_image(image)
    height, width = pixels.shape[:2]
    camera, options = default_camera(width, height), ViewOptions(short_side)
    view = plain_view(pixels, camera, encoder.stride, options)
    features = _milliseconds(lambda: encode_features([view], encoder), repeat)
    print(f"features of one image: median {np.median(features):.1f} ms, worst {max(features):.1f}")
    list(in_parallel(localize, [image] * 8))
    began, cpu = time.perf_counter(), time.process_time()
    list(in_parallel(localize, [image] * repeat))
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    print(
        f"batch, decoding included: {repeat / seconds:.1f} images per second,"
        f" {1000 * cpu / repeat:.1f} ms of processor time each"
    )
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
        command = [sys.executable, *arguments]
        times = _milliseconds(
            lambda c=command: subprocess.run(c, capture_output=True, check=True), 5
        )
        print(f"{name}: median {np.median(times) / 1000:.2f} s")


def _milliseconds(work: Callable[[], object], repeat: int) -> list[float]:
    times = []
    for _ in range(repeat):
        began = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - began))
    return times
