"""How well cameras are calibrated from images: on the arm from nothing, fixed, and after bumps."""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tabulate import tabulate
from tqdm import tqdm

from evercal.calibration.calibration import Calibration
from evercal.calibration.drift import check
from evercal.calibration.from_images import Images, calibrate
from evercal.continual.learn_scene import LearnOptions, learn_scene
from evercal.continual.presets import preset
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, pose_distance, squared_mahalanobis
from evercal.localization.localizer import Localizer
from evercal.recordings import Recording, load_recording
from evercal.recordings.samples import FOLDER

ROBOT_NOISE_M, ROBOT_NOISE_DEG = 2e-4, 0.02


def run(what: str, rooms: Sequence[Path], out: Path, draws: int, store: Path | None) -> None:
    """Runs one measurement, prints its table, and writes it as JSON lines.

    Args:
        what: wrist, fixed or bump.
        rooms: folders of recorded rooms; the packaged ones when empty.
        out: folder for stores and results; a wrist draw that is there already is not repeated.
        draws: random `gripper_from_camera`, images or bumps of each room.
        store: a store that knows the rooms; one is learned when left out.
    """
    out.mkdir(parents=True, exist_ok=True)
    rooms = rooms or [FOLDER / name for name in ("bedroom", "kitchen", "living")]
    if what == "wrist":
        rows = wrist(rooms, out, draws)
    else:
        path = store or _learned(rooms, out / "rooms.evercal")
        rows = (fixed if what == "fixed" else bumps)(rooms, path, draws)
    (out / f"{what}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    print(tabulate([_short(row) for row in rows], headers="keys", floatfmt=".3f"))
    _summary(rows)


def wrist(rooms: Sequence[Path], out: Path, draws: int) -> list[dict[str, object]]:
    """Training frames of a room seen as a wrist recording through a random hand-eye transform."""
    rows = []
    for room in rooms:
        scene = load_recording(room)
        for draw in tqdm(range(draws), room.name, unit="draw"):
            done = out / f"wrist-{room.name}-{draw}.json"
            if not done.exists():
                store = out / f"wrist-{room.name}-{draw}.evercal"
                done.write_text(json.dumps(_wrist_draw(scene, room, store, draw)))
            rows.append(json.loads(done.read_text()))
    return rows


def as_wrist_recording(scene: Recording, draw: int) -> tuple[Recording, SE3]:
    """A recording that states gripper poses only, and the true `gripper_from_camera`."""
    rng = np.random.default_rng(draw)
    turn = Rotation.random(rng=rng).as_quat(canonical=True, scalar_first=True)
    truth = SE3(turn, rng.uniform(-0.1, 0.1, 3))
    size = np.repeat([ROBOT_NOISE_M, np.deg2rad(ROBOT_NOISE_DEG)], 3)
    train = []
    for frame in scene.train:
        assert frame.base_from_camera is not None
        noise = SE3.exp(rng.normal(0, size))
        gripper = frame.base_from_camera @ truth.inverse() @ noise
        train.append(replace(frame, base_from_camera=None, base_from_gripper=gripper))
    return replace(scene, train=tuple(train), test=()), truth


def _wrist_draw(scene: Recording, room: Path, store: Path, draw: int) -> dict[str, object]:
    recording, truth = as_wrist_recording(scene, draw)
    began = time.perf_counter()
    report = learn_scene(store, recording, LearnOptions(preset("fast")))
    seconds, found = time.perf_counter() - began, report.hand_eye
    assert found is not None
    row = _error(found.gripper_from_camera, np.array(found.covariance), truth)
    row |= {"start_mm": found.start_mm, "seconds": seconds}
    folder = room / "calibration" / "fixed"
    if folder.is_dir():
        images, true_camera = _images(folder)
        answer = calibrate(Localizer.open(store), images)
        error = _error(answer.parent_from_child, answer.covariance, true_camera)
        row |= {f"fixed_{key}": value for key, value in error.items()}
    return {"room": room.name, "draw": draw, **row}


def fixed(rooms: Sequence[Path], store: Path, draws: int) -> list[dict[str, object]]:
    """A fixed camera of each room: all images, and random five of them."""
    localizer, rows = Localizer.open(store), []
    for room in tqdm(rooms, "rooms"):
        for recording in ("fixed", "bumped"):
            images, truth = _images(room / "calibration" / recording)
            rng = np.random.default_rng(0)
            for draw in range(draws + 1):
                given = images if draw == 0 else _some(images, 5, rng)
                answer = calibrate(localizer, given)
                error = _error(answer.parent_from_child, answer.covariance, truth)
                count = len(given.images)
                rows.append({"room": room.name, "camera": recording, "images": count, **error})
    return rows


def bumps(rooms: Sequence[Path], store: Path, draws: int) -> list[dict[str, object]]:
    """Five images of a camera against its reference from all others that it took.

    Bumps come from moving the reference instead of the camera: a reference that states a pose 2 mm
    or 0.1 deg off is what a camera looks like that was moved by as much. False alarms come from
    five images of the unmoved camera that the reference never saw.
    """
    localizer, rows = Localizer.open(store), []
    for room in tqdm(rooms, "rooms"):
        for recording in ("fixed", "bumped"):
            images, _ = _images(room / "calibration" / recording)
            rng = np.random.default_rng(1)
            for _ in range(draws):
                order = rng.permutation(len(images.images)).tolist()
                five, rest = order[:5], order[5:]
                reference = calibrate(localizer, _take(images, rest))
                for kind, moved in _moves(reference, rng).items():
                    shift, _ = check(localizer, [images.images[i] for i in five], moved)
                    rows.append(
                        {
                            "room": room.name,
                            "camera": recording,
                            "kind": kind,
                            "moved": shift.moved,
                            "mm": shift.translation_mm,
                            "deg": shift.rotation_deg,
                            "confidence": shift.confidence,
                        }
                    )
    return rows


def _moves(reference: Calibration, rng: np.random.Generator) -> dict[str, Calibration]:
    """The reference as it is, and moved by 2 mm, by 0.1 deg and by both, in random directions."""
    kinds = {"none": (0.0, 0.0), "2 mm": (2e-3, 0.0), "0.1 deg": (0.0, 0.1), "both": (2e-3, 0.1)}
    found = {}
    for kind, (metres, degrees) in kinds.items():
        shift, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        small = SE3.exp(np.r_[np.zeros(3), np.deg2rad(degrees) * turn])
        pose = reference.parent_from_child @ small
        pose = SE3(pose.rotation_wxyz, pose.translation_m + metres * shift)
        found[kind] = replace(reference, parent_from_child=pose)
    return found


def _learned(rooms: Sequence[Path], store: Path) -> Path:
    if not store.exists():
        for room in tqdm(rooms, "learning"):
            learn_scene(store, load_recording(room), LearnOptions(preset("fast")))
    return store


def _images(folder: Path) -> tuple[Images, SE3]:
    scene = load_recording(folder)
    truth = scene.test[0].base_from_camera
    if truth is None:
        raise InputError(f"{folder}: states no camera pose to compare with")
    images = [(frame.name, frame.read_image()) for frame in scene.test]
    return Images(images, scene.test[0].camera), truth


def _take(images: Images, which: Sequence[int]) -> Images:
    return replace(images, images=[images.images[i] for i in which])


def _some(images: Images, count: int, rng: np.random.Generator) -> Images:
    return _take(images, rng.choice(len(images.images), count, replace=False).tolist())


def _error(found: SE3, covariance: np.ndarray, truth: SE3) -> dict[str, object]:
    metres, radians = pose_distance(found, truth)
    return {
        "mm": 1000 * float(metres),
        "deg": float(np.rad2deg(radians)),
        "sigma_mm": 1000 * float(np.sqrt(np.trace(covariance[:3, :3]) / 3)),
        "sigma_deg": float(np.rad2deg(np.sqrt(np.trace(covariance[3:, 3:]) / 3))),
        "squared_mahalanobis": squared_mahalanobis(found, covariance, truth),
    }


def _short(row: dict[str, object]) -> dict[str, object]:
    return {key.replace("squared_mahalanobis", "m2"): value for key, value in row.items()}


def _summary(rows: Sequence[dict[str, object]]) -> None:
    """Medians, worst cases and ellipsoids by the number of images; of bumps the rates."""
    if "kind" in rows[0]:
        for kind in dict.fromkeys(row["kind"] for row in rows):
            of_kind = [row for row in rows if row["kind"] == kind]
            rate = 100 * np.mean([bool(row["moved"]) for row in of_kind])
            print(f"{kind}: moved in {rate:.1f} % of {len(of_kind)} trials")
        return
    for count in dict.fromkeys(row.get("images") for row in rows):
        some = [row for row in rows if row.get("images") == count]
        title = "camera" if count is None else f"camera, {count} images"
        _print_errors(title, "", some)
        if "fixed_mm" in some[0]:
            _print_errors("fixed camera in that map", "fixed_", some)


def _print_errors(title: str, prefix: str, rows: Sequence[dict[str, object]]) -> None:
    mm, deg, m2 = (
        np.array([float(str(row[f"{prefix}{key}"])) for row in rows])
        for key in ("mm", "deg", "squared_mahalanobis")
    )
    print(
        f"{title}: {len(mm)} trials, median {np.median(mm):.2f} mm and {np.median(deg):.3f} deg,"
        f" worst {mm.max():.2f} mm and {deg.max():.3f} deg, {share_inside(m2):.1f} % inside the"
        f" 95 % ellipsoid"
    )
