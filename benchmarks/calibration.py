"""Accuracy of cameras calibrated from images: on the arm, fixed, and after bumps."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import Positional

from benchmarks.accuracy import pose_error
from benchmarks.rows import Row, once, save
from evercal.calibration.calibration import Calibration
from evercal.calibration.drift import check
from evercal.calibration.from_images import calibrate
from evercal.calibration.image_source import Images
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6
from evercal.geometry import SE3
from evercal.learning.report import LearnReport
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.recordings import Recording, load_recording
from evercal.recordings.samples import FOLDER, ROOMS

ROBOT_NOISE_M = 2e-4
ROBOT_NOISE_DEG = 0.02
PACKAGED = tuple(FOLDER / name for name in ROOMS)
"""Folders of the packaged rooms."""


def run(
    what: Positional[Literal["wrist", "fixed", "bump"]],
    rooms: tuple[Path, ...] = (),
    out: Path = Path("runs/calibration"),
    draws: int = 10,
    store: Path | None = None,
) -> None:
    """Calibrate cameras from images and compare with the simulator's truth.

    Args:
        what: wrist: gripper_from_camera of a camera on the arm, without an initial value. fixed: a
            fixed camera. bump: the alarm after bumps.
        rooms: Folders of rendered rooms. Defaults to the packaged rooms.
        out: Folder for stores and results; complete wrist draws are not repeated.
        draws: Trials of each room.
        store: Store with the rooms. Without it, they are learned.
    """
    out.mkdir(parents=True, exist_ok=True)
    folders = rooms or PACKAGED
    if what == "wrist":
        rows = wrist(folders, out, draws)
    else:
        localizer = Localizer.open(store or learned(folders, out / "rooms.evercal"))
        rows = (fixed if what == "fixed" else bumps)(folders, localizer, draws)
    save(out / f"{what}.csv", rows)
    print(summary(rows))


def wrist(rooms: Sequence[Path], out: Path, draws: int) -> list[Row]:
    """Calibrate a wrist camera from training frames and gripper poses."""
    rows = []
    for room in rooms:
        scene = load_recording(room)
        for draw in tqdm(range(draws), room.name, unit="draw"):
            path = out / f"wrist-{room.name}-{draw}.json"
            measure = partial(
                _wrist_draw, scene, room, path.with_suffix(".evercal"), draw
            )
            rows.append(once(path, measure))
    return rows


def as_wrist_recording(scene: Recording, draw: int) -> tuple[Recording, SE3]:
    """Return a recording of gripper poses, and the true `gripper_from_camera`."""
    rng = np.random.default_rng(draw)
    rotation = Rotation.random(rng=rng).as_quat(canonical=True, scalar_first=True)
    truth = SE3(rotation, rng.uniform(-0.1, 0.1, 3))
    sigma = np.repeat([ROBOT_NOISE_M, np.deg2rad(ROBOT_NOISE_DEG)], 3)
    train = []
    for frame in scene.train:
        assert frame.base_from_camera is not None
        noise = SE3.exp(rng.normal(0, sigma))
        gripper = frame.base_from_camera @ truth.inverse() @ noise
        train.append(replace(frame, base_from_camera=None, base_from_gripper=gripper))
    return replace(scene, train=tuple(train), test=()), truth


def learned_mount(
    recording: Recording, truth: SE3, store: Path
) -> tuple[Row, LearnReport]:
    """Learn a wrist recording and compare its `gripper_from_camera` with the true one."""
    report = Map.open(store).learn(recording)
    assert report.hand_eye is not None
    calibration = report.hand_eye.calibration.for_lens("stated")
    return pose_error(calibration.uncertain_pose, truth), report


def _wrist_draw(scene: Recording, room: Path, store: Path, draw: int) -> Row:
    recording, truth = as_wrist_recording(scene, draw)
    row, report = learned_mount(recording, truth, store)
    assert report.hand_eye is not None
    row |= {"start_mm": report.hand_eye.start_mm, "seconds": report.seconds}
    folder = room / "calibration" / "fixed"
    if folder.is_dir():
        images, true_camera = fixed_images(folder)
        calibration = calibrate(Localizer.open(store), images)
        calibration = calibration.for_lens("stated")
        error = pose_error(calibration.uncertain_pose, true_camera)
        row |= {f"fixed_{key}": value for key, value in error.items()}
    return {"room": room.name, "draw": draw, **row}


def fixed(rooms: Sequence[Path], localizer: Localizer, draws: int) -> list[Row]:
    """Calibrate the fixed cameras of each room from all images, and from random sets of five."""
    rows = []
    for room in tqdm(rooms, "rooms"):
        for recording in ("fixed", "bumped"):
            images, truth = fixed_images(room / "calibration" / recording)
            rng = np.random.default_rng(0)
            count = len(images.images)
            five = [rng.choice(count, 5, replace=False).tolist() for _ in range(draws)]
            for some in (images, *(_take(images, chosen) for chosen in five)):
                calibration = calibrate(localizer, some)
                error = pose_error(calibration.uncertain_pose, truth)
                camera: Row = {
                    "room": room.name,
                    "camera": recording,
                    "images": len(some.images),
                }
                rows.append(camera | error)
    return rows


def bumps(rooms: Sequence[Path], localizer: Localizer, draws: int) -> list[Row]:
    """Check five images of a camera against a reference from its other images.

    Instead of the camera, the reference is moved. False alarms are counted with the reference as it
    is.
    """
    rows = []
    for room in tqdm(rooms, "rooms"):
        for recording in ("fixed", "bumped"):
            images, _ = fixed_images(room / "calibration" / recording)
            rng = np.random.default_rng(1)
            for _ in range(draws):
                order = rng.permutation(len(images.images)).tolist()
                reference = calibrate(localizer, _take(images, order[5:]))
                five = _take(images, order[:5]).images
                for kind, moved in _moved(reference, rng).items():
                    shift = check(localizer, five, moved)
                    row: Row = {"room": room.name, "camera": recording, "kind": kind}
                    row |= {"moved": shift.moved, "mm": shift.translation_mm}
                    row |= {"deg": shift.rotation_deg, "confidence": shift.confidence}
                    rows.append(row)
    return rows


def _moved(reference: Calibration, rng: np.random.Generator) -> dict[str, Calibration]:
    sizes = {
        "none": (0.0, 0.0),
        "2 mm": (2e-3, 0.0),
        "0.1 deg": (0.0, 0.1),
        "both": (2e-3, 0.1),
    }
    moved = {}
    for kind, (metres, degrees) in sizes.items():
        direction, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        rotation = SE3.exp(np.r_[np.zeros(3), np.deg2rad(degrees) * axis])
        pose = reference.parent_from_child @ rotation
        pose = SE3(pose.rotation_wxyz, pose.translation_m + metres * direction)
        moved[kind] = replace(reference, parent_from_child=pose)
    return moved


def learned(rooms: Sequence[Path], store: Path) -> Path:
    """Learn the rooms that a store lacks, and return the store."""
    cell = Map.open(store)
    scenes = [load_recording(room) for room in rooms]
    for scene in tqdm(
        [scene for scene in scenes if scene.name not in cell.scenes], "learning"
    ):
        cell.learn(scene)
    return store


def fixed_images(folder: Path) -> tuple[Images, SE3]:
    """Load the images of a fixed camera, and its true pose."""
    scene = load_recording(folder)
    truth = scene.test[0].base_from_camera
    if truth is None:
        raise InputError(f"{folder}: no true camera pose")
    images = [(frame.name, frame.read_image()) for frame in scene.test]
    return Images(images, scene.test[0].camera), truth


def _take(images: Images, chosen: Sequence[int]) -> Images:
    return replace(images, images=[images.images[i] for i in chosen])


def summary(rows: Sequence[Row]) -> str:
    """Summarize trials: the share reported as moved, or errors and the share inside ellipsoids."""
    frame = pd.DataFrame(list(rows))
    if "kind" in frame:
        return (
            frame.groupby("kind", sort=False)["moved"].agg(["mean", "size"]).to_string()
        )
    groups = frame.groupby(
        "images" if "images" in frame else lambda _: "wrist", sort=False
    )
    errors = groups[list(frame.filter(regex="^(fixed_)?(mm|deg)$"))].agg(
        ["median", "max"]
    )
    inside = groups[list(frame.filter(like="mahalanobis"))].agg(
        lambda of: (of < CHI2_6).mean()
    )
    return (
        f"{errors.to_string()}\n\nshare inside the 95 % ellipsoid\n{inside.to_string()}"
    )
