"""`learn_networks`: what the command line calls to learn a scene into a store of networks."""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from torch import nn

from evercal.calibration.eye_in_hand import hand_eye_report, posed_by_gripper
from evercal.continual.learning.finish_scene import memory_bytes
from evercal.continual.learning.learn import learn
from evercal.continual.learning.presets import preset, short_side
from evercal.continual.learning.stage import Encoding, Stage, StageOptions
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.continual.store import Checkpoint, NetworkStore, Resume, head_bytes
from evercal.continual.strategies import Strategy, strategy_named
from evercal.continual.threshold import fit_threshold
from evercal.errors import InputError
from evercal.features.device import device_of
from evercal.features.weights_file import network_bytes
from evercal.geometry import SE3
from evercal.learning.scene import LearnReport
from evercal.localization.fit_acceptance import fit_acceptance
from evercal.mapping.build import BuiltMap
from evercal.recordings.frame import Frame, Recording, lacks_camera_poses, posed_recording
from evercal.recordings.held_out import named_recording, require_frames, split_held_out
from evercal.storage.stages import is_store


@dataclass(frozen=True)
class MapProgress:
    """A map is being built."""

    step: str
    """Name of the step."""
    done: int
    """How much of it is done."""
    total: int
    """How much there is."""


OnEvent = Callable[[Encoding | MapProgress | Progress | Checkpoint], object]


@dataclass(frozen=True)
class NetworkLearnOptions:
    """How a scene is learned into a store of networks."""

    strategy: str | Strategy = "evercal_network"
    """The strategy or its name; a store keeps the one it was made with."""
    preset: str = "fast"
    """Amount of training, see `presets`."""
    memory: str | int = "10%"
    """Keyframes of a scene, see `MemoryBudget.parse`."""
    centres: int | None = None
    """Cluster centres that a scene adds; those of the preset by default."""
    encoder: Path | nn.Module | None = None
    """A weights file for a new store, or a module of the caller's own."""
    gripper_from_camera: SE3 | None = None
    """A rough one, such as from CAD, that the estimate is compared with."""
    device: str = "auto"
    """Device of the networks, see `device_of`."""
    seed: int = 0
    """Seed of everything that is drawn at random."""
    stage: StageOptions | None = None
    """Options of the stage in place of preset, memory and centres."""
    short_side: int | None = None
    """Working size of images in a new store, pixels; that of the preset by default."""
    cache: Path | None = None
    """Folder for features of views, for many runs over the same frames."""

    def stage_options(self) -> StageOptions:
        """Options of the stage."""
        if self.stage is not None:
            return self.stage
        stage = preset(self.preset, self.seed).with_memory(self.memory)
        if self.centres is None:
            return stage
        if self.centres < 1:
            raise InputError(f"--centres {self.centres}: give a number >= 1")
        return replace(stage, head=replace(stage.head, centres_per_scene=self.centres))


def learn_networks(
    store: Path,
    recording: Recording,
    options: NetworkLearnOptions,
    on_event: OnEvent = lambda _: None,
) -> LearnReport:
    """Learn a scene into a store, or continue an interrupted call of the same kind.

    Args:
        store: folder of the store; created if it is missing.
        recording: its training frames are learned; a few are held out to fit the threshold.
        options: strategy and amount of training.
        on_event: called with every event, for progress bars.

    Raises:
        InputError: No such device or strategy, too few frames, a name that is taken, another
            strategy than the store's, or another process is writing into the store.
    """
    began = time.perf_counter()
    named, stage = options.strategy, options.stage_options()
    strategy = named if isinstance(named, Strategy) else strategy_named(named)
    opened = _opened(store, strategy, stage, options, recording.train)
    with opened.writing():
        contents = opened.contents.to(device_of(options.device))
        names = [record.name for record in contents.scenes]
        recording, start = named_recording(recording, None, names), None
        if lacks_camera_poses(recording):
            _require_map(recording, strategy)
            posed = posed_by_gripper(recording, contents.encoder, _on_map(on_event))
            recording, start = posed.recording, posed.start
            stage = replace(stage, map=stage.map.for_hand_eye())
        recording = posed_recording(recording)
        require_frames(recording)
        if options.cache is not None and isinstance(contents.encoder, nn.Module):
            cache_features(contents.encoder, options.cache)
            contents.cache = options.cache
        split = split_held_out(recording.train)
        train = replace(recording, train=split.train)
        resume = opened.begin(_identity(opened, recording, strategy, stage))
        try:
            done = run_stage(opened, strategy, train, stage, resume, on_event)
        except InputError:
            opened.abandon()  # bad input: nothing to resume
            raise
        done.scenes.scenes[-1] = with_fitted_threshold(
            done.scenes, split.held_out, built=done.built
        )
        record, keyframes = done.scenes.scenes[-1], done.scenes.keyframes[-1]
        report = LearnReport(
            scene=recording.name,
            seconds=time.perf_counter() - began,
            memory_bytes=memory_bytes(done.scenes, strategy),
            frames_kept=done.frames_kept,
            train_frames=len(split.train),
            held_out_frames=len(split.held_out),
            min_support=record.map.min_support if record.map else record.inlier_threshold,
            landmarks=sum(map(len, keyframes.landmarks)) if keyframes else 0,
            adjusted=done.built.adjusted if done.built else None,
            hand_eye=hand_eye_report(start, done.built, options.gripper_from_camera)
            if start and done.built
            else None,
            iterations=done.iterations,
            head_bytes=sum(head_bytes(head) for head in done.scenes.heads),
        )
        opened.commit(done.scenes, asdict(report))
    return report


def with_fitted_threshold(
    scenes: LearnedScenes,
    held_out: Sequence[Frame],
    index: int = -1,
    built: BuiltMap | None = None,
) -> SceneRecord:
    """A record with its threshold: of the map, if there is one, else of the network."""
    record = scenes.scenes[index]
    if record.map is None:
        return fit_threshold(scenes, held_out, index)
    noise = (0.0, 0.0)
    if built is not None:
        held_out, noise = built.corrected(held_out), built.independent_noise
    return replace(record, map=fit_acceptance(scenes.map_contents(), held_out, index, noise=noise))


def run_stage(
    opened: NetworkStore,
    strategy: Strategy,
    recording: Recording,
    options: StageOptions,
    resume: Resume | None,
    on_event: OnEvent = lambda _: None,
) -> Stage:
    """Run `learn` to its end, writing checkpoints to the store."""
    events = learn(opened.contents, strategy, recording, options, resume, _on_map(on_event))
    for event in events:
        if isinstance(event, Stage):
            return event
        if isinstance(event, Checkpoint):
            opened.checkpoint(event)
        on_event(event)
    raise AssertionError("learn() ends with a Stage")


def _on_map(on_event: OnEvent) -> Callable[[str, int, int], object]:
    return lambda step, done, total: on_event(MapProgress(step, done, total))


def _opened(
    store: Path,
    strategy: Strategy,
    stage: StageOptions,
    options: NetworkLearnOptions,
    frames: Sequence[Frame],
) -> NetworkStore:
    """The store, checked against the options."""
    if strategy.jointly:
        raise InputError(
            f"strategy {strategy.name!r}: learns all scenes at once, so a store cannot grow by it;"
            " use another strategy, or compare it with 'evercal bench'"
        )
    if stage.memory.auto:
        raise InputError("memory auto: only a map selects its keyframes; give a share or bytes")
    if not is_store(store):
        side = options.short_side or short_side(options.preset, frames)
        return NetworkStore.create(store, strategy.name, side, options.encoder)
    if isinstance(options.encoder, Path):
        raise InputError(
            f"encoder {options.encoder}: store {store} keeps the encoder it was made with"
        )
    opened = NetworkStore.open(store, options.encoder)
    if opened.contents.strategy != strategy.name:
        raise InputError(
            f"strategy {strategy.name!r}: the store was made with {opened.contents.strategy!r};"
            " use that one or start a new store"
        )
    heads, method = opened.contents.heads, strategy.method
    shared = method is not None and not method.head_per_scene and heads
    if shared and options.centres not in (None, heads[-1].options.centres_per_scene):
        raise InputError(
            f"--centres {options.centres}: {store} was made with"
            f" {heads[-1].options.centres_per_scene} per scene; leave the option out or start a new"
            " store"
        )
    return opened


def _require_map(recording: Recording, strategy: Strategy) -> None:
    if not strategy.builds_map:
        raise InputError(
            f"scene {recording.name!r}: only gripper poses are stated, and strategy"
            f" {strategy.name!r} builds no map to estimate the camera on the gripper; use strategy"
            " evercal"
        )


def _identity(
    opened: NetworkStore, recording: Recording, strategy: Strategy, stage: StageOptions
) -> dict[str, object]:
    """Everything that decides the outcome of a stage: only the same identity is resumed."""
    poses, networks = hashlib.sha256(), hashlib.sha256()
    for frame in recording.train:
        assert frame.base_from_camera is not None, "frames without a pose are left out before"
        poses.update(frame.name.encode())
        poses.update(frame.base_from_camera.matrix().tobytes())
    for kind in ("encoder", "descriptor"):
        module = getattr(opened.contents, kind)
        assert isinstance(module, nn.Module)
        networks.update(network_bytes(module, kind))
    return {
        "scene": recording.name,
        "networks": networks.hexdigest(),
        "frames": poses.hexdigest(),
        "camera": recording.train[0].camera.to_dict(),
        "stage": json.loads(json.dumps(asdict(stage))),
        "strategy": strategy.description(),
        "short_side": opened.contents.short_side,
        "stages": opened.stages,
    }
