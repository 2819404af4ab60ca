"""Recordings for `guard`, written as 7-Scenes folders, which every build reads.

Real rooms with training blocks left out, so that views are far from all keyframes. Packaged rooms
as a stabilised phone or a rolling shutter records them. Images of another camera that is stated as
the recording's.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from benchmarks.guard_far import ROOMS, far_room
from benchmarks.same_model import seen
from evercal.geometry import Camera
from evercal.recordings import load_recording, posed_frames, write_image
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.samples import sample_rooms

TEST_IMAGES = 60
"""Images of a recording that are located, at most."""
OTHER_IMAGES = 39
"""Images of another camera that are located."""
SMOOTH_FRAMES = 3
"""Standard deviation of the kernel that smooths errors over frames."""
STATED_LONG = 1.02
"""Factor on the focal length where wrong intrinsics are stated."""
STABILISED_PX = (3.0, 6.0)
"""Root mean squares of the motion of a principal point, per axis."""
ROLLING_PX = 2.0
"""Largest shift of the first and last row of an image against the middle one."""
OTHERS = {"longer": (0.01, 0.0, 0.0), "shorter": (-0.005, 3.0, -2.0)}
"""Other cameras: change of the focal length as a share, of the principal point in pixels."""


@dataclass(frozen=True)
class RealRoom:
    """How a real recording is learned and located."""

    memory: str
    """Keyframes that are kept."""
    block: int = 0
    """Training frames in a block of which every second one is left out and located; 0: none."""
    focal_px: float | None = None
    """Focal length that is right for the images, where the file states another."""


REAL = {
    "tsdf_room": RealRoom("10%", 25, 512.0),
    "redkitchen": RealRoom("3%", 100),
    "fr1_rpy": RealRoom("3%"),
}
"""Real rooms. The file of tsdf_room states the focal length of its depth camera."""


Make = Callable[[], Recording]
"""Makes a recording."""


@dataclass(frozen=True)
class Case:
    """Recordings that are located in a map of the first one."""

    suite: str
    """Name of its suite."""
    make: Mapping[str, Make]
    """Recordings by name."""
    memory: str = "10%"
    """Keyframes that are kept."""

    @property
    def learned(self) -> str:
        """Name of the recording that is learned."""
        return next(iter(self.make))


def all_cases(real: Path | None) -> Iterator[Case]:
    """List what is measured beside rendered rooms.

    Args:
        real: Folder of real recordings.
    """
    scenes = [room.scene for room in sample_rooms()]
    others = [(scene, "10%") for scene in scenes]
    if real is not None:
        for name in REAL:
            yield from _real(name, load_recording(real / name))
        kitchen = load_recording(real / "redkitchen")
        # Half of the frames are enough for as many keyframes as 3 % of all.
        others.append((replace(kitchen, train=kitchen.train[::2]), "6%"))
    for scene in scenes:
        yield from _packaged(scene)
    for scene, memory in others:
        yield _other_cameras(scene, memory)


def far_cases(rendered: Path) -> Iterator[Case]:
    """List rendered rooms, whose images are kept in a folder."""
    for kind in ROOMS:
        make = partial(far_room, kind, rendered)
        yield Case("far views", {f"far-{kind}": make}, "20%")


def _real(name: str, recording: Recording) -> Iterator[Case]:
    """A real room with right intrinsics, with those of its file, and with wrong ones."""
    room = REAL[name]
    own = recording.train[0].camera
    stated = {"": own}
    if room.focal_px is not None:
        stated = {"": own.zoomed(room.focal_px / own.fx), "-as-stated": own}
    stated["-focal-long"] = stated[""].zoomed(STATED_LONG)
    far = _with_blocks_left_out(recording, room.block)
    name = f"{name}-far" if room.block else name
    for more, camera in stated.items():
        make = partial(_stated, far, camera)
        yield Case("real", {f"{name}{more}": make}, room.memory)


def _packaged(scene: Recording) -> Iterator[Case]:
    """A packaged room, and as a stabilised phone and a rolling shutter record it."""
    drawn: dict[str, Make] = {scene.name: lambda: scene}
    for px in STABILISED_PX:
        draw = partial(_with_moving_centre, px)
        drawn[f"stabilised-{scene.name}-{px:.0f}px"] = partial(_drawn, scene, draw)
    draw = partial(_with_rolling_shutter, ROLLING_PX)
    drawn[f"rolling-{scene.name}-{ROLLING_PX:.0f}px"] = partial(_drawn, scene, draw)
    for name, make in drawn.items():
        yield Case("packaged", {name: make})


def _other_cameras(scene: Recording, memory: str) -> Case:
    """Images of the recording's camera and of others, all stated as the recording's."""
    make: dict[str, Make] = {f"{scene.name}-middle": partial(_middle, scene)}
    for name, change in OTHERS.items():
        make[f"{scene.name}-{name}"] = partial(_other_camera, scene, change)
    return Case("another camera", make, memory)


def write(folder: Path, recording: Recording) -> None:
    """Write a recording of one camera as a 7-Scenes folder, whole or not at all."""
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    parts = (("Train", recording.train), ("Test", recording.test))
    for number, (part, frames) in enumerate(parts, start=1):
        sequence = unfinished / f"seq-{number:02d}"
        sequence.mkdir(parents=True)
        listed = f"sequence{number}\n" if frames else ""
        (unfinished / f"{part}Split.txt").write_text(listed)
        for i, frame in enumerate(frames):
            _write_frame(str(sequence / f"frame-{i:06d}"), frame)
    camera = (recording.train or recording.test)[0].camera
    np.savetxt(unfinished / "camera-intrinsics.txt", camera.matrix())
    unfinished.rename(folder)


def _write_frame(stem: str, frame: Frame) -> None:
    assert frame.base_from_camera is not None
    np.savetxt(f"{stem}.pose.txt", frame.base_from_camera.matrix())
    if isinstance(frame.image, Path):
        shutil.copyfile(frame.image, f"{stem}.color{frame.image.suffix}")
    else:
        write_image(f"{stem}.color.png", frame.read_image())


def _stated(recording: Recording, camera: Camera) -> Recording:
    """A recording with other intrinsics."""
    parts = (recording.train, recording.test)
    train, test = (
        tuple(replace(frame, camera=camera) for frame in part) for part in parts
    )
    return replace(recording, train=train, test=test)


def _spread(frames: Sequence[Frame], count: int) -> tuple[Frame, ...]:
    """Frames at equal steps, at most so many."""
    steps = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return tuple(frames[i] for i in steps.round().astype(int))


def _with_blocks_left_out(recording: Recording, block: int) -> Recording:
    """Leave out every second block of training frames; a part of them is located as well."""
    train = posed_frames(recording.train)
    test = posed_frames(recording.test)
    if not block:
        return replace(recording, train=train, test=_spread(test, TEST_IMAGES))
    odd = np.arange(len(train)) // block % 2 == 1
    left_out = [frame for frame, out in zip(train, odd, strict=True) if out]
    kept = tuple(frame for frame, out in zip(train, odd, strict=True) if not out)
    return replace(recording, train=kept, test=_spread([*test, *left_out], TEST_IMAGES))


def _smooth_noise(count: int, channels: int, seed: int) -> np.ndarray:
    """Noise (count, channels) that is smooth in time, with a mean square of 1."""
    margin = 4 * SMOOTH_FRAMES
    white = np.random.default_rng(seed).normal(size=(count + 2 * margin, channels))
    smooth = gaussian_filter1d(white, SMOOTH_FRAMES, axis=0)[margin : margin + count]
    return smooth / np.sqrt((smooth**2).mean(0))


def _drawn(
    scene: Recording, draw: Callable[[Sequence[Frame], int], tuple[Frame, ...]]
) -> Recording:
    """Draw the images of both parts with errors of their own."""
    train = draw(posed_frames(scene.train), 0)
    test = draw(posed_frames(scene.test), 1)
    return replace(scene, train=train, test=test)


def _pixels(camera: Camera) -> np.ndarray:
    """Pixels (h, w, 2) of a camera."""
    size = camera.width, camera.height
    return np.stack(np.meshgrid(*map(np.arange, size)), -1).astype(float)


def _resampled(frame: Frame, where: np.ndarray) -> Frame:
    """A frame whose pixels come from elsewhere in its image (h, w, 2)."""
    x, y = np.moveaxis(where.astype(np.float32), -1, 0)
    border = cv2.BORDER_REPLICATE
    image = cv2.remap(frame.read_image(), x, y, cv2.INTER_LINEAR, borderMode=border)
    return replace(frame, image=np.asarray(image, np.uint8))


def _with_moving_centre(
    px: float, frames: Sequence[Frame], seed: int
) -> tuple[Frame, ...]:
    """As a stabilised phone: the principal point moves, the camera is turned to hide it."""
    drawn = []
    for frame, off in zip(
        frames, px * _smooth_noise(len(frames), 2, seed), strict=True
    ):
        camera = frame.camera
        moved = replace(camera, cx=camera.cx + off[0], cy=camera.cy + off[1])
        centre = moved.unproject(np.array([camera.cx, camera.cy]))
        turn = Rotation.align_vectors([0.0, 0.0, 1.0], centre)[0]
        rays = moved.unproject(_pixels(camera)) @ turn.as_matrix().T
        drawn.append(_resampled(frame, camera.project(rays)))
    return tuple(drawn)


def _with_rolling_shutter(
    px: float, frames: Sequence[Frame], seed: int
) -> tuple[Frame, ...]:
    """As a rolling shutter of a camera that pans: rows are shifted in proportion to their place."""
    pans = _smooth_noise(len(frames), 1, seed)[:, 0]
    drawn = []
    for frame, shift in zip(frames, px * pans / np.abs(pans).max(), strict=True):
        where = _pixels(frame.camera)
        middle = (frame.camera.height - 1) / 2
        where[..., 0] += shift * (where[..., 1] - middle) / middle
        drawn.append(_resampled(frame, where))
    return tuple(drawn)


def _middle(scene: Recording) -> Recording:
    """The middle of all images, so that views of other cameras fit into them."""
    train = tuple(seen(frame, np.zeros(4)) for frame in scene.train)
    return replace(_other_camera(scene, (0.0, 0.0, 0.0)), train=train)


def _other_camera(scene: Recording, change: tuple[float, float, float]) -> Recording:
    """Test images of another camera, see `OTHERS`, stated as the recording's."""
    focal, x, y = change
    test = []
    for frame in _spread(posed_frames(scene.test), OTHER_IMAGES):
        own = seen(frame, np.zeros(4)).camera
        width = frame.camera.width
        other = seen(frame, np.array([focal, x / width, y / width, 0.0]))
        test.append(replace(other, camera=own))
    return replace(scene, train=(), test=tuple(test))
