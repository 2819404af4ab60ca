"""`learn_scene`: what the command line, the API and the benchmarks call to learn a scene."""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from evercal.calibration.eye_in_hand import (
    HandEyeReport,
    hand_eye_report,
    lacks_camera_poses,
    posed_by_gripper,
)
from evercal.continual.finish_scene import memory_bytes
from evercal.continual.learn import learn
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.networks.trainer import Progress
from evercal.continual.stage import Encoding, Stage, StageOptions
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.errors import InputError
from evercal.features.device import device_of
from evercal.features.weights_file import network_bytes
from evercal.geometry.se3 import SE3
from evercal.localization.acceptance import fitted_record
from evercal.mapping.build import Adjusted, Mapping
from evercal.mapping.stage_files import head_bytes
from evercal.mapping.store import Checkpoint, Resume, Store
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Frame, Recording, posed_recording
from evercal.storage.manifest import MANIFEST

HELD_OUT_EVERY = 100
HELD_OUT_BLOCK = 4


@dataclass(frozen=True)
class LearnOptions:
    """How a scene is learned into a store."""

    stage: StageOptions = field(default_factory=StageOptions)
    """Network and training."""
    strategy: Strategy = STRATEGIES["evercal"]
    """What is learned; a store keeps the strategy it was made with."""
    encoder: Path | torch.nn.Module | None = None
    """Another encoder than the shipped one: a file for a new store, or a module of one's own."""
    short_side: int = 240
    """Working size of images in a new store, pixels."""
    gripper_from_camera: SE3 | None = None
    """Where the camera roughly sits on the gripper (CAD), for recordings of gripper poses alone:
    what is found is compared with it."""
    device: str | torch.device = "auto"
    """What the networks run on, see `device_of`."""
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
    """Frames held out to calibrate the unknown-scene threshold."""
    inlier_threshold: float
    """Poses with a smaller inlier ratio are reported as unknown_scene."""
    resumed: bool
    """Whether an interrupted run was continued."""
    landmarks: int = 0
    """Landmarks of this scene's map."""
    adjusted: Adjusted | None = None
    """What bundle adjustment changed about the recording; None where no map was built."""
    hand_eye: HandEyeReport | None = None
    """Where the camera was found on the gripper; None where the recording states camera poses."""


OnEvent = Callable[[Encoding | Mapping | Progress | Checkpoint], None]


def learn_scene(
    store: Path, scene: Recording, options: LearnOptions, on_event: OnEvent | None = None
) -> LearnReport:
    """Learns a scene into a store, or goes on where an interrupted call of the same kind stopped.

    Args:
        store: folder of the store; made when missing.
        scene: its training frames are learned; a few of them are held out to calibrate the
            unknown-scene threshold. Its test frames are not looked at.
        options: how.
        on_event: called with everything that happens, for progress bars.

    Raises:
        InputError: no such device, too few frames, a name that the store knows already, another
            strategy than the store's, a store that is none or that another process is learning
            into.
    """
    began = time.perf_counter()
    opened = open_or_create(store, options)
    with opened.writing():
        return _learn_scene(opened, scene, options, on_event, began)


def _learn_scene(
    opened: Store, scene: Recording, options: LearnOptions, on_event: OnEvent | None, began: float
) -> LearnReport:
    wrist = lacks_camera_poses(scene)
    scene = scene if wrist else posed_recording(scene)
    device = device_of(options.device)
    _check(opened, scene, options)
    opened.maps.to(device)
    stage_options, start = options.stage, None
    if wrist:
        scene, start = posed_by_gripper(scene, opened.maps.encoder, on_event or (lambda _: None))
        stage_options = replace(stage_options, map=stage_options.map.for_hand_eye())
    if options.cache is not None and isinstance(opened.maps.encoder, torch.nn.Module):
        cache_features(opened.maps.encoder, options.cache)
    train, held_out = validation_split(scene.train)
    train_split = replace(scene, train=train)
    resume = opened.begin(_identity(opened, scene, options))
    try:
        stage = run_stage(
            opened, train_split, replace(options, stage=stage_options), resume, on_event
        )
    except InputError:
        opened.abandon()  # bad input: no interrupted stage worth going on with
        raise
    maps = stage.maps
    maps.scenes[-1] = fitted_record(maps, held_out)
    kept, scene_map = maps.keyframes[-1], stage.scene_map
    report = LearnReport(
        scene.name,
        time.perf_counter() - began,
        stage.iterations,
        memory_bytes(maps, options.strategy),
        sum(head_bytes(head) for head in maps.heads),
        stage.frames_kept,
        len(train),
        len(held_out),
        maps.scenes[-1].inlier_threshold,
        resume is not None,
        sum(map(len, kept.landmarks)) if kept else 0,
        scene_map.adjusted if scene_map else None,
        hand_eye_report(start, scene_map, options.gripper_from_camera)
        if start and scene_map
        else None,
    )
    opened.commit(maps, asdict(report))
    return report


def open_or_create(store: Path, options: LearnOptions) -> Store:
    """The store at a path, or a new one when there is none yet.

    Raises:
        InputError: as `Store.open` and `Store.create`.
    """
    if (store / MANIFEST).exists():
        own = options.encoder if isinstance(options.encoder, torch.nn.Module) else None
        return Store.open(store, own)
    return Store.create(store, options.strategy.name, options.short_side, options.encoder)


def _check(opened: Store, scene: Recording, options: LearnOptions) -> None:
    names = [record.name for record in opened.maps.scenes]
    if scene.name in names:
        raise InputError(
            f"scene {scene.name!r}: the store has a scene of this name; give another with --name"
        )
    if not scene.name or set(scene.name) & set("/\\") or scene.name.startswith("."):
        raise InputError(
            f"scene name {scene.name!r}: names become folders; give one without slashes (--name)"
        )
    strategy = options.strategy
    if opened.maps.strategy != strategy.name:
        raise InputError(
            f"strategy {strategy.name!r}: the store was made with {opened.maps.strategy!r}; "
            "go on with that one or start a new store"
        )
    if strategy.jointly:
        raise InputError(
            f"strategy {strategy.name!r}: learns all scenes at once, so a store cannot grow by it; "
            "take another strategy, or compare it with 'evercal bench'"
        )
    if lacks_camera_poses(scene) and not strategy.builds_map:
        raise InputError(
            f"scene {scene.name!r}: only gripper poses are known, and strategy"
            f" {strategy.name!r} builds no map that could find the camera on the gripper;"
            " use strategy evercal"
        )
    if options.stage.memory_auto and strategy.method is not None:
        raise InputError(
            f"memory auto: strategy {strategy.name!r} trains a network; give a share or bytes"
        )
    if len(scene.train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"scene {scene.name!r}: {len(scene.train)} training frames are too few; "
            f"give at least {MIN_TRAIN_FRAMES}"
        )


def _identity(opened: Store, scene: Recording, options: LearnOptions) -> dict[str, object]:
    """Whatever changes the outcome of a stage: only the same identity may be resumed."""
    poses = hashlib.sha256()
    for frame in scene.train:
        assert frame.base_from_camera is not None, "frames without a pose are left out before"
        poses.update(frame.name.encode())
        poses.update(frame.base_from_camera.matrix().tobytes())
    networks = hashlib.sha256()
    for kind in ("encoder", "descriptor"):
        module = getattr(opened.maps, kind)
        assert isinstance(module, torch.nn.Module)
        networks.update(network_bytes(module, kind))
    # Another version of a stage is the same scene, laid elsewhere by `evercal align`.
    stages = [name.partition("~")[0] for name in opened.stages]
    return {
        "scene": scene.name,
        "networks": networks.hexdigest(),
        "frames": poses.hexdigest(),
        "camera": scene.train[0].camera.to_dict(),
        "stage": json.loads(json.dumps(asdict(options.stage))),
        "strategy": options.strategy.description(),
        "stages": stages,
    }


def run_stage(
    opened: Store,
    train_split: Recording,
    options: LearnOptions,
    resume: Resume | None,
    on_event: OnEvent | None,
) -> Stage:
    """Drives `learn` to its end, writing checkpoints to the store."""
    for event in learn(opened.maps, options.strategy, train_split, options.stage, resume):
        if isinstance(event, Stage):
            return event
        if isinstance(event, Checkpoint):
            opened.checkpoint(event)
        if on_event is not None:
            on_event(event)
    raise AssertionError("learn() ends with a Stage")


def validation_split(frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Splits recorded frames: those to learn, and blocks of 4 in every 100 (at least one)."""
    every = min(HELD_OUT_EVERY, len(frames))
    middle = every // 2
    aside = [middle <= i % every < middle + HELD_OUT_BLOCK for i in range(len(frames))]
    learned = tuple(f for f, out in zip(frames, aside, strict=True) if not out)
    return learned, tuple(f for f, out in zip(frames, aside, strict=True) if out)
