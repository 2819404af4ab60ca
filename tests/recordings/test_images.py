"""Images keep pixels and colours, are turned upright, and broken files are refused."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps, TiffImagePlugin

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import (
    Frame,
    as_rgb,
    generic,
    image_size,
    load_recording,
    read_image,
    write_image,
)
from evercal.recordings.frame import Recording
from evercal.recordings.image_files import image_files
from evercal.recordings.images import UnturnedImage, as_stored, pixels_of

from .checks import refused, with_orientation


def test_png_round_trip_is_exact(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    file = tmp_path / "ünï.png"
    write_image(file, image)
    read = read_image(file)
    np.testing.assert_array_equal(read, image)
    assert read.dtype == np.uint8
    assert read.flags.c_contiguous
    assert image_size(file) == (30, 20)


RAMP = np.arange(0, 65536, 257, dtype=np.uint16).reshape(16, 16)
RGB16 = np.stack([RAMP, RAMP[::-1], RAMP.T], axis=2) + np.uint16(100)


@pytest.mark.parametrize(
    "image",
    [
        (RAMP >> 8).astype(np.uint8),
        RAMP,
        (RGB16 >> 8).astype(np.uint8),
        RGB16,
        np.dstack([(RGB16 >> 8).astype(np.uint8), np.full((16, 16), 7, np.uint8)]),
        np.dstack([RGB16, np.full((16, 16), 7, np.uint16)]),
    ],
    ids=["grey8", "grey16", "rgb8", "rgb16", "rgba8", "rgba16"],
)
@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_files_and_arrays_convert_alike(
    tmp_path: Path, image: np.ndarray, ending: str
) -> None:
    stored = image if image.ndim == 2 else image[:, :, [2, 1, 0, 3][: image.shape[2]]]
    cv2.imwrite(str(tmp_path / f"a{ending}"), stored)
    rgb = as_rgb(image)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{ending}"), rgb)
    colours = image[:, :, None] if image.ndim == 2 else image[:, :, :3]
    expected = colours / 257 if image.dtype == np.uint16 else colours
    np.testing.assert_array_equal(rgb, np.broadcast_to(np.round(expected), (16, 16, 3)))


def test_nested_lists_and_single_channels_are_images() -> None:
    assert as_rgb([[0, 255], [7, 8]])[1, 1].tolist() == [8, 8, 8]
    assert as_rgb(np.full((2, 3, 1), 9, np.uint8)).shape == (2, 3, 3)
    image = np.zeros((4, 4, 3), np.uint8)
    assert np.shares_memory(as_rgb(image), image)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 4, 3), np.float32), r"shape \(4, 4, 3\) and type float32"),
        (np.zeros((4, 4, 2), np.uint8), r"shape \(4, 4, 2\) and type uint8"),
        (np.zeros((0, 4, 3), np.uint8), r"shape \(0, 4, 3\)"),
        (np.zeros(4, np.uint8), r"shape \(4,\)"),
        ([[0, 256]], "type int64"),
        ([[1], [1, 2]], "not an array"),
        ("image.png", "shape"),
        (None, "type object"),
    ],
)
def test_other_arrays_are_refused(image: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_rgb(image)  # pyright: ignore[reportArgumentType]


def test_a_copy_keeps_the_orientation_of_its_file(tmp_path: Path) -> None:
    file = tmp_path / "a.jpg"
    write_image(file, np.random.default_rng(0).integers(0, 255, (16, 32, 3), np.uint8))
    file.write_bytes(with_orientation(file.read_bytes(), 6))
    assert image_size(file) == (16, 32)
    frame = Frame("a", file, Camera(16, 32, 20.0, 20.0, 7.5, 15.5), SE3.identity())
    generic.write(tmp_path / "out", Recording("x", (frame,), ()))
    [copy] = load_recording(tmp_path / "out").train
    np.testing.assert_array_equal(copy.read_image(), read_image(file))


@pytest.mark.parametrize("order", ["II", "MM"])
@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp", ".tiff"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_or_not_in_every_format(
    tmp_path: Path, ending: str, orientation: int, order: str
) -> None:
    """Files of Pillow 13.0.0; its byte order of TIFF is that of the prefix."""
    stored = np.full((16, 40, 3), 20, np.uint8)
    stored[:8] += 60
    stored[:, :20] += 120
    file = tmp_path / f"a{ending}"
    exif = Image.Exif()
    exif[0x112] = orientation
    exif.endian = {"II": "<", "MM": ">"}[order]
    exif[0x10F] = 5000 * "maker "  # an entry that is long
    image = Image.fromarray(stored)
    if ending == ".tiff":
        tags = TiffImagePlugin.ImageFileDirectory_v2(prefix=order.encode())
        tags[0x112] = orientation
        compression = {"II": "tiff_lzw", "MM": None}[order]
        image.save(file, tiffinfo=tags, compression=compression)
    else:
        image.save(file, exif=exif)
    upright = ImageOps.exif_transpose(Image.open(file))
    assert np.abs(read_image(file).astype(int) - np.asarray(upright)).max() < 9
    unturned = as_stored(file)
    assert isinstance(unturned, UnturnedImage) == (orientation != 1)
    assert np.abs(pixels_of(unturned).astype(int) - stored).max() < 9


def test_broken_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_bytes(b"hello")
    for name, message in (
        ("none.png", r"none\.png: image file is missing"),
        ("empty.png", r"empty\.png: not a readable image \(0 bytes\)"),
        ("text.png", r"text\.png: not a readable image \(5 bytes\)"),
        ("", "cannot be read"),
    ):
        refused(message, read_image, tmp_path / name)


def test_writer_refuses_other_arrays_and_endings(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'\.xyz' is no image format"):
        write_image(tmp_path / "a.xyz", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(ValueError, match="float32"):
        write_image(tmp_path / "a.png", np.zeros((2, 2, 3), np.float32))  # pyright: ignore[reportArgumentType]


def test_image_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    camera = Camera(32, 16, 20.0, 20.0, 15.5, 7.5)
    image = np.zeros((16, 32, 3), np.uint8)
    write_image(tmp_path / "a.png", image)
    for picture in (tmp_path / "a.png", image):
        assert Frame("a", picture, camera, None).read_image().shape == image.shape
    with pytest.raises(InputError, match="b: image is 16x32, its camera 32x16"):
        Frame("b", image.transpose(1, 0, 2), camera, None).read_image()


def test_what_is_no_file_is_no_image(tmp_path: Path) -> None:
    """Reading a pipe would wait for ever."""
    pipe = tmp_path / "a.jpg"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="no images in this folder"):
        image_files([tmp_path])
    with pytest.raises(InputError, match=r"a.jpg: image file is missing, or no file"):
        image_files([pipe])
