"""`evercal verify` on virtual cells: who is accused, who is caught, and how well errors are stated.

Geometry is direct, without images: touched points with a noise of the tip and of the picks, boards
with the noise of their corners, depths with an error of scale. A calibration states a covariance. A
good one errs by it. A bad one errs by 0.3 to 10 mm and 0.02 to 1 deg more.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.rows import Row, once, save
from evercal.calibration.calibration import Calibration
from evercal.calibration.evidence import Data, plus
from evercal.calibration.picked_points import PickedPoint
from evercal.calibration.unseen.targets import TargetView, target_data
from evercal.calibration.unseen.touched import Touches, touched_data
from evercal.geometry import SE3, UncertainPose, norms
from evercal.simulation.cell_room import WORK_AREA_M
from evercal.simulation.virtual_cell import VirtualCell

FIRST_SEED = 500
"""Seeds below it are for development."""
TOUCH_M = 3e-4
"""Noise of the tip per axis."""
PICK_PX = 0.7
"""Noise of a pick per axis."""
CORNER_PX = 0.1
"""Noise of a corner of the board per axis."""
ARM = (1e-4, np.deg2rad(0.02))
"""Noise of gripper poses per axis, metres and radians."""
DEPTH_SCALE = 1.01
"""Measured over true depth."""
TOOL_M = np.array([0.01, -0.02, 0.12])
"""Tip of the tool in the gripper."""
TILTS = np.array([[0.5, 0, 0], [0, 0.5, 0], [-0.4, -0.4, 0]])
"""Orientations in which the first point is touched again, radians."""
BOARD_M = np.stack(np.meshgrid(*2 * [np.linspace(-0.1, 0.1, 6)], [0.0]), -1).reshape(
    -1, 3
)
"""Corners of the board."""
BAD = 3.0
"""Errors of so many times the stated ones are bad."""


class Case(NamedTuple):
    """One kind of data."""

    kind: str
    number: int
    moves: bool
    """Whether the camera is on the gripper."""


CASES = [
    *(Case("points", n, moves) for moves in (False, True) for n in (1, 3, 5, 8)),
    *(Case("points, depth", n, False) for n in (1, 3)),
    *(Case("points, tool unknown", n, False) for n in (3,)),
    *(Case("board", n, moves) for moves in (False, True) for n in (2, 4, 6)),
    Case("board, known place", 1, False),
]


class Trial(NamedTuple):
    """A calibration and its true pose."""

    calibration: Calibration
    true: SE3
    cell: VirtualCell
    rng: np.random.Generator


def run(out: Path = Path("runs/verify"), draws: int = 200) -> None:
    """Verify good and bad calibrations of virtual cells.

    Args:
        out: Folder of the table.
        draws: Calibrations of each kind, half of them bad.
    """
    rows = []
    for case in CASES:
        seeds = range(FIRST_SEED, FIRST_SEED + draws)
        row = once(
            out / f"{case.kind}-{case.number}-{case.moves}.json",
            lambda c=case, s=seeds: _summary(c, [_tried(c, seed) for seed in s]),
        )
        rows.append(row)
    save(out / "verify.csv", rows, {"draws": draws})


def _tried(case: Case, seed: int) -> tuple[float, ...]:
    """Whether it is bad, the verdict, and true, measured, 95 % and stated errors, millimetres."""
    bad = seed % 2 == 1
    trial = _trial(seed, case.moves, bad)
    data = _board(case, trial) if "board" in case.kind else _points(case, trial)
    found = trial.calibration.verify(data)
    own = trial.calibration.parent_from_child
    off = norms(trial.true.apply(data.places) - own.apply(data.places))
    error = 1000 * np.sqrt((off**2).mean())
    verdict = ("honest", "cannot tell", "not as stated").index(found.verdict)
    return (bad, verdict, error, found.error_mm, found.error_95_mm, found.stated_mm)


def _trial(seed: int, moves: bool, bad: bool) -> Trial:
    rng = np.random.default_rng([seed, 71])
    cell = VirtualCell(seed % 40)
    true = cell.truth.gripper_from_camera if moves else cell.truth.base_from_tripod
    sizes = np.repeat(
        [rng.uniform(0.1, 1) * 1e-3, np.deg2rad(rng.uniform(0.01, 0.1))], 3
    )
    mixed = rng.normal(size=(6, 6)) * 0.4 + np.eye(6)
    covariance = sizes[:, None] * (mixed @ mixed.T) * sizes / 2
    error = rng.multivariate_normal(np.zeros(6), covariance)
    if bad:
        shift = np.exp(rng.uniform(*np.log([3e-4, 1e-2])))
        turn = np.deg2rad(np.exp(rng.uniform(*np.log([0.02, 1.0]))))
        away = rng.normal(size=(2, 3))
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        error = error + np.r_[shift * away[0], turn * away[1]]
    mount = "eye_in_hand" if moves else "eye_to_hand"
    stated = plus(true, -error)
    calibration = Calibration(mount, stated, covariance, camera=cell.intrinsics)
    return Trial(calibration, true, cell, rng)


def _noisy(trial: Trial, poses: SE3) -> SE3:
    """True poses (n,) of stated ones."""
    return poses @ SE3.exp(trial.rng.normal(size=(len(poses), 6)) * np.repeat(ARM, 3))


def _points(case: Case, trial: Trial) -> Data:
    rng = trial.rng
    camera = trial.cell.intrinsics
    names = [f"p{i}" for i in range(case.number)]
    area = np.array([0.15, 0.15, 0.05])
    poses = trial.cell.reachable_poses(4 * case.number, trial.cell.seed + 1)
    points = []
    stated = []
    while len(points) < case.number:
        point = WORK_AREA_M + rng.uniform(-1, 1, 3) * area
        pose = poses[rng.integers(len(poses))]
        view = pose @ trial.true if case.moves else trial.true
        pixel = camera.project(view.inverse().apply(point))
        if np.all(
            (pixel > 20) & (pixel < np.array([camera.width, camera.height]) - 20)
        ):
            points.append(point)
            stated.append(pose)
    points = np.stack(points)
    down = SE3.exp([0, 0, 0, np.pi, 0, 0])
    tool = TOOL_M + rng.normal(0, 2e-4, 3)
    touched = [*names]
    if "tool" in case.kind:
        touched += [f"{names[0]}#{i}" for i in (2, 3, 4)]
    turns = np.zeros((len(touched), 6))
    turns[:, 3:] = rng.uniform(-0.2, 0.2, (len(touched), 3))
    turns[case.number :, 3:] += TILTS[: len(touched) - case.number]
    rotated = down @ SE3.exp(turns)
    tips = np.r_[points, np.repeat(points[:1], len(touched) - len(names), 0)]
    tips = tips + rng.normal(0, TOUCH_M, tips.shape)
    gripper = SE3.from_translation(tips - rotated.apply(tool)) @ rotated
    known = None if "tool" in case.kind else TOOL_M
    touches = Touches(tuple(touched), gripper, known, TOUCH_M)
    grippers = {}
    picks = []
    for name, point, pose in zip(names, points, stated, strict=True):
        view = trial.true
        if case.moves:
            view = _noisy(trial, SE3.stack([pose]))[0] @ view
        place = view.inverse().apply(point)
        pixel = camera.project(place) + rng.normal(0, PICK_PX, 2)
        depth = np.nan
        if "depth" in case.kind:
            depth = DEPTH_SCALE * place[2] + rng.normal(0, 2e-3)
        grippers[name] = pose
        picks.append(PickedPoint(name, name, pixel, depth))
    return touched_data(trial.calibration, touches, picks, grippers, PICK_PX)


def _board(case: Case, trial: Trial) -> Data:
    from evercal.calibration.boards.corners import BoardView, board_pose

    rng = trial.rng
    cell = trial.cell
    count = case.number
    seed = trial.cell.seed + 1
    if case.moves:
        stated = cell.reachable_poses(count, seed)
    else:
        stated = cell.holding_poses(count, seed)
    grippers = _noisy(trial, stated)
    placed = SE3.from_translation(WORK_AREA_M) @ SE3.exp(
        [0, 0, 0, *rng.uniform(-0.2, 0.2, 3)]
    )
    if case.moves:
        targets = (grippers @ trial.true).inverse() @ placed
    elif "known" in case.kind:
        targets = SE3.stack([trial.true.inverse() @ placed])
    else:
        held = SE3.exp([0, 0, 0.1, *rng.uniform(-0.3, 0.3, 3)])
        targets = trial.true.inverse() @ grippers @ held
    views = {}
    for i, target in enumerate(targets):
        pixels = cell.intrinsics.project(target.apply(BOARD_M))
        view = BoardView(BOARD_M, pixels + rng.normal(0, CORNER_PX, pixels.shape))
        found = board_pose(view, cell.intrinsics, target)
        covariance = CORNER_PX**2 * found.unit_covariance
        pose = UncertainPose(found.camera_from_board, covariance)
        views[str(i)] = TargetView(pose, BOARD_M)
    known = placed if "known" in case.kind else None
    named = {str(i): pose for i, pose in enumerate(stated)}
    return target_data(trial.calibration, views, named, known)


def _summary(case: Case, found: Sequence[tuple[float, ...]]) -> Row:
    bad, verdict, true, measured, most, stated = np.transpose(found)
    good = bad == 0
    accused = verdict == 2
    times = true / stated
    clear = (bad == 1) & (times > BAD)
    far = (bad == 1) & (times > 2 * BAD)
    factor = np.quantile(np.abs(np.log(measured / true)), 0.9)
    return {
        "data": case.kind,
        "number": case.number,
        "camera": "gripper" if case.moves else "fixed",
        "good, accused %": float(100 * accused[good].mean()),
        "good, no answer %": float(100 * (verdict[good] == 1).mean()),
        f"above {BAD:g}x, caught %": float(100 * accused[clear].mean()),
        f"above {BAD:g}x, honest %": float(100 * (verdict[clear] == 0).mean()),
        f"above {2 * BAD:g}x, caught %": float(100 * accused[far].mean()),
        "factor at 90 %": float(np.exp(factor)),
        "below 95 % error %": float(100 * (true < most).mean()),
        "good": int(good.sum()),
        "bad": int(clear.sum()),
    }
