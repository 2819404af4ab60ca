"""Halves of real hand-eye recordings with boards: how far their answers are apart."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import Row
from evercal.calibration.pose_pairs.pair_files import PairFiles, read_pairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.robot.mount import MountName

CHARUCO = (
    "charuco --size 5x7 --square-mm 36.195 --marker-mm 18.256 --dictionary 6X6_250"
)
RECORDINGS: dict[str, tuple[MountName, str]] = {
    "handeye/kuka_eye_in_hand": (
        "eye_in_hand",
        "chessboard --size 24x17 --square-mm 15",
    ),
    "handeye/franka_eye_in_hand": (
        "eye_in_hand",
        "chessboard --size 9x6 --square-mm 23.6",
    ),
    "handeye/franka_eye_to_hand": (
        "eye_to_hand",
        "apriltag --square-mm 48 --dictionary APRILTAG_36h11",
    ),
    "abb_fixed": ("eye_to_hand", CHARUCO),
}
"""Mount and board by folder."""
LENS = "607.593 0 323.463\n0 607.575 243.255\n0 0 1\n"
"""Intrinsics that are stated for the Franka's recordings."""


def boards(real: Path, out: Path) -> None:
    """Detect the board of each recording, once."""
    lens = out / "lens.txt"
    lens.write_text(LENS)
    for name, (_, board) in RECORDINGS.items():
        file = out / f"{Path(name).name}.json"
        words = [str(real / name), "--board", *board.split(), "--out", str(file)]
        if (real / name / "images").is_dir():
            words[0] += "/images"
        if "franka" in name:
            words += ["--camera", str(lens)]
        if not file.exists():
            detect = [sys.executable, "-m", "evercal", "detect", *words]
            subprocess.run(detect, check=True, capture_output=True)


def halves(real: Path, out: Path) -> Iterator[Row]:
    """Distances of the answers of two halves, with the corners and with board poses alone."""
    for name, (mount, _) in RECORDINGS.items():
        robot = real / name / "base_from_gripper.csv"
        pairs, corners = read_pairs(PairFiles(robot, out / f"{Path(name).name}.json"))
        n = len(pairs)
        cuts = {
            "first and second": (np.arange(n) < n // 2),
            "interleaved": np.arange(n) % 2 == 0,
        }
        for cut, half in cuts.items():
            for given in ("corners", "poses"):
                row: dict[str, Any] = {"recording": Path(name).name, "halves": cut}
                row |= {"given": given, "poses": n}
                try:
                    used = corners if given == "corners" else None
                    row |= _apart(pairs, used, mount, half)
                except InputError as error:
                    row["refused"] = str(error)[:80]
                yield row


def _apart(pairs: Any, corners: Any, mount: Any, half: np.ndarray) -> Row:
    answers = []
    for rows in (np.flatnonzero(half), np.flatnonzero(~half)):
        own = corners and replace(corners, views=tuple(corners.views[i] for i in rows))
        answers.append(solve(pairs[rows], mount, corners=own))
    one, other = answers
    apart = (other.parent_from_child.inverse() @ one.parent_from_child).log()
    shift = one.parent_from_child.translation_m - other.parent_from_child.translation_m
    off = np.concatenate([shift, apart[3:]])
    both = one.covariance + other.covariance
    return {
        "mm": float(1000 * np.linalg.norm(off[:3])),
        "deg": float(np.rad2deg(np.linalg.norm(off[3:]))),
        "sigma mm": one.sigma_mm,
        "sigma deg": one.sigma_deg,
        "d2": float(off @ np.linalg.solve(both, off)),
    }


def evidence(real: Path, out: Path) -> Iterator[Row]:
    """Evidence of each kind of errors that the poses share, alone and together."""
    from evercal.calibration.pose_pairs.noise_levels import evidence_of_shared
    from evercal.calibration.pose_pairs.solve import solve_pose_pairs
    from evercal.robot.pose_errors import ArmErrors, shared_errors

    for name, (mount, _) in RECORDINGS.items():
        robot = real / name / "base_from_gripper.csv"
        pairs, corners = read_pairs(PairFiles(robot, out / f"{Path(name).name}.json"))
        solved = solve_pose_pairs(pairs, mount, corners=corners)
        kinds = shared_errors(pairs.base_from_gripper, ArmErrors())
        row: Row = {
            "recording": Path(name).name,
            "poses": int(solved.fit.inliers.sum()),
        }
        for some in ("joint offsets", "smooth", "drift", ""):
            shared = {
                kind: errors.of_rows(solved.rows)
                for kind, errors in kinds.items()
                if kind.startswith(some)
            }
            equation = replace(solved.equation, shared=shared)[solved.fit.inliers]
            row[some or "all"] = evidence_of_shared(equation.system(solved.fit.at))
        yield row


if __name__ == "__main__":
    print(json.dumps(list(halves(Path(sys.argv[1]), Path(sys.argv[2])))))
