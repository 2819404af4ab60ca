"""The HTML report of `evercal evaluate`."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from evercal.evaluation import scores
from evercal.evaluation.tables import SCENE_HEADER, scene_rows
from evercal.reports.charts import error_curve, trajectory
from evercal.reports.overlay import encode_image
from evercal.reports.page import Picture, Table, Tile, render
from evercal.reports.pictures import draw_estimate

if TYPE_CHECKING:
    from evercal.evaluation import FrameResult
    from evercal.evaluation.metrics import Scores
    from evercal.localization.learned import LearnedLocalizer
    from evercal.recordings import Recording

_WORST = 12
_AXES_MM = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)


def evaluation_page(
    localizer: "LearnedLocalizer",
    scenes: "Mapping[str, Recording]",
    results: "Sequence[FrameResult]",
    store: str,
) -> str:
    """Write the report of an evaluation.

    The localizer draws the worst frames.
    """
    summary = scores(results)
    by_scene = {name: [r for r in results if r.scene == name] for name in summary.scenes}
    mm = 1000 * float(np.median([r.translation_error_m for r in results]))
    deg = math.degrees(float(np.median([r.rotation_error_rad for r in results])))
    return render(
        "evaluate.html",
        title=f"{store}: evaluation",
        headline=f"{mm:.2f} mm and {deg:.3f} deg median error"
        if math.isfinite(mm)
        else "No right pose for half of the frames",
        level="",
        first=_tiles(summary),
        frames=len(results),
        summary=summary,
        scores=Table(SCENE_HEADER, scene_rows(summary)),
        curve=_curve(by_scene),
        trajectories=[_trajectory(scenes[name], rows) for name, rows in by_scene.items()],
        worst=_worst(localizer, scenes, results),
    )


def _tiles(summary: "Scores") -> list[Tile]:
    shares = {
        "10 mm and 1 deg": summary.mean_accuracy_1cm_1deg,
        "50 mm and 5 deg": summary.mean_accuracy_5cm_5deg,
    }
    return [
        *(
            Tile(f"{share:.1f} %", f"of frames within {b}, mean of scenes")
            for b, share in shares.items()
        ),
        Tile(f"{summary.ms_per_image:.0f} ms", "per image, one at a time, decoding included"),
    ]


def _curve(by_scene: "Mapping[str, Sequence[FrameResult]]") -> Picture:
    """The error curve with an axis that contains 95 % of the finite errors."""
    errors = {name: [r.translation_error_m for r in rows] for name, rows in by_scene.items()}
    finite = [1000 * e for values in errors.values() for e in values if math.isfinite(e)]
    most = float(np.quantile(finite, 0.95)) if finite else math.inf
    limit = next((mm for mm in _AXES_MM if mm >= most), _AXES_MM[-1])
    curve = error_curve(errors, limit, 50.0 if limit > 50 else None)
    return Picture(curve, "Share of frames below each error")


def _trajectory(scene: "Recording", rows: "Sequence[FrameResult]") -> Picture:
    poses = {frame.name: frame.base_from_camera for frame in scene.test}
    truth = [pose.translation_m for row in rows if (pose := poses[row.frame]) is not None]
    estimated = [
        row.estimated.translation_m
        if row.estimated is not None and row.found_scene == row.scene and row.status == "ok"
        else np.full(3, np.nan)
        for row in rows
    ]
    caption = f"{rows[0].scene}: true and estimated camera positions"
    return Picture(trajectory(truth, estimated), caption)


def _worst(
    localizer: "LearnedLocalizer",
    scenes: "Mapping[str, Recording]",
    results: "Sequence[FrameResult]",
) -> list[Picture]:
    pictures = []
    for result in sorted(results, key=lambda r: (-r.translation_error_m, r.inlier_ratio))[:_WORST]:
        frame = next(f for f in scenes[result.scene].test if f.name == result.frame)
        image = frame.read_image()
        estimate = localizer.localize(image, frame.camera)
        drawn = encode_image(draw_estimate(image, estimate, frame.camera), "jpg")
        pictures.append(Picture(drawn, f"{result.scene} {result.frame}: {_outcome(result)}"))
    return pictures


def _outcome(result: "FrameResult") -> str:
    if math.isfinite(result.translation_error_m):
        degrees = math.degrees(result.rotation_error_rad)
        return f"{1000 * result.translation_error_m:.2f} mm, {degrees:.3f} deg"
    if result.wrong_scene:
        return f"wrong scene: {result.found_scene}"
    return result.status.replace("_", " ")
