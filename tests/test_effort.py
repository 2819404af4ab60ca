"""How far a reader walks: our functions that an image or a recording takes, and changes of file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import FrameType

import evercal
from evercal.learning.scene import learn_scene
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording

ROOT = str(Path(evercal.__file__).parent)
MOST_CALLS = 555
"""Calls of Python functions of evercal for one image, a tenth above the count."""
MOST_CHANGES = 258
"""Calls among them of a function in another file than the one before."""


MOST_LEARNING_CALLS = 27_900
"""The same for learning a recording of 24 frames, on the thread that asks for it."""
MOST_LEARNING_CHANGES = 12_900
"""Changes of file among them."""


def walked(function: Callable[[], object]) -> tuple[int, int]:
    """Calls of our functions, comprehensions aside, and changes of file."""
    files: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        comprehension = code.co_name.startswith("<")
        if event == "call" and code.co_filename.startswith(ROOT) and not comprehension:
            files.append(code.co_filename)

    sys.setprofile(note)
    try:
        function()
    finally:
        sys.setprofile(None)
    changes = sum(a != b for a, b in pairwise(files))
    return len(files), changes


def test_an_image_takes_few_calls_and_changes_of_file(
    hall: Recording, hall_map: MapContents
) -> None:
    localizer = Localizer(hall_map)
    image = hall.test[7].read_image()
    localizer.localize(image)  # keyframes are decoded once
    calls, changes = walked(lambda: localizer.localize(image))
    print(calls, "calls", changes, "changes")  # noqa: T201
    assert 100 < calls <= MOST_CALLS
    assert changes <= MOST_CHANGES


def test_a_recording_takes_few_calls_and_changes_of_file(
    arcs: tuple[Recording, Recording], hall_map: MapContents
) -> None:
    calls, changes = walked(lambda: learn_scene(arcs[0], hall_map.empty()))
    print(calls, "calls", changes, "changes")  # noqa: T201
    assert 100 < calls <= MOST_LEARNING_CALLS
    assert changes <= MOST_LEARNING_CHANGES
