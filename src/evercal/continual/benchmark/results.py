"""Results of a benchmark as two tables, written and read with pandas.

    OUT/results.csv    a row per strategy, seed, stage and scene: correct frames, errors, memory
    OUT/frames.csv     a row per test frame after the last stage: errors and what became of it

Accuracy matrices, forgetting and intervals are derived from these. After an interruption a row may
be there twice; the last one counts.
"""

import hashlib
import json
import math
import os
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock

from evercal.classes import frozen_arrays
from evercal.continual.benchmark.environment import environment
from evercal.errors import InputError
from evercal.evaluation import metrics
from evercal.storage import write_json
from evercal.storage.settings import read_settings
from evercal.typing import JsonObject

Table = Any
"""A DataFrame of pandas, whose methods pyright cannot check without stubs."""
RESULTS = "results.csv"
"""File of the rows of stages and scenes."""
FRAMES = "frames.csv"
"""File of the rows of test frames."""
SETTINGS = "settings.json"
"""File of the options that decide the results."""
STRATEGIES = "strategies.json"
"""File of the descriptions of strategies."""
ENVIRONMENTS = "environments.json"
"""File of commits, versions and processors."""
CURVES = "training"
"""Folder of the curves of trainings, a folder for each."""
WITHIN = {
    "within_10cm_10deg": (0.10, math.radians(10.0)),
    "within_5cm_5deg": metrics.COARSE,
    "within_2cm_2deg": metrics.MIDDLE,
    "within_1cm_1deg": metrics.FINE,
    "within_5mm_05deg": metrics.FINEST,
}
"""Columns that count correct frames: metres and radians, both errors strictly below."""
KEY = ["strategy", "seed", "stage", "scene"]
"""Columns that identify a row of results.csv."""
_REQUIRED = {
    *KEY,
    "frames",
    *WITHIN,
    "seconds",
    "memory_bytes",
    "head_bytes",
    "environment",
}
"""Columns that results.csv must have."""


@frozen_arrays
class StageResults:
    """Results of all scenes learned so far, after one stage of a run."""

    stage: int
    """Number of the stage, from 0."""
    results: Table
    """Rows of results.csv."""
    frames: Table
    """Rows of frames.csv; empty before the last stage."""


def scene_row(frames: Sequence[metrics.FrameResult]) -> JsonObject:
    """Summarize the test frames of one scene: columns of results.csv that depend on them."""
    metres = metrics.column(frames, "translation_error_m")
    squared = metrics.column(frames, "squared_mahalanobis")
    wrong = metrics.column(frames, "wrong_scene")
    middle_m = metrics.upper_median(frames, "translation_error_m")
    middle_rad = metrics.upper_median(frames, "rotation_error_rad")
    within = {
        name: int(metrics.correct_rows(frames, most).sum())
        for name, most in WITHIN.items()
    }
    return {
        "scene": frames[0].scene,
        "frames": len(frames),
        **within,
        "median_mm": round(1000 * middle_m, 3),
        "median_deg": round(math.degrees(middle_rad), 4),
        "area_20cm": round(metrics.recall_area(metres), 4),
        "wrong_scene": int(wrong.sum()),
        "refused": int((~np.isfinite(metres) & ~wrong).sum()),
        "with_covariance": int((~np.isnan(squared)).sum()),
        "inside_95": int((squared < metrics.CHI2_6).sum()),
    }


def frame_row(frame: metrics.FrameResult) -> JsonObject:
    """Columns of frames.csv that depend on the frame."""
    squared = frame.squared_mahalanobis
    if frame.wrong_scene:
        outcome = "wrong scene"
    elif not math.isfinite(frame.translation_error_m):
        outcome = "refused"
    elif math.isnan(squared):
        outcome = "no covariance"
    elif squared < metrics.CHI2_6:
        outcome = "inside"
    else:
        outcome = "outside"
    return {
        "scene": frame.scene,
        "frame": frame.frame,
        "error_mm": round(1000 * frame.translation_error_m, 3),
        "error_deg": round(math.degrees(frame.rotation_error_rad), 4),
        "outcome": outcome,
    }


def locked(folder: Path) -> FileLock:
    """Return a lock of the results of a folder, which several processes may write."""
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".results.lock")


def append(folder: Path, stage: StageResults) -> None:
    """Append the rows of a stage, and flush them to disk."""
    with locked(folder):
        # Frames come first: a stage whose results are complete has its frames.
        _append_rows(folder / FRAMES, stage.frames)
        _append_rows(folder / RESULTS, stage.results)


def _append_rows(path: Path, rows: Table) -> None:
    if rows.empty:
        return
    with open(path, "a+b") as file:
        file.seek(0)
        lines, newline, _ = file.read().rpartition(b"\n")
        file.truncate(len(lines + newline))  # an interrupted call left part of a line
        file.write(rows.to_csv(header=not lines, index=False).encode())
        file.flush()
        os.fsync(file.fileno())


def read(folder: Path) -> Table:
    """Read the results of a folder; without any, an empty table."""
    path = folder / RESULTS
    if not path.exists():
        return pd.DataFrame(columns=sorted(_REQUIRED))
    try:
        lines, newline, _ = path.read_bytes().rpartition(b"\n")
        table: Table = pd.read_csv(
            BytesIO(lines + newline),
            dtype=dict.fromkeys(("strategy", "scene", "environment"), "str"),
            keep_default_na=False,  # a scene may be called `nan`
            na_values=[""],
        )
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not a table of results ({error})") from error
    missing = _REQUIRED.difference(table)
    if missing:
        raise InputError(f"{path}: no columns {', '.join(sorted(missing))}")
    return table.drop_duplicates(KEY, keep="last")


def record_environment(folder: Path) -> str:
    """Add the record of this process to environments.json and return its key."""
    record = environment()
    text = json.dumps(record, sort_keys=True)
    key = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
    with locked(folder):
        before = read_records(folder / ENVIRONMENTS)
        if key not in before:
            write_json(folder / ENVIRONMENTS, before | {key: record})
    return key


def read_records(path: Path) -> JsonObject:
    """Read records in JSON by key; empty without the file."""
    if not path.exists():
        return {}
    return read_settings(path)
