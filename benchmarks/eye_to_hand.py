"""A fixed camera, and a textured thing in the gripper: errors, ellipsoids, refusals.

Recordings are rendered on demand by `rooms.held`. Every answer is one JSON line in OUT/rows.jsonl
and is not repeated.
"""

import itertools
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.accuracy import pose_error, wrong
from benchmarks.arm_noise import grippers
from benchmarks.hand_eye import pose
from benchmarks.rows import Row, grouped, median_of, numbers, save
from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.map import Map
from evercal.recordings import load_recording
from evercal.storage import write_json
from rooms.held import FAULTS, Setting, render, write_poses
from rooms.things import SQUARES

FIRST_SEED = 205
"""Seeds below it are for development."""
ARM = (0.1, 0.02)
"""Standard deviation of the stated gripper poses per axis, millimetres and degrees."""
CLOSED = "closed form"
"""OpenCV's detection of a board and closed-form solvers."""
SOLVED = "evercal solve"
"""`evercal detect` of a board and `evercal solve`."""
HELD = "eye_to_hand"
"""`Map.eye_to_hand`, with any thing in the gripper."""


@dataclass(frozen=True)
class Condition:
    """Recordings of ten seeds, and what is done to them before they are solved."""

    scene: dict[str, object] = field(default_factory=dict)
    """Fields of `rooms.held.Setting`."""
    images: int = 25
    """The first ones of the recording are used."""
    arm: tuple[float, float] = ARM
    spoiled: str = ""
    """other, shuffled: gripper poses; focal: stated 5 % too long; lens: intrinsics with errors of
    0.1 % and 0.25 px, as from a board."""

    def setting(self, seed: int) -> Setting:
        """The recording of a seed; recordings are rendered once, with their largest length."""
        return Setting(seed, **{"images": 25, **self.scene})  # pyright: ignore[reportArgumentType]


SMALL: dict[str, object] = {"size": (320, 240), "px": 100, "images": 20}
THINGS = ("box", "bottle", "book", "tool")
MAIN = {
    "box": Condition(),
    **{thing: Condition({"thing": thing}) for thing in THINGS[1:]},
    "board": Condition({"thing": "board"}),
    **{f"box, {n} images": Condition(images=n) for n in (8, 15)},
    "box, arm 0.5 mm 0.1 deg": Condition(arm=(0.5, 0.1)),
    "box, arm 2 mm 0.5 deg": Condition(arm=(2.0, 0.5)),
    "board, arm 0.5 mm 0.1 deg": Condition({"thing": "board"}, arm=(0.5, 0.1)),
    "board, arm 2 mm 0.5 deg": Condition({"thing": "board"}, arm=(2.0, 0.5)),
    "box, hobby arm 5 mm 2 deg": Condition(arm=(5.0, 2.0)),
    "box, intrinsics from a board": Condition(spoiled="lens"),
    "box, poses of another recording": Condition(spoiled="other"),
    "box, poses shuffled": Condition(spoiled="shuffled"),
    "box, focal length 5 % wrong": Condition(spoiled="focal"),
    **{f"box, {px} px": Condition({"px": px}) for px in (60, 100, 300)},
    "box, 40 images": Condition({"images": 40}, 40),
    "box, 1280x720": Condition({"size": (1280, 720)}),
    **{
        f"board, {px} px": Condition({"thing": "board", "px": px})
        for px in (60, 100, 300)
    },
}
FAILING = {
    f"small images, {fault or 'nothing wrong'}": Condition(
        {**SMALL, "fault": fault}, 20
    )
    for fault in ("", *FAULTS)
}
CONDITIONS = {**MAIN, **FAILING}


def run(
    data: Path = Path("runs/held"),
    out: Path = Path("runs/eye-to-hand"),
    only: tuple[str, ...] = (),
    draws: int = 10,
    methods: tuple[str, ...] = (CLOSED, SOLVED, HELD),
    render_only: bool = False,
) -> None:
    """Calibrate fixed cameras from a thing in the gripper, beside a board in the gripper.

    Args:
        data: Folder of the rendered recordings; missing ones are rendered.
        out: Folder of the rows.
        only: Conditions; all if omitted.
        draws: Recordings of each condition.
        methods: Which of closed form, evercal solve and eye_to_hand.
        render_only: Whether the recordings are rendered and nothing is solved.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / "rows.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    rows: list[Row] = [json.loads(line) for line in lines]
    done = {(row["condition"], row["seed"], row["method"]) for row in rows}
    for name in tqdm(only or CONDITIONS, unit="condition"):
        condition = CONDITIONS[name]
        for setting in itertools.islice(_rendered(condition, data), draws):
            seed = setting.seed
            for method in methods:
                if render_only or (name, seed, method) in done:
                    continue
                if method != HELD and setting.thing != "board":
                    continue
                row: Row = {"condition": name, "seed": seed, "method": method}
                row |= measured(method, condition, data, setting)
                rows.append(row)
                with file.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
    if rows:
        save(out / "eye-to-hand.csv", summary(rows))


def _rendered(condition: Condition, data: Path) -> Iterator[Setting]:
    """Settings of the seeds whose room has a place for such a camera, rendered."""
    for seed in itertools.count(FIRST_SEED):
        setting = condition.setting(seed)
        try:
            for _ in tqdm(
                render(setting, data), setting.name, leave=False, unit="image"
            ):
                pass
        except InputError as error:
            tqdm.write(str(error))
            continue
        yield setting


def measured(method: str, condition: Condition, data: Path, setting: Setting) -> Row:
    """Error of one method in one recording, or its refusal."""
    truth = json.loads((data / setting.name / "truth.json").read_text())
    # A camera that is bumped half way has two true poses.
    true_cameras = _poses(truth["base_from_camera"])[[0, condition.images - 1]]
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / setting.name
        _spoil(recording, condition, data, setting)
        began = time.process_time()
        try:
            if method == HELD:
                cell = Map.open(Path(folder) / "thing")
                answer = cell.eye_to_hand(
                    load_recording(recording), name="thing", on_progress=lambda *_: None
                )
            else:
                answer = _from_board(method, recording, float(truth["scale"]))
        except InputError as error:
            return {"refused": str(error), "seconds": time.process_time() - began}
    seconds = time.process_time() - began
    if isinstance(answer, SE3):
        mm, deg = pose_distance_mm_deg(answer, true_cameras[0])
        return {"seconds": seconds, "Shah_mm": mm, "Shah_deg": deg}
    # The truth is for the stated intrinsics.
    pose = answer.for_program().uncertain_pose
    errors = [pose_error(pose, true_camera) for true_camera in true_cameras]
    nearest = min(errors, key=lambda error: float(error["mm"]))
    return {**nearest, "verdict": answer.verdict, "seconds": seconds}


def _spoil(recording: Path, condition: Condition, data: Path, setting: Setting) -> None:
    """Write the recording that a condition makes of a rendered one."""
    source = data / setting.name
    n = condition.images
    truth = json.loads((source / "truth.json").read_text())
    rng = np.random.default_rng([setting.seed, 31])
    recording.mkdir()
    for i in range(n):
        image = source / "recording" / f"{i:03d}.png"
        (recording / image.name).symlink_to(image.absolute())
    camera = json.loads((source / "recording" / "camera.json").read_text())
    if condition.spoiled == "focal":
        camera |= {"fx": 1.05 * camera["fx"], "fy": 1.05 * camera["fy"]}
    if condition.spoiled == "lens":
        focal = 1 + 1e-3 * rng.normal()
        centre = 0.25 * rng.normal(size=2)
        camera |= {"fx": focal * camera["fx"], "fy": focal * camera["fy"]}
        camera |= {"cx": camera["cx"] + centre[0], "cy": camera["cy"] + centre[1]}
    write_json(recording / "camera.json", camera)
    if condition.spoiled == "other":
        others = sorted(
            data.glob(setting.name.removesuffix(str(setting.seed)) + "*/truth.json")
        )
        other = others[(others.index(source / "truth.json") + 1) % len(others)]
        truth = json.loads(other.read_text())
    poses = _poses(truth["base_from_gripper"])[:n]
    if condition.spoiled == "shuffled":
        poses = poses[rng.permutation(n)]
    sigma = np.repeat([condition.arm[0] / 1000, np.deg2rad(condition.arm[1])], 3)
    write_poses(recording, poses @ SE3.exp(rng.normal(0, sigma, (n, 6))))


def _poses(rows: Sequence[Mapping[str, Any]]) -> SE3:
    return SE3.stack(
        [SE3(row["quaternion_wxyz"], row["translation_m"]) for row in rows]
    )


def _from_board(method: str, recording: Path, scale: float) -> Calibration | SE3:
    """`evercal detect` and `solve`, or OpenCV's detection, solvePnP and the closed form of Shah."""
    board = replace(
        SQUARES, size_m=SQUARES.size_m * scale, marker_m=SQUARES.marker_m * scale
    )
    loaded = load_recording(recording)
    names = [frame.name for frame in loaded.train]
    robot = grippers(loaded)
    camera = loaded.train[0].camera
    images = [frame.read_image() for frame in loaded.train]
    found: list[tuple[int, SE3, BoardView | None]] = []
    if method == SOLVED:
        views = [find_board(image, board) for image in images]
        fits = board_poses(board, camera, dict(zip(names, views, strict=True))).images
        for i, fit in enumerate(fits):
            found += (
                []
                if fit.camera_from_board is None
                else [(i, fit.camera_from_board, fit.view)]
            )
    else:
        for i, image in enumerate(images):
            seen = _opencv_board(image, board, camera)
            found += [] if seen is None else [(i, seen, None)]
    if len(found) < 3:
        raise InputError(
            f"the board is detected in {len(found)} of {len(images)} images"
        )
    rows = [i for i, _, _ in found]
    poses = SE3.stack([camera_from_board for _, camera_from_board, _ in found])
    pairs = PosePairs(tuple(names[i] for i in rows), robot[rows], poses)
    if method == CLOSED:
        return shah(pairs)
    corners = BoardCorners(
        camera, tuple(v for _, _, v in found if v is not None), stated=True
    )
    return solve(pairs, "eye_to_hand", corners=corners)


def _opencv_board(image: np.ndarray, board: Board, camera: Camera) -> SE3 | None:
    """camera_from_board by the detector and the iterative solvePnP of OpenCV."""
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.size_m, board.marker_m, dictionary_of(board)
    )
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(printed).detectBoard(grey)
    if ids is None or len(ids) < 6:
        return None
    points = np.asarray(printed.getChessboardCorners(), float)[
        np.ravel(ids).astype(int)
    ]
    if np.linalg.matrix_rank(points - points.mean(0), tol=0.5 * board.size_m) < 2:
        return None
    ok, rotvec, shift = cv2.solvePnP(
        points, np.reshape(pixels, (-1, 1, 2)), camera.matrix(), None
    )
    return pose(Rotation.from_rotvec(rotvec.ravel()), shift.ravel()) if ok else None


def shah(pairs: PosePairs) -> SE3:
    """base_from_camera X with G Y = X B, by Shah (ASME J. Mechanisms and Robotics 2013)."""
    robot = pairs.base_from_gripper
    board = pairs.camera_from_board
    turned = robot.rotation_matrix()
    products = [
        np.kron(b, g) for g, b in zip(turned, board.rotation_matrix(), strict=True)
    ]
    left, _, _ = np.linalg.svd(np.sum(products, 0))
    raw = left[:, 0].reshape(3, 3).T
    u, _, vt = np.linalg.svd(raw * np.sign(np.linalg.det(raw)))
    moved = board.translation_m @ (u @ vt).T - robot.translation_m
    matrix = np.concatenate(
        [turned, -np.broadcast_to(np.eye(3), turned.shape)], 2
    ).reshape(-1, 6)
    shifts = np.linalg.lstsq(matrix, moved.ravel(), rcond=None)[0]
    return pose(Rotation.from_matrix(u @ vt), shifts[3:])


def summary(rows: Sequence[Row]) -> list[Row]:
    """One row for each condition and method; `wrong`: over 10 mm and over five sigma."""
    groups = grouped(rows, "condition", "method")
    return [_summary(name, method, group) for (name, method), group in groups.items()]


def _summary(name: str, method: str, group: list[Row]) -> Row:
    condition = CONDITIONS[name]
    setting = condition.setting(FIRST_SEED)
    answers = [row for row in group if "refused" not in row]

    row: Row = {
        "condition": name,
        "method": method,
        "thing": setting.thing,
        "px": setting.px,
    }
    row |= {"size": "x".join(map(str, setting.size)), "images": condition.images}
    row |= {"draws": len(group), "refused": len(group) - len(answers)}
    if not answers:
        return row
    prefix = "Shah_" if method == CLOSED else ""
    for unit in ("mm", "deg"):
        errors = numbers(answers, prefix + unit)
        row |= {unit: median_of(errors), f"{unit}_90": float(np.quantile(errors, 0.9))}
    if prefix:
        return row | {"solver": "Shah"}
    squared = numbers(answers, "squared_mahalanobis")
    row |= {
        f"sigma_{unit}": median_of(numbers(answers, f"sigma_{unit}"))
        for unit in ("mm", "deg")
    }
    row |= {
        "inside_95": share_inside(squared),
        "squared_mahalanobis": float(squared.mean()),
    }
    row["wrong"] = int(wrong(numbers(answers, "mm"), squared).sum())
    return row | {"seconds": median_of(numbers(answers, "seconds"))}
