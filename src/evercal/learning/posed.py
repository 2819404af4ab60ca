"""A scene from frames with camera poses, stated or estimated: map, scatter and report."""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from time import perf_counter

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.learning.report import LearnReport
from evercal.learning.stated_scatter import (
    held_out_errors,
    localizer_of,
    located_as_stated,
    with_scatter,
)
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.built_map import LENGTHS, BuiltMap
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.held_out import HeldOutSplit
from evercal.recordings.pictures import look_at
from evercal.typing import Floats


@frozen_arrays
class LearnedScene:
    """A new scene, and how it came about."""

    scene: SceneMap
    """What is stored."""
    built: BuiltMap
    """The map before its scatter was fitted."""
    split: HeldOutSplit
    metric: bool
    """Whether the recording was in metres."""
    set_aside: Mapping[str, Floats] = field(default_factory=dict)
    """See `LearnReport.set_aside`."""

    def report(
        self, contents: MapContents, began: float, fixed_share: float = 0.0
    ) -> LearnReport:
        """The report of a scene that joins `contents`; `began` is a time of `perf_counter`."""
        adjusted = self.built.adjusted
        if not self.metric:
            unknown = dict.fromkeys(LENGTHS)
            adjusted = replace(adjusted, **unknown)
        return LearnReport(
            scene=self.scene.name,
            seconds=perf_counter() - began,
            memory_bytes=contents.with_scene(self.scene).memory_bytes,
            frames_kept=len(self.scene.keyframes),
            train_frames=len(self.split.train),
            held_out_frames=len(self.split.held_out),
            set_aside=self.set_aside,
            landmarks=self.scene.landmarks,
            adjusted=adjusted,
            fixed_share=fixed_share,
        )


def require_usable(recording: Recording) -> None:
    """Refuse a recording whose images show too little."""
    shown = look_at(recording.train)
    if not shown.usable:
        raise InputError(f"scene {recording.name!r}: {'; '.join(shown.warnings)}")


def learn_posed(
    recording: Recording,
    split: HeldOutSplit,
    contents: MapContents,
    budget: MemoryBudget,
    options: MapOptions,
    on_progress: OnProgress,
) -> LearnedScene:
    """Build the map of a scene and fit the scatter of its poses to the held-out frames."""
    options = sized(options, budget, contents)
    options = replace(options, metric=recording.metric, names=recording.frames)
    encoder = contents.encoder
    built = build_map(recording.name, split.train, encoder, options, on_progress)
    if budget.auto:
        from evercal.learning.fewest_keyframes import fewest_keyframes

        built = built.take(fewest_keyframes(contents, built, split.train, on_progress))
    held_out = built.corrected(split.held_out)
    scene = with_scatter(
        # Alone in a map, so that it does not depend on the other scenes.
        contents.empty().with_scene(built.scene),
        held_out,
        left_out=built.left_out(split.train),
        noise=built.independent_noise,
    )
    built = cleared(built, scene, split.train, contents)
    errors = held_out_errors(contents.empty().with_scene(scene), held_out)
    if not recording.metric:
        errors = {name: error[1:] for name, error in errors.items()}
    return LearnedScene(scene, built, split, recording.metric, errors)


def sized(
    options: MapOptions, budget: MemoryBudget, contents: MapContents
) -> MapOptions:
    """The options with a number of keyframes, for images of the size that the map encodes."""
    if budget.auto:
        from evercal.learning.fewest_keyframes import MOST_SHARE

        budget = MemoryBudget(share=MOST_SHARE)
    size = replace(options.size, cells=contents.short_side)
    return replace(options, memory=budget, size=size)


def cleared(
    built: BuiltMap, scene: SceneMap, frames: Sequence[Frame], contents: MapContents
) -> BuiltMap:
    """The map, without accusing frames that the scene locates where their poses say."""
    wrong = built.adjusted.wrong_poses
    accused = [frame for frame in frames if frame.name in wrong]
    if not accused:
        return built
    localizer = localizer_of(contents, scene)
    return built.cleared(located_as_stated(localizer, built.corrected(accused)))
