"""Mistakes in pose files and boards, made in simulated recordings, and clean recordings."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from tqdm import tqdm

from benchmarks.board_recordings import (
    BoardRecording,
    BoardSetting,
    board_points,
    corner_pairs,
    pose_pairs,
    project,
    record,
)
from benchmarks.hand_eye import Setting, shaken
from benchmarks.pose_mistakes import FLIP, MISTAKES, OTHER, misread, order_of
from benchmarks.rows import Row, once, save
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import CONVENTIONS
from evercal.robot.mount import MountName

FIRST_SEED = 700
"""Seeds below were used while the messages were written."""


class Case(NamedTuple):
    """What `solve` is given."""

    pairs: PosePairs
    mount: MountName
    right: tuple[SE3, ...]
    """Right answers: the pose of the camera, before and after it slipped; () for equal lists."""
    pattern: str
    """Of what names the mistake."""
    corners: BoardCorners | None = None


def drawn(
    seed: int, squares_m: tuple[float, ...], poses: int | None = None
) -> BoardRecording:
    """Draw a recording of small or large motions before a small or large board."""
    rng = np.random.default_rng([seed, 1])
    tilt = 35 * rng.choice((0.25, 0.5, 1.0, 1.6))
    square = float(rng.choice(squares_m))
    views = poses or int(rng.integers(12, 30))
    mount: MountName = ("eye_in_hand", "eye_to_hand")[seed // 2 % 2]
    return record(
        BoardSetting(mount=mount, views=views, tilt_deg=tilt, square_m=square), seed
    )


def _misread(name: str, seed: int) -> Case:
    made = drawn(seed, SMALL)
    mistake, pattern = MISTAKES[name]
    mount = OTHER[made.setting.mount] if name == "other mount" else made.setting.mount
    return Case(
        mistake(pose_pairs(made, seed)), mount, (made.parent_from_camera,), pattern
    )


def _order(side: str, seed: int) -> Case:
    rng = np.random.default_rng([seed, 2])
    made = drawn(seed, SMALL)
    written = f"{ORDERS[seed % len(ORDERS)]}:mm:deg"
    others = [
        r
        for r in ("kuka", "yaskawa", "staubli", "ur:mm:deg")
        if order_of(r) != order_of(written)
    ]
    mistake, pattern = misread(side, written, str(rng.choice(others)))
    pairs = mistake(pose_pairs(made, seed))
    return Case(pairs, made.setting.mount, (made.parent_from_camera,), pattern)


def _shifted(seed: int) -> Case:
    rng = np.random.default_rng([seed, 3])
    made = drawn(seed, SMALL)
    rows = np.arange(len(made.views))
    rows = np.minimum(rows + (rows >= rng.integers(1, len(rows) - 2)), len(rows) - 1)
    pairs, corners = _pairs(made, seed)
    if corners is not None or seed % 4 == 1:
        pairs = replace(pairs, base_from_gripper=pairs.base_from_gripper[rows])
    else:
        pairs = replace(pairs, camera_from_board=pairs.camera_from_board[rows])
    right = (made.parent_from_camera,)
    return Case(pairs, made.setting.mount, right, "shifted by one", corners)


def _one_list(seed: int) -> Case:
    rng = np.random.default_rng([seed, 4])
    made = drawn(seed, SMALL)
    pairs = pose_pairs(made, seed)
    listed = pairs.camera_from_board if seed % 2 else pairs.camera_from_board.inverse()
    listed = (listed, FLIP @ listed, listed @ FLIP)[rng.integers(3)]
    noise = Setting(noise_mm=rng.uniform(0, 2), noise_deg=rng.uniform(0, 0.2))
    robot = shaken(listed, noise, rng)
    unit = float(rng.choice([0.001, 1.0, 1000.0]))
    robot = SE3(robot.rotation_wxyz, unit * robot.translation_m)
    return Case(
        replace(pairs, base_from_gripper=robot), made.setting.mount, (), "one list"
    )


def _pan_tilt(seed: int) -> Case:
    """Turn the gripper on the spot by up to 15 degrees; the board stays in view."""
    rng = np.random.default_rng([seed, 5])
    made = drawn(seed, SMALL)
    x = made.parent_from_camera
    first = made.camera_from_board[0]
    poses = list[SE3]()
    fixed = list[SE3]()
    while len(poses) < len(made.views):
        turned = x @ SE3.exp(np.r_[0, 0, 0, np.deg2rad(rng.uniform(-15, 15, 2)), 0])
        parent = SE3((turned @ x.inverse()).rotation_wxyz, np.zeros(3))
        seen = (parent @ x).inverse() @ x @ first
        pixels = project(board_points(made.setting), seen, made.camera)
        if ((pixels > 8) & (pixels < (632, 472))).all():
            poses = [*poses, seen]
            fixed = [*fixed, parent]
    made = seen_from(made, SE3.stack(poses))
    robot = (
        SE3.stack(fixed)
        if made.setting.mount == "eye_in_hand"
        else SE3.stack(fixed).inverse()
    )
    pairs, corners = _pairs(replace(made, base_from_gripper=robot), seed)
    return Case(pairs, made.setting.mount, (x,), "", corners)


def seen_from(made: BoardRecording, camera_from_board: SE3) -> BoardRecording:
    """Move the board in the images; their noise stays."""
    moved = zip(made.views, made.camera_from_board, camera_from_board, strict=True)
    views = tuple(
        replace(
            view, pixels=view.pixels + _seen(view, new, made) - _seen(view, old, made)
        )
        for view, old, new in moved
    )
    return replace(made, views=views, camera_from_board=camera_from_board)


def _seen(view: BoardView, pose: SE3, made: BoardRecording) -> np.ndarray:
    return project(view.points_m, pose, made.camera)


def _slipped(what: str, squares_m: tuple[float, ...], seed: int) -> Case:
    """Move the camera or the board by 1 to 10 mm and up to 1 degree before a row."""
    rng = np.random.default_rng([seed, 6])
    made = drawn(seed, squares_m)
    row = int(rng.integers(1, len(made.views)))
    poses = made.camera_from_board
    axes = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    size = rng.uniform(1e-3, 1e-2), np.deg2rad(rng.uniform(0, 1))
    slip = SE3.exp(np.concatenate([s * a for s, a in zip(size, axes, strict=True)]))
    moved = slip.inverse() @ poses if what == "camera" else poses @ slip
    made = seen_from(made, SE3.stack([*poses][:row] + [*moved][row:]))
    pairs, corners = _pairs(made, seed)
    x = made.parent_from_camera
    pattern = rf"the ({what}|camera or board) looks moved .* before {pairs.names[row]},"
    alone = [0] if row == 1 else [row] if row == len(poses) - 1 else []
    if alone:  # an outlier
        pattern += f"|left out: {pairs.names[alone[0]]};"
    return Case(
        pairs,
        made.setting.mount,
        (x, x @ slip if what == "camera" else x),
        pattern,
        corners,
    )


def _wrong_corners(count: int, seed: int) -> Case:
    """Move corners of one or two images by 1.5 to 20 pixels."""
    rng = np.random.default_rng([seed, 7])
    made = drawn(seed, SMALL)
    views = list(made.views)
    wrong = set[tuple[int, int]]()
    while len(wrong) < count:
        wrong.add((int(rng.integers(len(views))), int(rng.integers(54))))
    for image, corner in wrong:
        way = rng.normal(size=2)
        pixels = views[image].pixels.copy()
        pixels[corner] += (
            np.exp(rng.uniform(np.log(1.5), np.log(20))) * way / np.linalg.norm(way)
        )
        views[image] = replace(views[image], pixels=pixels)
    pairs, corners = corner_pairs(replace(made, views=tuple(views)))
    names = [
        f"{i}.png {x:.0f} {y:.0f}"
        for i, k in sorted(wrong)
        for x, y in [views[i].pixels[k]]
    ]
    pattern = f"corners: {re.escape(', '.join(names))};"
    return Case(pairs, made.setting.mount, (made.parent_from_camera,), pattern, corners)


def _clean(what: str, seed: int) -> Case:
    rng = np.random.default_rng([seed, 8])
    made = drawn(seed, ANY)
    pairs, corners = _pairs(made, seed, what == "corners")
    for side in ("robot", "camera") if what == "tables" else ():
        name = str(
            rng.choice(["wxyz", "xyzw", "rpy", "ur", "kuka", "staubli", "matrix"])
        )
        pairs = misread(side, name, name)[0](pairs)
    return Case(pairs, made.setting.mount, (made.parent_from_camera,), NOTHING, corners)


def _pairs(
    made: BoardRecording, seed: int, with_corners: bool | None = None
) -> tuple[PosePairs, BoardCorners | None]:
    if seed % 2 if with_corners is None else with_corners:
        return corner_pairs(made)
    return pose_pairs(made, seed), None


NOTHING = "^left out: .*; corners: ; $"
"""Messages about a clean recording."""
LIMIT = float(chi2.ppf(0.99, 6))
SMALL = (0.02, 0.025, 0.05)
ANY = (0.02, 0.025, 0.05, 0.1, 0.2, 0.25)
ORDERS = [name for name in CONVENTIONS if name.startswith(("fixed_", "moving_"))]
KINDS: dict[str, Callable[[int], Case]] = {
    **{name: partial(_misread, name) for name in MISTAKES},
    "any order of the robot's angles": partial(_order, "robot"),
    "any order of the camera's angles": partial(_order, "camera"),
    "rows shifted from any on": _shifted,
    "one list in both files": _one_list,
    "camera slipped": partial(_slipped, "camera", SMALL),
    "board slipped": partial(_slipped, "board", SMALL),
    "camera slipped, any board": partial(_slipped, "camera", ANY),
    "board slipped, any board": partial(_slipped, "board", ANY),
    "one wrong corner": partial(_wrong_corners, 1),
    "two wrong corners": partial(_wrong_corners, 2),
    "none, pan-tilt head": _pan_tilt,
    "none, corners": partial(_clean, "corners"),
    "none, poses": partial(_clean, "poses"),
    "none, tables": partial(_clean, "tables"),
}
"""Mistakes by name, drawn by a seed; half of the recordings have corners where both may."""


def measure(name: str, draws: int) -> Row:
    """Make one mistake in many recordings."""
    counts = dict.fromkeys(("refused", "warned", "named", "safe"), 0)
    messages = list[str]()
    for seed in range(FIRST_SEED, FIRST_SEED + draws):
        case = KINDS[name](seed)
        try:
            answer = solve(case.pairs, case.mount, corners=case.corners)
        except InputError as error:
            text = str(error)
            safe = True
            counts["refused"] += 1
        else:
            checks = answer.checks.to_dict()
            left_out = [i.name for i in answer.images if not i.used]
            notes = [*checks["warnings"], f"left out: {', '.join(left_out)}"]
            notes += [f"corners: {', '.join(checks.get('corners_left_out', ()))}"]
            text = "; ".join([*notes, ""])
            counts["warned"] += bool(
                checks["warnings"] or checks.get("corners_left_out")
            )
            distances = [
                answer.uncertain_pose.squared_mahalanobis(x) for x in case.right
            ]
            safe = min(distances, default=np.inf) < LIMIT
        named = bool(re.search(case.pattern, text))
        counts["named"] += named
        counts["safe"] += safe
        if not (named and safe):
            messages.append(f"{seed}: {text}" if safe else f"{seed} WRONG: {text}")
    percent = {key: 100 * value / draws for key, value in counts.items()}
    return {
        "mistake": name,
        "draws": draws,
        **percent,
        "otherwise": "\n".join(messages),
    }


def origins(draws: int) -> Row:
    """Renumber the corners from each end of the board; return the largest change of the answer."""
    largest = 0.0
    spread = 0.0
    for seed in range(FIRST_SEED, FIRST_SEED + draws):
        drawn = record(BoardSetting(), seed)
        pairs, corners = corner_pairs(drawn)
        base = solve(pairs, "eye_in_hand", corners=corners)
        sigma = np.sqrt(np.diag(base.covariance))
        points = drawn.views[0].points_m
        for corner in (8, 45, 53):  # the other ends of 9x6 corners
            moved = tuple(
                replace(v, points_m=v.points_m - points[corner]) for v in corners.views
            )
            shift = SE3.from_translation(points[corner])
            poses = replace(pairs, camera_from_board=pairs.camera_from_board @ shift)
            other = solve(poses, "eye_in_hand", corners=replace(corners, views=moved))
            change = (base.parent_from_child.inverse() @ other.parent_from_child).log()
            largest = max(largest, float((np.abs(change) / sigma).max()))
            ratio = np.sqrt(np.diag(other.covariance)) / sigma
            spread = max(spread, float(np.abs(ratio - 1).max()))
    return {
        "draws": draws,
        "largest_change_sigma": largest,
        "largest_change_of_sigma": spread,
    }


def run(
    draws: int = 100, clean: int = 1000, out: Path = Path("runs/mistakes.csv")
) -> None:
    """Mistakes in pose files and boards, recordings without mistakes, other origins of the board.

    `named`: the message, a warning or the list of what is left out names the mistake. `safe`:
    refused, or inside the 99 % ellipsoid. Kinds that were measured are read from OUT/.

    Args:
        draws: Recordings of each mistake.
        clean: Recordings without a mistake, a third each with corners, poses and pose tables.
        out: File of the rows.
    """
    settings: dict[str, object] = {"draws": draws, "clean": clean}
    rows: list[Row] = []
    for name in tqdm(KINDS, unit="kind"):
        count = clean // 3 + 1 if name.startswith("none") else draws
        path = out.with_suffix("") / f"{name.replace('/', ' ')}.json"
        rows.append(once(path, partial(measure, name, count)))
    settings |= origins(20)
    save(out, rows, settings)
    print(settings)
