"""Recordings with mistakes in their stated camera poses: refused, warned of, or lies."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.accuracy import pose_error, wrong
from benchmarks.rows import Row, grouped, median_of, numbers, once, save, show
from evercal.cli.learn import summary
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.map import Map
from evercal.recordings import Recording, load_recording, posed_frames
from evercal.recordings.frame import stated_poses
from evercal.recordings.samples import sample_rooms

FIRST_LINES = 4
"""Lines of the outcome, in which a warning is looked for."""
Change = Callable[[SE3], SE3]


class Mistake(NamedTuple):
    """A change of true poses (n,), and a pattern of the message that names its cause."""

    change: Change
    pattern: str


def _mount(shift_m: Sequence[float], turn_deg: Sequence[float] = (0, 0, 0)) -> Change:
    offset = SE3.exp(np.r_[shift_m, np.deg2rad(turn_deg)])
    return lambda poses: poses @ offset


def _moved(poses: SE3, shift_m: np.ndarray) -> SE3:
    return SE3(poses.rotation_wxyz, poses.translation_m + shift_m)


def _sag(poses: SE3) -> SE3:
    reach = np.linalg.norm(poses.translation_m[:, :2], axis=1)
    return _moved(poses, -0.02 * reach[:, None] * [0, 0, 1])


def _late(frames: int) -> Change:
    """Each image gets the pose of so many frames before it."""
    return lambda poses: poses[
        np.clip(np.arange(len(poses)) - frames, 0, len(poses) - 1)
    ]


def _jumps(share: float) -> Change:
    """Random poses are off by 0.2 m and 10 deg a axis."""

    def change(poses: SE3) -> SE3:
        rng = np.random.default_rng(0)
        n = len(poses)
        chosen = rng.permutation(n) < share * n
        error = rng.normal(size=(n, 6)) * np.repeat([0.2, np.deg2rad(10)], 3)
        return poses @ SE3.exp(error * chosen[:, None])

    return change


def _scaled(factors: Sequence[float]) -> Change:
    return lambda poses: SE3(poses.rotation_wxyz, poses.translation_m * factors)


def _left_handed(poses: SE3) -> SE3:
    mirror = np.diag([1.0, -1.0, 1.0])
    turned = Rotation.from_matrix(mirror @ poses.rotation_matrix() @ mirror)
    quaternion = turned.as_quat(canonical=True, scalar_first=True)
    return SE3(quaternion, poses.translation_m @ mirror)


def _bumped_base(poses: SE3) -> SE3:
    later = np.arange(len(poses)) >= len(poses) / 2
    return _moved(poses, 0.05 * later[:, None] * [1, 0, 0])


def _drift(poses: SE3) -> SE3:
    steps = np.linalg.norm(np.diff(poses.translation_m, axis=0), axis=1)
    path = np.r_[0, np.cumsum(steps)]
    return _moved(poses, 0.01 * path[:, None] * [0.6, -0.48, 0.64])


_CAMERA = "mount|camera_from|gripper_from_camera"
_SMOOTH = "deform"
_MANY = "contradict"
_KIND = "inverse|order|handed|mirror"
MISTAKES: dict[str, Mistake] = {
    "none": Mistake(lambda poses: poses, "a^"),
    "mount 30 mm along": Mistake(_mount((0, 0, 0.03)), _CAMERA),
    "mount 30 mm sideways": Mistake(_mount((0.03, 0, 0)), _CAMERA),
    "mount 3 deg about x": Mistake(_mount((0, 0, 0), (3, 0, 0)), _CAMERA),
    "mount 3 deg about the axis": Mistake(_mount((0, 0, 0), (0, 0, 3)), _CAMERA),
    "gripper poses": Mistake(
        _mount((0.03, -0.08, 0.05), (20, 0, 90)), f"{_CAMERA}|fixed angle"
    ),
    "sag 20 mm/m": Mistake(_sag, _SMOOTH),
    "drift 1 % of the path": Mistake(_drift, _SMOOTH),
    "one axis scaled 5 %": Mistake(_scaled((1.05, 1, 1)), f"{_SMOOTH}|scale"),
    "base jumped 50 mm": Mistake(_bumped_base, f"{_SMOOTH}|jump"),
    "poses 3 frames late": Mistake(_late(3), "clocks"),
    "poses 3 frames early": Mistake(_late(-3), "clocks"),
    "a third wrong": Mistake(_jumps(1 / 3), _MANY),
    "half wrong": Mistake(_jumps(1 / 2), _MANY),
    "inches as metres": Mistake(_scaled((1 / 0.0254,) * 3), "unit|inch"),
    "mm as metres": Mistake(_scaled((1000,) * 3), "unit|millimet"),
    "inverted": Mistake(SE3.inverse, _KIND),
    "left-handed": Mistake(_left_handed, _KIND),
    "wxyz as xyzw": Mistake(
        lambda p: SE3(np.roll(p.rotation_wxyz, 1, 1), p.translation_m), _KIND
    ),
}
"""Mistakes by name."""


def mistaken(recording: Recording, change: Change) -> Recording:
    """A recording whose training poses are changed; the test frames stay true."""
    frames = posed_frames(recording.train)
    poses = change(stated_poses(frames))
    train = []
    for frame, pose in zip(frames, poses, strict=True):
        train.append(replace(frame, base_from_camera=pose))
    return replace(recording, train=tuple(train))


def measure(recording: Recording, name: str) -> Row:
    """Learn a recording with a mistake and locate its test frames."""
    mistake = MISTAKES[name]
    spoiled = mistaken(recording, mistake.change)
    row: Row = {"room": recording.name, "mistake": name}
    with TemporaryDirectory() as folder:
        cell = Map.open(Path(folder) / "map")
        try:
            report = cell.learn(spoiled, on_progress=lambda *_: None)
        except InputError as error:
            row["named"] = bool(re.search(mistake.pattern, str(error)))
            return row | {"refused": True, "text": str(error)}
        lines = list(summary(report, Path("map")))
        first = [line for line in lines[:FIRST_LINES] if line.startswith("warning")]
        row["named"] = any(re.search(mistake.pattern, line) for line in first)
        row["warnings"] = sum(line.startswith("warning") for line in lines)
        row["text"] = "\n".join(lines)
        return row | _answers(cell, recording, mistake.change)


def _answers(cell: Map, recording: Recording, change: Change) -> Row:
    frames = posed_frames(recording.test)
    truth = stated_poses(frames)
    of_stated = change(truth)
    errors = list[Row]()
    stated = list[Row]()
    for i, frame in enumerate(frames):
        estimate = cell.localize(frame.read_image(), frame.camera)
        pose = estimate.uncertain_pose
        if estimate.status == "ok" and pose is not None:
            errors.append(pose_error(pose, truth[i]))
            stated.append(pose_error(pose, of_stated[i]))
    return {
        "tests": len(frames),
        "located": len(errors),
        "lies": _lies(errors),
        "lies_stated": _lies(stated),
        "mm": median_of(numbers(errors, "mm")) if errors else 0.0,
        "sigma_mm": median_of(numbers(errors, "sigma_mm")) if errors else 0.0,
    }


def _lies(errors: Sequence[Row]) -> int:
    squared = numbers(errors, "squared_mahalanobis")
    return int(wrong(numbers(errors, "mm"), squared).sum())


def run(
    out: Path = Path("runs/recording_mistakes.csv"),
    rooms: tuple[Path, ...] = (),
    kinds: tuple[str, ...] = (),
) -> None:
    """Mistakes in the stated camera poses of recordings: refused, warned of, or wrong answers.

    `named`: the refusal, or a warning in the first lines, names the cause. `lies`: answers that are
    `ok`, more than 10 mm and 5 sigma from the true pose. `lies_stated`: from what the mistake makes
    of it. Kinds that were measured are read from OUT/.

    Args:
        out: File of the rows.
        rooms: Folders of recordings. Default: the packaged rooms.
        kinds: Mistakes. Default: all.
    """
    recordings = [load_recording(room) for room in rooms]
    recordings = recordings or [room.scene for room in sample_rooms()]
    rows: list[Row] = []
    for name in tqdm(kinds or MISTAKES, unit="kind"):
        for recording in recordings:
            path = out.with_suffix("") / recording.name / f"{name.replace('/', ' ')}"
            rows.append(once(path, partial(measure, recording, name)))
    save(out, rows)
    show([_total(name, group) for (name,), group in grouped(rows, "mistake").items()])


def _total(name: str, rows: Sequence[Row]) -> Row:
    total: Row = {"mistake": name, "rooms": len(rows)}
    for key in ("refused", "named", "tests", "located", "lies", "lies_stated"):
        total[key] = float(numbers(rows, key).sum())
    unsafe = [row for row in rows if not row["named"] and "refused" not in row]
    return total | {"unnamed_lies": float(numbers(unsafe, "lies").sum())}
