"""The studio without a browser: steps, samples, files, and that nothing is lost."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.export.formats import FORMATS
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance, pose_distance_mm_deg
from evercal.live.camera import StreamCamera
from evercal.live.robot import PoseFileRobot
from evercal.map import Map
from evercal.recordings import load_recording, write_image
from evercal.robot.frame_names import FrameNames
from evercal.service.studio.controls import Tasks
from evercal.service.studio.devices import Devices
from evercal.service.studio.page import StudioPage
from evercal.service.studio.steps import STEPS
from evercal.service.studio.studio import Studio
from evercal.simulation.virtual_cell import CellOptions, VirtualCell, nominal_mount


def devices_of(cell: VirtualCell) -> Devices:
    return Devices(
        cell.wrist_camera,
        cell.intrinsics,
        cell.robot,
        cell.tripod_camera,
        cell.intrinsics,
        cell.reachable_poses(60),
        cell.holding_poses(60),
        cell.hold,
        nominal_mount(),
        settle_s=0.0,
    )


@pytest.fixture
def cell() -> VirtualCell:
    return VirtualCell(3, CellOptions(width=160, height=120))


def studio_in(root: Path, cell: VirtualCell, **changes: Any) -> Studio:
    return Studio(replace(devices_of(cell), **changes), root)


def silent(*_: object) -> None:
    pass


def status(studio: Studio, step: str) -> str:
    return STEPS[step](studio)[0]


def says(studio: Studio, step: str) -> str:
    return STEPS[step](studio)[1]


def calibration(scene: str) -> Calibration:
    pose = SE3.from_translation((0.3, 0, 0.5))
    return Calibration(
        "eye_in_hand",
        pose,
        1e-6 * np.eye(6),
        source={"scene": scene, "frames": 1},
    )


def test_samples_are_on_disk_at_once_and_a_new_studio_goes_on(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    assert [status(studio, step) for step in STEPS] == [
        "to do",
        *["waits"] * 3,
        "to do",
        "waits",
    ]
    assert studio.next_view() is None
    studio.connection.look()
    assert status(studio, "Connect") == "done"
    assert "take the first sample" in says(studio, "Record")
    assert studio.take_sample() == "Took sample 0000.jpg."
    assert len(load_recording(tmp_path / "wrist").train) == 1
    assert "same pose as 0000.jpg: better remove it" in studio.take_sample()
    again = studio_in(tmp_path, cell)
    assert again.bad_samples() == ["0001.jpg"]
    assert again.remove(*again.bad_samples()) == "Removed 0001.jpg."
    assert again.remove(*again.bad_samples()) == "There is no such sample."
    assert [f.name for f in load_recording(tmp_path / "wrist").train] == ["0000.jpg"]
    assert status(again, "Learn") == "waits"


def test_the_next_view_is_reachable_lowers_sigma_and_is_not_repeated(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    studio.take_sample()
    reachable = studio.connection.devices.reachable
    assert reachable is not None
    sigmas = []
    for _ in range(4):
        view = studio.next_view()
        assert view is not None
        pose = view.poses[0]
        assert min(sum(pose_distance(pose, other)) for other in reachable) < 1e-9
        assert view.sigma_mm[1] < view.sigma_mm[0]
        sigmas.append(view.sigma_mm[0])
        assert studio.move_to(pose) == "The arm is there."
        assert max(pose_distance(cell.robot.base_from_gripper(), pose)) < 1e-4
        studio.take_sample()
    assert sigmas == sorted(sigmas, reverse=True)
    assert not studio.bad_samples()


def test_a_pose_out_of_reach_is_not_proposed_again(cell, tmp_path):
    far = SE3.stack([SE3.from_translation((2.0, 0, 0.5))])
    farther = SE3.stack([SE3.from_translation((3.0, 0, 0.5))])
    studio = studio_in(tmp_path, cell, reachable=far, holding=farther)
    studio.take_sample()
    assert studio.next_view() is not None
    assert studio.record(silent) == "1 samples are recorded."
    assert studio.record(silent, which="fixed") == "0 samples are recorded."
    assert studio.next_view() is None


def test_the_arm_moves_only_while_somebody_sees_it(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    looks = iter([True, True, True])
    studio.take_sample()
    studio.watched = lambda: next(looks, False)
    with pytest.raises(InputError, match="open its page"):
        studio.record(silent)
    assert len(studio.recorders["wrist"].frames) == 2  # each view asks twice
    page = StudioPage(studio, "127.0.0.1", 0)
    try:
        before = cell.robot.joints_rad()
        view = studio.next_view()
        assert view is not None
        with pytest.raises(InputError, match="open its page"):
            studio.move_to(view.poses[0])
        assert cell.robot.joints_rad() == before
    finally:
        page.close()


def test_without_reachable_poses_views_near_the_recorded_ones_are_proposed(
    cell, tmp_path
):
    studio = studio_in(tmp_path, cell, reachable=None)
    studio.take_sample()
    view = studio.next_view()
    assert view is not None
    metres, radians = pose_distance(cell.robot.base_from_gripper(), view.poses[0])
    assert 0.02 < metres < 1.0 or radians > 0.07


def test_recording_by_itself_ends_complete_or_when_it_is_stopped(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    done: list[float] = []
    studio.record(lambda _what, good, _total: done.append(good), lambda: len(done) >= 4)
    assert done == [1, 2, 3, 4]
    assert len(studio.recorders["wrist"].frames) == 5
    studio.record(silent)
    covered = studio.coverage()
    assert (covered.ready, covered.missing) == (True, ())
    assert (status(studio, "Record"), status(studio, "Learn")) == ("done", "to do")


def test_devices_that_give_nothing_are_named(cell, tmp_path):
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images/0.png", cell.wrist_camera.read()[1])
    camera = StreamCamera(str(tmp_path / "images"))
    devices = Devices(camera, cell.intrinsics, PoseFileRobot(tmp_path / "poses.csv"))
    studio = Studio(devices, tmp_path / "out", tmp_path / "map")
    connection = studio.connection
    connection.look()
    assert "wrist" in connection.images
    assert "poses.csv" in connection.problems["robot"]
    assert "poses.csv" in says(studio, "Connect")
    (tmp_path / "poses.csv").write_text("x,y,z,qw,qx,qy,qz\n0.4,0,0.5,1,0,0,0\n")
    connection.look(None)
    assert connection.complete
    connection.look()
    assert "no more frames" in connection.problems["wrist"]
    assert not connection.complete
    calls: list[tuple[Callable[[], str], str]] = [
        (lambda: studio.move_to(SE3.identity()), "move it by hand"),
        (studio.take_fixed, "`fixed` SOURCE"),
        (studio.check_fixed, "the fixed camera is not calibrated yet"),
        (lambda: studio.calibrate_fixed(silent), "take one first"),
        (lambda: studio.export("wrist", "urdf"), "not calibrated yet"),
    ]
    for call, message in calls:
        with pytest.raises(InputError, match=message):
            call()
    assert not studio.can_move


def test_an_image_of_a_moving_arm_is_refused(cell, tmp_path):
    angles = iter(np.arange(0, 1, 0.01))
    turning = SimpleNamespace(
        base_from_gripper=lambda: SE3.exp([0, 0, 0, 0, 0, next(angles)])
    )
    studio = studio_in(tmp_path, cell, robot=turning)
    with pytest.raises(InputError, match="let it stand still"):
        studio.take_sample()
    assert studio.recorders["wrist"].frames == ()


def test_images_of_the_fixed_camera_are_numbered_and_removed(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    studio.take_sample()
    assert studio.take_fixed() == "Took image 0000.jpg."
    assert studio.take_fixed_series(silent, move=True) == "Took 8 images."
    assert [path.stem for path in studio.fixed_images] == [f"{i:04d}" for i in range(9)]
    studio.clear_fixed()
    assert studio.fixed_images == []


class Cell:
    """The scenes of a map, without their content."""

    def __init__(self, root: Path, *scenes: str):
        self.path = root
        self.scenes = scenes

    def learn(
        self, _: object, name: str, replace: str | None, on_progress: object
    ) -> Any:
        kept = [scene for scene in self.scenes if scene != replace]
        self.scenes = (*kept, name)

    def calibration(self, scene: str) -> Calibration:
        return calibration(scene)


def test_samples_learned_again_replace_their_scene_and_no_other(
    cell, tmp_path, monkeypatch
):
    opened: Any = Cell(tmp_path, "wrist", "wrist-2")
    monkeypatch.setattr(Map, "open", lambda *_, **__: opened)
    studio = studio_in(tmp_path, cell)
    studio.take_sample()
    for _ in range(2):
        assert studio.samples_changed()
        assert studio.learn(silent) == f"Learned 1 images; wrote {tmp_path}/wrist.json."
        assert opened.scenes == ("wrist", "wrist-2", "wrist-3")
        again = studio_in(tmp_path, cell)
        assert (again.scene, again.samples_changed()) == ("wrist-3", False)
        assert status(again, "Learn") == "done"
        os.utime(tmp_path / "wrist" / "base_from_gripper.csv")  # the same samples
        assert not again.samples_changed()
        again.take_sample()
        # The clock was set back.
        os.utime(tmp_path / "wrist" / "base_from_gripper.csv", (1e9, 1e9))
        assert again.samples_changed()

    def fail(*_: object, **__: object) -> None:
        raise InputError("too few images")

    opened.learn = fail
    with pytest.raises(InputError, match="too few"):
        studio.learn(silent)
    assert opened.scenes == ("wrist", "wrist-2", "wrist-3")


def test_a_held_thing_leads_from_an_empty_folder_to_the_fixed_camera(tmp_path):
    """No map, no camera on the gripper: within 1 mm and 0.1 deg, and within the stated error."""
    cell = VirtualCell(3, CellOptions(width=320, height=240))
    studio = studio_in(tmp_path, cell, wrist_camera=None)
    truth = cell.truth.base_from_tripod
    studio.connection.look("fixed")
    assert status(studio, "Connect") == "done"
    frames = studio.recorders["fixed"]
    studio.record(silent, lambda: len(frames.frames) == 8, "fixed")
    studio.remove("0007.jpg", which="fixed")
    assert "1 more image to start with" in says(studio, "Hold")
    assert "cannot be calibrated yet" in says(studio, "Hold")
    studio.record(silent, lambda: len(frames.frames) == 12, "fixed")
    assert studio.coverage("fixed").ready
    assert (
        studio.learn(silent, "fixed")
        == f"Learned 12 images; wrote {tmp_path}/fixed.json."
    )
    again = studio_in(tmp_path, cell, wrist_camera=None)
    assert [status(again, step) for step in ("Fixed", "Hold")] == ["done", "done"]
    again.export("fixed", "easy_handeye2", NAMES)
    found = read_calibration(tmp_path / "fixed.json")
    assert found.frames == NAMES
    millimetres, degrees = pose_distance_mm_deg(found.parent_from_child, truth)
    assert millimetres < 1
    assert degrees < 0.1
    # 0.999 of chi-square, 6 degrees.
    assert found.uncertain_pose.squared_mahalanobis(truth) < 22.5
    assert (tmp_path / "export/fixed.calib").is_file()
    view = cell.holding_poses(3, seed=5)
    images = []
    for pose in view:
        cell.robot.move_to(pose)
        images.append(cell.tripod_camera.read()[1])
    thing = Map.open(tmp_path / "thing")
    now = np.stack(images)
    assert not thing.check(now, found, robot_poses=view).moved
    bumped = replace(
        found, parent_from_child=SE3.from_translation((0.004, 0, 0)) @ truth
    )
    assert thing.check(now, bumped, robot_poses=view).moved
    second = thing.calibrate(now, robot_poses=view)
    assert second.mount == "eye_to_hand"
    assert second.uncertain_pose.squared_mahalanobis(truth) < 22.5
    with pytest.raises(InputError, match="is a thing in the gripper: give"):
        thing.check(now, found)


NAMES = FrameNames("base_link", "tool0", "camera_optical")
NEEDING_MORE = ("moveit_samples", "joint_offsets", "corrected_urdf", "lerobot")
"""Formats that need poses of a board, or offsets of joints."""


def test_every_format_is_exported_or_says_why_not(cell, tmp_path):
    studio = studio_in(tmp_path, cell)
    pose = cell.truth.base_from_tripod
    covariance = 1e-6 * np.eye(6)
    studio.calibrations["fixed"] = Calibration(
        "eye_to_hand", pose, covariance, camera=cell.intrinsics
    )
    written = []
    for name in FORMATS:
        if name in NEEDING_MORE:
            with pytest.raises(InputError, match=f"{name}: "):
                studio.export("fixed", name)
        elif FORMATS[name].frame == "tf" and not written:
            with pytest.raises(InputError, match="the base frame is unknown"):
                studio.export("fixed", name)
            written.append(studio.export("fixed", name, NAMES))
        else:  # the names are kept
            written.append(studio.export("fixed", name))
    # Each has a file of its own.
    assert len(set(written)) == len(FORMATS) - len(NEEDING_MORE)
    assert status(studio, "Export") == "done"


def ended(tasks: Tasks) -> None:
    until = time.monotonic() + 30
    while tasks.busy and time.monotonic() < until:
        time.sleep(0.01)


def test_one_task_runs_at_a_time_and_failures_are_one_line():
    tasks = Tasks(silent)
    go = threading.Event()

    def wait() -> str:
        go.wait(30)
        return "waited"

    assert tasks.start("waiting", wait)
    assert (tasks.busy, tasks.message) == (True, "waiting")
    assert not tasks.start("another", lambda: "never")
    go.set()
    ended(tasks)
    assert (tasks.failed, tasks.message) == (False, "waited")

    def fail(error: Exception) -> str:
        raise error

    for error, text in (
        (InputError("two\nlines"), "two lines"),
        (KeyError("k"), "internal error, KeyError: 'k'"),
    ):
        assert tasks.start("failing", lambda error=error: fail(error))
        ended(tasks)
        assert (tasks.failed, tasks.message) == (True, text)


def test_the_page_follows_a_task(cell, tmp_path, caplog):
    page = StudioPage(studio_in(tmp_path, cell), "127.0.0.1", 0)
    try:
        assert page.tasks.start("taking a sample", page.studio.take_sample)
        ended(page.tasks)
        assert page.tasks.message == "Took sample 0000.jpg."
        page.studio.connection.look("fixed")
        page.refresh()
    finally:
        page.close()
    assert caplog.records == []
