"""What a benchmark leaves on disk: one JSON line per strategy, seed, stage and scene.

Everything else (accuracy matrices, forgetting, tables, bounds) is derived from these lines.
"""

import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.evaluation.metrics import COARSE, FrameResult
from evercal.storage import read_settings

RESULTS, SETTINGS, STRATEGIES = "results.jsonl", "settings.json", "strategies.json"
NETWORK, UNALIGNED = ":network", ":unaligned"
"""Added to a strategy's name where the same run is judged by its network alone, or by the first
pose from matched keyframes, whose landmarks are not aligned."""
_LATER = {"keyframe_positions_m", "covering_radius", "min_spacing", "squared_mahalanobis"}
"""Fields that older results lack."""
_FORMERLY = {
    "kept_m": "keyframe_positions_m",
    "covering": "covering_radius",
    "closest": "min_spacing",
}
"""What older results call them."""


@dataclass(frozen=True)
class SceneResult:
    """How one scene's test frames fared after one stage of one run."""

    strategy: str
    """Name of the strategy; strategies.json says what it is."""
    seed: int
    """Of the run."""
    stage: int
    """Scenes learned so far, less one."""
    scene: str
    """Whose test frames these are."""
    frames: tuple[str, ...]
    """Names of the test frames in recorded order."""
    translation_m: tuple[float, ...]
    """Error of each frame, infinite without a pose in the right scene."""
    rotation_rad: tuple[float, ...]
    """Error of each frame, infinite without a pose in the right scene."""
    wrong_scene: tuple[bool, ...]
    """Which frames got a pose in another scene."""
    near_training_frame: tuple[bool, ...]
    """Which frames have a training frame within 5 cm and 5 deg."""
    seconds: float
    """Wall time of the stage; that of a first stage which strategies share counts for each."""
    memory_bytes: int
    """What is remembered of all scenes."""
    head_bytes: int
    """All heads as stored."""
    frames_kept: int
    """Remembered frames of the stage's scene."""
    keyframe_positions_m: tuple[tuple[float, float, float], ...] = ()
    """Where the cameras of these stood, base frame; told once, when the scene was learned."""
    covering_radius: float = math.nan
    """Largest distance, in the metric of SARS, from a training frame to one that was kept."""
    min_spacing: float = math.nan
    """Smallest such distance between two that were kept."""
    squared_mahalanobis: tuple[float, ...] = ()
    """Squared error of each pose in units of its covariance, NaN without a pose in the right scene
    or without a covariance; empty where no frame has one."""

    @property
    def refused(self) -> np.ndarray:
        """(frames,) bool: those without any pose."""
        return ~np.isfinite(self.translation_m) & ~np.array(self.wrong_scene, bool)

    def accuracy(self, thresholds: tuple[float, float] = COARSE) -> float:
        """Share of correct frames, 0 to 1."""
        return float(self.correct(thresholds).mean())

    def correct(self, thresholds: tuple[float, float] = COARSE) -> np.ndarray:
        """(frames,) bool: both errors strictly below (metres, radians)."""
        metres, radians = thresholds
        return (np.array(self.translation_m) < metres) & (np.array(self.rotation_rad) < radians)


def scene_result(results: Sequence[FrameResult], **of: object) -> SceneResult:
    """An outcome from the results of one scene's frames and the remaining fields by name."""
    return SceneResult(
        scene=results[0].scene,
        frames=tuple(r.frame for r in results),
        translation_m=tuple(r.translation_error_m for r in results),
        rotation_rad=tuple(r.rotation_error_rad for r in results),
        wrong_scene=tuple(r.wrong_scene for r in results),
        near_training_frame=tuple(r.near_training_frame for r in results),
        squared_mahalanobis=tuple(r.squared_mahalanobis for r in results),
        **of,  # pyright: ignore[reportArgumentType]
    )


def append(folder: Path, results: Iterable[SceneResult]) -> None:
    """Adds lines to the results of a folder, all of them on the disk when this returns."""
    lines = [json.dumps(_plain(result), allow_nan=False) + "\n" for result in results]
    with open(folder / RESULTS, "a", encoding="utf-8") as file:
        file.write("".join(lines))
        file.flush()
        os.fsync(file.fileno())


def read(folder: Path) -> list[SceneResult]:
    """All outcomes in a folder; a last line that a kill cut short is taken away.

    Raises:
        InputError: a line before the last that is none of ours.
    """
    path = folder / RESULTS
    if not path.exists():
        return []
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        with open(path, "r+b") as file:
            file.truncate(whole)
    found = []
    for number, line in enumerate(data[:whole].splitlines(), start=1):
        try:
            found.append(_result(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: line {number} is not a result ({error!r})") from error
    return found


def read_strategies(folder: Path) -> dict[str, dict[str, object]]:
    """What each strategy of a folder is (`Strategy.description`); none in older folders.

    Raises:
        InputError: a file that is none of ours.
    """
    path = folder / STRATEGIES
    return read_settings(path) if path.exists() else {}  # pyright: ignore[reportReturnType]


def _plain(result: SceneResult) -> dict[str, object]:
    record = asdict(result)
    for name in ("translation_m", "rotation_rad"):
        record[name] = [round(v, 6) if math.isfinite(v) else None for v in record[name]]
    squared = record.pop("squared_mahalanobis")
    if not all(map(math.isnan, squared)):
        record["squared_mahalanobis"] = [_significant(v) for v in squared]
    for name in ("covering_radius", "min_spacing"):
        record[name] = record[name] if math.isfinite(record[name]) else None
    return record


def _significant(value: float) -> float | None:
    return None if math.isnan(value) else float(f"{value:.4g}")


def _result(record: object) -> SceneResult:
    names = {field.name for field in fields(SceneResult)}
    if not isinstance(record, dict):
        raise KeyError("other fields")
    found = {_FORMERLY.get(name, str(name)): value for name, value in record.items()}
    if not names - _LATER <= found.keys() <= names:
        raise KeyError("other fields")
    for name, value in found.items():
        if name == "keyframe_positions_m":
            found[name] = tuple(map(tuple, value))
        elif name == "squared_mahalanobis":
            found[name] = tuple(math.nan if v is None else v for v in value)
        elif isinstance(value, list):
            found[name] = tuple(math.inf if v is None else v for v in value)
        elif value is None:
            found[name] = math.nan
    return SceneResult(**found)  # pyright: ignore[reportArgumentType]
