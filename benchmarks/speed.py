"""Seconds: localization, SARS, import."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

from evercal.continual.networks.descriptor import encode
from evercal.features.views import ViewOptions, plain_view
from evercal.localization.localizer import Localizer
from evercal.localization.parallel import in_parallel
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.recordings.images import read_image
from evercal.simulation.box_room import default_camera


def run(store: Path, image: Path, repeat: int) -> None:
    """Prints one line per figure."""
    localizer = Localizer.open(store)
    for _ in range(5):
        localizer.localize(read_image(image))
    one, cpu = [], []
    for _ in range(repeat):
        began, spent = time.perf_counter(), time.process_time()
        localizer.localize(read_image(image))
        one.append(1000 * (time.perf_counter() - began))
        cpu.append(1000 * (time.process_time() - spent))
    print(
        f"localize, decoding included: median {np.median(one):.1f} ms, worst {max(one):.1f} ms,"
        f" {np.median(cpu):.1f} ms of processor time on {torch.get_num_threads()} threads"
    )
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
    list(in_parallel(lambda path: localizer.localize(read_image(path)), [image] * 8))
    began, spent = time.perf_counter(), time.process_time()
    list(in_parallel(lambda path: localizer.localize(read_image(path)), [image] * repeat))
    seconds, busy = time.perf_counter() - began, time.process_time() - spent
    print(
        f"batch, decoding included: {repeat / seconds:.1f} images per second,"
        f" {1000 * busy / repeat:.1f} ms of processor time each"
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
