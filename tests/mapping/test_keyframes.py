"""Keyframes survive a file: images nearly, all else exactly."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save

from evercal.errors import InputError
from evercal.features.views import working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.landmarks import Landmarks
from evercal.recordings.frame import Frame, Recording
from evercal.storage.tensors import open_tensors, save_tensors

DISTORTIONS = ((), (0.1, -0.05, 0.001, 0.002), (0.1, -0.05, 0.001, 0.002, 0.01),
               (0.1, -0.05, 0.001, 0.002, 0.01, 0.02, -0.03, 0.004))  # fmt: skip


def through_a_file(keyframes: Keyframes) -> Keyframes:
    return Keyframes.from_tensors(load(save(keyframes.to_tensors())))


def test_images_are_stored_with_little_loss(rooms: tuple[Recording, ...]) -> None:
    frames = rooms[0].train[:5]
    back = store_keyframes(frames, 48).frames()
    assert len(back) == 5
    for frame, stored in zip(frames, back, strict=True):
        grey, _ = working_image(frame.read_image(), frame.camera, 48)
        image = stored.read_image()
        assert image.dtype == np.uint8
        assert (image == image[..., :1]).all()
        error = image[..., 0].astype(float) - grey
        assert np.abs(error).mean() < 3.0
        assert np.abs(error).mean() < 0.1 * grey.std()


def test_poses_and_cameras_are_stored_exactly() -> None:
    rng = np.random.default_rng(0)
    frames = []
    for i, distortion in enumerate(DISTORTIONS):
        width, height = [(64, 48), (48, 64), (101, 77), (640, 480)][i]
        camera = Camera(
            width, height, 71.3 + i, 70.1, width / 2.1, height / 1.9, distortion
        )
        pose = SE3.exp(rng.normal(size=6))
        frames.append(
            Frame(str(i), np.zeros((height, width, 3), np.uint8), camera, pose)
        )
    keyframes = store_keyframes(frames, 48)
    for again in (keyframes, through_a_file(keyframes)):
        assert tuple(again.images) == keyframes.images
        for frame, stored in zip(frames, again.frames(), strict=True):
            assert stored.camera == frame.camera.short_side_resized(48)
            assert min(stored.read_image().shape[:2]) == 48
            assert stored.base_from_camera is not None
            assert frame.base_from_camera is not None
            for name in ("rotation_wxyz", "translation_m"):
                np.testing.assert_allclose(
                    getattr(stored.base_from_camera, name),
                    getattr(frame.base_from_camera, name),
                    rtol=0,
                    atol=1e-15,
                )


def test_size_is_that_of_all_tensors(rooms: tuple[Recording, ...]) -> None:
    for count in (1, 4):
        keyframes = store_keyframes(rooms[1].train[:count], 48)
        tensors = keyframes.to_tensors()
        assert keyframes.bytes == sum(tensor.nbytes for tensor in tensors.values())
        assert keyframes.bytes > sum(map(len, keyframes.images))
        # The file adds only a header.
        assert keyframes.bytes < len(save(tensors)) < keyframes.bytes + 1000


@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
def test_large_images_are_stored_at_working_size(size: tuple[int, int]) -> None:
    width, height = size
    ramp = np.linspace(0, 255, width)[None, :, None]
    image = np.broadcast_to(ramp, (height, width, 3)).astype(np.uint8)
    camera = Camera(width, height, 500, 500, (width - 1) / 2, (height - 1) / 2)
    frame = Frame("a", image, camera, SE3.identity())
    keyframes = store_keyframes([frame], 120)
    stored = keyframes.frames()[0]
    assert stored.read_image().shape[:2] == (height // 4, width // 4)
    assert stored.camera.fx == pytest.approx(125)
    # Column u of the small image shows column 4 u + 1.5.
    columns = stored.read_image()[height // 8, :, 0].astype(float)
    middle = np.arange(8, width // 4 - 8)
    np.testing.assert_allclose(columns[middle], ramp[0, 4 * middle + 1, 0], atol=2.5)
    small = replace(frame, image=stored.read_image(), camera=stored.camera)
    assert store_keyframes([small], 120).bytes < store_keyframes([frame], 480).bytes / 4


def mapped(frames: tuple[Frame, ...], counts: tuple[int, ...]) -> Keyframes:
    """Keyframes with random depths, descriptors and numbers of landmarks."""
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
    depths = tuple(rng.uniform(0.1, 1, 48).astype(np.float16) for _ in counts)
    descriptors = rng.normal(size=(len(counts), 16)).astype(np.float16)
    plain = store_keyframes(frames[: len(counts)], 48)
    return replace(
        plain, inverse_depth=depths, landmarks=marks, descriptors=descriptors
    )


@pytest.mark.parametrize("counts", [(7, 0, 12), (0, 0), (5,)])
def test_landmarks_are_stored_exactly(
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
        np.testing.assert_array_equal(one, two)
    assert back.descriptors is not None
    np.testing.assert_array_equal(back.descriptors, keyframes.descriptors)
    assert back.descriptors.dtype == back.inverse_depth[0].dtype == np.float16
    # 16 bytes of floats and 4 of pixels a landmark.
    plain = replace(keyframes, landmarks=(), descriptors=None, inverse_depth=())
    extra = (
        20 * sum(counts)
        + 8 * len(counts)
        + (2 * 48 + 8) * len(counts)
        + 32 * len(counts)
    )
    assert keyframes.bytes == plain.bytes + extra
    empty = through_a_file(plain)
    assert (empty.landmarks, empty.descriptors, empty.inverse_depth) == ((), None, ())


def test_pixels_need_two_bytes(rooms: tuple[Recording, ...]) -> None:
    keyframes = mapped(rooms[0].train, (2,))
    far = replace(keyframes.landmarks[0], pixels=np.array([[32767.0, 0], [1919, 1079]]))
    back = through_a_file(replace(keyframes, landmarks=(far,)))
    np.testing.assert_array_equal(back.landmarks[0].pixels, far.pixels)


@pytest.mark.parametrize("counts", [(7, 0, 12), (0, 0, 0), (4, 5, 0)])
def test_keyframes_stay_in_their_file_until_they_are_used(
    counts: tuple[int, ...], rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    keyframes = mapped(rooms[0].train, counts)
    file = tmp_path / "a.safetensors"
    save_tensors(file, keyframes.to_tensors())
    back = Keyframes.from_tensors(open_tensors(file))
    file.unlink()  # as when another process replaces a scene
    assert tuple(back.images) == tuple(keyframes.images)
    assert back.bytes == keyframes.bytes
    for i in range(3):
        assert back.landmarks[i].slope.tolist() == keyframes.landmarks[i].slope.tolist()
    assert back.landmarks[-1].sigma.tolist() == keyframes.landmarks[2].sigma.tolist()
    taken = pickle.loads(pickle.dumps(back.take(np.arange(3))))
    np.testing.assert_array_equal(taken.inverse_depth[1], keyframes.inverse_depth[1])


@pytest.mark.parametrize("name", ["lengths", "cells", "landmark_counts"])
def test_parts_beyond_their_arrays_are_errors_at_once(
    name: str, rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    tensors = mapped(rooms[0].train, (7, 3)).to_tensors()
    file = tmp_path / "a.safetensors"
    for change in (+1, -tensors[name][-1] - 1):
        counts = tensors[name].copy()
        counts[-1] += change
        save_tensors(file, {**tensors, name: counts})
        with pytest.raises(ValueError, match="do not make up"):
            Keyframes.from_tensors(open_tensors(file))


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "a.safetensors"
    file.write_bytes(b"\x08" + bytes(15))
    with pytest.raises(InputError, match=r"a\.safetensors: not readable"):
        open_tensors(file)
