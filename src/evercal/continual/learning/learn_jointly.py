"""Training on all frames of all scenes at once: a reference for continual methods."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

from evercal.continual.learning.finish_scene import Learned, finished_stage, trained_record
from evercal.continual.learning.learn import adjusted_frames, build_scene_map
from evercal.continual.learning.stage import Event, Stage, StageOptions
from evercal.continual.learning.stage_head import head_for_all, whiten
from evercal.continual.learning.stage_rows import add_surfaces, encoded, scene_buffer, view_plan
from evercal.continual.methods.method import Method
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import LearnedScenes
from evercal.continual.strategies import Strategy
from evercal.recordings.frame import Recording, stated_poses


def learn_jointly(
    start: LearnedScenes,
    strategy: Strategy,
    recordings: Sequence[Recording],
    options: StageOptions,
) -> Iterator[Event]:
    """Train one head on several scenes, with the steps and rows of the same number of stages.

    A step has the rows of one that learns a scene and replays others.

    Args:
        start: without scenes; not changed.
        strategy: whether maps are built, too; its method adds nothing.
        recordings: their training frames are learned.
        options: of one stage.

    Yields:
        `Encoding` and `Progress` as it goes, a `Stage` of all scenes at the end.
    """
    after = start.copy_for_training()
    plan = view_plan(options, start.short_side)
    cells, positions, buffers, learned, maps = [], [], [], [], []
    atlas, fit = after.atlas(options.grid_scenes), options.fit
    for number, recording in enumerate(recordings):
        frames, built = recording.train, None
        if strategy.builds_map:
            built = build_scene_map(start, recording, options, lambda *_: None)
            frames, fit = adjusted_frames(built, frames), fit.with_known_lens()
        learned.append(frames)
        maps.append(built)
        cameras = stated_poses(frames).translation_m
        cells.append(atlas.place(cameras))
        positions.append(cells[-1].atlas_from_base.apply(cameras))
        buffers.append(scene_buffer(number, cells[-1], frames, start.device))
        yield from encoded(buffers[-1], frames, plan, start)
        if fit.surface_weight > 0:
            yield from add_surfaces(buffers[-1], frames, start)
    head = head_for_all(after, options, positions)
    whiten(head, buffers, options.seed)
    rows = fit.batch + (fit.replay_batch if len(recordings) > 1 else 0)
    whole = replace(fit, iterations=fit.iterations * len(recordings), batch=rows)
    trainer = HeadTrainer(head, buffers, whole, options.seed)
    yield from trainer.run()
    frames_kept = 0
    for number, recording in enumerate(recordings):
        count = len(learned[number])
        after.scenes.append(trained_record(recording, cells[number], trainer, number, count))
        rows_of = partial(buffers.__getitem__, number)
        done = Learned(learned[number], rows_of, built=maps[number])
        frames_kept = finished_stage(after, Method(), done, options).frames_kept
    yield Stage(after, whole.iterations, frames_kept)
