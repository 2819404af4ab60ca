"""The evaluation protocol: test images of all scenes in random order, without their scene names."""

import os
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from evercal.errors import InputError
from evercal.evaluation.metrics import FrameResult
from evercal.geometry import pose_distance
from evercal.geometry.near import near_training
from evercal.localization.learned import SceneLocalizer
from evercal.recordings import (
    Frame,
    Recording,
    load_recording,
    posed_frames,
    stated_poses,
)
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
    named = _named(scenes)
    tests = {
        name: _test_frames(localizer, name, scene) for name, scene in named.items()
    }
    if not tests:
        raise InputError(
            f"no scene to evaluate; give one or more of {_listed(localizer.scenes)}"
        )
    near = [
        flag for name, frames in tests.items() for flag in _near(named[name], frames)
    ]
    jobs = [(name, frame) for name, frames in tests.items() for frame in frames]
    results: dict[int, FrameResult] = {}
    for done, index in enumerate(
        np.random.default_rng(seed).permutation(len(jobs)), start=1
    ):
        name, frame = jobs[index]
        accepted = _same_base(name, named)
        results[int(index)] = _result(localizer, name, frame, near[index], accepted)
        if on_frame is not None:
            on_frame(done, len(jobs))
    return [results[index] for index in range(len(jobs))]


def _named(
    scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded],
) -> dict[str, Recording]:
    if isinstance(scenes, Mapping):
        return {name: _loaded(scene) for name, scene in scenes.items()}
    given = [scenes] if isinstance(scenes, str | os.PathLike | Recording) else scenes
    named: dict[str, Recording] = {}
    for scene in map(_loaded, given):
        if scene.name in named:
            raise InputError(
                f"scene {scene.name!r}: given twice; give a mapping of the names under which they"
                " were learned"
            )
        named[scene.name] = scene
    return named


def _loaded(scene: Recorded) -> Recording:
    return scene if isinstance(scene, Recording) else load_recording(scene)


def _test_frames(
    localizer: SceneLocalizer, name: str, scene: Recording
) -> tuple[Frame, ...]:
    if name not in localizer.scenes:
        raise InputError(
            f"scene {name!r} is not in the store; its scenes are {_listed(localizer.scenes)};"
            " give NAME=SCENE with the name under which it was learned"
        )
    frames = posed_frames(scene.test)
    if not frames:
        raise InputError(
            f"scene {name!r} has {len(scene.test)} test frames, none with a pose; give a scene with"
            " posed test frames"
        )
    return frames


def _same_base(name: str, scenes: Mapping[str, Recording]) -> set[str]:
    base = scenes[name].base
    return {name} | {
        n for n, scene in scenes.items() if base is not None and scene.base == base
    }


def _result(
    localizer: SceneLocalizer, name: str, frame: Frame, near: bool, accepted: set[str]
) -> FrameResult:
    start = time.perf_counter()
    estimate = localizer.localize(frame.read_image(), frame.camera)
    milliseconds = 1e3 * (time.perf_counter() - start)
    metres = radians = np.inf
    squared = np.nan
    truth = frame.base_from_camera
    pose = estimate.base_from_camera
    if estimate.status == "ok" and estimate.scene in accepted:
        assert truth is not None
        assert pose is not None, "an estimate whose status is ok has a pose"
        metres, radians = pose_distance(truth, pose)
        uncertain = estimate.uncertain_pose
        if uncertain is not None:
            squared = uncertain.squared_mahalanobis(truth)
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
        estimated=pose,
    )


def _near(scene: Recording, frames: Sequence[Frame]) -> list[bool]:
    return near_training(stated_poses(scene.train), stated_poses(frames)).tolist()


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"
