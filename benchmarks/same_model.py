"""Images of other cameras of the recording's model, whose intrinsics are not stated.

Cameras of one model differ by half a per cent in focal length, and by some pixels in principal
point. Maps are learned from the middle of each image, so that views of the same size by other
cameras fit into it.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy import wrong
from benchmarks.lenses import View, cropped
from benchmarks.rows import median_of, save
from evercal.geometry import Camera, UncertainPose
from evercal.localization.parallel import in_parallel
from evercal.map import Map
from evercal.recordings.frame import Frame
from evercal.recordings.samples import sample_rooms

MARGIN = 0.0375
"""Part of an image that the recording leaves out on each side."""
SPREAD = {"focal": 0.005, "centre": 0.006, "k1": 0.005}
"""Standard deviations among cameras of a model: focal length as a share, principal point as a share
of the width, first distortion coefficient."""
FIXED_IMAGES = 12
"""Images of a fixed camera."""
INSIDE_95 = 7.815
"""95 % quantile of a squared deviation in three dimensions (chi-squared)."""


def run(
    out: Path = Path("runs/same-model.csv"), cameras: int = 8, every: int = 3
) -> None:
    """Locate test images of the packaged rooms as other cameras of the same model see them.

    The images are of the recording's own camera and of others. No camera is stated, or the
    recording's, or the right one. Fixed cameras are calibrated in the same way.

    Args:
        out: File of rows to write.
        cameras: Other cameras that are drawn.
        every: Step between test images.
    """
    spread = SPREAD["focal"], SPREAD["centre"], SPREAD["centre"], SPREAD["k1"]
    draws = np.random.default_rng(0).normal(size=(cameras, 4)) * spread
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        learned = Map.open(Path(scratch) / "rooms")
        frames: list[Frame] = []
        fixed: list[Sequence[Frame]] = []
        rooms = sample_rooms()
        recorded = seen(rooms[0].scene.train[0], np.zeros(4)).camera
        for room in rooms:
            middle = tuple(seen(frame, np.zeros(4)) for frame in room.scene.train)
            learned.learn(replace(room.scene, train=middle, test=()))
            frames += room.scene.test[::every]
            fixed += [room.fixed.test[:FIXED_IMAGES]] if room.fixed else []
        for name, changes in (("own", np.zeros((1, 4))), ("another", draws)):
            images = [seen(frame, change) for change in changes for frame in frames]
            views = [
                [seen(frame, change) for frame in of]
                for change in changes
                for of in fixed
            ]
            choices: dict[str, Callable[[Frame], Camera | None]] = {
                "none": lambda _: None,
                "the recording's": lambda _: recorded,
                "the right one": lambda frame: frame.camera,
            }
            for stated, given in list(choices.items())[: 2 if name == "own" else 3]:
                what = {"camera": name, "stated": stated}
                poses = [_calibrated(learned, of, given(of[0])) for of in views]
                answers = _answers(learned, images, given)
                rows.append({"answer": "image", **what, **_summary(answers, images)})
                first = [of[0] for of in views]
                rows.append(
                    {"answer": "fixed camera", **what, **_summary(poses, first)}
                )
    settings = {"cameras": cameras, "every": every, "draws": draws.round(5).tolist()}
    save(out, rows, settings)


def seen(frame: Frame, change: np.ndarray) -> Frame:
    """The middle of a frame as a camera with changed intrinsics (4,) sees it, see `SPREAD`."""
    own = frame.camera
    left = round(MARGIN * own.width)
    top = round(MARGIN * own.height)
    middle = cropped(own, left, top, own.width - 2 * left, own.height - 2 * top)
    zoomed, (x, y) = middle.zoomed(1 + change[0]), change[1:3] * own.width
    camera = replace(zoomed, cx=middle.cx + x, cy=middle.cy + y)
    if change[3]:
        camera = replace(camera, distortion=(float(change[3]), 0.0, 0.0, 0.0))
    return replace(
        frame, image=View(camera).render(frame.read_image(), own), camera=camera
    )


def _answers(
    learned: Map, frames: Sequence[Frame], given: Callable[[Frame], Camera | None]
) -> list[UncertainPose | None]:
    def located(frame: Frame) -> UncertainPose | None:
        answer = learned.localize(frame.read_image(), given(frame))
        return answer.uncertain_pose if answer.status == "ok" else None

    return list(in_parallel(located, frames))


def _calibrated(
    learned: Map, frames: Sequence[Frame], camera: Camera | None
) -> UncertainPose:
    found = learned.calibrate([frame.read_image() for frame in frames], camera=camera)
    return UncertainPose(found.parent_from_child, found.covariance)


def _summary(
    answers: Sequence[UncertainPose | None], frames: Sequence[Frame]
) -> Mapping[str, object]:
    """Errors in millimetres, and whether the covariance contains them."""
    errors = []
    deviations = []
    sigmas = []
    for pose, frame in zip(answers, frames, strict=True):
        truth = frame.base_from_camera
        if pose is not None and truth is not None:
            off = pose.pose.translation_m - truth.translation_m
            covariance = pose.covariance[:3, :3]
            errors.append(1000 * np.linalg.norm(off))
            deviations.append(off @ np.linalg.solve(covariance, off))
            sigmas.append(1000 * np.sqrt(np.trace(covariance) / 3))
    mm = np.array(errors)
    squared = np.array(deviations)
    return {
        "answers": len(frames),
        "located": len(errors),
        "median_mm": median_of(mm),
        "95_%_mm": float(np.percentile(mm, 95)),
        "sigma_mm": median_of(sigmas),
        "inside_95_%": 100 * float((squared < INSIDE_95).mean()),
        "wrong": int(wrong(mm, squared).sum()),
    }
