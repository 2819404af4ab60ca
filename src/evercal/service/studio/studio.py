"""`Studio`: everything that the page can do, without the page."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.export.formats import FORMATS, export_files
from evercal.calibration.from_map.next_views import NextViews, looked_at, next_views
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms, pose_distance
from evercal.live.coverage import IMAGES, SAME_DEG, SAME_MM, Coverage, Sample, coverage
from evercal.live.recorder import (
    JPEG_QUALITY,
    POSES,
    WristRecorder,
    next_name,
    require_own,
)
from evercal.live.robot import MovingRobot
from evercal.map import Map
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.frame import stated_grippers
from evercal.recordings.images import write_jpeg
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.service.studio.devices import Connection, Devices, Which
from evercal.storage import sha256_file, write_json
from evercal.typing import Strings

FIXED_IMAGES = 8
"""Images of a series of the fixed camera."""
_CANDIDATES = 200
"""Poses from which the next view is chosen where reachable poses are unknown."""
_TURN_RAD = np.deg2rad(30.0)
"""Largest rotation of a candidate about the observed point, per axis, from a recorded pose."""
_ROLL_RAD = np.deg2rad(40.0)
"""Largest rotation of a candidate about its optical axis from a recorded pose."""
_NEARER = 0.25
"""Largest change of a candidate's distance from the observed point, relative to that distance."""
_TABLE = "robot_poses_sha256"
"""Entry of a calibration's source: checksum of the samples' table of poses."""

_measured = cache(Sample.of)

OnStep = Callable[[str, float, float], Any]
"""Called with the current step, how much of it is done, and its total."""


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
        require_own(out / "fixed")
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
            if not path.is_file():
                continue
            calibration = read_calibration(path)
            scenes = *self.cell.scenes, *self.thing.scenes
            if calibration.source.get("scene") in scenes:
                self._keep(which, calibration)

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
        calibration = self.calibrations.get("wrist")
        return calibration and str(calibration.source["scene"])

    def samples_changed(self, which: Which = "wrist") -> bool:
        """Whether samples were added or removed since they were learned."""
        calibration = self.calibrations.get(which)
        table = self._table_sha256(which)
        if calibration is None or table is None:
            return True
        return calibration.source.get(_TABLE) != table

    def _table_sha256(self, which: Which) -> str | None:
        table = self.recording(which) / POSES
        return sha256_file(table) if table.is_file() else None

    @property
    def fixed_images(self) -> list[Path]:
        """Images of the fixed camera, in order."""
        return sorted((self.out / "fixed").glob("*.jpg"))

    def coverage(self, which: Which = "wrist") -> Coverage:
        """What the samples cover."""
        samples = list(map(_measured, self.recorders[which].frames))
        if which == "wrist":
            return coverage(samples, self.mount)
        return coverage(samples, use="calibrated")

    def bad_samples(self, which: Which = "wrist") -> list[str]:
        """Names of the samples with problems."""
        return [row.name for row in self.coverage(which).samples if row.problems]

    def next_view(self) -> NextViews | None:
        """The view that would lower the uncertainty most; None before the first good sample.

        It is one of the reachable poses, else one near those of the samples.
        """
        poses = stated_grippers(self.recorders["wrist"].frames)
        usable = [not row.problems for row in self.coverage().samples]
        if not any(usable):
            return None
        good = poses[usable]
        reachable = self.connection.devices.reachable
        if reachable is None:
            reachable = _around(poses, good, self.mount)
        excluded = SE3.stack([*poses, *self._refused])
        views = next_views(good, reachable, 1, self.mount, excluded)
        if not len(views.poses):
            return None
        return views

    def next_pose(self, which: Which = "wrist") -> SE3 | None:
        """The gripper pose of the next view; for a held thing the one farthest from all before."""
        if which == "wrist":
            view = self.next_view()
            return view and view.poses[0]
        poses = self.connection.devices.holding
        if poses is None:
            return None
        recorded = stated_grippers(self.recorders[which].frames)
        nearest = np.full(len(poses), np.inf)
        for pose in (*recorded, *self._refused):
            metres, radians = pose_distance(poses, pose)
            apart = np.maximum(1000 * metres / SAME_MM, np.rad2deg(radians) / SAME_DEG)
            nearest = np.minimum(nearest, apart)
        farthest = int(np.argmax(nearest))
        if nearest[farthest] <= 1:
            return None
        return poses[farthest]

    def take_sample(self, which: Which = "wrist") -> str:
        """Record image and pose."""
        recorder = self.recorders[which]
        taken = self.connection.sample(which)
        recorder.names = recorder.names.or_of(self.connection.frames(which))
        name = recorder.add(*taken).name
        bad = "; ".join(self.coverage(which).samples[-1].problems)
        if bad:
            return f"Took sample {name}, {bad}: better remove it."
        return f"Took sample {name}."

    def remove(self, *names: str, which: Which = "wrist") -> str:
        """Remove samples."""
        if not names:
            return "There is no such sample."
        for name in names:
            self.recorders[which].remove(name)
        return f"Removed {', '.join(names)}."

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
        if pose is None:
            return "There is no next view."
        return self.move_to(pose)

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
            covered = self.coverage(which)
            pose = self.next_pose(which)
            good = len(covered.samples) - len(self.bad_samples(which))
            if not covered.missing or pose is None or good >= 2 * IMAGES:
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

        The scene that the studio learned before is replaced.
        """
        folder = self.recording(which)
        table = self._table_sha256(which)
        cell = self.cell
        learn = cell.learn
        old = self.scene
        if which == "fixed":
            cell = self.thing
            learn = cell.eye_to_hand
            old = next(iter(cell.scenes), None)
        scene = old or _free_name(folder.name, cell.scenes)
        learn(folder, name=scene, replace=old, on_progress=on_step)
        calibration = cell.calibration(scene)
        self._write(which, calibration, **{_TABLE: table})
        frames = calibration.source["frames"]
        return f"Learned {frames} images; wrote {self.calibration_file(which)}."

    def take_fixed(self) -> str:
        """Take an image of the fixed camera."""
        image = self.connection.image("fixed")
        folder = self.out / "fixed"
        folder.mkdir(exist_ok=True)
        name = next_name(folder)
        write_jpeg(folder / name, image, JPEG_QUALITY)
        return f"Took image {name}."

    def take_fixed_series(self, on_step: OnStep, move: bool) -> str:
        """Take several images; the arm may go to poses of samples, so that it hides other parts."""
        poses = stated_grippers(self.recorders["wrist"].frames)
        for i in range(FIXED_IMAGES):
            on_step("taking images", i, FIXED_IMAGES)
            if move and len(poses):
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
        calibration = self.cell.calibrate(
            files, camera=self._fixed_intrinsics(), mount="eye_to_hand"
        )
        self._write("fixed", calibration, store=str(self.cell.path))
        return f"Calibrated the fixed camera; wrote {self.calibration_file('fixed')}."

    def check_fixed(self) -> str:
        """Test with a new image whether the fixed camera has moved."""
        reference = self._made("fixed")
        image = self.connection.image("fixed")
        shift = self.cell.check([image], reference)
        size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
        if not shift.moved:
            return f"The camera has not moved: it is within {size} of its calibration."
        confidence = f"confidence {100 * shift.confidence:.1f} %"
        return f"The camera has moved by {size} ({confidence}). Calibrate it again."

    def export(self, which: Which, format: str, names: FrameNames = UNKNOWN) -> str:
        """Export a calibration in a format of `evercal export`; it keeps the names."""
        calibration = self._made(which)
        calibration = replace(calibration, frames=names.or_of(calibration.frames))
        self._write(which, calibration)
        chosen = FORMATS[format]
        folder = self.out / "export"
        folder.mkdir(exist_ok=True)
        # Formats share endings; easy_handeye2 looks files up by their name.
        name = which if format == "easy_handeye2" else f"{which}_{format}"
        poses = None
        if which == "wrist" and chosen.per_image:
            poses = self.out / "wrist" / POSES
        path = folder / f"{name}{chosen.ending}"
        exported = export_files(calibration, format, path, robot_poses=poses)
        return f"Wrote {', '.join(map(str, exported.files))}."

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

    def _write(self, which: Which, calibration: Calibration, **source: object) -> None:
        calibration = replace(calibration, source={**calibration.source, **source})
        calibration.write(self.calibration_file(which))
        self._keep(which, calibration)

    def _keep(self, which: Which, calibration: Calibration) -> None:
        self.calibrations[which] = calibration
        if which == "wrist":
            self.mount = calibration.parent_from_child


def _around(recorded: SE3, good: SE3, gripper_from_camera: SE3 | None) -> SE3:
    """Poses (n,) near recorded ones that look at the same point."""
    mount = gripper_from_camera or SE3.identity()
    point_m = looked_at(good @ mount)
    rng = np.random.default_rng(len(recorded))
    cameras = recorded @ mount
    start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
    turns, closer = np.zeros((2, _CANDIDATES, 6))
    turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
    distance = norms(start.translation_m - point_m)
    closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
    closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
    there = SE3.from_translation(point_m)
    back = SE3.from_translation(-point_m)
    return there @ SE3.exp(turns) @ back @ start @ SE3.exp(closer) @ mount.inverse()


def _free_name(name: str, taken: Strings) -> str:
    free = name
    number = 2
    while free in taken:
        free = f"{name}-{number}"
        number += 1
    return free
