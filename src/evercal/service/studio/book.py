"""The samples of the camera on the gripper: written as they are taken, measured, advised on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.next_views import looked_at, next_views
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.coverage import Coverage, Sample, coverage
from evercal.live.recorder import WristRecorder
from evercal.recordings.frame import Frame
from evercal.service.studio.devices import Devices

_CANDIDATES = 200
_TURN_RAD, _ROLL_RAD, _NEARER = np.deg2rad(30.0), np.deg2rad(40.0), 0.25
"""How far proposed views may lie from recorded ones where reachable poses are unknown."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """The next view."""

    base_from_gripper: SE3
    base_from_camera: SE3
    sigma_mm: tuple[float, float]
    """Expected standard deviation per axis, now and after it."""
    sigma_deg: tuple[float, float]
    """The same of the rotation."""


class SampleBook:
    """The recording of the camera on the gripper.

    Args:
        root: its folder; one that was begun earlier is continued.
        devices: intrinsics, rough mount and reachable poses.

    Raises:
        InputError: The folder holds samples of another camera.
    """

    def __init__(self, root: Path, devices: Devices):
        self.root, self._devices = root, devices
        self._recorder = WristRecorder(root, devices.intrinsics)
        # Replaced as a whole: threads that draw read it while another one takes a sample.
        self._samples = {frame.name: Sample.of(frame) for frame in self._recorder.frames}
        self._refused: list[SE3] = []

    @property
    def frames(self) -> tuple[Frame, ...]:
        """All samples in recorded order."""
        return self._recorder.frames

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self._samples)

    @property
    def poses(self) -> SE3:
        """(n,) base_from_gripper."""
        return SE3.stack([sample.base_from_gripper for sample in self._samples.values()])

    def coverage(self, gripper_from_camera: SE3 | None = None) -> Coverage:
        """What the samples cover, for a mount that is known roughly or not at all."""
        samples = tuple(self._samples.values())
        return coverage(samples, gripper_from_camera or self._devices.rough)

    def add(self, image: NDArray[np.uint8], base_from_gripper: SE3) -> Frame:
        """Write a sample.

        Raises:
            InputError: The image has another size than the intrinsics.
        """
        frame = self._recorder.add(image, base_from_gripper)
        self._samples = {**self._samples, frame.name: Sample.of(frame)}
        return frame

    def remove(self, name: str) -> None:
        """Remove a sample.

        Raises:
            InputError: No such sample.
        """
        self._recorder.remove(name)
        self._samples = {key: value for key, value in self._samples.items() if key != name}

    def bad(self) -> list[str]:
        """Names of the samples with problems."""
        return [row.name for row in self.coverage().samples if row.problems]

    def refuse(self, base_from_gripper: SE3) -> None:
        """Never propose a pose again, since the arm did not reach it."""
        self._refused.append(base_from_gripper)

    def proposal(self, gripper_from_camera: SE3 | None = None) -> Proposal | None:
        """The view that would lower the uncertainty most; None before the first sample."""
        bad = set(self.bad())
        good = [sample for name, sample in self._samples.items() if name not in bad]
        if not good:
            return None
        mount = gripper_from_camera or self._devices.rough
        recorded = SE3.stack([s.base_from_gripper for s in good])
        used = SE3.stack([*self.poses, *self._refused])
        candidates = self._candidates(mount or SE3.identity())
        try:
            views = next_views(recorded, candidates, 1, mount, used)
        except InputError:
            return None
        if not len(views.poses):
            return None
        pose = views.poses[0]
        camera = pose @ (mount or SE3.identity())
        first, then = views.sigma_mm[:2], views.sigma_deg[:2]
        return Proposal(pose, camera, (first[0], first[1]), (then[0], then[1]))

    def _candidates(self, mount: SE3) -> SE3:
        """The reachable poses, else poses around the recorded ones that look at the same point."""
        if self._devices.reachable is not None:
            return self._devices.reachable
        rng, recorded = np.random.default_rng(len(self.frames)), self.poses
        cameras = recorded @ mount
        at = looked_at(cameras)
        start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
        turns = np.zeros((_CANDIDATES, 6))
        turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
        around = SE3.from_translation(at) @ SE3.exp(turns) @ SE3.from_translation(-at)
        closer = np.zeros((_CANDIDATES, 6))
        distance = np.linalg.norm(start.translation_m - at, axis=1)
        closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
        closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
        return around @ start @ SE3.exp(closer) @ mount.inverse()
