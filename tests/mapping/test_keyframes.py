"""What is remembered comes back: images nearly, poses and cameras exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from evercal.features.views import working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.landmarks import Landmarks
from evercal.recordings.frame import Frame, Recording

DISTORTIONS = ((), (0.1, -0.05, 0.001, 0.002), (0.1, -0.05, 0.001, 0.002, 0.01),
               (0.1, -0.05, 0.001, 0.002, 0.01, 0.02, -0.03, 0.004))  # fmt: skip


def through_a_file(keyframes: Keyframes) -> Keyframes:
    return Keyframes.from_tensors(load(save(keyframes.to_tensors())))


def test_images_come_back_nearly(rooms: tuple[Recording, ...]) -> None:
    frames = rooms[0].train[:5]
    back = store_keyframes(frames, 48).frames()
    assert len(back) == 5
    for frame, seen in zip(frames, back, strict=True):
        grey, _ = working_image(frame.read_image(), frame.camera, 48)
        image = seen.read_image()
        assert image.dtype == np.uint8
        assert (image == image[..., :1]).all()
        error = image[..., 0].astype(float) - grey
        assert np.abs(error).mean() < 3.0
        assert np.abs(error).mean() < 0.1 * grey.std()  # and not another picture


def test_poses_and_cameras_come_back_exactly() -> None:
    rng = np.random.default_rng(0)
    frames = []
    for i, distortion in enumerate(DISTORTIONS):
        width, height = [(64, 48), (48, 64), (101, 77), (640, 480)][i]
        camera = Camera(width, height, 71.3 + i, 70.1, width / 2.1, height / 1.9, distortion)
        pose = SE3.exp(rng.normal(size=6))
        frames.append(Frame(str(i), np.zeros((height, width, 3), np.uint8), camera, pose))
    keyframes = store_keyframes(frames, 48)
    for again in (keyframes, through_a_file(keyframes)):
        assert again.images == keyframes.images
        for frame, seen in zip(frames, again.frames(), strict=True):
            assert seen.camera == frame.camera.short_side_resized(48)
            assert min(seen.read_image().shape[:2]) == 48
            assert seen.base_from_camera is not None
            assert frame.base_from_camera is not None
            for name in ("rotation_wxyz", "translation_m"):
                np.testing.assert_allclose(
                    getattr(seen.base_from_camera, name),
                    getattr(frame.base_from_camera, name),
                    rtol=0,
                    atol=1e-15,
                )


def test_every_byte_is_counted(rooms: tuple[Recording, ...]) -> None:
    for count in (1, 4):
        keyframes = store_keyframes(rooms[1].train[:count], 48)
        tensors = keyframes.to_tensors()
        assert keyframes.bytes == sum(tensor.nbytes for tensor in tensors.values())
        assert keyframes.bytes > sum(map(len, keyframes.images))
        # The file adds only a header.
        assert keyframes.bytes < len(save(tensors)) < keyframes.bytes + 1000


def test_a_remembered_frame_can_be_remembered_again(rooms: tuple[Recording, ...]) -> None:
    once = store_keyframes(rooms[2].train[:3], 48)
    twice = store_keyframes(once.frames(), 48)
    assert twice.cameras == once.cameras
    for a, b in zip(once.frames(), twice.frames(), strict=True):
        difference = a.read_image().astype(float) - b.read_image()
        assert np.abs(difference).mean() < 1.0


@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
def test_large_images_are_kept_at_working_size(size: tuple[int, int]) -> None:
    width, height = size
    ramp = np.linspace(0, 255, width)[None, :, None]
    image = np.broadcast_to(ramp, (height, width, 3)).astype(np.uint8)
    camera = Camera(width, height, 500, 500, (width - 1) / 2, (height - 1) / 2)
    frame = Frame("a", image, camera, SE3.identity())
    keyframes = store_keyframes([frame], 120)
    kept = keyframes.frames()[0]
    assert kept.read_image().shape[:2] == (height // 4, width // 4)
    assert kept.camera.fx == pytest.approx(125)
    # A pixel keeps its viewing ray: column u of the small image shows column 4 u + 1.5.
    columns = kept.read_image()[height // 8, :, 0].astype(float)
    middle = np.arange(8, width // 4 - 8)
    np.testing.assert_allclose(columns[middle], ramp[0, 4 * middle + 1, 0], atol=2.5)
    small = replace(frame, image=kept.read_image(), camera=kept.camera)
    assert store_keyframes([small], 120).bytes < store_keyframes([frame], 480).bytes / 4


def mapped(frames: tuple[Frame, ...], counts: tuple[int, ...]) -> Keyframes:
    """Keyframes with depths, descriptors and so many landmarks each."""
    rng = np.random.default_rng(0)
    marks = tuple(
        Landmarks(
            rng.integers(0, 640, (n, 2)).astype(float),
            rng.uniform(0.1, 4, n).astype(np.float32).astype(float),
            rng.normal(0, 0.01, (n, 2)).astype(np.float32).astype(float),
            rng.uniform(0.001, 0.1, n).astype(np.float32).astype(float),
        )
        for n in counts
    )
    depths = tuple(torch.rand(48, dtype=torch.float32).half() + 0.1 for _ in counts)
    descriptors = torch.randn(len(counts), 16).half()
    plain = store_keyframes(frames[: len(counts)], 48)
    return replace(plain, inverse_depth=depths, landmarks=marks, descriptors=descriptors)


@pytest.mark.parametrize("counts", [(7, 0, 12), (0, 0), (5,)])
def test_a_map_comes_back_exactly_and_counts(
    counts: tuple[int, ...], rooms: tuple[Recording, ...]
) -> None:
    keyframes = mapped(rooms[0].train, counts)
    back = through_a_file(keyframes)
    assert len(back) == len(back.landmarks) == len(back.inverse_depth) == len(counts)
    for a, b in zip(back.landmarks, keyframes.landmarks, strict=True):
        for name in ("pixels", "inverse_depth", "slope", "sigma"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
            assert getattr(a, name).dtype == np.float64
    for one, two in zip(back.inverse_depth, keyframes.inverse_depth, strict=True):
        assert torch.equal(one, two)
    assert keyframes.descriptors is not None
    assert torch.equal(torch.as_tensor(back.descriptors), keyframes.descriptors)
    # 16 bytes of floats and 4 of pixels a landmark.
    plain = replace(keyframes, landmarks=(), descriptors=None, inverse_depth=())
    extra = 20 * sum(counts) + 8 * len(counts) + (2 * 48 + 8) * len(counts) + 32 * len(counts)
    assert keyframes.bytes == plain.bytes + extra
    nothing = through_a_file(plain)
    assert (nothing.landmarks, nothing.descriptors, nothing.inverse_depth) == ((), None, ())


def test_pixels_beyond_single_bytes_survive(rooms: tuple[Recording, ...]) -> None:
    keyframes = mapped(rooms[0].train, (2,))
    far = replace(keyframes.landmarks[0], pixels=np.array([[32767.0, 0], [1919, 1079]]))
    back = through_a_file(replace(keyframes, landmarks=(far,)))
    np.testing.assert_array_equal(back.landmarks[0].pixels, far.pixels)
