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
    assert split.train == tuple(f for f in frames if f not in split.held_out)
    blocks = np.reshape([int(frame.name) for frame in split.held_out], (-1, 4))
    assert len(blocks) == max(1, (count + 49) // 100)
    assert (np.diff(blocks) == 1).all()
    # A block lies between learned frames.
    assert (np.diff(blocks[:, 0]) > 4).all()
    assert blocks.min() > 0
    assert blocks.max() < count - 1
