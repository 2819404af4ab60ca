"""Images that are missing, unreadable or hidden beside those of a recording."""

from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording, load_recording, write_image
from evercal.recordings.formats import generic
from evercal.recordings.image_files import image_files
from evercal.recordings.images import is_readable

from .checks import refused

CAMERA = Camera(32, 24, 30.0, 31.0, 15.0, 11.0)
PIXELS = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
APPLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(40)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A recording of eight images."""
    frames = tuple(Frame(f"shot-{i}", PIXELS, CAMERA, SE3.identity()) for i in range(8))
    generic.write(tmp_path / "a", Recording("a", frames, ()))
    return tmp_path / "a"


def test_missing_and_unreadable_images_are_named_and_left_out(root: Path) -> None:
    images = sorted((root / "images").iterdir())
    images[0].unlink()
    images[1].write_bytes(b"")
    images[2].write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    data = bytearray(images[3].read_bytes())
    data[len(data) // 2] ^= 255  # its ends are whole
    images[3].write_bytes(data)
    read = load_recording(root)
    assert [frame.name for frame in read.train] == [f"shot-{i}" for i in range(4, 8)]
    assert read.notes == (
        "4 of 8 images are missing or unreadable and left out: images/000000.png,"
        " images/000001.png, images/000002.png and 1 more",
    )
    images[4].unlink()
    message = "5 of 8 images are missing or unreadable: images/000000.png, .* and 2 more; restore"
    refused(message, load_recording, root)


def test_the_file_that_a_missing_one_may_be_is_shown(root: Path) -> None:
    file = root / "images/000000.png"
    file.rename(root / "images/000000.PNG")
    [note] = load_recording(root).notes
    assert note.endswith("000000.png (nearest: images/000000.PNG)")


def test_paths_of_windows_are_read(root: Path) -> None:
    file = root / generic.FILE
    file.write_text(file.read_text().replace("images/", "images\\\\"))
    assert len(load_recording(root).train) == 8


def test_hidden_files_are_no_images(root: Path) -> None:
    (root / "images/._000000.png").write_bytes(APPLE)
    assert len(image_files([root / "images"])) == 8


@pytest.mark.parametrize("ending", [".jpg", ".png", ".bmp", ".tif", ".webp"])
def test_files_that_are_cut_are_unreadable(ending: str, tmp_path: Path) -> None:
    file = tmp_path / f"a{ending}"
    write_image(file, PIXELS)
    assert is_readable(file)
    for kept in (0, 20, file.stat().st_size // 2):
        file.write_bytes(file.read_bytes()[:kept])
        assert not is_readable(file)


def test_a_jpeg_that_is_damaged_inside_is_unreadable(tmp_path: Path) -> None:
    file = tmp_path / "a.jpg"
    write_image(file, PIXELS)
    data = bytearray(file.read_bytes())
    table = data.index(b"\xff\xc4")  # the first table of Huffman codes
    data[table + 5 : table + 25] = bytes(20)
    file.write_bytes(data)
    assert not is_readable(file)
