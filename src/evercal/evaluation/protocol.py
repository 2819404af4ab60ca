"""The evaluation protocol: test images of all scenes in random order, without their scene names."""

import os
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.evaluation.metrics import FrameResult
from evercal.geometry import pose_distance
from evercal.geometry.near import near_training
from evercal.localization.pictures import SceneLocalizer
from evercal.recordings import (
    Frame,
    Recording,
    load_recording,
    posed_frames,
    stated_poses,
)
from evercal.storage.text_files import few
from evercal.typing import PathLike

Recorded = PathLike | Recording
"""A recording, or its folder."""


def evaluate(
    localizer: SceneLocalizer,
    scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded],
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[FrameResult]:
    """Localize every test image of scenes, one at a time in random order.

    The localizer gets image and camera only. Errors are measured if the estimated scene is that of
    the frame or has the same base frame (`Recording.base`), and are infinite otherwise. Test frames
    without a pose are skipped.

    Args:
        localizer: A localizer that learned these scenes, and possibly others.
        scenes: Recordings or their folders; a mapping where the localizer has other names.
        seed: Seed of the random order; results are in recorded order.
        on_frame: Called after each image with the numbers of images done and in total.
    """
    recordings = _named(scenes)
    tests: list[_Test] = []
    for name in recordings:
        tests += _scene_tests(localizer, name, recordings)
    if not tests:
        names = few(localizer.scenes) or "none"
        raise InputError(f"no scene to evaluate; give one or more of {names}")
    results: dict[int, FrameResult] = {}
    order = np.random.default_rng(seed).permutation(len(tests))
    for done, index in enumerate(order.tolist(), start=1):
        results[index] = _result(localizer, tests[index])
        if on_frame is not None:
            on_frame(done, len(tests))
    return [results[index] for index in range(len(tests))]


@frozen
class _Test:
    """A frame to localize."""

    scene: str
    frame: Frame
    near_training: bool
    """Whether a training frame of the scene is within 5 cm and 5 deg."""
    accepted: set[str]
    """Scenes with the base frame of the frame's scene."""


def _named(
    scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded],
) -> dict[str, Recording]:
    named: dict[str, Recording] = {}
    if isinstance(scenes, Mapping):
        for name, scene in scenes.items():
            named[name] = _loaded(scene)
        return named
    if isinstance(scenes, str | os.PathLike | Recording):
        scenes = [scenes]
    for scene in map(_loaded, scenes):
        if scene.name in named:
            raise InputError(
                f"scene {scene.name!r}: given twice; give a mapping of the names under which they"
                " were learned"
            )
        named[scene.name] = scene
    return named


def _loaded(scene: Recorded) -> Recording:
    if isinstance(scene, Recording):
        return scene
    return load_recording(scene)


def _scene_tests(
    localizer: SceneLocalizer, name: str, recordings: Mapping[str, Recording]
) -> list[_Test]:
    if name not in localizer.scenes:
        names = few(localizer.scenes) or "none"
        raise InputError(
            f"scene {name!r} is not in the store; its scenes are {names};"
            " give NAME=SCENE with the name under which it was learned"
        )
    scene = recordings[name]
    frames = posed_frames(scene.test)
    if not frames:
        raise InputError(
            f"scene {name!r} has {len(scene.test)} test frames, none with a pose; give a scene with"
            " posed test frames"
        )
    accepted = {name}
    for other, recording in recordings.items():
        if scene.base is not None and recording.base == scene.base:
            accepted.add(other)
    near = near_training(stated_poses(scene.train), stated_poses(frames)).tolist()
    return [_Test(name, *row, accepted) for row in zip(frames, near, strict=True)]


def _result(localizer: SceneLocalizer, test: _Test) -> FrameResult:
    frame = test.frame
    start = perf_counter()
    estimate = localizer.localize(frame.read_image(), frame.camera)
    milliseconds = 1e3 * (perf_counter() - start)
    metres = radians = np.inf
    squared = np.nan
    truth = frame.base_from_camera
    pose = estimate.base_from_camera
    if estimate.status == "ok" and estimate.scene in test.accepted:
        assert truth
        assert pose, "an estimate whose status is ok has a pose"
        metres, radians = pose_distance(truth, pose)
        uncertain = estimate.uncertain_pose
        if uncertain:
            squared = uncertain.squared_mahalanobis(truth)
    return FrameResult(
        scene=test.scene,
        frame=frame.name,
        translation_error_m=float(metres),
        rotation_error_rad=float(radians),
        status=estimate.status,
        found_scene=estimate.scene,
        near_training_frame=test.near_training,
        milliseconds=milliseconds,
        inliers=int(estimate.inliers),
        inlier_ratio=float(estimate.inlier_ratio),
        squared_mahalanobis=squared,
        estimated=pose,
    )
