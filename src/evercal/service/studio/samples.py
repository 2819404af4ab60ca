"""The samples of the camera on the gripper: written as they are taken, measured, advised on."""

from pathlib import Path

import numpy as np

from evercal.calibration.next_views import NextViews, next_views
from evercal.calibration.view_information import HandEyeViews
from evercal.geometry import SE3, pose_distance
from evercal.live.coverage import Coverage, CoverageOptions, Sample, coverage
from evercal.live.recorder import WristRecorder
from evercal.recordings.frame import Frame
from evercal.service.studio.devices import Devices, Image

_CANDIDATES = 200
_TURN_RAD, _ROLL_RAD, _NEARER = np.deg2rad(30.0), np.deg2rad(40.0), 0.25
"""How far proposed views may lie from recorded ones where reachable poses are unknown."""


class Samples:
    """The recording of the camera on the gripper; one that was begun earlier is continued."""

    def __init__(self, root: Path, devices: Devices):
        self._recorder, self._reachable = WristRecorder(root, devices.intrinsics), devices.reachable
        self.mount = devices.rough
        """gripper_from_camera, rough or calibrated; None if nothing is known."""
        # Replaced as a whole: threads that draw read it while another one takes a sample.
        self._measured = {frame.name: Sample.of(frame) for frame in self._recorder.frames}
        self._refused: list[SE3] = []

    @property
    def frames(self) -> tuple[Frame, ...]:
        """All samples in recorded order."""
        return self._recorder.frames

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self._measured)

    @property
    def poses(self) -> SE3:
        """(n,) base_from_gripper."""
        return SE3.stack([sample.base_from_gripper for sample in self._measured.values()])

    def coverage(self) -> Coverage:
        """What the samples cover."""
        return coverage(tuple(self._measured.values()), self.mount)

    def bad(self) -> list[str]:
        """Names of the samples with problems."""
        return [row.name for row in self.coverage().samples if row.problems]

    def add(self, image: Image, base_from_gripper: SE3) -> str:
        """Write a sample and return its name; the image must have the size of the intrinsics."""
        frame = self._recorder.add(image, base_from_gripper)
        self._measured = {**self._measured, frame.name: Sample.of(frame)}
        return frame.name

    def remove(self, name: str) -> None:
        """Remove a sample."""
        self._recorder.remove(name)
        self._measured = {key: value for key, value in self._measured.items() if key != name}

    def refuse(self, base_from_gripper: SE3) -> None:
        """Never propose a pose again, since the arm did not reach it."""
        self._refused.append(base_from_gripper)

    def taken_at(self, base_from_gripper: SE3) -> bool:
        """Whether there is a sample of this pose."""
        options = CoverageOptions()
        for pose in self.poses:
            metres, radians = map(float, pose_distance(base_from_gripper, pose))
            if 1000 * metres < options.same_mm and np.rad2deg(radians) < options.same_deg:
                return True
        return False

    def next_view(self) -> NextViews | None:
        """The view that would lower the uncertainty most; None before the first good sample."""
        bad = set(self.bad())
        good = [s.base_from_gripper for name, s in self._measured.items() if name not in bad]
        if not good:
            return None
        state, candidates = HandEyeViews.recorded(SE3.stack(good), self.mount), self._reachable
        if candidates is None:
            candidates = self._around(state.base_from_scene.translation_m)
        views = next_views(state, candidates, 1, SE3.stack([*self.poses, *self._refused]))
        return views if len(views.poses) else None

    def _around(self, point_m: np.ndarray) -> SE3:
        """Poses (n,) near the recorded ones that look at the same point."""
        mount = self.mount or SE3.identity()
        rng, cameras = np.random.default_rng(len(self.names)), self.poses @ mount
        start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
        turns, closer = np.zeros((2, _CANDIDATES, 6))
        turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
        distance = np.linalg.norm(start.translation_m - point_m, axis=1)
        closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
        closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
        there, back = SE3.from_translation(point_m), SE3.from_translation(-point_m)
        return there @ SE3.exp(turns) @ back @ start @ SE3.exp(closer) @ mount.inverse()
