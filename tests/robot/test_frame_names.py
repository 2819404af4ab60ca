"""Names of frames: what is known stays known."""

from evercal.robot.frame_names import FrameNames


def test_a_known_name_wins_over_that_of_another() -> None:
    names = FrameNames(gripper="tool0", camera="left")
    other = FrameNames("base_link", "flange")
    assert names.or_of(other) == FrameNames("base_link", "tool0", "left")
    assert other.or_of(names) == FrameNames("base_link", "flange", "left")
