"""One build's answers to recordings, printed as JSON in a process of its own.

The build is the one that PYTHONPATH names, so this file uses only what all builds have.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from evercal.map import Map
from evercal.recordings import Frame, load_recording, posed_frames


def answers(memory: str, *recordings: str) -> list[dict[str, object]]:
    """Learn the first of some recordings and locate the test frames of all.

    Args:
        memory: Keyframes that are kept.
        recordings: Their folders.

    Returns:
        A row for each image, with CPU seconds.
    """
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        learned = Map.open(Path(scratch) / "map")
        start = time.process_time()
        learned.learn(recordings[0], memory=memory, on_progress=_silent)
        seconds = time.process_time() - start
        for name in recordings:
            for frame in posed_frames(load_recording(name).test):
                row = {"recording": name, "image": frame.name, "learn_s": seconds}
                rows.append(row | _answer(learned, frame))
    return rows


def _silent(*_: object) -> None:
    """Show no progress."""


def _answer(learned: Map, frame: Frame) -> dict[str, object]:
    """Status of an image, and of an accepted pose its errors and squared deviations."""
    image = frame.read_image()
    start = time.process_time()
    found = learned.localize(image, frame.camera)
    seconds = time.process_time() - start
    row: dict[str, object] = {"ask_s": seconds, "status": found.status}
    truth = frame.base_from_camera
    pose = found.uncertain_pose
    if found.status != "ok" or pose is None or truth is None:
        return row
    off = pose.pose.translation_m - truth.translation_m
    turn = (pose.pose.inverse() @ truth).log()[3:]
    return row | {
        "mm": 1000 * float(np.linalg.norm(off)),
        "deg": float(np.rad2deg(np.linalg.norm(turn))),
        "position": float(off @ np.linalg.solve(pose.covariance[:3, :3], off)),
        "pose": pose.squared_mahalanobis(truth),
    }


if __name__ == "__main__":
    print(json.dumps(answers(*sys.argv[1:])))
