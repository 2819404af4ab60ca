"""Whether answers can be trusted: other lenses, few images, an arm that is not accurate."""

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import Positional

from benchmarks.accuracy import pose_error, wrong
from benchmarks.arm_noise import grippers, with_arm_errors
from benchmarks.calibration import (
    PACKAGED,
    as_wrist_recording,
    fixed_images,
    learned,
    learned_mount,
)
from benchmarks.lenses import LENSES, ROLLS_DEG, View, rolled
from benchmarks.rows import Row, once, save, show
from evercal.calibration.from_images import calibrate
from evercal.calibration.image_source import Images
from evercal.continual.benchmark.results import Table
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6
from evercal.evaluation.protocol import evaluate
from evercal.geometry import SE3, Camera, average_poses, pose_distance_mm_deg
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings import Frame, Recording, load_recording, posed_frames

What = Literal["lens", "few", "arm"]
DRAWS = {"few": 10, "arm": 3}
SIZES = (8, 12, 16, 25)
"""Images of the recordings of `few`."""
FOCAL_PERCENT = (-5.0, -2.0, -0.5, 0.5, 2.0, 5.0)
"""Errors of stated focal lengths."""
LEAST_ANSWERS = 4
"""Answers that a fitted base frame needs."""
WRONG_MEDIANS = 4.0
"""Deviation of an answer that is left out of the fit, in median deviations."""


def run(
    what: Positional[What],
    rooms: tuple[Path, ...] = (),
    out: Path = Path("runs/trust"),
    draws: int | None = None,
    images: int | None = None,
    sizes: tuple[int, ...] = SIZES,
) -> None:
    """Measure errors, and whether stated deviations contain them, under adverse conditions.

    Rows go to OUT/WHAT.csv. Each draw has a file in OUT/WHAT and is not repeated: give another
    --out to measure another version.

    Args:
        what: lens: images through other lenses, with and without stated intrinsics. few:
            gripper_from_camera from few images. arm: from an arm with errors of 5 mm and 1 deg.
        rooms: Folders of rendered rooms with calibration/fixed. Defaults to the packaged rooms.
        out: Folder for stores and results.
        draws: Trials of each room, and of each size. Defaults to 10 for few, 3 for arm.
        images: For lens, the first images of each recording only.
        sizes: For few, numbers of images.
    """
    (out / what).mkdir(parents=True, exist_ok=True)
    folders = rooms or PACKAGED
    if what == "lens":
        rows = lens(folders, out, images)
    else:
        count = DRAWS[what] if draws is None else draws
        rows = (
            few(folders, out, count, sizes)
            if what == "few"
            else arm(folders, out, count)
        )
    save(out / f"{what}.csv", rows)
    show(
        summary(
            rows, {"lens": ["what", "case"], "few": ["images"], "arm": ["room"]}[what]
        )
    )


def summary(rows: Sequence[Row], by: Sequence[str]) -> Table:
    """Summarize groups of answers: errors, stated deviations, wrong and missing answers."""
    table: Table = pd.DataFrame(list(rows))
    table["wrong"] = wrong(table["mm"], table["squared_mahalanobis"])
    table["inside"] = 100.0 * (table["squared_mahalanobis"] < CHI2_6)
    table["1 cm/1 deg %"] = 100.0 * ((table["mm"] < 10) & (table["deg"] < 1))
    of = table.groupby(by, sort=False)
    answered = table[table["status"] == "ok"]
    located = answered.groupby(by, sort=False)
    columns = {"n": of.size(), "located": located.size()}
    for unit in ("mm", "deg"):
        columns[f"median {unit}"] = located[unit].median()
        # A mean of neighbours is not defined for infinity.
        columns[f"95 % {unit}"] = located[unit].quantile(0.95, interpolation="higher")
        columns[f"worst {unit}"] = located[unit].max()
        if f"sigma_{unit}" in table:
            columns[f"sigma {unit}"] = located[f"sigma_{unit}"].median()
    columns["in ellipsoid %"] = located["inside"].mean()
    columns["1 cm/1 deg %"] = of["1 cm/1 deg %"].mean()
    columns["wrong"] = of["wrong"].sum()
    return pd.DataFrame(columns, index=of.size().index).reset_index()


@dataclass(frozen=True)
class Case:
    """One way of seeing the rooms, and what is stated about it."""

    view: Callable[[Camera], View]
    """The view, from the recording's intrinsics."""
    stated: float | None = None
    """Stated focal length over the true one. None: no camera is stated."""

    def camera(self, true: Camera) -> Camera | None:
        """Return the stated intrinsics."""
        return None if self.stated is None else true.zoomed(self.stated)


def cases() -> dict[str, Case]:
    """Return all cases by name; only those that say so state a camera."""
    found = {name: Case(view) for name, view in LENSES.items()}
    for percent in FOCAL_PERCENT:
        found[f"stated focal {percent:+g} %"] = Case(View, 1 + percent / 100)
    for deg in ROLLS_DEG:
        found[f"roll {deg}"] = Case(partial(rolled, roll_deg=deg))
        found[f"roll {deg}, true camera stated"] = Case(
            partial(rolled, roll_deg=deg), 1.0
        )
    return found


def lens(rooms: Sequence[Path], out: Path, images: int | None) -> list[Row]:
    """Locate test images, and calibrate the fixed camera, through every lens."""
    localizer = Localizer.open(learned(rooms, out / "rooms.evercal"))
    jobs = [*product(rooms, cases())]
    rows: list[Row] = []
    for room, name in tqdm(jobs, "lenses"):
        path = out / "lens" / _file(room.name, images or "all", name)
        common: Row = {"room": room.name, "case": name}
        measure = partial(_lens_draw, localizer, room, cases()[name], images)
        rows += [common | row for row in once(path, measure)]
    return rows


def _lens_draw(
    localizer: Localizer, room: Path, case: Case, count: int | None
) -> list[Row]:
    scene = load_recording(room)
    fixed = load_recording(room / "calibration" / "fixed")
    frames = [seen(frame, case) for frame in posed_frames(scene.test)[:count]]
    views = [seen(frame, case) for frame in fixed.test[:count]]
    return [*_located(localizer, scene, frames, case), _camera(localizer, views, case)]


def seen(frame: Frame, case: Case) -> Frame:
    """Return a frame as a case sees it, with its true intrinsics and pose."""
    view = case.view(frame.camera)
    pose = frame.base_from_camera
    assert pose is not None
    image = view.render(frame.read_image(), frame.camera)
    true = pose @ view.own_from_view
    return replace(frame, image=image, camera=view.camera, base_from_camera=true)


@dataclass(frozen=True)
class _Told:
    """A localizer that is told the stated intrinsics of a case."""

    localizer: Localizer
    case: Case

    @property
    def scenes(self) -> tuple[str, ...]:
        return self.localizer.scenes

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        assert camera is not None, "frames have the true intrinsics of their view"
        return self.localizer.localize(image, self.case.camera(camera))


def _located(
    localizer: Localizer, scene: Recording, frames: Sequence[Frame], case: Case
) -> Iterator[Row]:
    seen_scene = replace(scene, test=tuple(frames), base=None)
    for result in evaluate(_Told(localizer, case), {scene.name: seen_scene}):
        # An answer in another room has an infinite error.
        squared = np.inf if result.wrong_scene else result.squared_mahalanobis
        yield {
            "what": "image",
            "name": result.frame,
            "status": result.status,
            "mm": 1000 * result.translation_error_m
            if result.status == "ok"
            else np.nan,
            "deg": np.rad2deg(result.rotation_error_rad)
            if result.status == "ok"
            else np.nan,
            "squared_mahalanobis": squared,
        }


def _camera(localizer: Localizer, frames: Sequence[Frame], case: Case) -> Row:
    true = frames[0].camera
    pose = frames[0].base_from_camera
    assert pose is not None
    images = [(frame.name, frame.read_image()) for frame in frames]
    row: Row = {"what": "fixed camera", "name": "fixed"}
    try:
        calibration = calibrate(localizer, Images(images, case.camera(true)))
    except InputError as error:
        return row | {"status": "failed", "reason": _reason(error)}
    assert calibration.camera is not None
    row |= {
        "status": "ok",
        "focal_percent": 100 * (calibration.camera.fx / true.fx - 1),
        "used": sum(image.used for image in calibration.images),
    }
    return row | pose_error(calibration.uncertain_pose, pose)


def few(
    rooms: Sequence[Path], out: Path, draws: int, sizes: Sequence[int]
) -> list[Row]:
    """Calibrate a wrist camera from few images of every room."""
    return _drawn(_few_draw, [*product(rooms, sizes, range(draws))], out / "few")


def _few_draw(room: Path, size: int, draw: int) -> Row:
    recording, truth = as_wrist_recording(load_recording(room), draw)
    chosen = spread(len(recording.train), size, np.random.default_rng([draw, size]))
    part = replace(recording, train=tuple(recording.train[i] for i in chosen))
    row: Row = {"room": room.name, "images": size, "draw": draw}
    with _scratch() as store:
        return row | _mount(part, truth, store)


def spread(count: int, size: int, rng: np.random.Generator) -> list[int]:
    """Choose one of each of `size` equal stretches of `count` images, in their order."""
    edges = np.linspace(0, count, size + 1)
    within = edges[:-1] + rng.random(size) * np.diff(edges)
    return np.floor(within).astype(int).tolist()


def _mount(recording: Recording, truth: SE3, store: Path) -> Row:
    try:
        row, report = learned_mount(recording, truth, store)
    except InputError as error:
        return {"status": "refused", "reason": _reason(error, recording.name)}
    assert report.hand_eye is not None
    assert report.adjusted is not None
    return {
        "status": "ok",
        **row,
        "warnings": "; ".join(report.hand_eye.warnings),
        "pose_sigma_mm": report.adjusted.pose_sigma_mm or 0.0,
        "pose_sigma_deg": report.adjusted.pose_sigma_deg,
        "seconds": report.seconds,
    }


def arm(rooms: Sequence[Path], out: Path, draws: int) -> list[Row]:
    """Calibrate a wrist camera on an inaccurate arm, then a fixed camera in its map."""
    return _drawn(_arm_draw, [*product(rooms, range(draws))], out / "arm")


def _drawn(
    measure: Callable[..., Row], jobs: Sequence[tuple[Any, ...]], out: Path
) -> list[Row]:
    """Rows of jobs, each of a room and numbers; those in files are not repeated."""
    rows = []
    for room, *numbers in tqdm(jobs, out.name):
        path = out / _file(room.name, *numbers)
        rows.append(once(path, partial(measure, room, *numbers)))
    return rows


def _arm_draw(room: Path, draw: int) -> Row:
    scene = load_recording(room)
    recording, truth = as_wrist_recording(scene, draw)
    noisy = with_arm_errors(recording, np.random.default_rng([draw, 1]))
    row: Row = {"room": room.name, "draw": draw, **_arm_size(recording, noisy)}
    with _scratch() as store:
        row |= _mount(noisy, truth, store)
        if row["status"] == "ok":
            localizer = Localizer.open(store)
            frame, fit = _frame_of(localizer, scene)
            row |= fit | _fixed(localizer, room, frame)
    return row


def _arm_size(exact: Recording, noisy: Recording) -> Row:
    pairs = zip(grippers(exact), grippers(noisy), strict=True)
    sizes = np.array([pose_distance_mm_deg(*pair) for pair in pairs])
    mm, deg = np.sqrt((sizes**2).mean(0) / 3).tolist()
    return {"arm_mm": mm, "arm_deg": deg}


def _frame_of(localizer: Localizer, scene: Recording) -> tuple[SE3 | None, Row]:
    """Fit the base frame to the test frames; None with fewer answers than a frame needs."""
    estimated = []
    true = []
    for frame in posed_frames(scene.test):
        pose = localizer.localize(frame.read_image()).base_from_camera
        if pose is not None:
            estimated.append(pose)
            true.append(frame.base_from_camera)
    row: Row = {"located": len(estimated)}
    if len(estimated) < LEAST_ANSWERS:
        return None, row
    offset = frame_offset(SE3.stack(estimated), SE3.stack(true))
    middle = SE3.stack(true).translation_m.mean(0)
    _, deg = pose_distance_mm_deg(offset, SE3.identity())
    shift = float(np.linalg.norm(offset.apply(middle) - middle))
    return offset, row | {"frame_mm": 1000 * shift, "frame_deg": deg}


def frame_offset(estimated: SE3, true: SE3) -> SE3:
    """Fit one motion of the base frame to poses (n,): estimated = offset @ true.

    A robust mean of all offsets, about the middle of the cameras, finds wrong answers. Then the
    positions of the others are fitted: rotations contain the error of the mount.
    """
    middle = SE3(np.array([1.0, 0, 0, 0]), true.translation_m.mean(0))
    each = middle.inverse() @ (estimated @ true.inverse()) @ middle
    rough = middle @ average_poses(each) @ middle.inverse()
    to = estimated.translation_m
    of = true.translation_m
    off = np.linalg.norm(to - rough.apply(of), axis=1)
    good = off <= WRONG_MEDIANS * np.median(off) + 1e-9
    centre_to = to[good].mean(0)
    centre_of = of[good].mean(0)
    rotation = Rotation.align_vectors(to[good] - centre_to, of[good] - centre_of)[0]
    quaternion = rotation.as_quat(canonical=True, scalar_first=True)
    return SE3(quaternion, centre_to - rotation.apply(centre_of))


def _fixed(localizer: Localizer, room: Path, frame: SE3 | None) -> Row:
    images, truth = fixed_images(room / "calibration" / "fixed")
    try:
        calibration = calibrate(localizer, images)
    except InputError as error:
        return {"fixed_reason": _reason(error)}
    error = pose_error(calibration.uncertain_pose, truth)
    row: Row = {f"fixed_{key}": value for key, value in error.items()}
    if frame is not None:
        pose = calibration.parent_from_child
        mm, deg = pose_distance_mm_deg(frame.inverse() @ pose, truth)
        row |= {"fitted_mm": mm, "fitted_deg": deg}
    return row


@contextmanager
def _scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "store.evercal"


def _file(*words: object) -> str:
    return "_".join(re.sub(r"[^\w.+-]+", "-", str(word)) for word in words) + ".json"


def _reason(error: InputError, name: str = "") -> str:
    return str(error).removeprefix(f"{name}: ")
