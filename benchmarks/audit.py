"""Audit of recorded data sets by the arm in view: 300 episodes, of which 20 % state wrong poses.

python -m benchmarks audit DIR --layout lerobot --out results/audit.csv
"""

import json
import resource
import subprocess
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from benchmarks.audit_cells import Options, panda
from benchmarks.audit_sets import KINDS, write_droid, write_lerobot
from benchmarks.rows import Row, save
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.processes import python_command
from evercal.recordings.poses.conventions import pose_convention, poses_from_numbers

WRITERS = {"lerobot": write_lerobot, "droid": write_droid}
EXACT = (20.0, 1.0)
"""Largest error of a pose that counts as repaired, millimetres and degrees."""


def run(
    folder: Annotated[Positional[Path], arg(metavar="DIR")],
    options: Options,
    layout: Literal["lerobot", "droid"] = "lerobot",
    workers: int = 2,
    out: Path = Path("runs/audit.csv"),
) -> None:
    """Make a data set, audit it, and compare the results with the truth.

    Args:
        folder: Folder of the data set; one that is complete is used.
        options: Size of the data set.
        layout: LeRobot 3.0, or DROID's.
        workers: Processes of the audit.
        out: File of the rows.
    """
    urdf = panda()
    root = folder / layout
    if not (folder / "truth.json").exists():
        WRITERS[layout](options, urdf, root)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    report = folder / "audit.json"
    words = ["audit", root, "--urdf", urdf, "--camera", folder / "camera.json"]
    words += ["--out", report, "--workers", workers, "--json"]
    command = python_command("-m", "evercal", *map(str, words))
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    results = json.loads(report.read_text())["episodes"]
    truths = json.loads((folder / "truth.json").read_text())
    rows = rows_of(results, truths)
    rows[-1]["wall_s"] = wall / len(results)
    rows[-1]["cpu_s"] = cpu / len(results)
    save(out, rows, {**asdict(options), "layout": layout, "workers": workers})


def rows_of(results: list[dict[str, Any]], truths: Mapping[str, Any]) -> list[Row]:
    """A row for each mistake, one for right poses, and one for all."""
    kinds: dict[str, list[dict[str, Any]]] = {kind: [] for kind in ("", *KINDS)}
    for result in results:
        known = truths[f"{result['episode']} {result['camera']}"]
        kinds[known["mistake"]].append({**result, **_error(result, known)})
    rows = [_row(kind, found) for kind, found in kinds.items()]
    return [*rows, _row("all", [item for found in kinds.values() for item in found])]


def _error(result: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, float]:
    if not result["corrected"]:
        return {"error_mm": np.nan, "error_deg": np.nan}
    pose = poses_from_numbers(result["corrected"], pose_convention("rpy"))
    true = SE3.from_matrix(known["base_from_camera"])
    mm, deg = pose_distance_mm_deg(pose, true)
    return {"error_mm": mm, "error_deg": deg}


def _row(kind: str, found: list[dict[str, Any]]) -> Row:
    errors = np.array([[item["error_mm"], item["error_deg"]] for item in found])
    errors = errors.reshape(-1, 2)
    known = errors[np.isfinite(errors).all(1)]
    row: Row = {"mistake": kind or "none", "poses": len(found)}
    for verdict in ("right", "wrong", "unknown"):
        row[verdict] = sum(item["verdict"] == verdict for item in found)
    words = KINDS.get(kind, "?")
    row["named"] = sum(item["mistake"].startswith(words) for item in found)
    row["within"] = int((known <= EXACT).all(1).sum())
    if len(known):
        row["median_mm"], row["median_deg"] = np.median(known, 0).tolist()
        row["p90_mm"], row["p90_deg"] = np.quantile(known, 0.9, 0).tolist()
    row["seconds"] = float(np.mean([item["seconds"] for item in found] or [np.nan]))
    return row
