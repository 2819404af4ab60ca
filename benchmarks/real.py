"""Accuracy and time of each real scene alone."""

import json
import os
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tabulate import tabulate

from evercal.evaluation.metrics import scores
from evercal.evaluation.protocol import evaluate
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.recordings import load_recording

DATA_VARIABLE = "EVERCAL_REAL_DATA"
SCENES = ("redkitchen", "fr1_rpy")
COLUMNS = (
    "frames",
    "accuracy_5cm_5deg",
    "median_translation_cm",
    "median_rotation_deg",
    "near_training_frame",
    "unknown",
    "seconds",
    "ms",
)


def run(data: Path | None = None, out: Path = Path("runs/real"), seed: int = 0) -> None:
    """Learn each real scene alone, preset `fast`. Complete runs are not repeated.

    Args:
        data: Folder with `redkitchen` and `fr1_rpy` (7-Scenes layout). Defaults to
            EVERCAL_REAL_DATA.
        out: Folder for stores and results.
        seed: Seed of the runs.
    """
    if data is None and DATA_VARIABLE not in os.environ:
        print(f"skipped: no real data; give --data DIR or set {DATA_VARIABLE}")
        return
    folder = data or Path(os.environ[DATA_VARIABLE])
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in SCENES:
        store = out / f"fast-{name}-{seed}"
        path = store.with_suffix(".json")
        if not path.exists():
            path.write_text(json.dumps(_measured(folder / name, name, store, seed)))
        record = json.loads(path.read_text())
        rows.append([name, *[record[key] for key in COLUMNS]])
    print("\nOne scene, preset fast\n")
    print(tabulate(rows, ["scene", *COLUMNS], "github", floatfmt=".1f"))


def _measured(folder: Path, name: str, store: Path, seed: int) -> dict[str, float]:
    scene = load_recording(folder)
    began = time.perf_counter()
    report = Map.open(store).learn(scene)
    seconds = time.perf_counter() - began
    results = evaluate(Localizer.open(store), {name: scene})
    return asdict(scores(results).scenes[name]) | {
        "seconds": seconds,
        "ms": float(np.mean([result.milliseconds for result in results])),
        "bytes": report.memory_bytes + report.head_bytes,
    }
