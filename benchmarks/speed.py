"""Seconds: localization, SARS, import."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from evercal.datasets.images import read_image
from evercal.features.encode import encode
from evercal.features.views import ViewOptions, plain_view
from evercal.localization.localizer import Localizer
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.simulation.box_room import default_camera


def run(store: Path, image: Path, repeat: int) -> None:
    """Prints one line per figure."""
    localizer = Localizer.open(store)
    for _ in range(5):
        localizer.localize(read_image(image))
    one = []
    for _ in range(repeat):
        began = time.perf_counter()
        localizer.localize(read_image(image))
        one.append(1000 * (time.perf_counter() - began))
    print(f"localize, decoding included: median {np.median(one):.1f} ms, worst {max(one):.1f} ms")
    maps, plain = localizer.maps, read_image(image)
    height, width = plain.shape[:2]
    view = plain_view(
        plain, default_camera(width, height), maps.encoder.stride, ViewOptions(maps.short_side)
    )
    features = []
    for _ in range(repeat):
        began = time.perf_counter()
        encode([view], maps.encoder, maps.descriptor)
        features.append(1000 * (time.perf_counter() - began))
    print(f"features of one image: median {np.median(features):.1f} ms, worst {max(features):.1f}")
    images = [read_image(image) for _ in range(repeat)]
    localizer.localize_batch(images[:8], [None] * 8)
    began = time.perf_counter()
    localizer.localize_batch([read_image(image) for _ in range(repeat)], [None] * repeat)
    print(
        f"batch, decoding included: {repeat / (time.perf_counter() - began):.1f} images per second"
    )
    rng = np.random.default_rng(0)
    positions = np.cumsum(rng.normal(0, 0.01, (10_000, 3)), 0)
    quaternions = rng.normal(size=(10_000, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    began = time.perf_counter()
    select_sars(positions, quaternions, 1000, SarsOptions(radius=0.0))
    print(f"SARS, 10,000 poses, N_b 1,000, r 0: {time.perf_counter() - began:.2f} s")
    for name, command in (
        ("import evercal", [sys.executable, "-c", "import evercal"]),
        ("evercal --help", [sys.executable, "-m", "evercal", "--help"]),
    ):
        times = []
        for _ in range(5):
            began = time.perf_counter()
            subprocess.run(command, capture_output=True, check=True)
            times.append(time.perf_counter() - began)
        print(f"{name}: median {np.median(times):.2f} s")
