"""Recordings learned at once in worker processes, beside one after the other."""

import shutil
import time
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate

from evercal import Map, Recording, load_recording
from evercal.geometry import pose_distance
from evercal.storage import write_json


def run(
    recordings: tuple[Path, ...],
    workers: int = 2,
    folder: Path = Path("runs/many"),
    out: Path = Path("runs/many.json"),
) -> None:
    """Learn the same recordings twice, and compare answers to their test images.

    Args:
        recordings: Recordings with test frames.
        workers: Processes at once.
        folder: Folder of the two maps; it is made anew.
        out: File for the row, JSON.
    """
    loaded = [load_recording(path) for path in recordings]
    shutil.rmtree(folder, ignore_errors=True)
    turn, many = Map.open(folder / "turn"), Map.open(folder / "many")
    began = time.perf_counter()
    for recording in loaded:
        turn.learn(recording)
    in_turn = time.perf_counter() - began
    began = time.perf_counter()
    many.learn_many(loaded, workers=workers)
    at_once = time.perf_counter() - began
    threads = torch.get_num_threads()
    torch.set_num_threads(max(1, threads // workers))
    same = Map.open(folder / "same")
    for recording in loaded:
        same.learn(recording)
    torch.set_num_threads(threads)
    row = {
        "recordings": len(loaded),
        "workers": workers,
        "in_turn_s": in_turn,
        "at_once_s": at_once,
        "times_as_fast": in_turn / at_once,
        **_differences(same, many, loaded, "as_many_threads"),
        **_differences(turn, many, loaded, "more_threads"),
    }
    write_json(out, {"settings": {"recordings": [r.name for r in loaded]}, "rows": [row]})
    print(tabulate(row.items(), floatfmt=".3g"))


def _differences(
    turn: Map, many: Map, recordings: list[Recording], name: str
) -> dict[str, float | int]:
    """How many answers differ in status or scene, and by how much the poses differ."""
    apart, different = [], 0
    for recording in recordings:
        for frame in recording.test:
            image = np.asarray(frame.read_image())
            a, b = turn.localize(image), many.localize(image)
            if (a.status, a.scene) != (b.status, b.scene):
                different += 1
            elif a.base_from_camera is not None and b.base_from_camera is not None:
                apart.append(float(pose_distance(a.base_from_camera, b.base_from_camera)[0]))
    return {
        f"{name}_images": different + len(apart),
        f"{name}_other_status_or_scene": different,
        f"{name}_median_mm": 1000 * float(np.median(apart)),
        f"{name}_largest_mm": 1000 * max(apart),
    }
