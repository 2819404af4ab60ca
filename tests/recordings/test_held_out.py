"""Training frames that are held out: blocks of four in every hundred."""

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.recordings import Frame
from evercal.recordings.held_out import split_held_out

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


@pytest.mark.parametrize("count", [16, 17, 30, 99, 100, 101, 150, 250, 300, 1000])
def test_held_out_frames_are_blocks_of_four(count: int) -> None:
    image = np.zeros((3, 4, 3), np.uint8)
    frames = [Frame(f"{i:06d}", image, CAMERA, None) for i in range(count)]
    split = split_held_out(frames)
    assert sorted([*split.train, *split.held_out], key=lambda f: f.name) == frames
    assert [f.name for f in split.train] == sorted(f.name for f in split.train)
    numbers = [int(f.name) for f in split.held_out]
    assert numbers == sorted(numbers)
    assert len(numbers) == 4 * max(1, (count + 49) // 100)
    for start in (n for n in numbers if n - 1 not in numbers):
        assert [n in numbers for n in range(start, start + 5)] == [True] * 4 + [False]
    # A block lies between learned frames.
    assert 0 not in numbers
    assert count - 1 not in numbers
