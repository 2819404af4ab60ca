"""Real rooms, far views and cameras that are not as stated, beside other commits.

Every build learns and locates the same recordings in a process of its own, by `guard_answers`.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.accuracy import wrong
from benchmarks.guard_recordings import Case, all_cases, far_cases, write
from benchmarks.rows import Row, grouped, median_of, numbers, once, save
from benchmarks.same_answers import ROOT, source_of
from benchmarks.same_model import INSIDE_95
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside

NOW = "now"
"""Name of the working tree's build."""


def run(
    out: Path = Path("results/guard.csv"),
    real: Path | None = None,
    beside: tuple[str, ...] = ("175b928",),
    only: str = "",
    rendered: bool = True,
    cache: Path = Path("runs/guard"),
) -> None:
    """Compare this build with others on rooms that are not as rendered ones.

    Percentages and medians are of all images, refused ones among them; those inside the 95 %
    ellipsoids are of the poses. An interrupted run continues.

    Args:
        out: File of rows to write.
        real: Folder of real recordings with tsdf_room, redkitchen and fr1_rpy.
        beside: Commits to compare with.
        only: Part of the names of recordings that are learned.
        rendered: Whether views of rendered rooms are measured, which needs Mitsuba.
        cache: Folder for recordings and the answers of every build.

    Raises:
        InputError: No such recording or commit, or a build fails.
    """
    if real is None:
        print("real rooms are left out: give their folder with --real")
    listed = [*all_cases(real)]
    if rendered:
        listed += far_cases(cache.resolve() / "rendered")
    cases = [case for case in listed if only in case.learned]
    if not cases:
        raise InputError(f"--only {only}: no recording has such a name")
    builds = {commit: source_of(commit, cache / "builds") / "src" for commit in beside}
    builds[NOW] = _kept(ROOT / "src", cache / "builds")
    rows: list[Row] = []
    for case in tqdm(cases, unit="map"):
        # Builds take turns, so that their CPU times are those of the same hour.
        measured = {name: _measured(case, src, cache) for name, src in builds.items()}
        rows += _compared(measured)
    save(out, rows, {"beside": list(beside), "real": real is not None})


def _compared(measured: dict[str, list[Row]]) -> Iterator[Row]:
    """Rows of all builds, by recording, with the differences of this build to others."""
    for row in zip(*measured.values(), strict=True):
        of_build = dict(zip(measured, row, strict=True))
        for name, of in of_build.items():
            yield {"build": name, **of}
        now = of_build.pop(NOW)
        for name, old in of_build.items():
            yield {"build": f"{NOW} - {name}", **_difference(old, now)}


def _kept(source: Path, builds: Path) -> Path:
    """A copy of the working tree's build, which may change while it is measured."""
    copy = builds.resolve() / fingerprint(source) / "src"
    if not copy.exists():
        shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


def fingerprint(source: Path) -> str:
    """Checksum of a build's files."""
    total = hashlib.sha256()
    for file in sorted(source.rglob("*")):
        if file.suffix in (".py", ".safetensors", ".onnx"):
            total.update(str(file.relative_to(source)).encode() + file.read_bytes())
    return total.hexdigest()[:12]


def _measured(case: Case, source: Path, cache: Path) -> list[Row]:
    """Rows of a build, one for each recording that is located."""
    kept = cache.resolve() / "answers" / fingerprint(source)
    measure = partial(_answers, case, source, cache.resolve() / "recordings")
    rows = []
    images = once(kept / f"{case.learned}.json", measure)
    for (name,), of in grouped(images, "recording").items():
        rows.append({"suite": case.suite, "recording": name, **summary(of)})
    return rows


def _answers(case: Case, source: Path, folder: Path) -> list[Row]:
    """Answers of a build, in a process of its own."""
    for name, make in case.make.items():
        if not (folder / name).exists():
            write(folder / name, make())
    script = str(ROOT / "benchmarks" / "guard_answers.py")
    done = subprocess.run(
        [sys.executable, "-P", script, case.memory, *case.make],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(source)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise InputError(f"{case.learned}: {done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout)


def summary(answers: Sequence[Row]) -> Row:
    """Accuracy, refusals and ellipsoids of the answers to one recording's images."""
    count = len(answers)
    located = numbers(answers, "mm")
    position = numbers(answers, "position")
    refused = np.full(count - len(located), np.inf)
    mm = np.concatenate([located, refused])
    deg = np.concatenate([numbers(answers, "deg"), refused])
    return {
        "n": count,
        "2_cm": 100 * float(((mm <= 20) & (deg <= 2)).mean()),
        "1_cm": 100 * float(((mm <= 10) & (deg <= 1)).mean()),
        "mm": median_of(mm),
        "deg": median_of(deg),
        "refused": 100 * len(refused) / count,
        "inside_position": 100 * float((position <= INSIDE_95).mean()),
        "inside_pose": share_inside(numbers(answers, "pose")),
        "wrong": int(wrong(located, position).sum()),
        "learn_s": float(answers[0]["learn_s"]),
        "ask_s": float(numbers(answers, "ask_s").sum()),
    }


def _difference(old: Row, now: Row) -> Row:
    """The numbers of a build less those of an older one."""
    more = {
        key: value - float(old[key])
        for key, value in now.items()
        if not isinstance(value, str)
    }
    return now | more
