"""`Studio`: everything that the page can do, without the page."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.export.formats import FORMATS, export_files
from evercal.calibration.from_map.next_views import NextViews, looked_at, next_views
from evercal.errors import InputError, with_options
from evercal.geometry import SE3, Camera, pose_distance
from evercal.live.coverage import IMAGES, SAME_DEG, SAME_MM, Coverage, Sample, coverage
from evercal.live.recorder import JPEG_QUALITY, POSES, WristRecorder
from evercal.live.robot import MovingRobot
from evercal.map import Map
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.frame import MIN_GRIPPER_FRAMES, stated_grippers
from evercal.recordings.images import write_jpeg
from evercal.service.studio.devices import Connection, Devices, Which
from evercal.storage import sha256_file, write_json

FIXED_IMAGES = 8
"""Images of a series of the fixed camera."""
_CANDIDATES = 200
_TURN_RAD, _ROLL_RAD, _NEARER = np.deg2rad(30.0), np.deg2rad(40.0), 0.25
"""How far proposed views may lie from recorded ones where reachable poses are unknown."""
_TABLE = "robot_poses_sha256"
"""Entry of a calibration's source: checksum of the samples' table of poses."""

_measured = cache(Sample.of)

State = tuple[Literal["waits", "to do", "done"], str]
"""Status of a step, and what was found or what to do in one to three sentences."""

OnStep = Callable[[str, float, float], Any]


class Studio:
    """The way to a calibration, in a folder that a later studio continues with.

    Actions return what was done, in one line, and raise `InputError` if it cannot be done.
    """

    def __init__(self, devices: Devices, out: Path, map: Path | None = None):
        self.connection = Connection(devices)
        self.out = out
        out.mkdir(parents=True, exist_ok=True)
        self.cell = Map.open(map or out / "map")
        self.thing = Map.open(out / "thing")
        self.mount = devices.rough
        """gripper_from_camera, rough or calibrated; None if nothing is known."""
        self.watched: Callable[[], bool] = lambda: True
        """Whether somebody sees what the arm does; it moves only then."""
        self._refused: list[SE3] = []
        self._fixed_camera = out / "fixed_camera.json"
        if devices.fixed_intrinsics is not None:
            write_json(self._fixed_camera, asdict(devices.fixed_intrinsics))
        fixed = self._fixed_intrinsics() or devices.intrinsics
        self.recorders: dict[Which, WristRecorder] = {
            "wrist": WristRecorder(self.recording("wrist"), devices.intrinsics),
            "fixed": WristRecorder(self.recording("fixed"), fixed),
        }
        """Samples of the camera on the gripper, and of a thing in the gripper."""
        self.calibrations: dict[Which, Calibration] = {}
        for which in ("wrist", "fixed"):
            path = self.calibration_file(which)
            found = read_calibration(path) if path.is_file() else None
            scenes = *self.cell.scenes, *self.thing.scenes
            if found is not None and found.source.get("scene") in scenes:
                self._keep(which, found, write=False)

    def calibration_file(self, which: Which) -> Path:
        """Calibration of a camera."""
        return self.out / f"{which}.json"

    def recording(self, which: Which) -> Path:
        """Samples of the camera on the gripper, or of a fixed camera that sees a held thing."""
        return self.out / ("wrist" if which == "wrist" else "held")

    @property
    def can_move(self) -> bool:
        """Whether the arm moves on request."""
        return isinstance(self.connection.devices.robot, MovingRobot)

    @property
    def scene(self) -> str | None:
        """The scene that was learned from the recording; None before."""
        found = self.calibrations.get("wrist")
        return None if found is None else str(found.source["scene"])

    def samples_changed(self, which: Which = "wrist") -> bool:
        """Whether samples were added or removed since they were learned."""
        found = self.calibrations.get(which)
        table = self._table_sha256(which)
        return found is None or table is None or found.source.get(_TABLE) != table

    def _table_sha256(self, which: Which) -> str | None:
        table = self.recording(which) / POSES
        return sha256_file(table) if table.is_file() else None

    @property
    def fixed_images(self) -> list[Path]:
        """Images of the fixed camera, in order."""
        return sorted((self.out / "fixed").glob("*.jpg"))

    def coverage(self, which: Which = "wrist") -> Coverage:
        """What the samples cover."""
        mount = self.mount if which == "wrist" else None
        return coverage(
            [_measured(frame) for frame in self.recorders[which].frames], mount
        )

    def bad_samples(self, which: Which = "wrist") -> list[str]:
        """Names of the samples with problems."""
        return [row.name for row in self.coverage(which).samples if row.problems]

    def next_view(self) -> NextViews | None:
        """The view that would lower the uncertainty most; None before the first good sample.

        It is one of the reachable poses, else one near those of the samples.
        """
        rows = self.coverage().samples
        poses = [
            _measured(frame).base_from_gripper
            for frame in self.recorders["wrist"].frames
        ]
        good = [pose for pose, row in zip(poses, rows, strict=True) if not row.problems]
        if not good:
            return None
        reachable = self.connection.devices.reachable
        if reachable is None:
            reachable = _around(SE3.stack(poses), SE3.stack(good), self.mount)
        excluded = SE3.stack([*poses, *self._refused])
        views = next_views(SE3.stack(good), reachable, 1, self.mount, excluded)
        return views if len(views.poses) else None

    def next_pose(self, which: Which = "wrist") -> SE3 | None:
        """The gripper pose of the next view; for a held thing the one farthest from all before."""
        if which == "wrist":
            return view.poses[0] if (view := self.next_view()) else None
        poses = self.connection.devices.holding
        before = [*stated_grippers(self.recorders[which].frames), *self._refused]
        if poses is None:
            return None
        away = np.full(len(poses), np.inf)
        for pose in before:
            metres, radians = pose_distance(poses, pose)
            apart = np.maximum(1000 * metres / SAME_MM, np.rad2deg(radians) / SAME_DEG)
            away = np.minimum(away, apart)
        farthest = int(np.argmax(away))
        return poses[farthest] if away[farthest] > 1 else None

    def take_sample(self, which: Which = "wrist") -> str:
        """Record image and pose."""
        name = self.recorders[which].add(*self.connection.sample(which)).name
        bad = "; ".join(self.coverage(which).samples[-1].problems)
        return f"Took sample {name}{f', {bad}: better remove it' if bad else ''}."

    def remove(self, *names: str, which: Which = "wrist") -> str:
        """Remove samples."""
        for name in names:
            self.recorders[which].remove(name)
        return f"Removed {', '.join(names)}." if names else "There is no such sample."

    def move_to(self, base_from_gripper: SE3) -> str:
        """Move the arm."""
        robot = self.connection.devices.robot
        if not isinstance(robot, MovingRobot):
            raise InputError("this robot does not move on request; move it by hand")
        self._require_watched()
        try:
            robot.move_to(base_from_gripper)
        except InputError:
            self._refused.append(base_from_gripper)
            raise
        time.sleep(self.connection.devices.settle_s)
        self.connection.look(None)
        return "The arm is there."

    def move_on(self, which: Which = "wrist") -> str:
        """Move the arm to the next view."""
        pose = self.next_pose(which)
        return "There is no next view." if pose is None else self.move_to(pose)

    def record(
        self,
        on_step: OnStep,
        stopping: Callable[[], bool] = lambda: False,
        which: Which = "wrist",
    ) -> str:
        """Move from one best view to the next and take samples until nothing is missing."""
        if which == "wrist" and not self.recorders[which].frames:
            self.take_sample()
        while not stopping():
            reached = self.coverage(which)
            pose = self.next_pose(which)
            good = sum(not row.problems for row in reached.samples)
            if not reached.missing or pose is None or good >= 2 * IMAGES:
                break
            on_step(f"recording, {good} good images", min(good, IMAGES), IMAGES)
            self._require_watched()
            try:
                self.move_to(pose)
            except InputError:  # out of reach, and never proposed again
                continue
            self.take_sample(which)
        return f"{len(self.recorders[which].frames)} samples are recorded."

    def learn(self, on_step: OnStep, which: Which = "wrist") -> str:
        """Learn the recording and calibrate the camera on the gripper, or one that sees the thing.

        The scene that the studio learned before is replaced once the new one is in the map.
        """
        folder = self.recording(which)
        table = self._table_sha256(which)
        cell = self.cell
        old = self.scene
        if which == "fixed":
            cell = self.thing
            old = next(iter(self.thing.scenes), None)
        scene = _free_name(folder.name, cell.scenes)
        learn = cell.learn if which == "wrist" else cell.eye_to_hand
        learn(folder, name=scene, on_progress=on_step)
        if old is not None:
            cell.remove(old)
            cell.rename(scene, old)
        found = cell.calibration(old or scene)
        self._keep(which, replace(found, source={**found.source, _TABLE: table}))
        return f"Learned {found.source['frames']} images; wrote {self.calibration_file(which)}."

    def take_fixed(self) -> str:
        """Take an image of the fixed camera."""
        image = self.connection.image("fixed")
        folder = self.out / "fixed"
        folder.mkdir(exist_ok=True)
        number = max((int(path.stem) for path in self.fixed_images), default=-1) + 1
        write_jpeg(folder / f"{number:04d}.jpg", image, JPEG_QUALITY)
        return f"Took image {number:04d}.jpg."

    def take_fixed_series(self, on_step: OnStep, move: bool) -> str:
        """Take several images; the arm may go to poses of samples, so that it hides other parts."""
        poses = stated_grippers(self.recorders["wrist"].frames if move else ())
        for i in range(FIXED_IMAGES):
            on_step("taking images", i, FIXED_IMAGES)
            if len(poses):
                self.move_to(poses[i * len(poses) // FIXED_IMAGES])
            self.take_fixed()
        return f"Took {FIXED_IMAGES} images."

    def clear_fixed(self) -> str:
        """Remove all images of the fixed camera, such as after it was moved."""
        for path in self.fixed_images:
            path.unlink()
        return "Removed all images."

    def calibrate_fixed(self, on_step: OnStep) -> str:
        """Calibrate the fixed camera."""
        files = self.fixed_images
        if not files:
            raise InputError("no image of the fixed camera yet; take one first")
        on_step("locating images", 0, len(files))
        found = self.cell.calibrate(
            files, camera=self._fixed_intrinsics(), mount="eye_to_hand"
        )
        self._keep(
            "fixed",
            replace(found, source={**found.source, "store": str(self.cell.path)}),
        )
        return f"Calibrated the fixed camera; wrote {self.calibration_file('fixed')}."

    def check_fixed(self) -> str:
        """Test with a new image whether the fixed camera has moved."""
        reference = self._made("fixed")
        image = self.connection.image("fixed")
        shift = self.cell.check([image], reference)
        size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
        if not shift.moved:
            return f"The camera has not moved: it is within {size} of its calibration."
        sure = f"{100 * shift.confidence:.1f} %"
        return (
            f"The camera has moved by {size} (confidence {sure}). Calibrate it again."
        )

    def export(self, which: Which, format: str) -> str:
        """Export a calibration in a format of `evercal export`."""
        calibration = self._made(which)
        folder = self.out / "export"
        folder.mkdir(exist_ok=True)
        # Formats share endings; easy_handeye2 looks files up by their name.
        name = which if format == "easy_handeye2" else f"{which}_{format}"
        options: dict[str, Any] = {}
        if which == "wrist" and FORMATS[format].per_image:
            options["robot_poses"] = self.out / "wrist" / POSES
        path = folder / f"{name}{FORMATS[format].ending}"
        files = export_files(calibration, format, path, **options).files
        return f"Wrote {', '.join(map(str, files))}."

    def _require_watched(self) -> None:
        if not self.watched():
            raise InputError(
                "the arm moves only while a browser shows the studio; open its page"
            )

    def _made(self, which: Which) -> Calibration:
        if which not in self.calibrations:
            raise InputError(f"the {which} camera is not calibrated yet")
        return self.calibrations[which]

    def _fixed_intrinsics(self) -> Camera | None:
        return read_camera(self._fixed_camera) if self._fixed_camera.is_file() else None

    def _keep(self, which: Which, calibration: Calibration, write: bool = True) -> None:
        if write:
            calibration.write(self.calibration_file(which))
        self.calibrations[which] = calibration
        if which == "wrist":
            self.mount = calibration.parent_from_child


def _around(recorded: SE3, good: SE3, gripper_from_camera: SE3 | None) -> SE3:
    """Poses (n,) near recorded ones that look at the same point."""
    mount = SE3.identity() if gripper_from_camera is None else gripper_from_camera
    point_m = looked_at(good @ mount)
    rng = np.random.default_rng(len(recorded))
    cameras = recorded @ mount
    start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
    turns, closer = np.zeros((2, _CANDIDATES, 6))
    turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
    distance = np.linalg.norm(start.translation_m - point_m, axis=1)
    closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
    closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
    there = SE3.from_translation(point_m)
    back = SE3.from_translation(-point_m)
    return there @ SE3.exp(turns) @ back @ start @ SE3.exp(closer) @ mount.inverse()


def _free_name(name: str, taken: tuple[str, ...]) -> str:
    numbered = (f"{name}-{number}" for number in range(2, len(taken) + 2))
    return (
        name
        if name not in taken
        else next(free for free in numbered if free not in taken)
    )


_NO_FIXED = "No fixed camera was given; restart with `fixed` SOURCE, or go on."


def _connect(studio: Studio) -> State:
    if studio.connection.complete:
        return "done", "Images and gripper poses arrive."
    problems = studio.connection.problems.values()
    return "to do", next(iter(problems), "Waiting for image and pose.")


def _record(studio: Studio) -> State:
    covered = studio.coverage()
    if covered.samples:
        return "done" if covered.ready else "to do", covered.verdict
    if studio.connection.devices.wrist_camera is None:
        return "waits", "No camera on the gripper was given; go on to 'or Hold'."
    if not studio.connection.complete:
        return "waits", "Connect the camera and the robot first."
    return (
        "to do",
        "Move the arm until the camera sees the work area; take the first sample.",
    )


def _learn(studio: Studio) -> State:
    found = studio.calibrations.get("wrist")
    covered = studio.coverage()
    if found is not None and not studio.samples_changed():
        return "done", found.verdict
    if not covered.ready:
        return "waits", "The recording cannot be learned yet."
    if found is not None:
        return "to do", "The samples have changed since: learn them again."
    return "to do", f"{len(covered.samples)} images are ready to be learned."


def _fixed(studio: Studio) -> State:
    images = len(studio.fixed_images)
    found = studio.calibrations.get("fixed")
    if found is not None:
        return "done", with_options(found.verdict).replace(
            "--camera", "--fixed-intrinsics"
        )
    if not studio.cell.scenes:
        return (
            "waits",
            "Learn the scene first, or let the gripper hold something: see 'or Hold'.",
        )
    if studio.connection.devices.fixed_camera is None:
        return "waits", _NO_FIXED
    if not images:
        return "to do", "Take images of the scene, 5 to 10."
    return "to do", f"{images} images; take more, or calibrate."


def _hold(studio: Studio) -> State:
    found = studio.calibrations.get("fixed")
    covered = studio.coverage("fixed")
    if found is not None and not studio.samples_changed("fixed"):
        return "done", found.verdict
    if studio.connection.devices.fixed_camera is None:
        return "waits", _NO_FIXED
    if covered.samples:
        return "to do", covered.verdict
    return "to do", (
        "Calibrates the fixed camera without a scene. The gripper holds a textured thing, such as a"
        f" box or a book, and turns it by 20° and more about two axes: {MIN_GRIPPER_FRAMES} images"
        f" or more, better {IMAGES}."
    )


def _export(studio: Studio) -> State:
    if not studio.calibrations:
        return "waits", "There is no calibration to export yet."
    exported = len(list((studio.out / "export").glob("*")))
    if exported:
        return "done", f"{exported} files were exported."
    return "to do", "Choose a camera and a format."


STEPS: dict[str, Callable[[Studio], State]] = {
    "1 Connect": _connect,
    "2 Record": _record,
    "3 Learn": _learn,
    "4 Fixed": _fixed,
    "or Hold": _hold,
    "5 Export": _export,
}
"""All steps in order, each with its state; a held thing stands in for steps 2 to 4."""
