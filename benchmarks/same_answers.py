"""The answers of two commits to the same commands, value by value."""

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.rows import Row, save
from evercal.errors import InputError
from evercal.recordings.samples import CELL, FOLDER, ROOMS

ROOT = Path(__file__).parents[1]
VOLATILE = {"created", "date", "ms", "ms_per_image", "seconds", "sha256", "time"}
"""Keys of values that differ from run to run."""
BOARD = ("--board", "chessboard", "--size", "24x17", "--square-mm", "15")
"""The board of the KUKA recording."""
REDKITCHEN_FRAMES = {"TrainSplit.txt": 200, "TestSplit.txt": 20}
"""Frames of redkitchen that are learned and located, by their split."""


@dataclass(frozen=True)
class Step:
    """A command in the folder of one commit."""

    name: str
    """Its row in the table."""
    words: tuple[str, ...]
    """Arguments of `evercal` beside `--json`; results are relative, so that both print the same."""
    outputs: tuple[str, ...] = ()
    """Files and folders that it writes."""


def run(
    reference: str = "1158df68",
    out: Path = Path("runs/same-answers"),
    real: Path | None = None,
) -> int:
    """Compare the answers of the working tree with those of a commit; 1 if any differ.

    Args:
        reference: The commit, whose answers are kept in the output folder.
        out: Folder for the answers of both, and the rows.
        real: Folder of real recordings, with `redkitchen` (7-Scenes layout) and `handeye`.
    """
    steps = [*_sample_steps()]
    if real is not None:
        steps += _real_steps(real.resolve(), out.resolve())
    kept = source_of(reference, out)
    # Relative paths in answers are equal in folders of the same depth.
    now = out.resolve() / "now" / "answers"
    shutil.rmtree(now, ignore_errors=True)
    rows = []
    for step in steps:
        before = _answers(step, kept / "src", kept / "answers")
        after = _answers(step, ROOT / "src", now)
        rows.append({"command": step.name, **compare(before, after)})
    save(out / "same_answers.csv", rows)
    return int(any(row["different"] for row in rows))


def _sample_steps() -> Iterator[Step]:
    for room in ROOMS:
        folder = FOLDER / room
        yield _learn(f"learn {room}", "rooms.evercal", folder)
    for room in ROOMS:
        images = [
            *_images(FOLDER / room / "changed"),
            *_images(FOLDER / room / "images"),
        ]
        words = ("localize", "rooms.evercal", *images[::5])
        yield Step(f"localize {room}", words)
    cameras = FOLDER / "kitchen" / "calibration"
    fixed = str(cameras / "fixed" / "images")
    yield _calibrate("calibrate kitchen", "rooms.evercal", fixed)
    bumped = str(cameras / "bumped" / "images")
    yield _check("check kitchen", "rooms.evercal", bumped)
    yield _learn("learn cell", "cell.evercal", CELL / "wrist")
    yield _calibrate("calibrate tripod", "cell.evercal", str(CELL / "tripod"))
    yield _check("check tripod", "cell.evercal", str(CELL / "bumped.jpg"))
    images = _images(CELL / "wrist" / "images")
    yield Step("localize cell", ("localize", "cell.evercal", *images[::3]))
    exported = ("export", "calibration.json", "--format", "static_transform_publisher")
    yield Step("export tripod", exported)


def _real_steps(real: Path, out: Path) -> Iterator[Step]:
    kitchen = _first_frames(real / "redkitchen", out / "redkitchen")
    yield _learn("learn redkitchen", "kitchen.evercal", kitchen)
    test = (kitchen / "TestSplit.txt").read_text().split()
    folders = [
        kitchen / f"seq-{int(name.removeprefix('sequence')):02d}" for name in test
    ]
    images = [str(path) for folder in folders for path in folder.glob("*.color.*")]
    words = ("localize", "kitchen.evercal", *sorted(images))
    yield Step("localize redkitchen", words)
    kuka = real / "handeye" / "kuka_eye_in_hand"
    detect = ("detect", str(kuka), *BOARD)
    yield Step("detect KUKA", detect, ("board.json",))
    robot = ("--robot-poses", str(kuka / "base_from_gripper.csv"))
    solve = ("solve", *robot, "--camera-poses", "board.json")
    yield Step("solve KUKA", (*solve, "--mount", "eye_in_hand"), ("calibration.json",))
    camera = ("--camera", "board.json")
    yield _learn("learn KUKA", "kuka.evercal", kuka, *camera)
    franka = real / "handeye" / "franka_eye_to_hand"
    matrix = out / "franka.txt"
    matrix.write_text("607.593 0 323.463\n0 607.575 243.255\n0 0 1\n")
    words = ("eye-to-hand", str(franka), "--camera", str(matrix))
    yield Step("eye-to-hand Franka", words, ("calibration.json",))


def _learn(name: str, store: str, recording: Path, *more: str) -> Step:
    return Step(name, ("learn", store, str(recording), *more), (store,))


def _calibrate(name: str, store: str, images: str) -> Step:
    return Step(name, ("calibrate", store, images), ("calibration.json",))


def _check(name: str, store: str, images: str) -> Step:
    return Step(name, ("check", store, images, "--reference", "calibration.json"))


def _images(folder: Path) -> list[str]:
    return sorted(map(str, folder.rglob("*.jpg")))


def _first_frames(source: Path, copy: Path) -> Path:
    """A 7-Scenes recording with the first frames of its training and test sequences."""
    if copy.exists():
        return copy
    copy.mkdir(parents=True)
    for file in source.glob("*.txt"):
        if "Split" not in file.name:
            (copy / file.name).symlink_to(file)
    for split, most in REDKITCHEN_FRAMES.items():
        used = []
        left = most
        for name in (source / split).read_text().split():
            folder = copy / f"seq-{int(name.removeprefix('sequence')):02d}"
            poses = sorted((source / folder.name).glob("*.pose.txt"))[:left]
            left -= len(poses)
            if poses:
                used.append(name)
                folder.mkdir(exist_ok=True)
            for pose in poses:
                for file in pose.parent.glob(pose.name.replace("pose.txt", "*")):
                    (folder / file.name).symlink_to(file)
        (copy / split).write_text("\n".join(used) + "\n")
    return copy


def source_of(commit: str, out: Path) -> Path:
    """The folder of a commit, with its source."""
    folder = out.resolve() / commit
    if not (folder / "src").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        archive = ["git", "-C", str(ROOT), "archive", "--format=tar", commit, "src"]
        tar = subprocess.run(archive, capture_output=True, check=False)
        if tar.returncode:
            raise InputError(f"{commit}: no such commit of this checkout")
        subprocess.run(["tar", "x", "-C", str(folder)], input=tar.stdout, check=True)
    return folder


def _answers(step: Step, source: Path, folder: Path) -> dict[str, object]:
    """Everything that a command printed and wrote; run once for a folder."""
    file = folder / f"{step.name}.json"
    if file.exists():
        return json.loads(file.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "evercal", *step.words, "--json"]
    environment = {**os.environ, "PYTHONPATH": str(source)}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode not in (0, 1) or not done.stdout.strip():
        raise InputError(f"{step.name}: {done.stderr.strip()[-300:]}")
    answers: dict[str, object] = {"exit code": done.returncode}
    answers["printed"] = json.loads(done.stdout)
    for output in step.outputs:
        path = folder / output
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for each in files:
            if each.is_file() and each.name != "manifest.json":
                answers[str(each.relative_to(folder))] = _contents(each)
    file.write_text(json.dumps(answers))
    return answers


def _contents(file: Path) -> object:
    """The values of a JSON file, or the checksum of another one."""
    if file.suffix == ".json":
        return json.loads(file.read_text())
    return hashlib.sha256(file.read_bytes()).hexdigest()


def compare(before: object, after: object) -> Row:
    """Count values and those that differ, with the largest relative difference."""
    old = dict(_leaves(before))
    new = dict(_leaves(after))
    different = []
    largest = 0.0
    for key in sorted({*old, *new}):
        first = old.get(key)
        second = new.get(key)
        if first == second:
            continue
        different.append(key)
        largest = max(largest, _relative(first, second))
    return {
        "values": len({*old, *new}),
        "different": len(different),
        "largest relative difference": largest,
        "first": ", ".join(different[:3]),
    }


def _relative(first: object, second: object) -> float:
    """Relative difference of two numbers; infinite of anything else."""
    if not isinstance(first, int | float) or not isinstance(second, int | float):
        return math.inf
    return abs(first - second) / max(abs(first), abs(second))


def _leaves(value: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Every value of nested dicts and lists, by its path; no volatile ones."""
    if isinstance(value, dict):
        for name, item in value.items():
            if name not in VOLATILE:
                yield from _leaves(item, f"{key}/{name}")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _leaves(item, f"{key}/{number}")
    else:
        yield key, value
