"""Scores of scenes from results of frames, and forgetting from accuracies of stages.

Results are in metres and radians, scores in per cent, centimetres and degrees. A frame is correct
if both errors are strictly below the thresholds. Frames without a pose, or with a pose in another
scene, have infinite errors.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from evercal.choices import Status
from evercal.classes import frozen
from evercal.geometry import SE3
from evercal.geometry.near import COARSE
from evercal.typing import BoolArray, JsonObject, Pair

Thresholds = Pair
"""Errors of position in metres and of rotation in radians, below which a pose is correct."""
MIDDLE: Thresholds = (0.02, math.radians(2.0))
"""2 cm and 2 deg, for one room."""
FINE: Thresholds = (0.01, math.radians(1.0))
"""1 cm and 1 deg."""
FINEST: Thresholds = (0.005, math.radians(0.5))
"""5 mm and 0.5 deg, for a robot cell."""

CHI2_6 = 12.5916
"""95 % quantile of chi square with six degrees of freedom."""


@frozen
class FrameResult:
    """Result of one test image: errors are infinite without a pose in the right scene."""

    scene: str
    frame: str
    translation_error_m: float
    rotation_error_rad: float
    status: Status
    found_scene: str | None
    """Scene of the estimate, if any."""
    near_training_frame: bool
    """Whether a training frame of the scene is within 5 cm and 5 deg."""
    milliseconds: float
    """Time per image, decoding included."""
    inliers: int
    """Scene points that agree with the pose."""
    inlier_ratio: float
    """Share of scene points that agree with the pose, 0 to 1."""
    squared_mahalanobis: float = math.nan
    """Squared error in units of the covariance; NaN without one, or in a wrong scene."""
    estimated: SE3 | None = field(default=None, compare=False)
    """Estimated camera pose in the base frame of `found_scene`."""

    @property
    def wrong_scene(self) -> bool:
        """Whether the pose is in a scene with another base frame."""
        return self.status == "ok" and math.isinf(self.translation_error_m)


@frozen
class SceneScores:
    """Scores of one scene: per cent of its test frames, and medians over all of them."""

    frames: int
    accuracy_5cm_5deg: float
    accuracy_2cm_2deg: float
    accuracy_1cm_1deg: float
    accuracy_5mm_05deg: float
    median_translation_cm: float
    """Frames without a pose count as infinite."""
    median_rotation_deg: float
    wrong_scene: float
    """Frames with a pose in another scene."""
    unknown: float
    """Frames with status `unknown_scene`, `uncertain` or `ambiguous`."""
    near_training_frame: float
    """Frames with a training frame within 5 cm and 5 deg."""
    inside_95: float = math.nan
    """Poses in the right scene whose 95 % ellipsoid contains the true one; NaN if unknown."""


@dataclass(frozen=True)
class Scores:
    """Scores of all scenes and their means."""

    scenes: dict[str, SceneScores]
    """By name, in the order of the results."""
    mean_accuracy_5cm_5deg: float
    """Per cent, unweighted mean over scenes."""
    mean_accuracy_1cm_1deg: float
    ms_per_image: float
    """Mean milliseconds per image, one at a time, decoding included."""

    def to_dict(self) -> JsonObject:
        """Convert to plain values for JSON; infinity and NaN become None."""
        values = dataclasses.asdict(self)
        values["scenes"] = {name: _plain(row) for name, row in self.scenes.items()}
        return values


@frozen
class ContinualScores:
    """Accuracy and forgetting over a sequence of scenes, in the unit of the accuracies."""

    final_accuracy: float
    """Mean over scenes after the last stage."""
    total_forgetting: float
    """TFR: mean drop from a scene's best accuracy, the last stage included, to its final one."""
    forgetting: float
    """Mean drop from the best accuracy before the last stage (Chaudhry et al. 2018)."""
    backward_transfer: float
    """BWT: mean change from just after learning a scene to the end (Lopez-Paz and Ranzato 2017)."""
    last_scene_accuracy: float
    """Accuracy on the scene learned last."""
    accuracy_along: float
    """ACC: mean over all stages and the scenes learned by then (Diaz-Rodriguez et al. 2018)."""

    def to_dict(self) -> JsonObject:
        """Convert to plain values for JSON; NaN becomes None."""
        return _plain(self)


def correct(
    results: Iterable[FrameResult], thresholds: Thresholds = COARSE
) -> dict[str, BoolArray]:
    """Which frames (frames,) of each scene are correct, by thresholds in metres and radians."""
    return {
        name: correct_rows(rows, thresholds)
        for name, rows in _by_scene(results).items()
    }


def scores(results: Sequence[FrameResult]) -> Scores:
    """Compute scores of scenes from the results of all frames, at least one."""
    if not results:
        raise ValueError("scores needs at least one result, got none")
    scenes = {name: _scene_scores(rows) for name, rows in _by_scene(results).items()}
    return Scores(
        scenes=scenes,
        mean_accuracy_5cm_5deg=_mean(scenes.values(), "accuracy_5cm_5deg"),
        mean_accuracy_1cm_1deg=_mean(scenes.values(), "accuracy_1cm_1deg"),
        ms_per_image=_mean(results, "milliseconds"),
    )


def share_inside(squared: ArrayLike) -> float:
    """Per cent of squared Mahalanobis errors (n,) inside the 95 % ellipsoid.

    NaN entries are ignored; the result is NaN without any number.
    """
    values = np.asarray(squared, float)
    values = values[~np.isnan(values)]
    if not len(values):
        return math.nan
    return _percent(values < CHI2_6)


def recall_area(translation_m: ArrayLike, within_m: float = 0.2) -> float:
    """Area under the curve of recall over position errors (frames,) up to `within_m`, in per cent.

    It separates methods that have few frames below any single threshold.
    """
    errors = np.asarray(translation_m, float)
    return 100 * float(np.clip(1 - errors / within_m, 0, 1).mean())


def continual_scores(accuracies: ArrayLike) -> ContinualScores:
    """Final accuracy and forgetting of one run over a sequence of scenes; NaN for a single one.

    Entry (i, j) of `accuracies` (N, N) is the accuracy after stage i on the scene learned in stage
    j. Entries above the diagonal are ignored. With NaN in earlier stages, as of joint training, the
    final accuracy and that of the last scene are the only numbers.
    """
    matrix = np.asarray(accuracies, float)
    count = len(np.atleast_1d(matrix))
    if count == 0 or matrix.shape != (count, count):
        raise ValueError(
            f"accuracies must be square (stages, scenes), got {matrix.shape}"
        )
    last = matrix[-1]
    if not np.isfinite(last).all():
        raise ValueError(
            "accuracies must be finite after the last stage, got inf or nan"
        )
    along = float(matrix[np.tril_indices(count)].mean())
    final = float(last.mean())
    newest = float(last[-1])
    if count == 1:
        return ContinualScores(final, math.nan, math.nan, math.nan, newest, along)
    since_learned = np.where(np.tri(count, dtype=bool), matrix, -np.inf)[:, :-1]
    best = since_learned.max(0)
    best_before = since_learned[:-1].max(0)
    return ContinualScores(
        final_accuracy=final,
        total_forgetting=float((best - last[:-1]).mean()),
        forgetting=float((best_before - last[:-1]).mean()),
        backward_transfer=float((last - np.diag(matrix))[:-1].mean()),
        last_scene_accuracy=newest,
        accuracy_along=along,
    )


def _by_scene(results: Iterable[FrameResult]) -> dict[str, list[FrameResult]]:
    grouped: dict[str, list[FrameResult]] = {}
    for result in results:
        grouped.setdefault(result.scene, []).append(result)
    return grouped


def _scene_scores(rows: list[FrameResult]) -> SceneScores:
    status = column(rows, "status")
    return SceneScores(
        frames=len(rows),
        accuracy_5cm_5deg=_percent(correct_rows(rows, COARSE)),
        accuracy_2cm_2deg=_percent(correct_rows(rows, MIDDLE)),
        accuracy_1cm_1deg=_percent(correct_rows(rows, FINE)),
        accuracy_5mm_05deg=_percent(correct_rows(rows, FINEST)),
        median_translation_cm=100.0 * upper_median(rows, "translation_error_m"),
        median_rotation_deg=math.degrees(upper_median(rows, "rotation_error_rad")),
        wrong_scene=_percent(column(rows, "wrong_scene")),
        unknown=_percent(np.isin(status, ("uncertain", "unknown_scene", "ambiguous"))),
        near_training_frame=_percent(column(rows, "near_training_frame")),
        inside_95=share_inside(column(rows, "squared_mahalanobis")),
    )


def correct_rows(rows: Iterable[FrameResult], thresholds: Thresholds) -> BoolArray:
    """Which rows (n,) are correct, by thresholds in metres and radians."""
    metres, radians = thresholds
    near = column(rows, "translation_error_m") < metres
    return near & (column(rows, "rotation_error_rad") < radians)


def upper_median(rows: Iterable[FrameResult], name: str) -> float:
    """The upper median: a mean of the two middle errors may include infinity."""
    values = np.sort(column(rows, name))
    return float(values[len(values) // 2])


def _mean(rows: Iterable[SceneScores | FrameResult], name: str) -> float:
    return float(np.mean(column(rows, name)))


def column(rows: Iterable[SceneScores | FrameResult], name: str) -> np.ndarray:
    """The values (n,) of a field."""
    return np.array([getattr(row, name) for row in rows])


def _percent(flags: BoolArray) -> float:
    return 100.0 * int(flags.sum()) / len(flags)


def _plain(record: SceneScores | ContinualScores) -> JsonObject:
    values = dataclasses.asdict(record)
    for key, value in values.items():
        if not math.isfinite(value):
            values[key] = None
    return values
