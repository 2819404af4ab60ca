"""All frames of all scenes at once: the reference for methods that see them one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

from evercal.continual.finish_scene import Learned, finished_stage, trained_record
from evercal.continual.methods.method import Method
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.stage import Event, Stage, StageOptions
from evercal.continual.stage_head import head_for_all, whiten
from evercal.continual.stage_map import stage_map
from evercal.continual.stage_rows import encoded, scene_buffer, view_plan
from evercal.continual.strategies import Strategy
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings.frame import Recording, stated_poses


def learn_jointly(
    maps: SceneMaps, strategy: Strategy, scenes: Sequence[Recording], options: StageOptions
) -> Iterator[Event]:
    """Trains one head on several scenes, with the steps and the rows of as many stages.

    A step has as many rows as one that learns a scene and replays others.

    Args:
        maps: without scenes; not changed.
        strategy: whether a map is built, too; its method adds nothing.
        scenes: their training frames are learned.
        options: of one stage.

    Yields:
        `Encoding` and `Progress` as it goes, a `Stage` of all scenes at the end.
    """
    after = maps.copy_for_training()
    plan = view_plan(options, maps.short_side)
    cells, places, buffers, learned, scene_maps = [], [], [], [], []
    atlas, fit = after.atlas(options.grid_scenes), options.fit
    for number, scene in enumerate(scenes):
        frames, scene_map = scene.train, None
        if strategy.builds_map:
            scene_map = yield from stage_map(after, frames, options)
            frames, fit = scene_map.adjusted_frames(frames), fit.with_known_lens()
        learned.append(frames)
        scene_maps.append(scene_map)
        positions = stated_poses(frames).translation_m
        cells.append(atlas.place(positions))
        places.append(cells[-1].atlas_from_base.apply(positions))
        buffers.append(scene_buffer(number, cells[-1], frames, maps.device))
        yield from encoded(buffers[-1], frames, plan, maps)
    head = head_for_all(after, options, places)
    whiten(head, buffers, options.seed)
    rows = fit.batch + (fit.replay_batch if len(scenes) > 1 else 0)
    whole = replace(fit, iterations=fit.iterations * len(scenes), batch=rows)
    trainer = HeadTrainer(head, buffers, whole, options.seed)
    yield from trainer.run()
    kept = 0
    for number, scene in enumerate(scenes):
        count = len(learned[number])
        after.scenes.append(trained_record(scene, cells[number], trainer, number, count))
        rows_of = partial(buffers.__getitem__, number)
        done = Learned(learned[number], rows_of, scene_map=scene_maps[number])
        kept = finished_stage(after, Method(), done, options).frames_kept
    yield Stage(after, whole.iterations, kept)
