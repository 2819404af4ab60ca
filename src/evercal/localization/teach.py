"""`learn_scene`: what the command line, the API and the benchmarks call to learn a scene."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock, Timeout

from evercal.continual.knowledge import Knowledge
from evercal.continual.learn import (
    Checkpoint,
    Encoding,
    Resume,
    Stage,
    StageOptions,
    learn,
)
from evercal.continual.robot import Robot, head_bytes, with_fit
from evercal.continual.strategies import STRATEGIES
from evercal.datasets.frame import Frame, Scene
from evercal.errors import InputError
from evercal.geometry.se3 import pose_distance
from evercal.localization.localizer import Localizer
from evercal.models.feature_cache import cache_features
from evercal.models.weights_file import network_bytes
from evercal.simulation.box_room import BoxRoom, default_camera
from evercal.storage.manifest import MANIFEST
from evercal.training.fit import Progress

MIN_TRAIN_FRAMES = 16
HELD_OUT_EVERY = 100
HELD_OUT_BLOCK = 4
NEGATIVE_ROOM_SEED = 8_990
CHI2_6_MEDIAN = 5.348
BELIEVED = 1 / 6


@dataclass(frozen=True)
class LearnOptions:
    """How a scene is learned into a store."""

    stage: StageOptions = field(default_factory=StageOptions)
    """Network and training."""
    strategy: str = "evercal"
    """Key of STRATEGIES; a store keeps the strategy it was made with."""
    encoder: Path | torch.nn.Module | None = None
    """Another encoder than the shipped one: a file for a new store, or a module of one's own."""
    short_side: int = 240
    """Working size of images in a new store, pixels."""
    cache: Path | None = None
    """Folder for features of views, for many runs over the same frames (`cache_features`)."""


@dataclass(frozen=True)
class LearnReport:
    """What came out."""

    scene: str
    """Its name in the store."""
    seconds: float
    """Wall time of this call; a resumed run counts from the resumption."""
    iterations: int
    """Optimiser steps of the stage."""
    memory_bytes: int
    """What replay keeps of all scenes."""
    head_bytes: int
    """All heads, as stored."""
    frames_kept: int
    """Frames of this scene in memory."""
    train_frames: int
    """Frames learned."""
    held_out_frames: int
    """Frames kept aside to fit the threshold of the unknown."""
    inlier_threshold: float
    """Smallest inlier ratio that is believed."""
    resumed: bool
    """Whether an interrupted run was continued."""


OnEvent = Callable[[Encoding | Progress | Checkpoint], None]


def learn_scene(
    store: Path, scene: Scene, options: LearnOptions, on_event: OnEvent | None = None
) -> LearnReport:
    """Learns a scene into a store, or goes on where an interrupted call of the same kind stopped.

    Args:
        store: folder of the store; made when missing.
        scene: its training frames are learned; a few of them are held out to fit the threshold of
            the unknown place. Its test frames are not looked at.
        options: how.
        on_event: called with everything that happens, for progress bars.

    Raises:
        InputError: too few frames, a name that the store knows already, another strategy than the
            store's, a store that is none or that another process is learning into.
    """
    with _alone(store):
        return _learn_scene(store, scene, options, on_event)


@contextmanager
def _alone(store: Path) -> Iterator[None]:
    """Holds the lock that keeps a second learner out of a store; it lies beside the store."""
    path = store.with_name(f".{store.name}.lock")
    lock = FileLock(path)
    try:
        store.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"store {store}: another process is learning into it; wait until it has finished"
        ) from None
    except OSError as error:
        raise InputError(f"store {store}: cannot be written ({error.strerror})") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.release()


def _learn_scene(
    store: Path, scene: Scene, options: LearnOptions, on_event: OnEvent | None
) -> LearnReport:
    began = time.perf_counter()
    posed = tuple(frame for frame in scene.train if frame.base_from_camera is not None)
    scene = replace(scene, train=posed)
    robot = open_or_create(store, options)
    _check(robot, scene, options)
    if options.cache is not None and isinstance(robot.known.encoder, torch.nn.Module):
        cache_features(robot.known.encoder, options.cache)
    train, held_out = hold_out(scene.train)
    lesson = replace(scene, train=train)
    resume = robot.begin(_identity(robot, scene, options))
    try:
        stage = run_stage(robot, lesson, options.stage, resume, on_event)
    except InputError:
        robot.abandon()  # bad input: no interrupted stage worth going on with
        raise
    known = stage.knowledge
    known.scenes[-1] = with_fit(known.scenes[-1], *fit_threshold(known, held_out))
    report = LearnReport(
        scene.name,
        time.perf_counter() - began,
        stage.iterations,
        known.memory_bytes,
        sum(head_bytes(head) for head in known.heads),
        stage.frames_kept,
        len(train),
        len(held_out),
        known.scenes[-1].inlier_threshold,
        resume is not None,
    )
    robot.commit(known, asdict(report))
    return report


def open_or_create(store: Path, options: LearnOptions) -> Robot:
    """The store at a path, or a new one when there is none yet."""
    if (store / MANIFEST).exists():
        own = options.encoder if isinstance(options.encoder, torch.nn.Module) else None
        return Robot.open(store, own)
    return Robot.create(store, options.strategy, options.short_side, options.encoder)


def _check(robot: Robot, scene: Scene, options: LearnOptions) -> None:
    names = [record.name for record in robot.known.scenes]
    if scene.name in names:
        raise InputError(
            f"scene {scene.name!r}: the store has a scene of this name; give another with --name"
        )
    if not scene.name or set(scene.name) & set("/\\") or scene.name.startswith("."):
        raise InputError(
            f"scene name {scene.name!r}: names become folders; give one without slashes (--name)"
        )
    if robot.known.strategy != options.strategy:
        raise InputError(
            f"strategy {options.strategy!r}: the store was made with {robot.known.strategy!r}; "
            "go on with that one or start a new store"
        )
    if STRATEGIES[robot.known.strategy].data == "all" and names:
        raise InputError(
            f"strategy {robot.known.strategy!r}: learns all scenes at once, so a scene cannot be "
            "added to a store; start a new store with another strategy"
        )
    if len(scene.train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"scene {scene.name!r}: {len(scene.train)} training frames are too few; "
            f"give at least {MIN_TRAIN_FRAMES}"
        )


def _identity(robot: Robot, scene: Scene, options: LearnOptions) -> dict[str, object]:
    """Whatever changes the outcome of a stage: only the same identity may be resumed."""
    poses = hashlib.sha256()
    for frame in scene.train:
        assert frame.base_from_camera is not None, "frames without a pose are left out before"
        poses.update(frame.name.encode())
        poses.update(frame.base_from_camera.matrix().tobytes())
    networks = hashlib.sha256()
    for kind in ("encoder", "descriptor"):
        module = getattr(robot.known, kind)
        assert isinstance(module, torch.nn.Module)
        networks.update(network_bytes(module, kind))
    stages = list(robot.stages)
    return {
        "scene": scene.name,
        "networks": networks.hexdigest(),
        "frames": poses.hexdigest(),
        "camera": scene.train[0].camera.to_dict(),
        "stage": json.loads(json.dumps(asdict(options.stage))),
        "strategy": options.strategy,
        "stages": stages,
    }


def run_stage(
    robot: Robot,
    lesson: Scene,
    options: StageOptions,
    resume: Resume | None,
    on_event: OnEvent | None,
) -> Stage:
    """Drives `learn` to its end, writing checkpoints to the store."""
    for event in learn(robot.known, lesson, options, resume):
        if isinstance(event, Stage):
            return event
        if isinstance(event, Checkpoint):
            robot.checkpoint(event)
        if on_event is not None:
            on_event(event)
    raise AssertionError("learn() ends with a Stage")


def hold_out(frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Splits recorded frames: those to learn, and blocks of 4 in every 100 (at least one)."""
    every = min(HELD_OUT_EVERY, len(frames))
    middle = every // 2
    aside = [middle <= i % every < middle + HELD_OUT_BLOCK for i in range(len(frames))]
    learned = tuple(f for f, out in zip(frames, aside, strict=True) if not out)
    return learned, tuple(f for f, out in zip(frames, aside, strict=True) if out)


def fit_threshold(
    known: Knowledge, held_out: Sequence[Frame], scene: int = -1
) -> tuple[float, float]:
    """Inlier threshold and covariance scale of a scene, by default the newest.

    Positives are held-out training frames, negatives are views of box rooms nobody ever learned.
    The threshold lies a sixth of the way from the negatives' top to the positives' 5 % quantile:
    positives lie on the trail of the recording, and of a view half a metre beside it far fewer
    cells agree. The scale makes the median of
    the squared Mahalanobis error of well located frames what it is for six Gaussian dimensions.

    Returns:
        (smallest inlier ratio that is believed, factor on covariances).
    """
    localizer = Localizer(known)
    right, ratios = [], []
    for frame in held_out:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        ratios.append(estimate.inlier_ratio)
        if estimate.base_from_camera is None or frame.base_from_camera is None:
            continue
        metres, radians = pose_distance(estimate.base_from_camera, frame.base_from_camera)
        if metres < 0.25 and radians < np.deg2rad(15) and estimate.covariance is not None:
            moved = estimate.base_from_camera.inverse() @ frame.base_from_camera
            shift = frame.base_from_camera.translation_m - estimate.base_from_camera.translation_m
            error = np.concatenate([shift, moved.log()[3:]])
            right.append(float(error @ np.linalg.pinv(estimate.covariance) @ error))
    strangers = [localizer.localize(image).inlier_ratio for image in _strangers(known, scene)]
    top = float(np.quantile(strangers, 0.95))
    known_low = float(np.quantile(ratios, 0.05)) if ratios else 1.0
    threshold = top + BELIEVED * max(0.0, known_low - top)
    scale = float(np.median(right)) / CHI2_6_MEDIAN if right else 1.0
    return threshold, max(scale, 1.0)


def _strangers(known: Knowledge, scene: int) -> list[np.ndarray]:
    """Views of rooms that are in no scene, at the proportions of the scene's camera."""
    small = known.scenes[scene].camera.short_side_resized(known.short_side)
    return _stranger_views(small.width, small.height)


@lru_cache(maxsize=4)
def _stranger_views(width: int, height: int) -> list[np.ndarray]:
    plain, images = default_camera(width, height), []
    for seed in range(NEGATIVE_ROOM_SEED, NEGATIVE_ROOM_SEED + 4):
        room = BoxRoom(seed, texture_px=192)
        rng = np.random.default_rng(seed)
        images += [room.render(plain, room.random_view(rng)) for _ in range(4)]
    return images
