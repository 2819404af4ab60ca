"""`learn_networks`: what the command line calls to learn a scene into a store of networks."""

import shutil
from collections.abc import Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from time import perf_counter

from evercal.classes import frozen
from evercal.continual.learning.checkpoint import CHECKPOINT, CURVE
from evercal.continual.learning.learn import learn
from evercal.continual.learning.presets import preset, short_side
from evercal.continual.learning.stage import (
    OnEvent,
    StageOptions,
    Watched,
    unobserved,
)
from evercal.continual.networks.device import device_of
from evercal.continual.networks.head import HeadOptions
from evercal.continual.store import NetworkStore, head_bytes
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.continual.threshold import fit_threshold
from evercal.errors import InputError
from evercal.learning.report import LearnReport
from evercal.recordings.frame import (
    Frame,
    Recording,
    lacks_camera_poses,
    posed_recording,
)
from evercal.recordings.held_out import (
    HeldOutSplit,
    named_recording,
    require_frames,
    split_held_out,
)
from evercal.storage.stages import is_store
from evercal.typing import JsonObject

SHARED = {
    "condition": "backbone",
    "offsets": "offsets",
    "centres_per_scene": "centres",
}
"""Fields of `HeadOptions` that all scenes of a store share, with the option that sets them."""
_USUAL = HeadOptions()


@frozen
class NetworkReport(LearnReport):
    """Outcome of learning a scene into networks."""

    iterations: int = 0
    """Training steps."""
    loss: float | None = None
    """Mean loss of the new rows in the last step."""
    inlier_share: float | None = None
    """Share of the new rows within 5 px in the last step."""
    preset: str = ""
    """Name of the preset."""
    strategy: JsonObject = field(default_factory=dict)
    """Name of the strategy, and its method with hyper-parameters."""
    seed: int = 0
    """Seed of all random draws."""
    head_bytes: int = 0
    """Size of the networks."""


@frozen
class NetworkLearnOptions:
    """How a scene is learned into a store of networks."""

    strategy: Strategy = STRATEGIES["sars_pixels"]
    """The strategy; a store keeps the one it was made with."""
    stage: StageOptions = field(default_factory=partial(preset, "fast"))
    """Options of the stage."""
    preset: str = "fast"
    """Name of the preset of `stage`, for the working size of a new store and for the report."""
    encoder: Path | None = None
    """An ONNX file for a new store."""
    device: str = "auto"
    """Device of the networks, see `device_of`."""
    short_side: int | None = None
    """Working size of images in a new store, pixels; that of the preset by default."""
    cache: Path | None = None
    """Folder for features of views, for many runs over the same frames."""
    holds_out: bool = True
    """Whether a few training frames are held out to fit the inlier threshold and the covariance."""
    folder: Path | None = None
    """Folder for checkpoint and curve of the training, which keeps the curve; by default one beside
    the store, which is removed."""

    def opened(
        self, store: Path, strategy: Strategy, frames: Sequence[Frame]
    ) -> NetworkStore:
        """Open the store of a strategy or make it; `frames` are those of the scene to learn."""
        if not strategy.method or strategy.jointly:
            raise InputError(
                f"strategy {strategy.name!r}: does not train a network scene by scene; use another"
                " strategy, or compare it with 'evercal bench'"
            )
        if not is_store(store):
            side = self.short_side or short_side(self.preset, frames)
            return NetworkStore.create(store, strategy.name, side, self.encoder)
        if self.encoder:
            raise InputError(
                f"encoder {self.encoder}: store {store} keeps the encoder it was made with"
            )
        opened = NetworkStore.open(store)
        if opened.contents.strategy != strategy.name:
            raise InputError(
                f"strategy {strategy.name!r}: the store was made with {opened.contents.strategy!r};"
                " use that one or start a new store"
            )
        if strategy.method.head_per_scene:
            return opened
        for head in opened.contents.heads[-1:]:
            for name, option in SHARED.items():
                accepted = getattr(_USUAL, name), getattr(head.options, name)
                if getattr(self.stage.head, name) not in accepted:
                    raise InputError(
                        f"`{option}`: {store} was made with another one; omit the option, or start"
                        " a new store"
                    )
        return opened


def _posed(recording: Recording, strategy: Strategy) -> Recording:
    """A recording with enough frames, all of which have poses."""
    if lacks_camera_poses(recording):
        raise InputError(
            f"scene {recording.name!r}: only gripper poses are stated, and strategy"
            f" {strategy.name!r} builds no map to estimate the camera on the gripper; use"
            " strategy evercal"
        )
    recording = posed_recording(recording)
    require_frames(recording)
    return recording


def learn_networks(
    store: Path,
    recording: Recording,
    options: NetworkLearnOptions,
    on_event: OnEvent = unobserved,
) -> NetworkReport:
    """Learn a scene into a store; an interrupted call leaves the store at its last scene.

    The same call goes on where it was interrupted, with the folder `.STORE.learning` beside the
    store. The folder is removed when the scene is complete.
    """
    began = perf_counter()
    stage = options.stage
    strategy = options.strategy
    opened = options.opened(store, strategy, recording.train)
    assert strategy.method, "that of a network"
    with opened.writing():
        contents = opened.contents.to(device_of(options.device))
        taken = [record.name for record in contents.scenes]
        recording = _posed(named_recording(recording, None, taken), strategy)
        resolved = store.resolve()
        beside = resolved.with_name(f".{resolved.name}.learning")
        folder = options.folder or beside
        folder.mkdir(parents=True, exist_ok=True)
        contents.cache = options.cache or beside
        split = HeldOutSplit(recording.train, ())
        if options.holds_out:
            split = split_held_out(recording.train)
        train = replace(recording, train=split.train)
        watched = Watched(on_event)
        learned = learn(contents, strategy.method, train, stage, watched, folder)
        last = watched.last
        if split.held_out:
            learned.scenes[-1] = fit_threshold(learned, split.held_out)
        report = NetworkReport(
            scene=recording.name,
            seconds=last.earlier_s + perf_counter() - began,
            memory_bytes=learned.memory_bytes,
            frames_kept=learned.frames_kept,
            train_frames=len(split.train),
            held_out_frames=len(split.held_out),
            iterations=stage.fit.iterations,
            loss=last.loss,
            inlier_share=last.inlier_share,
            preset=options.preset,
            strategy={"name": strategy.name, **strategy.description()},
            seed=stage.seed,
            head_bytes=sum(map(head_bytes, learned.heads)),
        )
        opened.commit(learned, report.to_dict(), folder / CURVE)
        (folder / CHECKPOINT).unlink(missing_ok=True)
        shutil.rmtree(beside, ignore_errors=True)
    return report
