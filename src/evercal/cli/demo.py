"""`evercal demo`."""

import shutil
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import require_folder, say, size
from evercal.errors import InputError
from evercal.progress import Bars, following, progress_bar

if TYPE_CHECKING:
    import numpy as np

    from evercal.evaluation import FrameResult
    from evercal.geometry import SE3
    from evercal.map import Map
    from evercal.recordings import Frame, Recording
    from evercal.recordings.samples import SampleRoom
    from evercal.reports.demo_page import DemoResult, FixedCamera
    from evercal.reports.page import Picture

STORE = "store"
"""Folder of the map."""
QUERY = "query.png"
"""File of an image to localize."""
REPORT = "report.html"
"""File of the report."""
UNKNOWN_IMAGES = 12
"""Images of each room that are localized before the room is learned."""
PICTURES = 3
"""Images of each room that the report shows."""


@frozen
class Demo(args.Verb):
    """Map three rendered rooms, localize, calibrate, detect a bump.

    It takes about a minute on two cores. With --copy-samples, only copy the recordings of these
    rooms and of a robot cell.

    Example: evercal demo --out evercal-demo/
    """

    out: args.OutFolder = Path("evercal-demo")
    """Folder for report.html, the store and a query image."""
    copy_samples: args.Folder = None
    """New or empty folder to copy the packaged recordings to, instead of running the demo."""

    def run(self) -> int:
        from evercal.recordings.samples import ROOMS, copy_samples, sample_rooms

        folder = self.copy_samples
        if folder:
            copy_samples(folder)
            cell = folder / "cell"
            learn = ("learn", "cell.evercal", cell / "wrist")
            self.answer(
                {"samples": str(folder)},
                f"copied {', '.join(ROOMS)} and the robot cell {cell} to {folder}; the cell has"
                " recordings of a camera on the gripper (wrist) and of a fixed camera (tripod)",
                then=(*learn, "--calibration", "wrist.json"),
            )
            return 0
        result = run_demo(self.out, sample_rooms(), quiet=self.json)
        headlines = result.headlines()
        self.answer(
            result.to_dict(),
            *map("{:>12}  {}".format, headlines, headlines.values()),
            f"wrote {self.out / REPORT} in {result.seconds:.0f} s",
            then=("localize", self.out / STORE, self.out / QUERY),
        )
        return 0


def run_demo(
    out: Path, rooms: "Sequence[SampleRoom]", quiet: bool = True
) -> "DemoResult":
    """Map the rooms, measure, and write the report.

    Args:
        out: Output folder; results of an earlier demo are replaced.
        rooms: Rooms with a fixed camera, a bump and a change.
        quiet: Whether to print nothing but progress bars.

    Raises:
        InputError: The folder contains other data.
    """
    from evercal.map import Map
    from evercal.recordings import write_image
    from evercal.reports.demo_page import DemoResult, demo_page
    from evercal.storage import MANIFEST, replace_folder, write_bytes

    began = perf_counter()
    store = out / STORE
    if store.exists() and not (store / MANIFEST).is_file():
        raise InputError(
            f"{store}: exists and is not an evercal store; pass another --out"
        )
    require_folder(out, "--out")
    result = DemoResult()
    work = Path(tempfile.mkdtemp(prefix=".demo-", dir=out))
    try:
        cell = Map.open(work / STORE)
        for room in rooms:
            if result.learned:
                _localize_unknown(cell, room.scene, result)
            _learn(cell, room.scene, result, quiet)
        replace_folder(work / STORE, store)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    cell = Map.open(store)
    scenes = {room.scene.name: room.scene for room in rooms}
    changed = {}
    for room in rooms:
        if room.changed:
            train = room.scene.train
            changed[room.scene.name] = replace(room.changed, train=train)
    result.test = _evaluate(cell, scenes)
    result.changed = _evaluate(cell, changed)
    result.cameras = [_fixed_camera(cell, room) for room in rooms]
    pictures = []
    for room in rooms:
        pictures += _pictures(cell, room.scene)
    write_image(out / QUERY, _spread(rooms[0].scene.test, 1)[0].read_image())
    result.seconds = perf_counter() - began
    write_bytes(out / REPORT, demo_page(result, pictures).encode())
    return result


def _learn(cell: "Map", scene: "Recording", result: "DemoResult", quiet: bool) -> None:
    from evercal.reports.demo_page import LearnedRoom

    with Bars() as bars:
        report = cell.learn(scene, on_progress=bars.step)
    room = LearnedRoom(
        room=report.scene,
        images=report.train_frames,
        keyframes=report.frames_kept,
        landmarks=report.landmarks,
        residual_px=report.adjusted and report.adjusted.residual_px,
        seconds=report.seconds,
    )
    result.learned.append(room)
    result.memory_bytes = report.memory_bytes
    if not quiet:
        say(
            f"mapped {room.room}: {room.images} images, {room.keyframes} keyframes,"
            f" {room.landmarks:,} landmarks, {room.seconds:.0f} s; {size(result.memory_bytes)} for"
            " all rooms"
        )


def _localize_unknown(cell: "Map", scene: "Recording", result: "DemoResult") -> None:
    """Localize images of a room that is not in the store yet."""
    frames = _spread(scene.test, UNKNOWN_IMAGES)
    what = f"images of unknown room {scene.name}"
    with progress_bar(what, len(frames), "image") as bar:
        for frame in frames:
            estimate = cell.localize(frame.read_image(), frame.camera)
            result.unknown_images += 1
            result.unknown_refused += estimate.status != "ok"
            bar.update()


def _evaluate(cell: "Map", scenes: "dict[str, Recording]") -> "list[FrameResult]":
    from evercal.evaluation import evaluate

    with progress_bar("localizing", 0, "image") as bar:
        return evaluate(cell.localizer, scenes, on_frame=following(bar))


def _fixed_camera(cell: "Map", room: "SampleRoom") -> "FixedCamera":
    """Calibrate the fixed camera of a room, and check it after the bump."""
    from evercal.geometry import pose_distance_mm_deg
    from evercal.reports.demo_page import FixedCamera

    name = room.scene.name
    fixed = room.fixed
    bumped = room.bumped
    assert fixed, "rooms of a demo have a fixed camera"
    assert bumped, "rooms of a demo have a bumped camera"
    true_shift_mm, _ = pose_distance_mm_deg(_pose(fixed), _pose(bumped))
    camera = FixedCamera(name, len(fixed.test), true_shift_mm=true_shift_mm)
    count = len(fixed.test) + len(bumped.test)
    # An InputError means that no image was localized.
    with progress_bar(f"camera in {name}", count, "image") as bar, suppress(InputError):
        calibration = cell.calibrate(
            _images(fixed),
            camera=fixed.test[0].camera,
            mount="eye_to_hand",
            on_image=bar.update,
        )
        if calibration.source["scene"] != name:
            return camera
        mm, deg = pose_distance_mm_deg(calibration.parent_from_child, _pose(fixed))
        camera = replace(
            camera,
            images_used=sum(image.used for image in calibration.images),
            error_mm=mm,
            error_deg=deg,
            sigma_mm=calibration.sigma_mm,
        )
        shift = cell.check(_images(bumped), calibration, on_image=bar.update)
        camera = replace(
            camera, shift_mm=shift.translation_mm, bump_detected=shift.moved
        )
    return camera


def _images(recording: "Recording") -> "list[np.ndarray]":
    return [frame.read_image() for frame in recording.test]


def _pose(recording: "Recording") -> "SE3":
    pose = recording.test[0].base_from_camera
    assert pose, "rendered images have poses"
    return pose


def _pictures(cell: "Map", scene: "Recording") -> "list[Picture]":
    """Test images with detected landmarks."""
    from evercal.reports.overlay import draw_landmarks
    from evercal.reports.page import Picture

    pictures = []
    for frame in _spread(scene.test, PICTURES):
        image = frame.read_image()
        estimate = cell.localize(image, frame.camera)
        drawn = draw_landmarks(image, estimate, cell.localizer)
        caption = f"{estimate.scene or estimate.status}: {drawn.summary}"
        pictures.append(Picture(drawn.image, caption))
    return pictures


def _spread(frames: "Sequence[Frame]", count: int) -> "list[Frame]":
    """At most `count` frames, evenly spread."""
    import numpy as np

    indices = (np.arange(count) + 0.5) * len(frames) / count
    return [frames[i] for i in np.unique(indices.astype(int))]
