"""How a store is examined: the test images of all scenes in one list, no scene given away."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.evaluation.metrics import FrameResult, Status
from evercal.geometry import SE3, Camera, near_training, pose_distance, squared_mahalanobis
from evercal.recordings import Frame, Recording, posed_frames, stated_poses


class Estimate(Protocol):
    """What is read from a localizer's answer."""

    @property
    def status(self) -> Status:
        """Whether there is a pose, and if not, why."""
        ...

    @property
    def scene(self) -> str | None:
        """The scene that the image was found in."""
        ...

    @property
    def base_from_camera(self) -> SE3 | None:
        """The pose in the base frame of `scene`; not None if the status is ok."""
        ...

    @property
    def inliers(self) -> int:
        """How many scene points agree with the pose."""
        ...

    @property
    def inlier_ratio(self) -> float:
        """The same as a share of all scene points."""
        ...


class SceneLocalizer(Protocol):
    """What is examined: anything that takes an image and a camera and knows some scenes."""

    @property
    def scenes(self) -> Sequence[str]:
        """The names of the scenes it was taught."""
        ...

    def localize(self, image: NDArray[np.uint8], camera: Camera, /) -> Estimate:
        """Localizes one image (H, W, 3) uint8 RGB."""
        ...


def evaluate(
    localizer: SceneLocalizer,
    scenes: Mapping[str, Recording],
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[FrameResult]:
    """Localizes every test image of all scenes, one at a time and in random order, and scores it.

    The localizer sees an image and its camera only. Names are used afterwards: errors count if
    the scene that was found is the frame's, or has the same base frame (`Recording.base`), and are
    infinite otherwise. Test frames whose pose is
    not known cannot be scored and are left out.

    Args:
        localizer: What is examined.
        scenes: By the name under which the localizer was taught each; no need to give them all.
        seed: Of the random order.
        on_frame: Told the number of images done and of all images, after each.

    Returns:
        Results scene by scene in the order of `scenes`, frames in recorded order.

    Raises:
        InputError: No scenes, a scene that the localizer was not taught, one without test frames
            that have a pose, or an image that cannot be read.
    """
    tests = {name: _test_frames(localizer, name, scene) for name, scene in scenes.items()}
    if not tests:
        raise InputError(f"no scene to evaluate; give one or more of {_listed(localizer.scenes)}")
    near = [flag for name, frames in tests.items() for flag in _near(scenes[name], frames)]
    jobs = [(name, frame) for name, frames in tests.items() for frame in frames]
    results: dict[int, FrameResult] = {}
    for done, index in enumerate(np.random.default_rng(seed).permutation(len(jobs)), start=1):
        name, frame = jobs[index]
        results[int(index)] = _result(localizer, name, frame, near[index], _alike(name, scenes))
        if on_frame is not None:
            on_frame(done, len(jobs))
    return [results[index] for index in range(len(jobs))]


def _test_frames(localizer: SceneLocalizer, name: str, scene: Recording) -> tuple[Frame, ...]:
    if name not in localizer.scenes:
        raise InputError(
            f"scene {name!r} is not in the store, which knows {_listed(localizer.scenes)};"
            f" give it as NAME=SCENE with the name under which it was learned"
        )
    frames = posed_frames(scene.test)
    if not frames:
        raise InputError(
            f"scene {name!r} has {len(scene.test)} test frames, none with a known pose;"
            f" give a scene with posed test frames"
        )
    return frames


def _alike(name: str, scenes: Mapping[str, Recording]) -> set[str]:
    """The scenes in whose base frame a scene's poses are told."""
    base = scenes[name].base
    return {name} | {n for n, scene in scenes.items() if base is not None and scene.base == base}


def _result(
    localizer: SceneLocalizer, name: str, frame: Frame, near: bool, alike: set[str]
) -> FrameResult:
    start = time.perf_counter()
    estimate = localizer.localize(frame.read_image(), frame.camera)
    milliseconds = 1e3 * (time.perf_counter() - start)
    metres = radians = np.inf
    squared = np.nan
    # Not in `Estimate`: a localizer need not say how sure it is.
    covariance = getattr(estimate, "covariance", None)
    truth, found = frame.base_from_camera, estimate.base_from_camera
    if estimate.status == "ok" and estimate.scene in alike:
        assert truth is not None
        assert found is not None, "an estimate whose status is ok has a pose"
        metres, radians = pose_distance(truth, found)
        if covariance is not None:
            squared = squared_mahalanobis(found, covariance, truth)
    return FrameResult(
        scene=name,
        frame=frame.name,
        translation_error_m=float(metres),
        rotation_error_rad=float(radians),
        status=estimate.status,
        found_scene=estimate.scene,
        near_training_frame=near,
        milliseconds=milliseconds,
        inliers=int(estimate.inliers),
        inlier_ratio=float(estimate.inlier_ratio),
        squared_mahalanobis=squared,
        estimated=found,
    )


def _near(scene: Recording, frames: Sequence[Frame]) -> list[bool]:
    return near_training(stated_poses(scene.train), stated_poses(frames)).tolist()


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "no scene yet"
