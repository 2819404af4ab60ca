"""Plans of a thing in the gripper before a fixed camera."""

from dataclasses import replace

import numpy as np

from evercal.geometry import pose_distance
from evercal.simulation.panda_arm import base_from_flange
from rooms.held import Setting, make_plan
from rooms.things import SIZES_M

SETTING = Setting(seed=100, px=100, images=12)


def test_thing_is_in_the_image_as_large_as_asked() -> None:
    plan = make_plan(SETTING)
    tip = np.array([[0, 0, -0.5], [0, 0, 0.5]]) * SIZES_M["box"][2] * plan.scale
    thing = (
        plan.base_from_camera.inverse()
        @ plan.base_from_gripper
        @ plan.gripper_from_thing
    )
    ends = np.stack([plan.camera.project(pose.apply(tip)) for pose in thing])
    assert ((ends > 0) & (ends < SETTING.size)).all()
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert 75 < np.median(length) < 115
    reached = [base_from_flange(joints) for joints in plan.joints_rad]
    for pose, stated in zip(reached, plan.base_from_gripper, strict=True):
        assert max(pose_distance(pose, stated)) < 1e-5


def test_shorter_recording_is_the_beginning_of_a_longer_one() -> None:
    plan = make_plan(SETTING)
    short = make_plan(replace(SETTING, images=5))
    assert np.array_equal(short.joints_rad, plan.joints_rad[:5])


def test_thing_slips_once() -> None:
    held = make_plan(replace(SETTING, fault="slip")).gripper_from_thing
    metres, radians = pose_distance(held[1:], held[:-1])
    assert ((metres > 0) | (radians > 0)).sum() == 1
    assert 0.0009 < metres.max() < 0.02
    assert 0.9 < np.rad2deg(radians.max()) < 3.1
