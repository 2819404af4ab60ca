"""What stays of a scene that was just learned: frames, their depths, and what is noted besides."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.continual.candidates import Candidates
from evercal.continual.knowledge import Knowledge
from evercal.continual.memory import Memory, remember
from evercal.continual.notes import Finished, Notes
from evercal.continual.recall import remembered_depths
from evercal.continual.strategies import STRATEGIES
from evercal.datasets.frame import Frame
from evercal.geometry.camera import Camera
from evercal.training.buffer import FeatureBuffer, FillPlan, fill
from evercal.training.views import ViewOptions


def keep(
    known: Knowledge,
    frames: Sequence[Frame],
    candidates: Candidates,
    capacity: int,
    refined: Camera | None,
) -> Memory | None:
    """What a strategy remembers of a scene's training frames.

    Args:
        known: whose strategy selects.
        frames: in recorded order.
        candidates: the same frames as selectors see them.
        capacity: N_b, how many at most.
        refined: the camera as training corrected it; replay takes it as given.
    """
    strategy = STRATEGIES[known.strategy]
    if strategy.select is None:
        return None
    chosen = strategy.select(candidates, capacity)
    if refined is not None:
        frames = [replace(frame, camera=refined) for frame in frames]
    memory = remember([frames[i] for i in chosen], known.short_side)
    if strategy.recall:
        depths = remembered_depths(known, chosen, frames, candidates)
        memory = replace(memory, inverse_depth=depths)
    return memory


def note_of(known: Knowledge, buffer: FeatureBuffer) -> Notes:
    """What the strategy notes about the newest scene, whose frames are chosen already.

    Args:
        known: with the scene's record and memory.
        buffer: rows of its training frames.
    """
    note = STRATEGIES[known.strategy].note
    if note is None:
        return {}

    def remembered() -> FeatureBuffer:
        memory = known.memories[-1]
        assert memory is not None, "a strategy that notes what it remembers selects frames"
        found = FeatureBuffer(buffer.scene, buffer.atlas_from_base)
        return plain_rows(found, memory.frames(), known)

    return note(Finished(known.heads[-1].eval(), buffer, remembered, known.notes))


def plain_rows(buffer: FeatureBuffer, frames: Sequence[Frame], known: Knowledge) -> FeatureBuffer:
    """Encodes frames as they are into a buffer, and gives it back."""
    plan = FillPlan(passes=1, view=ViewOptions(short_side=known.short_side))
    for _ in fill(buffer, frames, plan, known.encoder, known.descriptor):
        pass
    return buffer
