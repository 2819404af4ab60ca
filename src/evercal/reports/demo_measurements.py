"""What the demo asks of a store that knows its rooms."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.calibration.drift import Shift, check
from evercal.calibration.from_images import Images, calibrate
from evercal.errors import InputError
from evercal.evaluation import FrameResult, evaluate, scores
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import Recording
from evercal.reports.demo_outcome import Bump, DemoOutcome, FixedCamera, UnknownRoom
from evercal.simulation.box_room import BoxRoom

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer
    from evercal.recordings.samples import SampleRoom

UNKNOWN_ROOM_SEED = 4_711
UNKNOWN_IMAGES = 20


@dataclass(frozen=True)
class Look:
    """The rooms and a localizer that was taught all of them."""

    localizer: "Localizer"
    """Answers."""
    rooms: "Sequence[SampleRoom]"
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
        """The cameras that stand still, calibrated, and checked after the bump."""
        for room in self.rooms:
            if room.fixed is None:
                continue
            name = room.scene.name
            before = self._calibrated(room.fixed, name)
            outcome.fixed.append(_fixed_camera(name, room.fixed, before))
            if room.bumped is None:
                continue
            if before is None:
                for _ in room.bumped.test:
                    self.on_image()
                continue
            with suppress(InputError):  # none of the images was located
                shift, _ = check(
                    self.localizer, _images(room.bumped), before, on_image=self.on_image
                )
                outcome.bumps.append(_bump(name, (room.fixed, room.bumped), shift))

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

    def _calibrated(self, recording: Recording, name: str) -> Calibration | None:
        """The camera of a recording, if it was found in the room of this name."""
        given = Images(_images(recording), recording.test[0].camera)
        try:
            found = calibrate(self.localizer, given, "eye_to_hand", on_image=self.on_image)
        except InputError:  # none of the images was located
            return None
        return found if found.source["scene"] == name else None

    def _tick(self, done: int, total: int) -> None:
        self.on_image()


def _images(recording: Recording) -> list[tuple[str, NDArray[np.uint8]]]:
    return [(frame.name, frame.read_image()) for frame in recording.test]


def _fixed_camera(name: str, recording: Recording, found: Calibration | None) -> FixedCamera:
    """What was found, compared with the truth."""
    count = len(recording.test)
    if found is None:
        return FixedCamera(name, count, 0, None, None)
    used = sum(use.used for use in found.images)
    return FixedCamera(
        name, count, used, *pose_distance_mm_deg(found.parent_from_child, _truth(recording))
    )


def _bump(name: str, recordings: tuple[Recording, Recording], shift: Shift) -> Bump:
    true = pose_distance_mm_deg(*(_truth(recording) for recording in recordings))
    found = (shift.translation_mm, shift.rotation_deg)
    return Bump(name, *found, *true, shift.sigma_mm, shift.moved)


def _truth(recording: Recording) -> SE3:
    truth = recording.test[0].base_from_camera
    assert truth is not None, "the simulator knows every pose"
    return truth
