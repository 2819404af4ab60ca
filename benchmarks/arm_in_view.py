"""A fixed camera calibrated from the arm in its images: errors, ellipsoids, refusals.

Recordings are rendered on demand by `rooms.arms`. Every answer is one JSON line in OUT/rows.jsonl
and is not repeated.
"""

import itertools
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks import eye_to_hand
from benchmarks.accuracy import pose_error, wrong
from benchmarks.arm_beside import beside
from benchmarks.arm_faults import Cell, read_cell, spoil, write_cell
from benchmarks.arm_parts import PARTS, without
from benchmarks.rows import Row, grouped, median_of, numbers, save
from evercal.calibration.arm_in_view.solve import calibrate_arm_in_view
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.recordings import load_recording
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from rooms.arms import ARMS, Setting, render


@dataclass(frozen=True)
class Condition:
    """Recordings, and what is done to them before they are solved."""

    scene: Mapping[str, object] = field(default_factory=dict)
    """Fields of `rooms.arms.Setting`."""
    images: int = 25
    """The first ones of the recording are used."""
    fault: str = ""
    """A key of `benchmarks.arm_faults.FAULTS`, or none."""
    size: float = 0.0
    """Of the fault: degrees, millimetres, a share, pixels."""
    first_seed: int = 0
    left_out: str = ""
    """A key of `benchmarks.arm_parts.PARTS`, or nothing."""

    def setting(self, seed: int) -> Setting:
        """The recording of a seed."""
        values = {"images": self.images, **self.scene}
        return Setting(seed, **values)  # pyright: ignore[reportArgumentType]


MAIN = {
    "25 images": Condition(),
    "10 images": Condition(images=10),
    "25 images of 320x240": Condition(fault="half"),
    "10 images of 320x240": Condition(images=10, fault="half"),
}
FEW = {f"{n} images": Condition(images=n) for n in (3, 5, 7, 15)}
DISTANCES = {
    "1.6 m": Condition({"drawn": True}, 15),
    "1.6 m, 1280x720": Condition({"drawn": True, "size": (1280, 720)}, 15),
    "0.8 m": Condition({"drawn": True, "distance_m": 0.8}, 15),
    "2.5 m": Condition({"drawn": True, "distance_m": 2.5}, 15),
}
DISTANCE_M = {"so101": 0.8, "scara": 1.2}
"""Of arms that are smaller than the others, which are at 1.6 m."""
ARM_KINDS = {
    arm: Condition({"arm": arm, "distance_m": DISTANCE_M.get(arm, 1.6)}, 15)
    for arm in ARMS
    if arm != "panda"
}
SPOILED = {
    "joints 0.2 deg off": ("joints", 0.2),
    "joints 0.5 deg off": ("joints", 0.5),
    "joints 1 deg off": ("joints", 1.0),
    "meshes 1 mm off": ("mesh", 1.0),
    "meshes 1 % large": ("scale", 0.01),
    "focal length 3 % off": ("focal", 0.03),
    "bump of 3 px half way": ("bump", 3.0),
    "bump of 10 px half way": ("bump", 10.0),
    "changing light": ("light", 0.4),
    "people in 80 %": ("people", 0.8),
    "foreign tool": ("tool", 0.16),
    "joints shuffled": ("shuffled", 0.0),
    "joints one image late": ("shifted", 1.0),
    "meshes of another robot": ("robot", 0.0),
}
WRONG = {
    name: Condition({}, 15, fault, size) for name, (fault, size) in SPOILED.items()
}

PARTS_LEFT = {
    "all of it": Condition(),
    **{part: Condition(left_out=part) for part in PARTS},
}


def _mass() -> dict[str, Condition]:
    """Cells of all arms, each with and without faults."""
    conditions = {}
    for number, arm in enumerate(ARMS):
        near = DISTANCE_M.get(arm, 1.6)
        for far in (0.65, 1.0, 1.5):
            distance = round(far * near, 2)
            scene = {"arm": arm, "distance_m": distance, "drawn": True}
            first = 100 + 40 * number
            for name, (fault, size) in {"as stated": ("", 0.0), **SPOILED}.items():
                key = f"{arm}, {distance} m, {name}"
                conditions[key] = Condition(scene, 8, fault, size, first)
    return conditions


MASS = _mass()
WHAT = {
    "main": MAIN,
    "few": FEW,
    "distances": DISTANCES,
    "arms": ARM_KINDS,
    "wrong": WRONG,
    "parts": PARTS_LEFT,
    "mass": MASS,
    "beside": {},
}
"""Conditions by the parts of the measurement."""


def run(
    what: Sequence[str] = tuple(WHAT),
    data: Path = Path("runs/arm"),
    out: Path = Path("runs/arm-in-view"),
    draws: int = 10,
    only: tuple[str, ...] = (),
) -> None:
    """Calibrate fixed cameras from the arm in their images.

    Args:
        what: Parts, see `WHAT`.
        data: Folder of the rendered recordings; missing ones are rendered.
        out: Folder of the rows.
        draws: Recordings of each condition.
        only: Conditions of these parts; all if omitted.
    """
    rows = Rows(out)
    for part in what:
        # One draw of all conditions after the other, so that a part of them says something.
        for name, condition, setting in _in_turn(part, only, draws, data):
            if rows.has(part, name, setting.seed):
                continue
            cell = read_cell(data / setting.name, condition.images)
            if condition.fault:
                rng = np.random.default_rng([setting.seed, 45])
                spoil(cell, condition.fault, condition.size, rng)
            with without(condition.left_out):
                row = _solved(cell)
            rows.add(part, name, setting.seed, row)
        if part == "beside":
            _beside(rows, data, draws)
    for (part,), group in grouped(rows.rows, "part").items():
        table = summary(group) if part != "mass" else _of_faults(group)
        save(out / f"arm-in-view-{part}.csv", table)


class Rows:
    """Rows of a file, each measured once."""

    def __init__(self, out: Path) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self._file = out / "rows.jsonl"
        self.rows: list[Row] = []
        if self._file.exists():
            lines = self._file.read_text().splitlines()
            self.rows = [json.loads(line) for line in lines]

    def has(self, part: str, condition: str, seed: int) -> bool:
        """Whether a row is measured."""
        wanted = {"part": part, "condition": condition, "seed": seed}
        return any(wanted.items() <= row.items() for row in self.rows)

    def add(self, part: str, condition: str, seed: int, row: Row) -> None:
        """Append a row to the file."""
        row = {"part": part, "condition": condition, "seed": seed, **row}
        self.rows.append(row)
        with self._file.open("a") as stream:
            stream.write(json.dumps(row) + "\n")


def _in_turn(
    part: str, only: Sequence[str], draws: int, data: Path
) -> Iterator[tuple[str, Condition, Setting]]:
    chosen = {name: c for name, c in WHAT[part].items() if name in (only or [name])}
    cells = {name: _rendered(condition, data) for name, condition in chosen.items()}
    for _ in tqdm(range(draws), desc=part):
        for name, condition in chosen.items():
            yield name, condition, next(cells[name])


def _beside(rows: Rows, data: Path, draws: int) -> None:
    for seed in tqdm(range(eye_to_hand.FIRST_SEED, eye_to_hand.FIRST_SEED + draws)):
        if rows.has("beside", "board: arm in view", seed):
            continue
        try:
            for name, found in beside(data, seed):
                row = _solved(found) if isinstance(found, Cell) else found
                if not rows.has("beside", name, seed):
                    rows.add("beside", name, seed, row)
        except InputError as error:
            tqdm.write(str(error))


def _rendered(condition: Condition, data: Path) -> Iterator[Setting]:
    """Settings of the seeds whose room has a place for such a camera, rendered."""
    for seed in itertools.count(condition.first_seed):
        setting = condition.setting(seed)
        try:
            for _ in render(setting, data):
                pass
        except InputError as error:
            tqdm.write(str(error))
            continue
        yield setting


def _solved(cell: Cell) -> Row:
    """Error of a calibration, or its refusal."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording"
        write_cell(cell, recording)
        options = ReadOptions(whole_robot=True)
        began = time.process_time()
        try:
            model = RobotModel(recording / "robot.urdf")
            loaded = load_recording(recording, options=options)
            answer = calibrate_arm_in_view(loaded, model)
        except InputError as error:
            seconds = time.process_time() - began
            return {"refused": str(error), "seconds": seconds}
        seconds = time.process_time() - began
    pose = answer.uncertain_pose
    errors = [pose_error(pose, truth) for truth in cell.base_from_camera]
    row = min(errors, key=lambda error: float(error["mm"]))
    row |= {"seconds": seconds, "warnings": "; ".join(answer.checks.warnings or [])}
    return row | {"confirmed": float(answer.checks.outline_confirmed or 0)}


def _of_faults(rows: list[Row]) -> list[Row]:
    """Summary of rows of the mass by what is wrong."""
    named = [row | {"condition": str(row["condition"]).split(", ")[-1]} for row in rows]
    everything = [row | {"condition": "all"} for row in rows]
    return summary([*named, *everything])


def summary(rows: Sequence[Row]) -> list[Row]:
    """One row for each condition; `wrong`: over 10 mm and over five sigma."""
    return [
        _summary(name, group) for (name,), group in grouped(rows, "condition").items()
    ]


def _summary(name: str, group: list[Row]) -> Row:
    answers = [row for row in group if "refused" not in row]
    row: Row = {"condition": name, "draws": len(group)}
    row["refused"] = len(group) - len(answers)
    row["warned"] = sum(bool(answer.get("warnings")) for answer in answers)
    row["seconds"] = median_of(numbers(group, "seconds"))
    if not answers:
        return row
    for unit in ("mm", "deg"):
        errors = numbers(answers, unit)
        row |= {unit: median_of(errors), f"{unit}_90": float(np.quantile(errors, 0.9))}
    squared = numbers(answers, "squared_mahalanobis")
    if not len(squared):
        return row
    for key in ("sigma_mm", "sigma_deg", "squared_mahalanobis"):
        row[key] = median_of(numbers(answers, key))
    row["inside_95"] = share_inside(squared)
    if "confirmed" in answers[0]:
        row["confirmed"] = median_of(numbers(answers, "confirmed"))
    is_wrong = wrong(numbers(answers, "mm"), squared)
    silent = np.array([not answer.get("warnings") for answer in answers])
    row["wrong"] = int(is_wrong.sum())
    row["wrong_unwarned"] = int((is_wrong & silent).sum())
    return row
