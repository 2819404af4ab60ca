"""Answers of `solve` to many recordings of pose pairs, by this tree or the source of a commit."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3

Recording = Mapping[str, Any]
"""`robot` and `camera`, (n, 4, 4) stated poses; `mount`; `truth`, (4, 4) parent_from_camera."""


def answers(
    recordings: Sequence[Recording], options: Mapping[str, Any]
) -> list[dict[str, float | str]]:
    """Errors and stated uncertainty of each answer; `options` are those of `solve`."""
    rows: list[dict[str, float | str]] = []
    for recording in recordings:
        robot = SE3.from_matrix(np.array(recording["robot"]))
        camera = SE3.from_matrix(np.array(recording["camera"]))
        names = tuple(f"row {i + 1}" for i in range(len(robot)))
        pairs = PosePairs(names, robot, camera)
        truth = SE3.from_matrix(np.array(recording["truth"]))
        began = time.process_time()
        try:
            answer = solve(pairs, recording["mount"], **options)
        except (InputError, np.linalg.LinAlgError) as error:
            rows.append({"refused": str(error)})
            continue
        ms = 1000 * (time.process_time() - began)
        off = (truth.inverse() @ answer.parent_from_child).log()
        rows.append(
            {
                "mm": float(1000 * np.linalg.norm(off[:3])),
                "deg": float(np.rad2deg(np.linalg.norm(off[3:]))),
                "d2": float(answer.uncertain_pose.squared_mahalanobis(truth)),
                "sigma mm": answer.sigma_mm,
                "sigma deg": answer.sigma_deg,
                "ms": ms,
            }
        )
    return rows


if __name__ == "__main__":
    text = Path(sys.argv[1]).read_text(encoding="utf-8")
    print(json.dumps(answers(json.loads(text), {})))
