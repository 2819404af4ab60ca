"""From results per frame to scores per scene, and from accuracies per stage to forgetting.

Units: results are in metres and radians, scores in per cent, centimetres and degrees. A frame is
correct if both errors are strictly below the thresholds; a frame without a pose, or placed in
another scene, has infinite errors.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.geometry import SE3

Status = Literal["ok", "unknown_scene", "failed"]

COARSE = (0.05, math.radians(5.0))
"""5 cm and 5 deg, the threshold of the indoor benchmarks, in metres and radians."""
MIDDLE = (0.02, math.radians(2.0))
"""2 cm and 2 deg, in metres and radians."""
FINE = (0.01, math.radians(1.0))
"""1 cm and 1 deg, in metres and radians."""
FINEST = (0.005, math.radians(0.5))
"""5 mm and 0.5 deg, in metres and radians."""

CHI2_6 = 12.5916
"""95 % quantile of chi square with six degrees of freedom."""


@dataclass(frozen=True)
class FrameResult:
    """What became of one test image."""

    scene: str
    """The scene that the image is from."""
    frame: str
    """The frame's name within its scene."""
    translation_error_m: float
    """Metres; infinite without a pose in the right scene."""
    rotation_error_rad: float
    """Radians; infinite without a pose in the right scene."""
    status: Status
    """What the localizer said."""
    found_scene: str | None
    """The scene that the localizer named, if any."""
    near_training_frame: bool
    """Whether a training frame of its scene lies within 5 cm and 5 deg."""
    milliseconds: float
    """Time from the encoded image to the answer."""
    inliers: int
    """How many scene points agree with the pose."""
    inlier_ratio: float
    """The same as a share of all scene points, 0 to 1."""
    squared_mahalanobis: float = math.nan
    """Squared error of the pose in units of its own covariance; NaN without a pose in the right
    scene or without a covariance."""
    estimated: SE3 | None = field(default=None, compare=False)
    """Estimated camera pose in the base frame of `found_scene`."""

    @property
    def wrong_scene(self) -> bool:
        """Whether a pose was given, but in a scene of another base frame."""
        return self.status == "ok" and math.isinf(self.translation_error_m)


@dataclass(frozen=True)
class SceneScores:
    """One scene's row."""

    frames: int
    """How many test frames were scored."""
    accuracy_5cm_5deg: float
    """Per cent."""
    accuracy_2cm_2deg: float
    """Per cent."""
    accuracy_1cm_1deg: float
    """Per cent."""
    accuracy_5mm_05deg: float
    """Per cent, within 5 mm and 0.5 deg."""
    median_translation_cm: float
    """Over all frames, those without a pose as infinite."""
    median_rotation_deg: float
    """Over all frames, those without a pose as infinite."""
    wrong_scene: float
    """Per cent of frames that got a pose in another scene."""
    unknown: float
    """Per cent of frames that the localizer said it does not know."""
    near_training_frame: float
    """Per cent of frames with a training frame within 5 cm and 5 deg: what a lookup could reach."""
    inside_95: float = math.nan
    """Per cent of the frames with a pose in the right scene whose true pose lies inside the 95 %
    ellipsoid that was stated for it; NaN where none was."""


@dataclass(frozen=True)
class Scores:
    """All scenes and what sums them up."""

    scenes: dict[str, SceneScores]
    """By name, in the order of the results."""
    mean_accuracy_5cm_5deg: float
    """Per cent, unweighted mean over scenes."""
    mean_accuracy_1cm_1deg: float
    """Per cent, unweighted mean over scenes."""
    ms_per_image: float
    """Mean milliseconds of one image at a time, decoding included."""

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; None stands for infinite."""
        return {
            "scenes": {name: _plain(row) for name, row in self.scenes.items()},
            "mean_accuracy_5cm_5deg": self.mean_accuracy_5cm_5deg,
            "mean_accuracy_1cm_1deg": self.mean_accuracy_1cm_1deg,
            "ms_per_image": self.ms_per_image,
        }


@dataclass(frozen=True)
class ContinualScores:
    """What a sequence of scenes did to accuracy; all in the unit of the accuracies given."""

    final_accuracy: float
    """Mean over scenes after the last stage."""
    total_forgetting: float
    """TFR: mean drop from a scene's best, the last stage included, to its last; never negative."""
    forgetting: float
    """The same with the best before the last stage (Chaudhry et al. 2018); negative is a gain."""
    backward_transfer: float
    """Mean change from just after learning a scene to the end (Lopez-Paz and Ranzato 2017)."""
    last_scene_accuracy: float
    """Accuracy on the scene learned last: can it still learn?"""
    accuracy_along: float
    """ACC: mean over all stages and the scenes known at each (Diaz-Rodriguez et al. 2018)."""

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; None where one scene alone leaves nothing to forget."""
        return _plain(self)


def correct(
    results: Iterable[FrameResult], thresholds: tuple[float, float] = COARSE
) -> dict[str, NDArray[np.bool_]]:
    """Which frames are right, per scene, in the order of the results.

    Args:
        results: In recorded order within each scene, if blocks of frames are to be resampled.
        thresholds: Metres and radians; an error equal to either is not below it.
    """
    metres, radians = thresholds
    return {
        scene: np.array(
            [r.translation_error_m < metres and r.rotation_error_rad < radians for r in rows]
        )
        for scene, rows in _by_scene(results).items()
    }


def scores(results: Sequence[FrameResult]) -> Scores:
    """Sums up the results of one run.

    Raises:
        ValueError: There are no results.
    """
    if not results:
        raise ValueError("scores takes at least one frame's result, got none")
    scenes = {scene: _scene_scores(rows) for scene, rows in _by_scene(results).items()}
    return Scores(
        scenes,
        float(np.mean([row.accuracy_5cm_5deg for row in scenes.values()])),
        float(np.mean([row.accuracy_1cm_1deg for row in scenes.values()])),
        float(np.mean([result.milliseconds for result in results])),
    )


def share_inside(squared: ArrayLike) -> float:
    """Per cent inside the 95 % ellipsoid among squared errors that are not NaN; NaN for none."""
    values = np.asarray(squared, dtype=np.float64)
    known = values[~np.isnan(values)]
    return _percent(known < CHI2_6) if len(known) else math.nan


def recall_area(translation_m: ArrayLike, within_m: float = 0.2) -> float:
    """Area under the curve of recall over position error, per cent of what it could be.

    It tells methods apart where few frames pass one bound, and jumps less from run to run.

    Args:
        translation_m: (frames,) errors, infinite without a pose in the right scene.
        within_m: where the curve ends.
    """
    errors = np.asarray(translation_m, dtype=np.float64)
    return 100 * float(np.clip(1 - errors / within_m, 0, 1).mean())


def continual_scores(accuracies: ArrayLike) -> ContinualScores:
    """Sums up one run through a sequence of scenes.

    Args:
        accuracies: (N, N); row i holds the accuracies after stage i, column j those of the scene
            learned in stage j. What stands above the diagonal, scenes not yet learned, is not
            read and may be NaN.

    Returns:
        Scores in the unit of `accuracies`; the three about forgetting are NaN for N = 1.

    Raises:
        ValueError: Not square, or no finite number on or below the diagonal.
    """
    matrix = np.asarray(accuracies, dtype=np.float64)
    count = len(matrix) if matrix.ndim == 2 else 0
    if count == 0 or matrix.shape != (count, count):
        raise ValueError(f"accuracies are (stages, scenes) and square, got {matrix.shape}")
    if not np.isfinite(matrix[np.tril_indices(count)]).all():
        raise ValueError("accuracies on and below the diagonal are finite, got inf or nan")
    last = matrix[-1]
    final, newest = float(last.mean()), float(last[-1])
    along = float(matrix[np.tril_indices(count)].mean())
    if count == 1:
        return ContinualScores(final, math.nan, math.nan, math.nan, newest, along)
    old = range(count - 1)
    best = np.array([matrix[j:, j].max() for j in old])
    best_before = np.array([matrix[j:-1, j].max() for j in old])
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
    middle = len(rows) // 2
    within = [_percent(*correct(rows, t).values()) for t in (COARSE, MIDDLE, FINE, FINEST)]
    return SceneScores(
        frames=len(rows),
        accuracy_5cm_5deg=within[0],
        accuracy_2cm_2deg=within[1],
        accuracy_1cm_1deg=within[2],
        accuracy_5mm_05deg=within[3],
        median_translation_cm=100.0 * sorted(row.translation_error_m for row in rows)[middle],
        median_rotation_deg=math.degrees(sorted(row.rotation_error_rad for row in rows)[middle]),
        wrong_scene=_percent([row.wrong_scene for row in rows]),
        unknown=_percent([row.status == "unknown_scene" for row in rows]),
        near_training_frame=_percent([row.near_training_frame for row in rows]),
        inside_95=share_inside([row.squared_mahalanobis for row in rows]),
    )


def _percent(flags: ArrayLike) -> float:
    flags = np.asarray(flags)
    return 100.0 * int(flags.sum()) / len(flags)


def _plain(record: SceneScores | ContinualScores) -> dict[str, object]:
    return {
        key: value if math.isfinite(value) else None
        for key, value in dataclasses.asdict(record).items()
    }
