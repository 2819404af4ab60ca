"""Streams of a moving camera: tracked, beside the location of every frame from nothing."""

import json
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline
from tqdm import tqdm

from benchmarks.rows import Row, save
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization import tracking
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.recordings import Frame, Recording, load_recording
from evercal.recordings.samples import CELL, sample_rooms
from evercal.simulation.cell_recording import record_cell
from evercal.simulation.panda_arm import HOME_RAD, joints_for
from evercal.simulation.virtual_cell import CellOptions, VirtualCell
from evercal.typing import Array, Image

RATE_HZ = 30.0
"""Frames per second of every stream."""
STEPS_MM = (6, 20, 50, 100)
"""Motion of the camera of the virtual cell from frame to frame."""
STRIDES = (1, 3)
"""Every n-th frame of real streams: the same images, moving faster."""
GAP_S = 10.0
"""Time between two sequences of a recording."""
WRONG_M = 0.005
WRONG_SIGMAS = 4.0
"""A pose is wrong beyond both."""
INSIDE = 12.592
"""95 % quantile of the squared Mahalanobis distance of a pose."""


@dataclass(frozen=True, eq=False)
class Stream:
    """Frames of one camera in a learned scene."""

    name: str
    localizer: Localizer
    frames: Iterable[tuple[float, Image, SE3]]
    """Times in seconds, images and poses base_from_camera."""
    exact: bool = True
    """Whether the poses are true; those of real recordings are labels with errors of their own."""


def run(
    real: Path | None = None,
    before: str = "",
    frames: int = 350,
    seeds: tuple[int, ...] = (1, 2, 3),
    out: Path = Path("runs/tracking"),
) -> None:
    """Judge tracked poses by the truth and by the location of each frame from nothing.

    Args:
        real: Folder with recordings `fr1_rpy` and `redkitchen`; their test sequences are streams.
        before: A commit; its tracker gets the same frames.
        frames: Frames of each stream of a virtual cell.
        seeds: Virtual cells.
        out: Folder for maps, every frame's errors and the rows.
    """
    trackers = {"now": tracking}
    if before:
        trackers["before"] = _tracker_of(before)
    rows: list[Row] = []
    every = []
    for stream in _streams(out, real, frames, seeds):
        answers = _answers(stream, trackers)
        for name in trackers:
            rows.append({"stream": stream.name, "tracker": name, **_row(answers, name)})
        every += [{"stream": stream.name, **answer} for answer in answers]
        print(rows[-len(trackers) :], flush=True)
    for name in trackers:
        row = {"stream": "all, true poses", "tracker": name}
        rows.append(row | _row([a for a in every if a["exact"]], name))
        row = {"stream": "all", "tracker": name}
        rows.append(row | _row(every, name))
    pd.DataFrame(every).to_csv(out / "frames.csv", index=False, float_format="%.6g")
    save(out / "tracking.csv", rows)


def _tracker_of(commit: str) -> ModuleType:
    """The module of a commit's tracker, with the localizer of this tree."""
    path = f"{commit}:src/evercal/localization/tracking.py"
    source = subprocess.run(
        ["git", "show", path], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    if source.returncode:
        raise InputError(f"{commit}: no such commit of this checkout")
    module = ModuleType(f"tracking_{commit}")
    sys.modules[module.__name__] = module
    exec(compile(source.stdout, path, "exec"), module.__dict__)
    return module


def _answers(stream: Stream, trackers: dict[str, ModuleType]) -> list[Row]:
    """Errors, state and CPU seconds of each frame, for each tracker and for `localize`."""
    running = {}
    for name, module in trackers.items():
        options = module.TrackOptions(fallback_s=1 / RATE_HZ)
        running[name] = module.Tracker(stream.localizer, options=options)
    rows = []
    for number, (stamp, image, truth) in enumerate(tqdm(stream.frames, stream.name)):
        if number == 0:
            stream.localizer.localize(image)  # loads keyframes
        began = time.process_time()
        alone = stream.localizer.localize(image)
        row: Row = {
            "exact": stream.exact,
            "number": number,
            "alone_s": time.process_time() - began,
            "alone_status": alone.status,
            "alone_ratio": alone.inlier_ratio,
            **_errors("alone", alone, truth),
        }
        for name, tracker in running.items():
            began = time.process_time()
            frame = tracker.track(image, stamp)
            row[f"{name}_s"] = time.process_time() - began
            row[f"{name}_state"] = frame.state
            row[f"{name}_ratio"] = frame.estimate.inlier_ratio
            row |= _errors(name, frame.estimate, truth)
            other = alone.base_from_camera
            if other is not None:
                row |= _errors(f"{name}_from_alone", frame.estimate, other, alone)
        rows.append(row)
    return rows


def _errors(
    name: str, estimate: PoseEstimate, truth: SE3, other: PoseEstimate | None = None
) -> Row:
    """Distance, and squared Mahalanobis distances of the pose and of its position.

    Two estimates of one image share their errors; their difference is compared to the sum of both
    covariances, which is too large by that.
    """
    pose = estimate.base_from_camera
    if pose is None or estimate.covariance is None:
        return {}
    covariance = estimate.covariance
    if other is not None and other.covariance is not None:
        covariance = covariance + other.covariance
    difference = np.r_[
        pose.translation_m - truth.translation_m, (truth.inverse() @ pose).log()[3:]
    ]
    position = difference[:3]
    metres, radians = pose_distance(pose, truth)
    return {
        f"{name}_m": float(metres),
        f"{name}_deg": float(np.rad2deg(radians)),
        f"{name}_d2": float(difference @ np.linalg.solve(covariance, difference)),
        f"{name}_position_d2": float(
            position @ np.linalg.solve(covariance[:3, :3], position)
        ),
        f"{name}_sigma_m": float(np.sqrt(np.trace(estimate.covariance[:3, :3]) / 3)),
    }


def _row(answers: Sequence[Row], name: str) -> Row:
    """One line of the table: a tracker in a stream."""
    states = [answer[f"{name}_state"] for answer in answers]
    tracking_ = _column(answers, f"{name}_state", str) == "tracking"
    metres = _column(answers, f"{name}_m")
    d2 = _column(answers, f"{name}_d2")
    far = metres > WRONG_M
    wrong = far & (_column(answers, f"{name}_position_d2") > WRONG_SIGMAS**2)
    apart = _column(answers, f"{name}_from_alone_m") > WRONG_M
    from_alone = _column(answers, f"{name}_from_alone_position_d2")
    apart &= from_alone > WRONG_SIGMAS**2
    alone_wrong = _column(answers, "alone_m") > WRONG_M
    alone_wrong &= _column(answers, "alone_position_d2") > WRONG_SIGMAS**2
    located = np.isfinite(d2)
    alone_d2 = _column(answers, "alone_d2")
    return {
        "frames": len(answers),
        "tracking": states.count("tracking"),
        "relocalized": states.count("relocalized"),
        "lost": states.count("lost"),
        "alone_lost": int(np.sum(_column(answers, "alone_status", str) != "ok")),
        "wrong": int((wrong & tracking_).sum()),
        "wrong_relocalized": int((wrong & ~tracking_).sum()),
        "alone_wrong": int(alone_wrong.sum()),
        "apart": int((apart & tracking_).sum()),
        "far": int((far & tracking_).sum()),
        "median_mm": 1000 * float(np.nanmedian(metres)),
        "worst_mm": 1000 * float(np.nanmax(metres)),
        "inside": 100 * float((d2[located] < INSIDE).mean()),
        "alone_inside": 100 * float((alone_d2[np.isfinite(alone_d2)] < INSIDE).mean()),
        "ms": 1000 * float(_column(answers, f"{name}_s").mean()),
        "alone_ms": 1000 * float(_column(answers, "alone_s").mean()),
    }


def _column(answers: Sequence[Row], key: str, kind: type = float) -> Array:
    missing = np.nan if kind is float else ""
    return np.array([kind(answer.get(key, missing)) for answer in answers])


def _streams(
    out: Path, real: Path | None, frames: int, seeds: Sequence[int]
) -> Iterator[Stream]:
    yield from _packaged(out)
    if real is not None:
        yield from _real(out, real)
    for seed in seeds:
        yield from _cells(out, seed, frames)


def _packaged(out: Path) -> Iterator[Stream]:
    yield _wrist(out)
    for room in sample_rooms():
        scene = room.scene
        localizer = _learned(out / f"{scene.name}.evercal", scene)
        yield Stream(f"{scene.name}, test", localizer, _recorded(scene.test))
        path = [*scene.train, *scene.test]
        path.sort(key=lambda frame: str(frame.image))
        yield Stream(scene.name, localizer, _recorded(path))


def _real(out: Path, real: Path) -> Iterator[Stream]:
    for name in ("fr1_rpy", "redkitchen"):
        recording = load_recording(real / name)
        localizer = _learned(out / f"{name}.evercal", recording)
        for stride in STRIDES:
            shown = recording.test[::stride]
            images = _recorded(shown, stride)
            yield Stream(f"{name}, 1 of {stride}", localizer, images, exact=False)


def _cells(out: Path, seed: int, frames: int) -> Iterator[Stream]:
    folder = out / f"cell-{seed}"
    cell = VirtualCell(seed, CellOptions(width=320, height=240))
    if not folder.exists():
        for _ in record_cell(folder, seed, wrist_images=60, options=cell.options):
            pass
    localizer = _learned(out / f"cell-{seed}.evercal", load_recording(folder / "wrist"))
    for step in STEPS_MM:
        images = _moving(cell, step / 1000, frames)
        yield Stream(f"cell {seed}, {step} mm", localizer, images)


def _learned(store: Path, recording: Recording) -> Localizer:
    if not store.exists():
        Map.open(store).learn(recording)
    return Localizer.open(store)


def _recorded(
    frames: Sequence[Frame], stride: int = 1
) -> Iterator[tuple[float, Image, SE3]]:
    """Frames with poses; the folders of their names are sequences."""
    stamp = 0.0
    folder = ""
    for frame in frames:
        assert frame.base_from_camera is not None
        stamp += 1 / RATE_HZ
        if folder and Path(frame.name).parent.name != folder:
            stamp += GAP_S
        folder = Path(frame.name).parent.name
        yield stamp, frame.read_image(), frame.base_from_camera


def _wrist(out: Path) -> Stream:
    """The wrist camera of the sample cell: poses far apart."""
    recording = load_recording(CELL / "wrist")
    localizer = _learned(out / "wrist.evercal", recording)
    mount = _mount()
    frames = []
    for number, frame in enumerate(recording.train):
        assert frame.base_from_gripper is not None
        truth = frame.base_from_gripper @ mount
        frames.append((number / RATE_HZ, frame.read_image(), truth))
    return Stream("wrist", localizer, frames)


def _mount() -> SE3:
    """The true gripper_from_camera of the sample cell."""
    text = (CELL / "truth.json").read_text()
    mount = json.loads(text)["gripper_from_camera"]
    return SE3(np.array(mount["quaternion_wxyz"]), np.array(mount["translation_m"]))


def _moving(
    cell: VirtualCell, step_m: float, count: int
) -> Iterator[tuple[float, Image, SE3]]:
    """Images of the wrist camera on a smooth path, with steps of one length."""
    for number, gripper in enumerate(_path(cell, step_m, count)):
        camera = gripper @ cell.truth.gripper_from_camera
        image = cell.render(camera, joints_for(gripper, HOME_RAD))
        noise = cell.noise.standard_normal(image.shape, np.float32)
        noisy = image + 255 * cell.options.image_noise * noise
        image = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
        yield number / RATE_HZ, image, camera


def _path(cell: VirtualCell, step_m: float, count: int) -> Iterator[SE3]:
    """Gripper poses through reachable ones, each next to the one before."""
    left = list(cell.reachable_poses(60, seed=2))
    poses = [left.pop(0)]
    while left:
        metres, radians = pose_distance(poses[-1], SE3.stack(left))
        poses.append(left.pop(int(np.argmin(metres + 0.3 * radians))))
    origin = poses[0]
    logs = np.array([(origin.inverse() @ pose).log() for pose in poses])
    places = np.array([pose.translation_m for pose in poses])
    rotations = CubicSpline(range(len(poses)), logs[:, 3:])
    positions = CubicSpline(range(len(poses)), places)
    fine = np.linspace(0, len(poses) - 1, 200 * len(poses))
    lengths = np.linalg.norm(np.diff(positions(fine), axis=0), axis=1)
    along = np.r_[0, np.cumsum(lengths)]
    # Back and forth, where the path is shorter than the stream.
    wanted = step_m * np.arange(count)
    turned = np.abs((wanted + along[-1]) % (2 * along[-1]) - along[-1])
    for s in np.interp(turned, along, fine):
        turn = origin @ SE3.exp(np.r_[0, 0, 0, rotations(s)])
        yield SE3(turn.rotation_wxyz, positions(s))
