"""Images of other cameras of the recording's model, whose intrinsics are not stated.

Cameras of one model differ by half a per cent in focal length, and by some pixels in principal
point. Maps are learned from the middle of each image, so that views of the same size by other
cameras fit into it.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from tabulate import tabulate

from benchmarks.lenses import View, cropped
from evercal.geometry import UncertainPose
from evercal.localization import intrinsics
from evercal.localization.parallel import in_parallel
from evercal.map import Map
from evercal.recordings.frame import Frame
from evercal.recordings.samples import sample_rooms

MARGIN = 0.0375
"""Part of an image that the recording leaves out on each side."""
SPREAD = {"focal": 0.005, "centre": 0.006, "k1": 0.005}
"""Standard deviations among cameras of a model: focal length as a share, principal point as a share
of the width, first distortion coefficient."""
WRONG_MM, WRONG_SIGMAS = 10.0, 5.0
"""A wrong answer is so far off, and more than so many of its own standard deviations."""
FIXED_IMAGES = 12
"""Images of a fixed camera."""
INSIDE_95 = 7.815
"""95 % quantile of a squared deviation in three dimensions (chi-squared)."""


def run(out: Path = Path("runs/same-model.json"), cameras: int = 8, every: int = 3) -> None:
    """Locate test images of the packaged rooms as other cameras of the same model see them.

    The images are of the recording's own camera, of others, and of others with stated intrinsics.
    The rows `own` leave out the possibility of another camera. Fixed cameras are calibrated in the
    same way.

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
        for room in sample_rooms():
            middle = tuple(_seen(frame, np.zeros(4)) for frame in room.scene.train)
            learned.learn(replace(room.scene, train=middle, test=()))
            frames += room.scene.test[::every]
            fixed += [room.fixed.test[:FIXED_IMAGES]] if room.fixed else []
        for name, changes in (("own", np.zeros((1, 4))), ("another", draws)):
            images = [_seen(frame, change) for change in changes for frame in frames]
            views = [[_seen(frame, change) for frame in of] for change in changes for of in fixed]
            for supposed in ("own or another", "own", "as stated")[: 2 if name == "own" else 3]:
                stated, what = supposed == "as stated", {"camera": name, "supposed": supposed}
                with _without_others(supposed == "own"):
                    poses = [_calibrated(learned, of, stated) for of in views]
                    answers = _answers(learned, images, stated)
                rows.append({"answer": "image", **what, **_summary(answers, images)})
                first = [of[0] for of in views]
                rows.append({"answer": "fixed camera", **what, **_summary(poses, first)})
    settings = {"cameras": cameras, "every": every, "draws": draws.round(5).tolist()}
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({"rows": rows, "settings": settings}, indent=1))
    print(tabulate(rows, "keys", floatfmt=".3g"))


def _seen(frame: Frame, change: np.ndarray) -> Frame:
    """The middle of a frame as a camera with changed intrinsics (4,) sees it, see `SPREAD`."""
    own = frame.camera
    left, top = round(MARGIN * own.width), round(MARGIN * own.height)
    middle = cropped(own, left, top, own.width - 2 * left, own.height - 2 * top)
    zoomed, (x, y) = middle.zoomed(1 + change[0]), change[1:3] * own.width
    camera = replace(zoomed, cx=middle.cx + x, cy=middle.cy + y)
    if change[3]:
        camera = replace(camera, distortion=(float(change[3]), 0.0, 0.0, 0.0))
    return replace(frame, image=View(camera).render(frame.read_image(), own), camera=camera)


@contextmanager
def _without_others(without: bool) -> Iterator[None]:
    """Suppose that no image is of another camera than its size suggests."""
    before = intrinsics.OTHER_CAMERA
    intrinsics.OTHER_CAMERA = 0.0 if without else before
    try:
        yield
    finally:
        intrinsics.OTHER_CAMERA = before


def _answers(learned: Map, frames: Sequence[Frame], stated: bool) -> list[UncertainPose | None]:
    def located(frame: Frame) -> UncertainPose | None:
        answer = learned.localize(frame.read_image(), frame.camera if stated else None)
        return answer.uncertain_pose if answer.status == "ok" else None

    return list(in_parallel(located, frames))


def _calibrated(learned: Map, frames: Sequence[Frame], stated: bool) -> UncertainPose | None:
    camera = frames[0].camera if stated else None
    found = learned.calibrate([frame.read_image() for frame in frames], camera=camera)
    return UncertainPose(found.parent_from_child, found.covariance)


def _summary(
    answers: Sequence[UncertainPose | None], frames: Sequence[Frame]
) -> Mapping[str, object]:
    """Errors in millimetres, and whether the covariance contains them."""
    errors, deviations, sigmas = [], [], []
    for pose, frame in zip(answers, frames, strict=True):
        truth = frame.base_from_camera
        if pose is not None and truth is not None:
            off = pose.pose.translation_m - truth.translation_m
            covariance = pose.covariance[:3, :3]
            errors.append(1000 * np.linalg.norm(off))
            deviations.append(off @ np.linalg.solve(covariance, off))
            sigmas.append(1000 * np.sqrt(np.trace(covariance) / 3))
    wrong = (np.array(errors) > WRONG_MM) & (np.array(deviations) > WRONG_SIGMAS**2)
    return {
        "answers": len(frames),
        "located": len(errors),
        "median_mm": float(np.median(errors)),
        "95_%_mm": float(np.percentile(errors, 95)),
        "sigma_mm": float(np.median(sigmas)),
        "inside_95_%": 100 * float(np.mean(np.array(deviations) < INSIDE_95)),
        "wrong": int(wrong.sum()),
    }
