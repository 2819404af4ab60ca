"""What the demo asks of a store that knows its rooms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evercal.datasets import Frame, Scene
from evercal.evaluation import FrameResult, evaluate, scores
from evercal.geometry import SE3, average_poses, pose_distance_mm_deg
from evercal.reports.demo_outcome import Bump, DemoOutcome, FixedCamera, UnknownRoom
from evercal.simulation.box_room import BoxRoom

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer
    from evercal.simulation.mini import CellRoom

UNKNOWN_ROOM_SEED = 4_711
UNKNOWN_IMAGES = 20


@dataclass(frozen=True)
class Look:
    """The rooms and a localizer that was taught all of them."""

    localizer: "Localizer"
    """Answers."""
    rooms: "Sequence[CellRoom]"
    """In order of learning."""
    on_image: Callable[[], object] = lambda: None
    """Called after every image."""

    def images(self) -> int:
        """How many images are looked at in all."""
        recordings = [
            recording
            for room in self.rooms
            for recording in (room.scene, room.changed, room.fixed, room.bumped)
            if recording is not None
        ]
        return sum(len(recording.test) for recording in recordings) + UNKNOWN_IMAGES

    def locate_test_images(self, outcome: DemoOutcome) -> None:
        """The test images of all rooms, mixed."""
        scenes = {room.scene.name: room.scene for room in self.rooms}
        results = evaluate(self.localizer, scenes, on_frame=self._tick)
        outcome.test = scores(results)
        outcome.errors_m = {name: [] for name in scenes}
        for result in results:
            outcome.errors_m[result.scene].append(result.translation_error_m)

    def locate_changed_rooms(self, outcome: DemoOutcome) -> None:
        """Images taken after the rooms were changed."""
        changed = {
            room.scene.name: replace(room.changed, train=room.scene.train)
            for room in self.rooms
            if room.changed is not None
        }
        if changed:
            results: list[FrameResult] = evaluate(self.localizer, changed, on_frame=self._tick)
            outcome.changed = scores(results)
            outcome.changed_errors_m = [result.translation_error_m for result in results]

    def find_fixed_cameras(self, outcome: DemoOutcome) -> None:
        """The cameras that stand still, before and after the bump."""
        for room in self.rooms:
            if room.fixed is None:
                continue
            name = room.scene.name
            before = self._poses(room.fixed, name)
            outcome.fixed.append(_fixed_camera(name, room.fixed, before))
            if room.bumped is None:
                continue
            after = self._poses(room.bumped, name)
            if len(before) >= 2 and after:
                outcome.bumps.append(_bump(name, (room.fixed, room.bumped), (before, after)))

    def show_unknown_room(self, outcome: DemoOutcome) -> None:
        """Images of a room of boxes that nobody ever learned."""
        camera = self.rooms[0].scene.train[0].camera
        room, rng = BoxRoom(UNKNOWN_ROOM_SEED), np.random.default_rng(UNKNOWN_ROOM_SEED)
        refused = 0
        for _ in range(UNKNOWN_IMAGES):
            image = room.render(camera, room.random_view(rng))
            refused += self.localizer.localize(image, camera).status != "ok"
            self.on_image()
        outcome.unknown = UnknownRoom(UNKNOWN_IMAGES, refused)

    def _poses(self, recording: Scene, name: str) -> list[SE3]:
        """Where the images of a recording were found, if in the room of this name."""
        found = []
        for frame in recording.test:
            estimate = self.localizer.localize(frame.read_image(), frame.camera)
            if estimate.scene == name and estimate.base_from_camera is not None:
                found.append(estimate.base_from_camera)
            self.on_image()
        return found

    def _tick(self, done: int, total: int) -> None:
        self.on_image()


def _fixed_camera(name: str, recording: Scene, poses: list[SE3]) -> FixedCamera:
    """One pose from all images of a camera that stands still, compared with the truth."""
    truth = _truth(recording.test[0])
    count = len(recording.test)
    if not poses or truth is None:
        return FixedCamera(name, count, len(poses), None, None)
    return FixedCamera(
        name, count, len(poses), *pose_distance_mm_deg(average_poses(SE3.stack(poses)), truth)
    )


def _bump(name: str, recordings: tuple[Scene, Scene], poses: tuple[list[SE3], list[SE3]]) -> Bump:
    before, after = (average_poses(SE3.stack(found)) for found in poses)
    first, second = (average_poses(SE3.stack(poses[0][start::2])) for start in (0, 1))
    true_before, true_after = (_truth(recording.test[0]) for recording in recordings)
    assert true_before is not None, "the simulator knows every pose"
    assert true_after is not None, "the simulator knows every pose"
    shift, true = pose_distance_mm_deg(before, after), pose_distance_mm_deg(true_before, true_after)
    return Bump(name, *shift, *true, pose_distance_mm_deg(first, second)[0])


def _truth(frame: Frame) -> SE3 | None:
    return frame.base_from_camera
