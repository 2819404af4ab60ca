"""The studio without its page: steps, samples, files, and that nothing is lost."""

from __future__ import annotations

import shlex
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration
from evercal.calibration.export.formats import FORMATS
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.live.camera import StreamCamera
from evercal.live.coverage import coverage
from evercal.live.robot import PoseFileRobot
from evercal.map import Map
from evercal.recordings import Recording, load_recording
from evercal.recordings.formats import generic
from evercal.service.studio.devices import Devices, Seen, moved
from evercal.service.studio.folders import Folders
from evercal.service.studio.jobs import Jobs
from evercal.service.studio.rest import RestTrigger
from evercal.service.studio.steps import Facts, current_step, step_states
from evercal.service.studio.studio import Studio
from evercal.service.studio.wrist import LearnedSamples, free_name, learned_again, read_learned
from evercal.simulation.virtual_cell import CellOptions, VirtualCell, nominal_mount

SMALL = CellOptions(width=160, height=120)


def devices_of(cell: VirtualCell) -> Devices:
    return Devices(
        cell.wrist_camera,
        cell.intrinsics,
        cell.robot,
        cell.tripod_camera,
        cell.intrinsics,
        cell.reachable_poses(60),
        nominal_mount(),
        settle_s=0.0,
    )


@pytest.fixture
def cell() -> VirtualCell:
    return VirtualCell(3, SMALL)


def studio_in(root: Path, cell: VirtualCell) -> Studio:
    return Studio(devices_of(cell), Folders(root, root / "map"), "cpu")


def silent(*_: object) -> None:
    pass


def statuses(studio: Studio) -> dict[str, str]:
    return {state.step: state.status for state in studio.steps()}


def facts() -> Facts:
    return Facts(
        connected=True,
        connection_problem="",
        coverage=coverage(()),
        mount_verdict=None,
        samples_changed=True,
        scenes=0,
        has_fixed=True,
        fixed_images=0,
        fixed_verdict=None,
        exported=0,
    )


def test_steps_open_one_after_another() -> None:
    """From nothing to an export; `now` is the step that the page opens at."""
    ready = replace(facts().coverage, ready=True, samples=(), verdict="Ready.")
    way: list[tuple[dict[str, object], str, str]] = [
        ({"connected": False, "connection_problem": "no camera"}, "connect", "no camera"),
        ({"connected": True}, "record", "Move the arm"),
        ({"coverage": ready}, "record", "Move the arm"),
        ({"mount_verdict": "Good.", "samples_changed": False, "scenes": 1}, "record", ""),
    ]
    state = facts()
    for changes, now, says in way:
        state = replace(state, **changes)  # pyright: ignore[reportArgumentType]
        states = step_states(state)
        assert current_step(states) == now
        assert says in next(s.says for s in states if s.step == now)
    by_step = {s.step: s for s in step_states(state)}
    assert by_step["learn"].status == "done"
    assert by_step["learn"].says == "Good."
    assert by_step["fixed"].status == "open"
    assert by_step["export"].status == "open"
    changed = {s.step: s for s in step_states(replace(state, samples_changed=True))}
    assert changed["learn"].status == "open"
    assert "learn them again" in changed["learn"].says


def test_a_map_that_was_learned_before_opens_the_fixed_camera_at_once() -> None:
    states = {s.step: s.status for s in step_states(replace(facts(), scenes=1))}
    assert (states["learn"], states["fixed"], states["export"]) == ("locked", "open", "locked")
    without = {s.step: s for s in step_states(replace(facts(), scenes=1, has_fixed=False))}
    assert without["fixed"].status == "locked"
    assert "--fixed SOURCE" in without["fixed"].says


def test_samples_are_on_disk_at_once_and_a_new_studio_goes_on(
    cell: VirtualCell, tmp_path: Path
) -> None:
    studio = studio_in(tmp_path, cell)
    assert statuses(studio)["record"] == "locked"
    assert studio.proposal() is None
    studio.connection.look()
    assert statuses(studio)["connect"] == "done"
    assert statuses(studio)["record"] == "open"
    assert studio.take_sample() == "Took sample 0000.jpg."
    assert len(load_recording(tmp_path / "wrist").train) == 1
    assert "same pose as 0000.jpg: better remove it" in studio.take_sample()
    assert studio.book.bad() == ["0001.jpg"]
    again = studio_in(tmp_path, cell)
    assert again.book.names == ("0000.jpg", "0001.jpg")
    assert again.remove(*again.book.bad()) == "Removed 0001.jpg."
    assert again.remove(*again.book.bad()) == "There is no bad sample."
    assert [f.name for f in load_recording(tmp_path / "wrist").train] == ["0000.jpg"]
    assert statuses(again)["learn"] == "locked"


def test_the_next_view_is_reachable_lowers_sigma_and_is_not_repeated(
    cell: VirtualCell, tmp_path: Path
) -> None:
    studio = studio_in(tmp_path, cell)
    studio.take_sample()
    reachable = studio.devices.reachable
    assert reachable is not None
    sigmas = []
    for _ in range(5):
        proposal = studio.proposal()
        assert proposal is not None
        pose = proposal.base_from_gripper
        assert min(sum(pose_distance(pose, other)) for other in reachable) < 1e-9
        assert proposal.sigma_mm[1] < proposal.sigma_mm[0]
        sigmas.append(proposal.sigma_mm[0])
        assert studio.move_to(pose) == "The arm is there."
        assert max(pose_distance(cell.robot.base_from_gripper(), pose)) < 1e-4
        studio.take_sample()
    assert sigmas == sorted(sigmas, reverse=True)
    assert not studio.book.bad()


def test_a_pose_out_of_reach_is_one_line_and_is_not_proposed_again(
    cell: VirtualCell, tmp_path: Path
) -> None:
    far = SE3.from_translation((2.0, 0, 0.5))
    devices = replace(devices_of(cell), reachable=SE3.stack([far]))
    studio = Studio(devices, Folders(tmp_path, tmp_path / "map"), "cpu")
    studio.take_sample()
    proposal = studio.proposal()
    assert proposal is not None
    jobs = Jobs()
    assert jobs.run("moving", lambda: studio.move_to(proposal.base_from_gripper))
    assert jobs.message.kind == "error"
    assert "\n" not in jobs.message.text
    assert studio.proposal() is None


def test_recording_by_itself_ends_complete_or_when_it_is_stopped(
    cell: VirtualCell, tmp_path: Path
) -> None:
    studio = studio_in(tmp_path, cell)
    said: list[float] = []
    studio.record(lambda _what, done, _total: said.append(done), lambda: len(said) >= 4)
    assert said == [1, 2, 3, 4]
    assert len(studio.book.frames) == 5
    studio.record(silent)
    covered = studio.book.coverage()
    assert covered.ready
    assert covered.missing == ()
    assert statuses(studio)["record"] == "done"
    assert statuses(studio)["learn"] == "open"


def test_without_reachable_poses_views_near_the_recorded_ones_are_proposed(
    cell: VirtualCell, tmp_path: Path
) -> None:
    devices = replace(devices_of(cell), reachable=None)
    studio = Studio(devices, Folders(tmp_path, tmp_path / "map"), "cpu")
    studio.take_sample()
    here, proposal = cell.robot.base_from_gripper(), studio.proposal()
    assert proposal is not None
    metres, radians = pose_distance(here, proposal.base_from_gripper)
    assert 0.02 < metres < 1.0 or radians > 0.07
    assert not (tmp_path / "reachable.csv").exists()
    assert "--next" not in studio.folders.record_command()


def test_devices_that_give_nothing_are_named(cell: VirtualCell, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    from evercal.recordings import write_image

    write_image(tmp_path / "images/0.png", cell.wrist_camera.read()[1])
    devices = Devices(
        StreamCamera(str(tmp_path / "images")),
        cell.intrinsics,
        PoseFileRobot(tmp_path / "poses.csv"),
    )
    studio = Studio(devices, Folders(tmp_path / "out", tmp_path / "map"), "cpu")
    seen = studio.connection.look()
    assert seen.image is not None
    assert "poses.csv" in seen.robot_problem
    assert not seen.complete
    (tmp_path / "poses.csv").write_text("x,y,z,qw,qx,qy,qz\n0.4,0,0.5,1,0,0,0\n")
    assert studio.connection.look(None).complete
    assert "no more frames" in studio.connection.look().camera_problem
    with pytest.raises(InputError, match="move it by hand"):
        studio.move_to(SE3.identity())
    with pytest.raises(InputError, match="--fixed SOURCE"):
        studio.take_fixed()
    with pytest.raises(InputError, match="not calibrated yet"):
        studio.export("wrist", "urdf")


def test_each_camera_has_its_own_problem(cell: VirtualCell, tmp_path: Path) -> None:
    class Unplugged:
        def read(self) -> tuple[float, np.ndarray]:
            raise InputError("unplugged")

    devices = replace(devices_of(cell), fixed_camera=Unplugged())
    studio = Studio(devices, Folders(tmp_path, tmp_path / "map"), "cpu")
    studio.connection.look("wrist")
    seen = studio.connection.look("fixed")
    assert seen.fixed_problem == "unplugged"
    assert seen.complete


def test_samples_learned_again_replace_their_scene_in_one_step(
    rooms: tuple[Recording, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = Folders(tmp_path, tmp_path / "map")
    generic.write(folders.wrist, replace(rooms[0], train=rooms[0].train[:16]))
    opened = Map.open(folders.map, device="cpu")
    opened.learn(folders.wrist, name="own")
    before = sorted(path.name for path in tmp_path.iterdir())

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(opened, "merge", killed)
        with pytest.raises(KeyboardInterrupt):
            learned_again(opened, folders, "own", silent)
    assert Map.open(folders.map, device="cpu").scenes == ("own",)
    report = learned_again(opened, folders, "own", silent)
    assert report.scene == "own"
    assert opened.scenes == ("own",)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_an_image_of_a_moving_arm_is_refused(cell: VirtualCell, tmp_path: Path) -> None:
    class Turning:
        def __init__(self) -> None:
            self.angle = 0.0

        def base_from_gripper(self) -> SE3:
            self.angle += 0.01
            return SE3.exp(np.array([0, 0, 0, 0, 0, self.angle]))

    devices = replace(devices_of(cell), robot=Turning(), reachable=None)
    studio = Studio(devices, Folders(tmp_path, tmp_path / "map"), "cpu")
    with pytest.raises(InputError, match="let it stand still"):
        studio.take_sample()
    assert studio.book.frames == ()
    assert not studio.devices.can_move


def test_an_arm_at_rest_is_sampled_once(cell: VirtualCell, tmp_path: Path) -> None:
    studio, trigger = studio_in(tmp_path, cell), RestTrigger(rest_s=0.0)
    image, pose = studio.connection.sample()
    seen = Seen(image, None, pose, still_since=1.0)
    assert trigger.fires(seen, studio.book)
    assert not trigger.fires(seen, studio.book)
    studio.take_sample()
    assert not trigger.fires(replace(seen, still_since=2.0), studio.book), "has a sample"
    away = pose @ SE3.from_translation((0.05, 0, 0))
    assert moved(pose, away)
    assert trigger.fires(replace(seen, base_from_gripper=away, still_since=3.0), studio.book)
    slow = RestTrigger(rest_s=1e9)
    assert not slow.fires(replace(seen, base_from_gripper=away, still_since=4.0), studio.book)


def test_one_task_runs_at_a_time_and_failures_are_one_line() -> None:
    jobs, go = Jobs(), threading.Event()

    def wait() -> str:
        go.wait(30)
        return "waited"

    assert jobs.start("waiting", wait)
    assert jobs.busy
    assert not jobs.start("another", lambda: "never")
    go.set()
    jobs.wait(30)
    assert (jobs.message.kind, jobs.message.text) == ("good", "waited")

    def fail(error: Exception) -> str:
        raise error

    for error, text in (
        (InputError("two\nlines"), "two lines"),
        (OSError(28, "No space left", "x.jpg"), "x.jpg: No space left"),
        (KeyError("k"), "internal error, KeyError: 'k'"),
    ):
        jobs.run("failing", lambda error=error: fail(error))
        assert (jobs.message.kind, jobs.message.text) == ("error", text)
    assert not jobs.busy


def test_every_format_is_exported_or_says_why_not(cell: VirtualCell, tmp_path: Path) -> None:
    studio = studio_in(tmp_path, cell)
    pose = UncertainPose(cell.truth.base_from_tripod, 1e-6 * np.eye(6))
    studio.calibrations["fixed"] = Calibration(
        "eye_to_hand", pose.pose, pose.covariance, camera=cell.intrinsics
    )
    written = set()
    for name in FORMATS:
        path = studio.folders.export("fixed", name)
        command = shlex.split(studio.folders.export_command("fixed", name))
        assert command[command.index("--out") + 1] == str(path)
        if name == "moveit_samples":  # needs poses of a board
            with pytest.raises(InputError, match="moveit_samples: "):
                studio.export("fixed", name)
            continue
        assert str(path) in studio.export("fixed", name)
        assert path.exists()
        written.add(path)
    assert len(written) == len(FORMATS) - 1, "each has a file of its own"
    assert statuses(studio)["export"] == "done"


def test_scenes_of_others_are_not_replaced(tmp_path: Path) -> None:
    assert free_name("wrist", ()) == "wrist"
    assert free_name("wrist", ("wrist", "wrist-2")) == "wrist-3"
    assert read_learned(tmp_path / "none.json") is None
    learned = LearnedSamples("wrist-3", ("0000.jpg",))
    learned.write(tmp_path / "studio.json")
    assert read_learned(tmp_path / "studio.json") == learned
    (tmp_path / "studio.json").write_text("{}")
    with pytest.raises(InputError, match="learn again"):
        read_learned(tmp_path / "studio.json")
