"""Feature rows of a stage: of the new scene's frames, and of remembered keyframes."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.classes import frozen
from evercal.continual.learning.stage import OnEvent, Part, StageOptions, unobserved
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.scenes import LearnedScenes
from evercal.recordings.frame import Frame


@frozen
class StageRows:
    """Encodes frames with the networks of scenes and the options of a stage."""

    scenes: LearnedScenes
    """Scenes with the networks that encode."""
    options: StageOptions
    """Options of the stage."""
    on_event: OnEvent = unobserved
    """Called after every view."""

    def of_scene(
        self, local: int, cell: Cell, frames: Sequence[Frame]
    ) -> FeatureBuffer:
        """Encode the training frames of a scene; `local` is its index in the head."""
        device = self.scenes.device
        buffer = FeatureBuffer(local, cell.atlas_from_base, device)
        return self._encoded(buffer, frames, self.options.encode)

    def of_keyframes(self, number: int) -> FeatureBuffer:
        """Encode a scene's keyframes for replay; the first views are not augmented."""
        scenes = self.scenes
        keyframes = self.scenes.keyframes[number]
        assert keyframes is not None, "a method that uses keyframes selects some"
        cell = scenes.scenes[number].cell
        _, local = scenes.head_for(number)
        buffer = FeatureBuffer(local, cell.atlas_from_base, scenes.device)
        views = self.options.replay_views_per_frame
        plan = replace(self.options.encode, views_per_frame=views)
        return self._encoded(buffer, keyframes.frames(), plan)

    def remembered(self) -> list[FeatureBuffer]:
        """Encode the keyframes of all scenes that have some: one buffer per scene."""
        keyframes = self.scenes.keyframes
        return [self.of_keyframes(i) for i, kept in enumerate(keyframes) if kept]

    def _encoded(
        self, buffer: FeatureBuffer, frames: Sequence[Frame], plan: EncodePlan
    ) -> FeatureBuffer:
        scenes = self.scenes
        view = replace(plan.view, short_side=scenes.short_side)
        plan = replace(plan, view=view, seed=self.options.seed)
        plan = plan.limited(frames, scenes.encoder.stride)
        total = len(frames) * plan.views_per_frame
        for done in encode_frames(
            buffer, frames, plan, scenes.encoder, scenes.descriptor, scenes.cache
        ):
            self.on_event(Part("encoding", done, total))
        return buffer
