"""A stream of a moving camera in a box room: tracked, beside the location of single frames."""

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.rows import save
from evercal.features.encoder import load_encoder
from evercal.geometry import SE3, Camera, pose_distance
from evercal.learning.stated_scatter import with_scatter
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import TrackedFrame, Tracker, TrackOptions
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Frame
from evercal.recordings.held_out import split_held_out
from evercal.simulation.box_room import BoxRoom, default_camera, look_at

RATE = 15.0
COVERED = ((150, 180), (500, 515))
"""Frames of a covered lens."""
MISSING = ((300, 308), (600, 630))
"""Frames that never arrive: 0.5 s and 2 s."""
JUMP, STILL = 700, (750, 810)
"""Frame at which the camera is elsewhere at once, and frames during which it stands still."""
EVERY = 5
"""Every fifth frame is also located by itself."""


def pose_at(s: float) -> SE3:
    """Return base_from_camera on a closed path, 0.4 m/s where s rises by 1 a second."""
    eye = np.array(
        [0.5 * np.sin(s), 0.4 * np.sin(0.7 * s + 1), 1.3 + 0.15 * np.sin(1.3 * s)]
    )
    heading = 34 + 0.6 * np.sin(0.5 * s)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.1 * np.sin(s)])
    return look_at(eye, eye + ahead, 0.1 * np.sin(0.9 * s))


def path(count: int) -> np.ndarray:
    """Return (count,) places on the path."""
    step = np.full(count, 0.6 / RATE)
    step[STILL[0] : STILL[1]] = 0
    s = 0.03 + np.cumsum(step)
    s[JUMP:] += 2.0
    return s


def run(
    seed: int = 34,
    count: int = 900,
    width: int = 320,
    at_most: float | None = None,
    out: Path = Path("runs/tracking.csv"),
) -> None:
    """Tracking over a recording with holes: time, errors, states.

    Args:
        seed: Seed of the room.
        count: Frames of the stream, 15 a second.
        width: Width of the images, pixels; the height is three quarters of it.
        at_most: Time budget of a frame, milliseconds.
        out: File of the row.
    """
    room = BoxRoom(seed, texture_px=256 if width < 400 else 512)
    camera = default_camera(width, width * 3 // 4)
    rng = np.random.default_rng(seed)
    localizer = Localizer(_learned(room, camera))
    localizer.localize(room.render(camera, pose_at(0.5)))  # loads and encodes keyframes
    tracker = Tracker(localizer, options=TrackOptions(at_most_ms=at_most))
    gone = {i for first, end in MISSING for i in range(first, end)}
    dark = {i for first, end in COVERED for i in range(first, end)}
    tracked: list[tuple[int, TrackedFrame, float]] = []
    singles: list[tuple[int, PoseEstimate, float]] = []
    places = path(count)
    start = time.perf_counter()
    for i in tqdm(range(count), unit="frame"):
        if i in gone:
            continue
        image = room.render(camera, pose_at(places[i]))
        noisy = image + rng.normal(0, 3, image.shape)
        image = (
            np.zeros_like(image) if i in dark else noisy.clip(0, 255).astype(np.uint8)
        )
        # What goes on in the background has as much time as it would.
        if at_most is not None:
            time.sleep(max(0.0, start + i / RATE - time.perf_counter()))
        began = time.perf_counter()
        frame = tracker.track(image, i / RATE)
        tracked.append((i, frame, 1000 * (time.perf_counter() - began)))
        if i % EVERY == 0 and i not in dark:
            began = time.perf_counter()
            estimate = localizer.localize(image)
            singles.append((i, estimate, 1000 * (time.perf_counter() - began)))
    seen = [(i, f, ms) for i, f, ms in tracked if i not in dark]
    errors = _errors((f.estimate, pose_at(places[i])) for i, f, _ in seen)
    alone = _errors((e, pose_at(places[i])) for i, e, _ in singles)
    ms, single_ms = (np.array([row[2] for row in rows]) for rows in (seen, singles))
    near = np.array([row[2] for row in seen if row[1].state == "tracking"])
    row = {
        "image": f"{width}x{width * 3 // 4}",
        "budget_ms": at_most,
        "frames": len(tracked),
        "tracking": sum(f.state == "tracking" for _, f, _ in seen),
        "relocalized": sum(f.state == "relocalized" for _, f, _ in seen),
        "lost": sum(f.state == "lost" for _, f, _ in seen),
        "found_while_covered": sum(
            f.state != "lost" for i, f, _ in tracked if i in dark
        ),
        "frames_until_found": _recovery(tracked, dark),
        "wrong_10_mm": sum(error > 10 for error in errors),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.quantile(errors, 0.95)),
        "single_median_mm": float(np.median(alone)),
        "single_p95_mm": float(np.quantile(alone, 0.95)),
        "ms_p50": float(np.median(ms)),
        "ms_p99": float(np.quantile(ms, 0.99)),
        "tracking_ms_p50": float(np.median(near)),
        "all_ms_p99": float(np.quantile([ms for _, _, ms in tracked], 0.99)),
        "over_budget": 0
        if at_most is None
        else sum(ms > at_most for _, _, ms in tracked),
        "per_second": 1000 / float(np.mean(ms)),
        "single_ms_p50": float(np.median(single_ms)),
    }
    save(out, [row], {"seed": seed})


def _learned(room: BoxRoom, lens: Camera) -> MapContents:
    frames = [
        Frame(f"{i}", room.render(lens, pose_at(s)), lens, pose_at(s))
        for i, s in enumerate(np.linspace(0, 12.5, 100))
    ]
    split = split_held_out(frames)
    encoder = load_encoder()
    built = build_map("room", split.train, encoder, MapOptions(memory=MemoryBudget()))
    contents = MapContents(encoder, 240, [built.scene])
    scene = with_scatter(
        contents, split.held_out, left_out=built.left_out(split.train), noise=(0.0, 0.0)
    )
    return MapContents(encoder, 240, [scene])


def _errors(answers: Iterable[tuple[PoseEstimate, SE3]]) -> list[float]:
    return [
        1000 * float(pose_distance(estimate.base_from_camera, truth)[0])
        for estimate, truth in answers
        if estimate.status == "ok" and estimate.base_from_camera is not None
    ]


def _recovery(tracked: list[tuple[int, TrackedFrame, float]], dark: set[int]) -> int:
    longest = 0
    waiting = 0
    for i, frame, _ in tracked:
        waiting = 0 if i in dark else waiting + 1
        if frame.state != "lost":
            waiting = 0
        longest = max(longest, waiting)
    return longest + 1
