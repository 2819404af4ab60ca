"""Images keep their pixels and colours; what is wrong with a file is told apart."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, image_size, read_image, write_image


def test_png_round_trip_is_exact(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    write_image(tmp_path / "ünï.png", image)
    read = read_image(tmp_path / "ünï.png")
    np.testing.assert_array_equal(read, image)
    assert read.dtype == np.uint8
    assert read.flags.c_contiguous
    assert image_size(tmp_path / "ünï.png") == (30, 20)


def test_red_is_the_first_channel(tmp_path: Path) -> None:
    red_in_opencv = np.zeros((4, 4, 3), np.uint8)
    red_in_opencv[:, :, 2] = 255
    cv2.imwrite(str(tmp_path / "red.png"), red_in_opencv)
    assert read_image(tmp_path / "red.png")[0, 0].tolist() == [255, 0, 0]


def test_grey_and_transparent_images_become_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 6), 7, np.uint8))
    cv2.imwrite(str(tmp_path / "alpha.png"), np.full((4, 6, 4), 7, np.uint8))
    for name in ("grey.png", "alpha.png"):
        assert read_image(tmp_path / name).shape == (4, 6, 3)


def test_an_exif_rotation_is_not_applied(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", np.zeros((16, 32, 3), np.uint8))
    data = (tmp_path / "a.jpg").read_bytes()
    # A TIFF header with the one entry "orientation = 6 (rotated by 90 degrees)".
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)
    exif = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    (tmp_path / "b.jpg").write_bytes(data[:2] + segment + data[2:])
    rotated = cv2.imread(str(tmp_path / "b.jpg"))
    assert rotated is not None
    assert rotated.shape == (32, 16, 3)  # the tag is there
    assert read_image(tmp_path / "b.jpg").shape == (16, 32, 3)


def test_missing_unreadable_and_folder_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"none\.png: image file is missing"):
        read_image(tmp_path / "none.png")
    with pytest.raises(InputError, match=r"empty\.png: not a readable image \(0 bytes\)"):
        read_image(tmp_path / "empty.png")
    with pytest.raises(InputError, match=r"text\.png: not a readable image \(5 bytes\)"):
        read_image(tmp_path / "text.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_image(tmp_path)


def test_write_refuses_what_is_no_image(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'\.xyz' is no image format"):
        write_image(tmp_path / "a.xyz", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(ValueError, match="float32"):
        write_image(tmp_path / "a.png", np.zeros((2, 2, 3), np.float32))  # pyright: ignore[reportArgumentType]


def test_a_frame_refuses_an_image_of_another_size(tmp_path: Path) -> None:
    camera = Camera(32, 16, 20.0, 20.0, 15.5, 7.5)
    image = np.zeros((16, 32, 3), np.uint8)
    write_image(tmp_path / "a.png", image)
    assert Frame("a", tmp_path / "a.png", camera, SE3.identity()).read_image().shape == image.shape
    with pytest.raises(InputError, match="b: image is 16x32, its camera 32x16"):
        Frame("b", image.transpose(1, 0, 2), camera, None).read_image()
