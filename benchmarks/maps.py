"""What the map reaches: sequences of scenes, changed rooms, fixed cameras, spoiled input, scale."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tabulate import tabulate
from tqdm import tqdm

from evercal.calibration.from_images import Images, calibrate
from evercal.continual.learn_scene import LearnOptions, LearnReport, learn_scene
from evercal.continual.presets import preset
from evercal.continual.stage import StageOptions
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera, pose_distance, squared_mahalanobis
from evercal.localization.localizer import LocalizeOptions, Localizer
from evercal.recordings import Frame, Recording, load_recording, posed_frames
from evercal.recordings.samples import sample_rooms

BOUNDS = ((0.05, 5.0), (0.02, 2.0), (0.01, 1.0), (0.005, 0.5))


def learned(
    store: Path, scenes: Sequence[Recording], memory: float, seed: int = 0
) -> list[LearnReport]:
    """Learns scenes one after the other into a store with the default strategy."""
    options = LearnOptions(_stage(memory, seed))
    return [learn_scene(store, scene, options) for scene in scenes]


def errors(
    localizer: Localizer, frames: Sequence[Frame], scene: str, change: Callable | None = None
) -> dict[str, object]:
    """Accuracy at four bounds, medians, wrong scenes, times and the 95 % ellipsoids of frames.

    Ellipsoids are those of all poses in the right scene, however far off: one that misses a pose
    that is 10 cm off is one that was stated too small.

    Args:
        localizer: of the store.
        frames: posed test frames.
        scene: the name that the frames' scene has in the store.
        change: what is done to each image before, (h, w, 3) uint8 to the same.
    """
    metres, radians, ms, squared, sigma, wrong, refused = [], [], [], [], [], 0, 0
    for frame in frames:
        began = time.perf_counter()
        image = frame.read_image()
        if change is not None:
            image = change(image)
        found = localizer.localize(image, frame.camera)
        ms.append(1000 * (time.perf_counter() - began))
        truth = frame.base_from_camera
        assert truth is not None
        if found.base_from_camera is None or found.scene != scene:
            wrong += found.base_from_camera is not None
            refused += found.base_from_camera is None
            metres.append(np.inf)
            radians.append(np.inf)
            continue
        m, r = pose_distance(found.base_from_camera, truth)
        metres.append(float(m))
        radians.append(float(r))
        assert found.covariance is not None
        squared.append(squared_mahalanobis(found.base_from_camera, found.covariance, truth))
        sigma.append(float(np.sqrt(np.trace(found.covariance[:3, :3]) / 3)))
    m, d = np.array(metres), np.rad2deg(radians)
    return {
        "scene": scene,
        "frames": len(m),
        **{_bound(a, b): 100 * float(np.mean((m < a) & (d < b))) for a, b in BOUNDS},
        "median_mm": 1000 * float(np.median(m)),
        "median_deg": float(np.median(d)),
        "wrong_scene": wrong,
        "refused": refused,
        "inside_95": share_inside(squared),
        "sigma_mm": 1000 * float(np.median(sigma)) if sigma else float("nan"),
        "ms": float(np.median(ms)),
    }


def _bound(metres: float, degrees: float) -> str:
    return f"{100 * metres:g} cm/{degrees:g} deg"


def sequence(scenes: Sequence[Recording], out: Path, memory: float) -> list[dict[str, object]]:
    """Learns scenes in turn; every scene just after it was learned, and all at the end."""
    store, rows, first, before = out / "store.evercal", [], {}, 0
    for scene in tqdm(scenes, "learning", unit="scene"):
        report = learned(store, [scene], memory)[0]
        localizer = Localizer.open(store)
        first[scene.name] = errors(localizer, posed_frames(scene.test), scene.name)
        first[scene.name]["seconds"] = report.seconds
        first[scene.name]["bytes"] = report.memory_bytes - before  # it counts all scenes
        before = report.memory_bytes
    localizer = Localizer.open(store)
    for scene in tqdm(scenes, "evaluating", unit="scene"):
        row = errors(localizer, posed_frames(scene.test), scene.name)
        new = first[scene.name]
        rows.append(
            row
            | {
                "forgotten_1cm": float(str(new["1 cm/1 deg"])) - float(str(row["1 cm/1 deg"])),
                "seconds": new["seconds"],
                "bytes": new["bytes"],
            }
        )
    rows.append(_mean("mean", rows))
    _write(out / "sequence.json", rows, memory)
    return rows


def _mean(name: str, rows: Sequence[dict[str, object]]) -> dict[str, object]:
    keys = [key for key in rows[0] if key != "scene"]
    means = {key: float(np.nanmean([float(str(row[key])) for row in rows])) for key in keys}
    return {"scene": name, **means}


DEGRADED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "half exposure": lambda image: (image * 0.5).astype(np.uint8),
    "double exposure": lambda image: np.minimum(image * 2.0, 255).astype(np.uint8),
    "gamma 2": lambda image: (255 * (image / 255.0) ** 2).astype(np.uint8),
    "blur 2 px": lambda image: cv2.GaussianBlur(image, (0, 0), 2.0),
    "30 % covered": lambda image: _covered(image, 0.3),
    "JPEG 40": lambda image: _jpeg(image, 40),
}


def _covered(image: np.ndarray, share: float) -> np.ndarray:
    """A grey disc, as of a hand, over a share of the image, off its middle."""
    height, width = image.shape[:2]
    radius = int(np.sqrt(share * height * width / np.pi))
    centre = (int(0.4 * width), int(0.55 * height))
    return cv2.circle(image.copy(), centre, radius, (150, 120, 100), -1)


def _jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def mini(out: Path, memory: float) -> list[dict[str, object]]:
    """The packaged rooms: accuracy, degraded images, changed rooms."""
    rooms, store = sample_rooms(), out / "store.evercal"
    learned(store, [room.scene for room in rooms], memory)
    localizer, rows = Localizer.open(store), []
    tests = [(room.scene.name, posed_frames(room.scene.test)) for room in rooms]
    plain = [errors(localizer, frames, name) for name, frames in tests]
    rows += [*plain, _mean("mean", plain)]
    for title, change in DEGRADED.items():
        found = [errors(localizer, frames, name, change) for name, frames in tests]
        rows.append(_mean(title, found))
    changed = [
        errors(localizer, posed_frames(room.changed.test), room.scene.name)
        for room in rooms
        if room.changed is not None
    ]
    rows += [row | {"scene": f"{row['scene']}, changed"} for row in changed]
    _write(out / "mini.json", rows, memory)
    return rows


def fixed(out: Path, memory: float) -> list[dict[str, object]]:
    """Fixed cameras of the packaged rooms, 25 images each, before and after a bump."""
    rooms, store, rows = sample_rooms(), out / "store.evercal", []
    learned(store, [room.scene for room in rooms], memory)
    localizer = Localizer.open(store)
    for room in rooms:
        assert room.fixed is not None
        assert room.bumped is not None
        before, after = (_fixed_pose(localizer, s.test) for s in (room.fixed, room.bumped))
        true = [s.test[0].base_from_camera for s in (room.fixed, room.bumped)]
        assert true[0] is not None
        assert true[1] is not None
        m, r = pose_distance(before, true[0])
        seen, real = before.inverse() @ after, true[0].inverse() @ true[1]
        dm, dr = pose_distance(seen, real)
        size_m, size_r = pose_distance(SE3.identity(), real)
        rows.append(
            {
                "scene": room.scene.name,
                "error_mm": 1000 * float(m),
                "error_deg": float(np.rad2deg(r)),
                "bump_mm": 1000 * float(size_m),
                "bump_deg": float(np.rad2deg(size_r)),
                "bump_error_mm": 1000 * float(dm),
                "bump_error_deg": float(np.rad2deg(dr)),
            }
        )
    _write(out / "fixed.json", rows, memory)
    return rows


def _fixed_pose(localizer: Localizer, frames: Sequence[Frame]) -> SE3:
    images = Images([(f.name, f.read_image()) for f in frames], frames[0].camera)
    return calibrate(localizer, images, "eye_to_hand").parent_from_child


OFFSET = SE3.exp(np.array([0.004, -0.003, 0.002, *np.deg2rad([0.4, -0.3, 0.2])]))


def spoiled(frames: Sequence[Frame], how: str, seed: int) -> tuple[Frame, ...]:
    """Training frames with stated poses or lens spoiled on purpose.

    Args:
        frames: with true poses.
        how: noise (2 mm, 0.2 deg), offset (common, 5.4 mm, 0.54 deg), focal (1 % too long) or
            gross (every twentieth pose 30 cm off).
        seed: of the noise.
    """
    rng, done = np.random.default_rng(seed), []
    far = set(rng.permutation(len(frames))[: max(1, len(frames) // 20)].tolist())
    for i, frame in enumerate(frames):
        pose, camera = frame.base_from_camera, frame.camera
        assert pose is not None
        if how == "noise":
            turn = Rotation.from_rotvec(np.deg2rad(0.2) * rng.standard_normal(3)).as_rotvec()
            move = pose.rotation_matrix().T @ (0.002 * rng.standard_normal(3))
            pose = pose @ SE3.exp(np.concatenate([move, turn]))
        elif how == "offset":
            pose = pose @ OFFSET
        elif how == "focal":
            camera = replace(camera, fx=1.01 * camera.fx, fy=1.01 * camera.fy)
        elif how == "gross" and i in far:
            away = rng.standard_normal(3)
            shift = 0.3 * away / np.linalg.norm(away)
            pose = SE3(pose.rotation_wxyz, pose.translation_m + shift)
        done.append(replace(frame, base_from_camera=pose, camera=camera))
    return tuple(done)


def bad_poses(
    out: Path, memory: float, seeds: Sequence[int] = (0, 1, 2)
) -> list[dict[str, object]]:
    """The packaged bedroom with spoiled training poses; test frames stay true."""
    scene, rows = sample_rooms()[0].scene, []
    for how in ("none", "noise", "offset", "focal", "gross"):
        for seed in seeds if how in ("noise", "gross") else (0,):
            store = out / f"{how}-{seed}.evercal"
            frames = spoiled(scene.train, how, seed)
            report = learned(store, [replace(scene, train=frames)], memory, seed)[0]
            localizer, adjusted = Localizer.open(store), report.adjusted
            assert adjusted is not None
            row = errors(localizer, [_stated(f, how) for f in posed_frames(scene.test)], scene.name)
            common = localizer.maps.scenes[0].common
            m, r = pose_distance(OFFSET.inverse() if how == "offset" else SE3.identity(), common)
            far = [f.name for f, g in zip(scene.train, frames, strict=True) if _moved(f, g, how)]
            rows.append(
                row
                | {
                    "scene": f"{how} {seed}",
                    "common_error_mm": 1000 * float(m),
                    "common_error_deg": float(np.rad2deg(r)),
                    "focal_percent": adjusted.focal_percent,
                    "pose_sigma_mm": adjusted.pose_sigma_mm,
                    "planted": len(far),
                    "named": len(set(far) & set(adjusted.wrong_poses)),
                    "named_wrongly": len(set(adjusted.wrong_poses) - set(far)),
                }
            )
    _write(out / "bad_poses.json", rows, memory)
    return rows


def _stated(frame: Frame, how: str) -> Frame:
    """A test frame as the recording would state it: a common offset belongs to its frame."""
    if how != "offset" or frame.base_from_camera is None:
        return frame
    return replace(frame, base_from_camera=frame.base_from_camera @ OFFSET)


def _moved(frame: Frame, spoiled_frame: Frame, how: str) -> bool:
    if how != "gross":
        return False
    assert frame.base_from_camera is not None
    assert spoiled_frame.base_from_camera is not None
    return float(pose_distance(frame.base_from_camera, spoiled_frame.base_from_camera)[0]) > 0.1


def strangers(out: Path, folders: Sequence[Path], memory: float) -> list[dict[str, object]]:
    """How many images get a pose in the first scene's map: of other scenes, and hard ones."""
    known, *others = [load_recording(folder) for folder in folders]
    for folder, scene in zip(folders[1:], others, strict=True):
        if not scene.test:
            raise InputError(f"{folder}: has no test images")
    store, rows = out / "store.evercal", []
    learned(store, [known], memory)
    localizer = Localizer.open(store)
    for folder, scene in zip(folders[1:], others, strict=True):
        shown = ((frame.read_image(), frame.camera) for frame in scene.test)
        rows.append(_believed(localizer, folder.name, shown))
    rng, size = np.random.default_rng(0), localizer.maps.scenes[0].camera
    shape = (size.height, size.width, 3)
    hand = cv2.GaussianBlur(rng.integers(90, 160, shape).astype(np.uint8), (0, 0), 25)
    rows.append(_believed(localizer, "blank", [(np.full(shape, 128, np.uint8), size)]))
    noise = [(rng.integers(0, 255, shape).astype(np.uint8), size) for _ in range(10)]
    rows.append(_believed(localizer, "noise", noise))
    rows.append(_believed(localizer, "hand before the lens", [(hand, size)]))
    _write(out / "strangers.json", rows, memory)
    return rows


def _believed(
    localizer: Localizer, name: str, images: Iterable[tuple[np.ndarray, Camera]]
) -> dict[str, object]:
    found = [localizer.localize(image, camera) for image, camera in images]
    return {
        "images": name,
        "count": len(found),
        "believed": sum(estimate.status == "ok" for estimate in found),
        "most_support": max(estimate.support for estimate in found),
    }


def ablation(out: Path, scenes: Sequence[Recording], memory: float) -> list[dict[str, object]]:
    """What alignment gives: the first pose, from matched patches, beside the refined one."""
    store, rows = out / "store.evercal", []
    learned(store, scenes, memory)
    for title, options in (
        ("map", LocalizeOptions()),
        ("matched patches, no alignment", LocalizeOptions(align=False)),
    ):
        localizer = Localizer.open(store, options)
        found = [errors(localizer, posed_frames(s.test), s.name) for s in scenes]
        rows.append(_mean(title, found))
    _write(out / "ablation.json", rows, memory)
    return rows


def print_rows(rows: Sequence[dict[str, object]]) -> None:
    """A table of rows."""
    print(tabulate([list(row.values()) for row in rows], list(rows[0]), "github", floatfmt=".3g"))


def settings(memory: float) -> dict[str, object]:
    """What decides the results."""
    return {"stage": asdict(_stage(memory, 0)), "localize": asdict(LocalizeOptions())}


def _stage(memory: float, seed: int) -> StageOptions:
    return replace(preset("fast", seed), memory_share=memory)


def _write(path: Path, rows: Sequence[dict[str, object]], memory: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"rows": list(rows), "settings": settings(memory)}, indent=1))


def run(what: str, folders: Sequence[Path], out: Path, memory: float) -> None:
    """Measures one thing, writes its rows beside the store and prints its table."""
    if out.exists():
        raise InputError(f"{out}: exists; remove it or give another --out")
    if what in ("sequence", "ablation", "strangers") and not folders:
        raise InputError(f"{what}: give scenes with --scenes DIR...")
    if what == "strangers":
        rows = strangers(out, folders, memory)
    elif what == "sequence":
        rows = sequence([load_recording(folder) for folder in folders], out, memory)
    elif what == "ablation":
        rows = ablation(out, [load_recording(folder) for folder in folders], memory)
    else:
        rows = {"mini": mini, "fixed": fixed, "badposes": bad_poses}[what](out, memory)
    print_rows(rows)
