"""Results of a benchmark on disk: one JSON line per strategy, seed, stage and scene.

Accuracy matrices, forgetting, tables and intervals are derived from these lines.
"""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path

import numpy as np
from filelock import FileLock

from evercal.continual.benchmark.environment import environment, environment_key
from evercal.errors import InputError
from evercal.evaluation.metrics import COARSE, FrameResult
from evercal.storage import write_json
from evercal.storage.settings import read_settings

RESULTS, SETTINGS, STRATEGIES = "results.jsonl", "settings.json", "strategies.json"
ENVIRONMENTS = "environments.json"
NETWORK, UNALIGNED = ":network", ":unaligned"
"""Suffixes of a strategy's name for additional results of the same run: by the network without the
map, and by the first pose from matched keyframes, before landmarks are aligned."""


@dataclass(frozen=True)
class SceneResult:
    """Results of one scene's test frames after one stage of one run."""

    strategy: str
    """Name of the strategy; strategies.json describes it."""
    seed: int
    """Seed of the run."""
    stage: int
    """Scenes learned before this stage."""
    scene: str
    """Scene of the test frames."""
    frames: tuple[str, ...]
    """Names of the test frames in recorded order."""
    translation_m: tuple[float, ...]
    """Error of each frame; infinite without a pose in the right scene."""
    rotation_rad: tuple[float, ...]
    """Error of each frame; infinite without a pose in the right scene."""
    wrong_scene: tuple[bool, ...]
    """Frames with a pose in another scene."""
    near_training_frame: tuple[bool, ...]
    """Frames with a training frame within 5 cm and 5 deg."""
    seconds: float
    """Wall time of the stage; a first stage that strategies share counts for each of them."""
    memory_bytes: int
    """Bytes remembered of all scenes."""
    head_bytes: int
    """Bytes of all heads."""
    frames_kept: int
    """Frames remembered of the stage's scene."""
    keyframe_positions_m: tuple[tuple[float, float, float], ...] = ()
    """Camera positions of these in the base frame; given for the scene that was just learned."""
    covering_radius: float = math.nan
    """Largest distance from a training frame to a remembered one, in the metric of SARS."""
    min_spacing: float = math.nan
    """Smallest distance between two remembered frames, in the metric of SARS."""
    squared_mahalanobis: tuple[float, ...] = ()
    """Squared error of each pose in units of its covariance. NaN without a pose in the right scene
    or without a covariance; empty if no frame has one."""
    environment: str = ""
    """Key of the record in environments.json: commit, versions, processor."""

    @property
    def refused(self) -> np.ndarray:
        """Frames without a pose, bool, shape (frames,)."""
        return ~np.isfinite(self.translation_m) & ~np.array(self.wrong_scene, bool)

    def accuracy(self, thresholds: tuple[float, float] = COARSE) -> float:
        """Return the share of correct frames, 0 to 1."""
        return float(self.correct(thresholds).mean())

    def correct(self, thresholds: tuple[float, float] = COARSE) -> np.ndarray:
        """Return which frames have errors strictly below (metres, radians), shape (frames,)."""
        metres, radians = thresholds
        return (np.array(self.translation_m) < metres) & (np.array(self.rotation_rad) < radians)


_FIELDS = {item.name for item in fields(SceneResult)}
_REQUIRED = {item.name for item in fields(SceneResult) if item.default is MISSING}


def scene_result(results: Sequence[FrameResult], **run: object) -> SceneResult:
    """Collect the results of one scene's frames.

    Args:
        results: Results of the test frames in recorded order.
        **run: The other fields of `SceneResult`.
    """
    return SceneResult(
        scene=results[0].scene,
        frames=tuple(r.frame for r in results),
        translation_m=tuple(r.translation_error_m for r in results),
        rotation_rad=tuple(r.rotation_error_rad for r in results),
        wrong_scene=tuple(r.wrong_scene for r in results),
        near_training_frame=tuple(r.near_training_frame for r in results),
        squared_mahalanobis=tuple(r.squared_mahalanobis for r in results),
        **run,  # pyright: ignore[reportArgumentType]
    )


def locked(folder: Path) -> FileLock:
    """Return a lock of the results of a folder, which several processes may write."""
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".results.lock")


def append(folder: Path, results: Iterable[SceneResult]) -> None:
    """Append lines to the results of a folder and flush them to disk."""
    lines = [json.dumps(_to_record(result), allow_nan=False) + "\n" for result in results]
    with locked(folder), open(folder / RESULTS, "a", encoding="utf-8") as file:
        file.write("".join(lines))
        file.flush()
        os.fsync(file.fileno())


def read(folder: Path) -> list[SceneResult]:
    """Read all results of a folder. An incomplete last line is removed from the file.

    Raises:
        InputError: A complete line is not a result.
    """
    path = folder / RESULTS
    if not path.exists():
        return []
    with locked(folder):
        data = path.read_bytes()
        complete = data.rfind(b"\n") + 1
        if complete < len(data):
            with open(path, "r+b") as file:
                file.truncate(complete)
    results = []
    for number, line in enumerate(data[:complete].splitlines(), start=1):
        try:
            results.append(_from_record(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: line {number} is not a result ({error!r})") from error
    return results


def record_environment(folder: Path) -> str:
    """Add the record of this process to environments.json and return its key."""
    record = environment()
    key = environment_key(record)
    add_environments(folder, {key: record})
    return key


def add_environments(folder: Path, records: Mapping[str, dict[str, str]]) -> None:
    """Add records by key to environments.json, unless it has all of them."""
    with locked(folder):
        before = read_environments(folder)
        after = before | dict(records)
        if after != before:
            write_json(folder / ENVIRONMENTS, after)


def read_environments(folder: Path) -> dict[str, dict[str, str]]:
    """Read the records of a folder by key; empty without the file.

    Raises:
        InputError: The file is not JSON.
    """
    path = folder / ENVIRONMENTS
    return read_settings(path) if path.exists() else {}  # pyright: ignore[reportReturnType]


def read_strategies(folder: Path) -> dict[str, dict[str, object]]:
    """Read `Strategy.description` of each strategy of a folder; empty without the file.

    Raises:
        InputError: The file is not JSON.
    """
    path = folder / STRATEGIES
    return read_settings(path) if path.exists() else {}  # pyright: ignore[reportReturnType]


def _to_record(result: SceneResult) -> dict[str, object]:
    record = asdict(result)
    for name in ("translation_m", "rotation_rad"):
        record[name] = [round(v, 6) if math.isfinite(v) else None for v in record[name]]
    squared = record.pop("squared_mahalanobis")
    if not all(map(math.isnan, squared)):
        record["squared_mahalanobis"] = [
            None if math.isnan(value) else float(f"{value:.4g}") for value in squared
        ]
    for name in ("covering_radius", "min_spacing"):
        record[name] = record[name] if math.isfinite(record[name]) else None
    return record


def _from_record(record: object) -> SceneResult:
    if not isinstance(record, dict) or not _REQUIRED <= record.keys() <= _FIELDS:
        raise KeyError("other fields")
    for name, value in record.items():
        missing = math.nan if name == "squared_mahalanobis" else math.inf
        if name == "keyframe_positions_m":
            record[name] = tuple(map(tuple, value))
        elif isinstance(value, list):
            record[name] = tuple(missing if v is None else v for v in value)
        elif value is None:
            record[name] = math.nan
    return SceneResult(**record)
