"""What a fixed camera sees of a thing in the gripper: masks, windows, and a thing that slips."""

from dataclasses import replace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from evercal.calibration.from_map.hand_eye_start import HandEyeStart
from evercal.calibration.from_map.image_pairs import ImagePair
from evercal.calibration.held_thing.background import background_motion
from evercal.calibration.held_thing.moving_parts import (
    PartOfImage,
    in_full_size,
    moving_parts,
    reduced,
)
from evercal.calibration.held_thing.slip import largest_step, motion_warnings
from evercal.calibration.held_thing.thing_map import of_whole_images
from evercal.calibration.held_thing.windows import cropped, windows
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.frame import Frame
from evercal.robot.mount import EYE_TO_HAND

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def texture(seed: int, height: int, width: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return 120 + 40 * smooth / smooth.std()


def frames_of(
    count: int, noise: float, gain: float = 0.0
) -> tuple[list[Frame], list[np.ndarray]]:
    """A textured square that moves before a textured wall, and where it is in each image."""
    rng = np.random.default_rng(0)
    wall = texture(1, 240, 320)
    thing = texture(2, 60, 60)
    frames = []
    masks = []
    for i in range(count):
        left = rng.integers(20, 230)
        top = rng.integers(20, 150)
        image = wall * (1 + gain * rng.normal())
        mask = np.zeros((240, 320), bool)
        turned = cv2.warpAffine(
            thing, cv2.getRotationMatrix2D((30, 30), 40.0 * i, 1.0), (60, 60)
        )
        image[top : top + 60, left : left + 60] = turned
        mask[top + 8 : top + 52, left + 8 : left + 52] = True
        image = image + rng.normal(0, noise, image.shape)
        grey = np.clip(image, 0, 255).astype(np.uint8)
        frames.append(
            Frame(
                str(i), np.repeat(grey[..., None], 3, 2), CAMERA, None, SE3.identity()
            )
        )
        masks.append(mask)
    return frames, masks


@pytest.mark.parametrize(("noise", "gain"), [(1.0, 0.0), (8.0, 0.0), (3.0, 0.1)])
def test_what_stands_still_is_removed(noise: float, gain: float) -> None:
    frames, masks = frames_of(8, noise, gain)
    moving, share = moving_parts(frames)
    assert 0.7 < share < 0.95
    assert all(isinstance(frame.image, PartOfImage) for frame in moving)  # read again
    for frame, old, mask in zip(moving, frames, masks, strict=True):
        change = np.abs(frame.read_image().astype(int) - old.read_image())[..., 0]
        assert (change[mask] <= 2).mean() > 0.9
        away = cv2.dilate(mask.astype(np.uint8), np.ones((61, 61))) == 0
        left = frame.read_image()[away][:, 0].std()
        assert left < 0.35 * old.read_image()[away][:, 0].std()


def test_a_reduced_frame_leads_back_to_the_whole_image() -> None:
    frames, _ = frames_of(8, 1.0)
    small = [reduced(frame, 120) for frame in frames]
    assert small[0].read_image().shape == (120, 160, 3)
    assert small[0].camera.resized(320, 240) == CAMERA
    assert reduced(frames[0], 480).camera is CAMERA
    moving, _ = moving_parts(small)
    whole = in_full_size(moving[3], frames[3])
    assert whole.camera is CAMERA
    wall = np.abs(whole.read_image().astype(int) - frames[3].read_image())[..., 0]
    assert (wall > 10).mean() > 0.3
    assert whole.read_image().shape == (240, 320, 3)


def test_a_map_of_reduced_images_or_windows_has_the_camera_of_whole_images() -> None:
    small = CAMERA.resized(160, 120)
    window = replace(CAMERA, width=90, height=90, cx=39.5, cy=49.5)
    for built in (small, window):
        moved = replace(built, fx=1.01 * built.fx, cx=built.cx + built.width / 160)
        scene = SceneMap("thing", built, moved, MagicMock(), MapFrame(), 8)
        whole = of_whole_images(scene, CAMERA)
        assert whole.camera == CAMERA
        assert whole.adjusted_camera.fx == pytest.approx(1.01 * CAMERA.fx)
        shift = whole.adjusted_camera.cx - CAMERA.cx
        assert shift == pytest.approx(2.0 if built is small else 90 / 160)


def test_a_window_follows_the_thing_and_keeps_its_rays() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (60, 3))
    base_from_camera = SE3.identity()
    grippers = SE3.stack(
        [
            SE3.from_translation((x, 0.05 * (-1) ** i, 1.0))
            @ SE3.exp([0, 0, 0, 0.3 * x, x, i])
            for i, x in enumerate(np.linspace(-0.2, 0.2, 6))
        ]
    )
    image = np.zeros((240, 320, 3), np.uint8)
    frames = [
        Frame(str(i), image, CAMERA, None, pose) for i, pose in enumerate(grippers)
    ]
    seen = [pose.apply(points) for pose in grippers]
    rays = [rows / rows[:, 2:] for rows in seen]
    pairs = tuple(
        ImagePair(i, i + 1, np.stack([rays[i], rays[i + 1]])) for i in range(5)
    )
    around = windows(frames, HandEyeStart(base_from_camera, EYE_TO_HAND, 5, 5, pairs))
    assert around is not None
    assert around[0, 2] < 90
    for frame, window, rows in zip(frames, around, seen, strict=True):
        part = cropped(frame, window)
        pixels = part.camera.project(rows)
        assert ((pixels > 0) & (pixels < window[2])).all()
        whole = CAMERA.project(rows) - window[:2]
        np.testing.assert_allclose(pixels, whole, atol=1e-9)


@pytest.mark.parametrize("kind", ["none", "step", "drift"])
def test_a_step_is_told_from_noise_and_drift(kind: str) -> None:
    sigma = np.repeat([2e-4, 3e-4], 3)
    found = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        values = rng.normal(0, sigma, (20, 6))
        if kind == "step":
            values[12:, 1] += 2e-3
        if kind == "drift":
            values[:, 1] += np.linspace(-1e-4, 1e-4, 20)
        step = largest_step(values)
        found += step is not None
        assert step is None or kind != "step" or step.before == 12
    assert found == (40 if kind == "step" else 0)


def test_the_background_says_whether_the_camera_moved() -> None:
    frames, _ = frames_of(12, 2.0)
    moving, _ = moving_parts(frames)
    still = background_motion(moving)
    assert np.rad2deg(np.nanmax(np.abs(still))) < 0.02
    moved = list(frames)
    for i in range(6, 12):
        image = np.roll(frames[i].read_image(), 3, axis=1)
        moved[i] = replace(frames[i], image=image)
    bumped = background_motion(moving_parts(moved)[0])
    # 3 pixels at a focal length of 300.
    assert np.nanmedian(bumped[6:, 0]) == pytest.approx(0.01, abs=1e-3)
    rng = np.random.default_rng(0)
    residuals = {frame.name: rng.normal(0, 1e-5, 6) for frame in frames}
    steps = {name: value.copy() for name, value in residuals.items()}
    built = MagicMock(hand_eye=MagicMock(residuals=residuals, moved=steps))
    assert motion_warnings(frames, built, still) == ()
    [words] = motion_warnings(frames, built, bumped)
    assert words.startswith("the background moves by 0.57 deg")
    uneven = {name: value.copy() for name, value in residuals.items()}
    for i, away in enumerate(rng.normal(0, 1e-3, (12, 3))):
        uneven[str(i)][:3] += away + np.array([4.5e-3 * (i >= 6), 0, 0])
    step = largest_step(np.stack([*uneven.values()]))
    assert step
    assert 0.5 < step.share < 0.75
    arm = MagicMock(hand_eye=MagicMock(residuals=residuals, moved=uneven))
    assert motion_warnings(frames, arm, still) == ()
    for i in range(6, 12):
        steps[str(i)] += [0.005, 0, 0, 0, 0, 0]
    [words] = motion_warnings(frames, built, still)
    assert "the camera did not move" in words
    assert "before image 6" in words
    unknown = np.full((12, 2), np.nan)
    for background in (bumped, unknown):
        with pytest.raises(InputError, match=r"the camera moved by 5\.0 mm"):
            motion_warnings(frames, built, background)
