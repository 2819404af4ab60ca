"""Recordings whose images show too little are named by the cause, before any work."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.learning.scene import learn_scene
from evercal.mapping.scene_map import MapContents
from evercal.recordings import Recording
from evercal.recordings.inspection import inspect_recording

Change = Callable[[np.ndarray], np.ndarray]
NOISE = np.random.default_rng(0).normal(0, 3, (240, 320, 3))


@pytest.mark.parametrize(
    ("change", "cause", "usable"),
    [
        (lambda image: image / 16, "almost black; if 12-bit values", False),
        (lambda image: 240 + image, "almost white", False),
        (lambda _: 120 + NOISE, "of one colour", False),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 3), "blurred", True),
    ],
)
def test_images_without_structure(
    change: Change, cause: str, usable: bool, hall: Recording
) -> None:
    def changed(image: np.ndarray) -> np.ndarray:
        return change(image.astype(np.float32)).clip(0, 255).round().astype(np.uint8)

    train = tuple(
        replace(frame, image=changed(frame.read_image())) for frame in hall.train
    )
    assert inspect_recording(hall).warnings == ()
    check(replace(hall, train=train), cause, usable)
    some = (*train[:10], *hall.train[10:])
    words = "\n".join(inspect_recording(replace(hall, train=some)).warnings)
    assert (cause in words) == (not usable)


def test_one_image_again_and_again(hall: Recording) -> None:
    same = tuple(replace(frame, image=hall.train[0].image) for frame in hall.train)
    check(replace(hall, train=same), "all images are the same", usable=False)


def check(recording: Recording, cause: str, usable: bool) -> None:
    assert cause in "\n".join(inspect_recording(recording).warnings)
    if not usable:
        with pytest.raises(InputError, match=cause):
            learn_scene(recording, MapContents(load_encoder(), 240))
