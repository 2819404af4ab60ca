"""Names of frames: what is known stays known."""

import pytest

from evercal.errors import InputError
from evercal.robot.frame_names import FrameNames


def test_a_known_name_wins_over_that_of_another() -> None:
    names = FrameNames(gripper="tool0", camera="left")
    other = FrameNames("base_link", "flange")
    assert names.or_of(other) == FrameNames("base_link", "tool0", "left")
    assert other.or_of(names) == FrameNames("base_link", "flange", "left")


def test_two_frames_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match="both called 'flange'"):
        FrameNames("base", "flange").or_of(FrameNames(camera="flange"))
    with pytest.raises(ValueError, match="both called 'base'"):
        FrameNames.from_dict({"base": "base", "camera": "base"})
    assert FrameNames.from_dict({}) == FrameNames()
