"""Before a recording is learned: its name, its frames and poses, and the held-out frames."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Frame, Recording, checked_name

if TYPE_CHECKING:
    from evercal.recordings.addresses import RecordingAt

EVERY = 100
"""Training frames from the start of one block of held-out frames to the next."""
FEWEST = 16
"""Recordings of fewer frames are learned whole."""
BLOCK = 4
"""Frames of a block, consecutive."""
Named = TypeVar("Named", bound="Recording | RecordingAt")


@frozen
class HeldOutSplit:
    """Training frames of a recording in two parts."""

    train: tuple[Frame, ...]
    held_out: tuple[Frame, ...]
    """Frames that the scatter of the stated poses is fitted to: 4 consecutive ones in every 100,
    and at least 4. A recording with fewer than `FEWEST` frames has none."""


def split_held_out(frames: Sequence[Frame]) -> HeldOutSplit:
    """Hold out blocks of training frames, in recorded order.

    Neighbours in a video share their errors. Single frames that are spread over a short recording
    make no better map (research/trust.md).
    """
    if len(frames) < FEWEST:
        return HeldOutSplit(tuple(frames), ())
    every = min(EVERY, len(frames))
    middle = every // 2
    train = []
    held_out = []
    for i, frame in enumerate(frames):
        if middle <= i % every < middle + BLOCK:
            held_out.append(frame)
        else:
            train.append(frame)
    return HeldOutSplit(tuple(train), tuple(held_out))


def split_again(recording: Recording, split: str) -> Recording:
    """A recording without test frames, with some: 4:1 for one after every four training frames."""
    match = re.fullmatch(r"([1-9]\d*):(\d+)", split)
    if not match or recording.test:
        raise InputError(
            f"`split` {split}: give N:M, such as 4:1, for a recording without test frames only"
        )
    count = int(match[1])
    places = np.arange(len(recording.train)) % (count + int(match[2]))
    train = compress(recording.train, places < count)
    test = compress(recording.train, places >= count)
    return replace(recording, train=tuple(train), test=tuple(test))


def named_recording(recording: Named, name: str | None, taken: Iterable[str]) -> Named:
    """A recording under the name that its scene will have; its own name by default."""
    if name is None:
        name = recording.name
    checked_name(name)
    if name in taken:
        raise InputError(
            f"scene {name!r}: a scene of this name exists; give another with `name`"
        )
    return replace(recording, name=name)


def require_frames(recording: Recording) -> None:
    """Refuse a recording with too few training frames."""
    if len(recording.train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"scene {recording.name!r}: {len(recording.train)} training frames are too few; give at"
            f" least {MIN_TRAIN_FRAMES}"
        )
