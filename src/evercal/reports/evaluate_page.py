"""The HTML report of `evercal evaluate`."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.reports.pictures import draw_estimate

if TYPE_CHECKING:
    from evercal.evaluation import FrameResult, Scores
    from evercal.geometry import SE3, Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer
    from evercal.recordings import Frame, Recording
    from evercal.reports import Section, Table

_WORST = 12
_AXES_CM = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


class Watch:
    """A localizer that remembers the poses it gave, frame by frame.

    `evaluate` shows images in random order and keeps errors only. Frames are told apart by their
    camera object, of which every frame of `watched` has its own.

    Args:
        localizer: does the work.
        scenes: by name; their frames stay as they are.
    """

    def __init__(self, localizer: "Localizer", scenes: "Mapping[str, Recording]"):
        self.localizer = localizer
        self.watched = {name: _with_own_cameras(scene) for name, scene in scenes.items()}
        self._poses: dict[int, SE3] = {}

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the scenes that the localizer knows."""
        return self.localizer.scenes

    def localize(self, image: "NDArray[np.uint8]", camera: "Camera", /) -> "PoseEstimate":
        """The localizer's answer."""
        estimate = self.localizer.localize(image, camera)
        if estimate.base_from_camera is not None:
            self._poses[id(camera)] = estimate.base_from_camera
        return estimate

    def found(self, frame: "Frame") -> "SE3 | None":
        """The pose that was given for a frame of `watched`, in the frame of the scene it named."""
        return self._poses.get(id(frame.camera))


def _with_own_cameras(scene: "Recording") -> "Recording":
    frames = (dataclasses.replace(f, camera=dataclasses.replace(f.camera)) for f in scene.test)
    return dataclasses.replace(scene, test=tuple(frames))


def evaluation_page(
    watch: Watch, results: "Sequence[FrameResult]", summary: "Scores", store: str
) -> str:
    """Everything that `evaluate` found out, on one page.

    Args:
        watch: what answered.
        results: for each frame.
        summary: of the results.
        store: its path, for the title.
    """
    from evercal.reports import Picture, Section, html_page

    errors: dict[str, list[float]] = {}
    for result in results:
        errors.setdefault(result.scene, []).append(result.translation_error_m)
    sections = [
        Section("", [_summary(summary), _table(summary)]),
        Section("Errors", [Picture(_curve(errors), "Share of frames within an error")]),
    ]
    for name in errors:
        rows = [result for result in results if result.scene == name]
        sections.append(_trajectory(watch, name, rows))
    sections.append(_worst(watch, results))
    return html_page(f"{store}: evaluation", sections)


def _curve(errors: "Mapping[str, Sequence[float]]") -> bytes:
    """The error curve, with an axis that shows 95 % of the errors."""
    from evercal.reports import error_curve

    finite = [100 * e for values in errors.values() for e in values if math.isfinite(e)]
    most = float(np.quantile(finite, 0.95)) if finite else math.inf
    limit = next((cm for cm in _AXES_CM if cm >= most), _AXES_CM[-1])
    return error_curve(errors, limit, 5.0 if limit > 5 else None)


def _summary(summary: "Scores") -> str:
    frames = sum(row.frames for row in summary.scenes.values())
    return (
        f"{frames} test frames of {len(summary.scenes)} scenes, mixed; the localizer saw images"
        f" and cameras only. Mean accuracy at 5 cm, 5 deg: {summary.mean_accuracy_5cm_5deg:.1f} %,"
        f" at 1 cm, 1 deg: {summary.mean_accuracy_1cm_1deg:.1f} %."
        f" {summary.ms_per_image:.0f} ms per image, decoding included. A frame without a pose, or"
        f" in another scene, counts as wrong."
    )


def _table(summary: "Scores") -> "Table":
    from evercal.evaluation.tables import SCENE_HEADER, scene_rows
    from evercal.reports import Table

    return Table(SCENE_HEADER, scene_rows(summary))


def _trajectory(watch: Watch, name: str, rows: "list[FrameResult]") -> "Section":
    from evercal.reports import Picture, Section, trajectory

    frames = {frame.name: frame for frame in watch.watched[name].test}
    truth, estimated, ok = [], [], []
    for row in rows:
        frame = frames[row.frame]
        found, right_scene = watch.found(frame), row.status == "ok" and row.found_scene == name
        assert frame.base_from_camera is not None, "only posed frames have results"
        truth.append(frame.base_from_camera.translation_m)
        ok.append(found is not None and right_scene)
        estimated.append(found.translation_m if found is not None else np.zeros(3))
    # The two axes along which the camera moved most: which way is up is not known here.
    spread = np.ptp(np.array(truth), axis=0)
    first, second = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    picture = trajectory(truth, estimated, ok, (first, second))
    return Section(name, [Picture(picture, f"{name}: where the camera was and where it was found")])


def _worst(watch: Watch, results: "Sequence[FrameResult]") -> "Section":
    from evercal.reports import Picture, Section, contact_sheet, encode_image

    chosen = sorted(results, key=lambda r: (-r.translation_error_m, r.inlier_ratio))[:_WORST]
    images, captions = [], []
    for result in chosen:
        frames = watch.watched[result.scene].test
        frame = next(frame for frame in frames if frame.name == result.frame)
        image = frame.read_image()
        estimate = watch.localizer.localize(image, frame.camera)
        images.append(draw_estimate(image, estimate, frame.camera, legend=False))
        captions.append(f"{result.scene} {result.frame}: {_verdict(result)}")
    sheet = encode_image(contact_sheet(images, 3, captions, cell_width=320), "jpg")
    caption = "The frames with the largest errors; points are those that agree with the pose"
    return Section("Worst frames", [Picture(sheet, caption)])


def _verdict(result: "FrameResult") -> str:
    from evercal.evaluation.tables import distance

    if math.isfinite(result.translation_error_m):
        degrees = math.degrees(result.rotation_error_rad)
        return f"{distance(result.translation_error_m)}, {degrees:.2f} deg"
    if result.wrong_scene:
        return f"taken for {result.found_scene}"
    return result.status.replace("_", " ")
