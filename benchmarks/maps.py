"""Accuracy of maps: sequences of scenes, changed rooms, fixed cameras, wrong input."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import Positional

from benchmarks.accuracy import accuracy_row
from benchmarks.rows import Row, mean_row, save
from evercal.calibration.from_images import calibrate
from evercal.calibration.image_source import Images
from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.geometry import SE3, Camera, pose_distance
from evercal.learning.report import LearnReport
from evercal.localization.localizer import Localizer
from evercal.localization.options import LocalizeOptions
from evercal.map import Map
from evercal.mapping.build import MapOptions
from evercal.mapping.memory_budget import MemoryBudget
from evercal.recordings import Frame, Recording, load_recording, posed_frames
from evercal.recordings.samples import sample_rooms

What = Literal["mini", "fixed", "badposes", "sequence", "ablation", "unknown"]
Image = np.ndarray
"""uint8, shape (h, w, 3)."""


def run(
    what: Positional[What],
    scenes: tuple[Path, ...] = (),
    out: Path = Path("runs/maps"),
    memory: float = 0.1,
) -> None:
    """Measure the accuracy of maps (strategy evercal).

    Args:
        what: mini: the packaged rooms, with degraded images and changed rooms. fixed: their fixed
            cameras. badposes: wrong training poses. sequence: scenes learned in turn. ablation: the
            gain of alignment. unknown: images that the first scene's map must refuse.
        scenes: Folders of scenes, for sequence, ablation and unknown.
        out: Folder for stores and results; `OUT/WHAT` must not exist.
        memory: Keyframes as a share of the frames.
    """
    out = out / what
    if out.exists():
        raise InputError(f"{out}: exists; remove it or give another --out")
    if what in ("sequence", "ablation", "unknown") and not scenes:
        raise InputError(f"{what}: give scenes with --scenes DIR...")
    recordings = [load_recording(folder) for folder in scenes]
    if what == "unknown":
        for folder, recording in zip(scenes[1:], recordings[1:], strict=True):
            if not recording.test:
                raise InputError(f"{folder}: no test images")
        rows = unknown_images(out, recordings, memory)
    elif what == "sequence":
        rows = sequence(recordings, out, memory)
    elif what == "ablation":
        rows = ablation(out, recordings, memory)
    else:
        rows = {"mini": mini, "fixed": fixed, "badposes": wrong_poses}[what](
            out, memory
        )
    options = MapOptions(MemoryBudget(memory))
    settings = {"map": asdict(options), "localize": asdict(LocalizeOptions())}
    save(out / f"{what}.csv", rows, settings)


def learned(
    store: Path, scenes: Sequence[Recording], memory: float
) -> list[LearnReport]:
    """Learn scenes in turn."""
    cell = Map.open(store)
    return [cell.learn(scene, memory=f"{100 * memory:g}%") for scene in scenes]


def measured(
    localizer: Localizer,
    scene: Recording,
    change: Callable[[Image], Image] | None = None,
) -> Row:
    """Localize the test frames of a scene.

    Args:
        localizer: Localizer of the store.
        scene: Recording with the name of the scene in the store.
        change: Degrades each image.
    """
    test = posed_frames(scene.test)
    if change is not None:
        test = tuple(replace(frame, image=change(frame.read_image())) for frame in test)
    return accuracy_row(
        scene.name,
        evaluate(localizer, {scene.name: replace(scene, test=test, base=None)}),
    )


def sequence(scenes: Sequence[Recording], out: Path, memory: float) -> list[Row]:
    """Measure scenes just after learning and after learning all of them."""
    store = out / "store.evercal"
    first = {}
    before = 0
    for scene in tqdm(scenes, "learning", unit="scene"):
        (report,) = learned(store, [scene], memory)
        accuracy = measured(Localizer.open(store), scene)["1 cm/1 deg"]
        # A report counts the bytes of all scenes.
        first[scene.name] = (
            float(accuracy),
            report.seconds,
            report.memory_bytes - before,
        )
        before = report.memory_bytes
    localizer = Localizer.open(store)
    rows = []
    for scene in tqdm(scenes, "evaluating", unit="scene"):
        accuracy, seconds, memory_bytes = first[scene.name]
        row = measured(localizer, scene)
        row["forgotten_1cm"] = accuracy - float(row["1 cm/1 deg"])
        rows.append(row | {"seconds": seconds, "bytes": memory_bytes})
    return [*rows, mean_row("mean", rows)]


DEGRADED: dict[str, Callable[[Image], Image]] = {
    "half exposure": lambda image: (image * 0.5).astype(np.uint8),
    "double exposure": lambda image: np.minimum(image * 2.0, 255).astype(np.uint8),
    "gamma 2": lambda image: (255 * (image / 255.0) ** 2).astype(np.uint8),
    "blur 2 px": lambda image: cv2.GaussianBlur(image, (0, 0), 2.0),
    "30 % covered": lambda image: _covered(image, 0.3),
    "JPEG 40": lambda image: _jpeg(image, 40),
}


def _covered(image: Image, share: float) -> Image:
    """Cover a share of the image by a grey disc, like a hand, off the centre."""
    height, width = image.shape[:2]
    radius = int(np.sqrt(share * height * width / np.pi))
    centre = (int(0.4 * width), int(0.55 * height))
    return cv2.circle(image.copy(), centre, radius, (150, 120, 100), -1)


def _jpeg(image: Image, quality: int) -> Image:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)


def mini(out: Path, memory: float) -> list[Row]:
    """Measure the packaged rooms, with degraded images and after a change in the room."""
    rooms = sample_rooms()
    store = out / "store.evercal"
    learned(store, [room.scene for room in rooms], memory)
    localizer = Localizer.open(store)
    rows = [measured(localizer, room.scene) for room in rooms]
    rows.append(mean_row("mean", rows))
    for title, change in DEGRADED.items():
        degraded = [measured(localizer, room.scene, change) for room in rooms]
        rows.append(mean_row(title, degraded))
    for room in rooms:
        if room.changed is not None:
            row = measured(localizer, replace(room.scene, test=room.changed.test))
            rows.append(row | {"scene": f"{room.scene.name}, changed"})
    return rows


def fixed(out: Path, memory: float) -> list[Row]:
    """Calibrate the fixed cameras of the packaged rooms, before and after a bump."""
    rooms = sample_rooms()
    store = out / "store.evercal"
    rows = []
    learned(store, [room.scene for room in rooms], memory)
    localizer = Localizer.open(store)
    for room in rooms:
        assert room.fixed is not None
        assert room.bumped is not None
        before, after = (
            _fixed_pose(localizer, s.test) for s in (room.fixed, room.bumped)
        )
        true_before = room.fixed.test[0].base_from_camera
        true_after = room.bumped.test[0].base_from_camera
        assert true_before is not None
        assert true_after is not None
        bump = before.inverse() @ after
        true_bump = true_before.inverse() @ true_after
        rows.append(
            {
                "scene": room.scene.name,
                **_distance("error", before, true_before),
                **_distance("bump", SE3.identity(), true_bump),
                **_distance("bump_error", bump, true_bump),
            }
        )
    return rows


def _fixed_pose(localizer: Localizer, frames: Sequence[Frame]) -> SE3:
    images = Images([(f.name, f.read_image()) for f in frames], frames[0].camera)
    return calibrate(localizer, images, "eye_to_hand").parent_from_child


def _distance(name: str, a: SE3, b: SE3) -> Row:
    metres, radians = pose_distance(a, b)
    return {
        f"{name}_mm": 1000 * float(metres),
        f"{name}_deg": float(np.rad2deg(radians)),
    }


OFFSET = SE3.exp(np.array([0.004, -0.003, 0.002, *np.deg2rad([0.4, -0.3, 0.2])]))
PoseError = Literal["none", "noise", "offset", "focal", "gross"]
POSE_ERRORS: tuple[PoseError, ...] = ("none", "noise", "offset", "focal", "gross")


def with_pose_errors(
    frames: Sequence[Frame], kind: PoseError, seed: int
) -> tuple[Frame, ...]:
    """Add errors to stated poses or intrinsics.

    Args:
        frames: Frames with true poses.
        kind: noise (2 mm, 0.2 deg), offset (common, 5.4 mm, 0.54 deg), focal (1 % too long) or
            gross (every twentieth pose off by 30 cm).
        seed: Seed of the noise.
    """
    rng = np.random.default_rng(seed)
    changed = []
    outliers = set(rng.permutation(len(frames))[: max(1, len(frames) // 20)].tolist())
    for i, frame in enumerate(frames):
        pose = frame.base_from_camera
        camera = frame.camera
        assert pose is not None
        if kind == "noise":
            rotation = Rotation.from_rotvec(
                np.deg2rad(0.2) * rng.standard_normal(3)
            ).as_rotvec()
            shift = pose.rotation_matrix().T @ (0.002 * rng.standard_normal(3))
            pose = pose @ SE3.exp(np.concatenate([shift, rotation]))
        elif kind == "offset":
            pose = pose @ OFFSET
        elif kind == "focal":
            camera = replace(camera, fx=1.01 * camera.fx, fy=1.01 * camera.fy)
        elif kind == "gross" and i in outliers:
            direction = rng.standard_normal(3)
            shift = 0.3 * direction / np.linalg.norm(direction)
            pose = SE3(pose.rotation_wxyz, pose.translation_m + shift)
        changed.append(replace(frame, base_from_camera=pose, camera=camera))
    return tuple(changed)


def wrong_poses(
    out: Path, memory: float, seeds: Sequence[int] = (0, 1, 2)
) -> list[Row]:
    """Learn the packaged bedroom with errors in its training poses."""
    scene = sample_rooms()[0].scene
    rows = []
    for kind in POSE_ERRORS:
        for seed in seeds if kind in ("noise", "gross") else (0,):
            store = out / f"{kind}-{seed}.evercal"
            train = with_pose_errors(scene.train, kind, seed)
            # A common offset belongs to the frame that the recording states.
            test = with_pose_errors(posed_frames(scene.test), "offset", 0)
            spoiled = replace(
                scene, train=train, test=test if kind == "offset" else scene.test
            )
            (report,) = learned(store, [spoiled], memory)
            localizer = Localizer.open(store)
            adjusted = report.adjusted
            assert adjusted is not None
            true_common = OFFSET.inverse() if kind == "offset" else SE3.identity()
            planted = {
                true.name
                for true, stated in zip(scene.train, train, strict=True)
                if kind == "gross" and _moved(true, stated)
            }
            named = set(adjusted.wrong_poses)
            rows.append(
                measured(localizer, spoiled)
                | {"scene": f"{kind} {seed}"}
                | _distance(
                    "common_error",
                    true_common,
                    localizer.contents.scenes[0].frame.common,
                )
                | {
                    "focal_percent": adjusted.focal_percent,
                    "pose_sigma_mm": adjusted.pose_sigma_mm,
                    "planted": len(planted),
                    "named": len(planted & named),
                    "named_wrongly": len(named - planted),
                }
            )
    return rows


def _moved(true: Frame, stated: Frame) -> bool:
    assert true.base_from_camera is not None
    assert stated.base_from_camera is not None
    return float(pose_distance(true.base_from_camera, stated.base_from_camera)[0]) > 0.1


def unknown_images(out: Path, scenes: Sequence[Recording], memory: float) -> list[Row]:
    """Count the images of other scenes, and hard ones, that get a pose in the first scene's map."""
    store = out / "store.evercal"
    learned(store, scenes[:1], memory)
    localizer = Localizer.open(store)
    rows = []
    for scene in scenes[1:]:
        images = ((frame.read_image(), frame.camera) for frame in scene.test)
        rows.append(_accepted(localizer, scene.name, images))
    rng = np.random.default_rng(0)
    camera = localizer.contents.scenes[0].camera
    shape = (camera.height, camera.width, 3)
    hand = cv2.GaussianBlur(rng.integers(90, 160, shape).astype(np.uint8), (0, 0), 25)
    rows.append(
        _accepted(localizer, "blank", [(np.full(shape, 128, np.uint8), camera)])
    )
    noise = [(rng.integers(0, 255, shape).astype(np.uint8), camera) for _ in range(10)]
    rows.append(_accepted(localizer, "noise", noise))
    rows.append(_accepted(localizer, "hand in front of the camera", [(hand, camera)]))
    return rows


def _accepted(
    localizer: Localizer, name: str, images: Iterable[tuple[Image, Camera]]
) -> Row:
    estimates = [localizer.localize(image, camera) for image, camera in images]
    return {
        "images": name,
        "count": len(estimates),
        "accepted": sum(estimate.status == "ok" for estimate in estimates),
        "most_support": max(estimate.support for estimate in estimates),
    }


def ablation(out: Path, scenes: Sequence[Recording], memory: float) -> list[Row]:
    """Measure the first pose, from matched patches, beside the aligned one."""
    store = out / "store.evercal"
    learned(store, scenes, memory)
    return [
        mean_row(
            title, [measured(Localizer.open(store, options), scene) for scene in scenes]
        )
        for title, options in (
            ("map", LocalizeOptions()),
            ("matched patches, no alignment", LocalizeOptions(align=False)),
        )
    ]
