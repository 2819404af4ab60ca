"""Sizes of files are bounded before the work that they make."""

from __future__ import annotations

import io
import json
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from evercal.bounds import VARIABLE, TooLargeError, bounds, reading_a_request
from evercal.calibration.calibration import read_calibration
from evercal.calibration.export.request import read_link_from_optical
from evercal.errors import InputError
from evercal.recordings import read_image, read_robot_poses, write_image
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.formats.video_file import Videos
from evercal.recordings.images import as_rgb, decode_image, is_readable
from evercal.recordings.poses import array_files
from evercal.recordings.streams import stream
from evercal.storage.text_files import natural_key

Read = Callable[[Path], object]
HEADER = "image,x,y,z,qw,qx,qy,qz\n"
ROW = "a.png,0,0,0,1,0,0,0\n"


@contextmanager
def frugal(seconds: float, megabytes: float) -> Iterator[None]:
    """What happens inside takes little time and memory."""
    tracemalloc.start()
    began = time.process_time()
    try:
        yield
        took = time.process_time() - began
        most = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert took < seconds
    assert most < megabytes


def refused(read: Read, path: Path, content: str | bytes, message: str) -> None:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=message) as error:
        read(path)
    assert len(str(error.value)) < 3000
    assert "\n" not in str(error.value)


def aliased(levels: int) -> str:
    """A few lines whose references repeat references."""
    lines = ["a0: &a0 [word, word]"]
    lines += [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, levels)]
    return "\n".join([*lines, f"camera_matrix: [*a{levels - 1}]"])


@pytest.mark.parametrize(
    "read", [read_camera, lambda p: read_link_from_optical(p, "a", "b")]
)
@pytest.mark.parametrize(
    "content",
    [
        aliased(3),
        "a: &a 1\nb: *a",
        "a: " + "[" * 51 + "]" * 51,
        "<<: {a: 1}",
        "a: !!set {b, c}",
        "a: " + ":".join(["1"] * 600),
        "- 1\n" * 20_001,
    ],
)
def test_yaml_with_references_or_deep_nesting_is_refused(
    tmp_path: Path, read: Read, content: str
) -> None:
    message = r"references .* or nests too deeply|characters of a value|values in YAML"
    with frugal(seconds=5, megabytes=50):
        refused(read, tmp_path / "a.yaml", content, message)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.json", read_camera),
        ("a.json", read_robot_poses),
        ("a.json", read_calibration),
    ],
)
def test_deep_json_is_refused(tmp_path: Path, name: str, read: Read) -> None:
    refused(
        read,
        tmp_path / name,
        '{"poses": ' * 20_000,
        "nested too deep|recursion|valid JSON",
    )


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "underscores.csv",
            HEADER.replace("x", "x" + "_" * 16_000) + ROW,
            "16,002 characters",
        ),
        (
            "cell.csv",
            HEADER + ROW + ROW.replace("a", "a" * 10_000),
            "row 3, column 1: 10,004 ch",
        ),
        (
            "columns.csv",
            HEADER.strip() + ",a" * 50_000 + "\n" + ROW,
            "50,008 columns, at most 1,0",
        ),
        ("names.csv", HEADER + ROW * 20_000, "'a.png' comes twice"),
        ("word.txt", "x" * 300_000, "is not a finite number|no line|characters"),
        ("brackets.txt", "p[" * 100_000 + "]" * 100_000, "[a-z]"),
        ("braces.txt", "{" * 200_000 + "X 1, Y 2", "[a-z]"),
        ("key.json", json.dumps([{"k" * 300: {"a": 1}}]), "300 characters of a key"),
        (
            "keys.json",
            json.dumps([{f"k{i}": 0} for i in range(5_000)]),
            "5,000 keys, at most",
        ),
        ("list.json", json.dumps([{"a": [0] * 5_000}]), "5,000 numbers of one key"),
        (
            "ragged.json",
            json.dumps({"x": ["A" * 3_000, *[""] * 9_000]}),
            "9,001 numbers of one key, at most",
        ),
        (
            "cell.json",
            json.dumps([{"x": "1" * 5_000}] * 500),
            "5,000 characters, at most 1,000",
        ),
    ],
)
def test_a_pose_table_takes_little_time_and_memory(
    tmp_path: Path, name: str, content: str, message: str
) -> None:
    with frugal(seconds=5, megabytes=100):
        refused(read_robot_poses, tmp_path / name, content, message)


def npz(shape: tuple[int, ...], arrays: int = 1) -> bytes:
    """An archive of arrays that state a shape."""
    array = io.BytesIO()
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        array, {"shape": shape, "fortran_order": False, "descr": "<f8"}
    )
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(arrays):
            archive.writestr(f"poses{i}.npy", array.getvalue() + bytes(8_000))
    return file.getvalue()


@pytest.mark.parametrize("read", [read_camera, read_robot_poses])
def test_arrays_are_measured_before_they_are_read(tmp_path: Path, read: Read) -> None:
    with frugal(seconds=5, megabytes=20):
        message = "200,000,000 numbers, at most 10,000,000"
        refused(read, tmp_path / "a.npz", npz((2 * 10**8,)), message)
        many = npz((6 * 10**6,), arrays=2)
        refused(read, tmp_path / "a.npz", many, "12,000,000 numbers, at most")


def test_the_bounds_are_raised_by_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        HEADER.replace("image", "image," + ",".join(["more"] * 1_500)) + ROW
    )
    with pytest.raises(InputError, match=r"`limits` columns=1508"):
        read_robot_poses(path)
    monkeypatch.setenv(VARIABLE, "columns=2000, pixels=1e6")
    assert (bounds().columns, bounds().pixels) == (2000, 10**6)
    with pytest.raises(InputError, match="row"):
        read_robot_poses(path)
    for wrong in ("columns", "columns=x", "rows=1", "columns=inf"):
        monkeypatch.setenv(VARIABLE, wrong)
        with pytest.raises(
            InputError, match=r"limit .*give NAME=NUMBER, the name one of"
        ):
            bounds()


def test_text_is_measured_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "text_bytes=100")
    refused(
        read_camera, tmp_path / "a.json", " " * 101, "101 bytes, at most 100 are read"
    )


def test_an_image_that_opencv_refuses_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    def refuse(*_: object) -> None:
        raise cv2.error("too many pixels")

    write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(cv2, "imdecode", refuse)
    with pytest.raises(InputError, match=r"a.png: not a readable image \(79 bytes\)"):
        read_image(tmp_path / "a.png")


def png_header(width: int, height: int) -> bytes:
    """A PNG file that ends after its header."""
    header = struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    checksum = struct.pack(">I", zlib.crc32(chunk))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + checksum


@pytest.mark.parametrize(
    ("width", "height", "message"),
    [
        (20_000, 20_000, "400,000,000 pixels, at most 100,000,000 are read"),
        (60_000, 1, "60,000 times longer than wide, at most 5 are read"),
        (100, 501, "6 times longer than wide"),
    ],
)
def test_the_size_in_the_header_of_an_image_is_bounded(
    tmp_path: Path, width: int, height: int, message: str
) -> None:
    content = png_header(width, height)
    with frugal(seconds=1, megabytes=5):
        refused(
            read_image,
            tmp_path / "a.png",
            content,
            f"a.png .{width}x{height}.: {message}",
        )
        assert not is_readable(tmp_path / "a.png")
        with pytest.raises(TooLargeError, match=message):
            decode_image(np.frombuffer(content, np.uint8))


def test_an_array_is_bounded_like_a_file() -> None:
    strip = np.zeros((1, 240, 3), np.uint8)
    with pytest.raises(InputError, match=r"image \(240x1\): 240 times longer"):
        as_rgb(strip)
    assert as_rgb(np.zeros((100, 500), np.uint8)).shape == (100, 500, 3)


def test_a_frame_of_a_video_is_bounded_before_it_is_converted(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(tmp_path / "a.mp4", "w") as container:
        out = container.add_stream("mpeg4", rate=10)
        out.width = 384
        out.height = 16
        out.pix_fmt = "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((16, 384, 3), np.uint8))
        container.mux([*out.encode(frame), *out.encode()])
    with pytest.raises(InputError, match=r"a.mp4 \(384x16\): 24 times"):
        Videos(fps=10).frame(tmp_path / "a.mp4", 0)
    with pytest.raises(InputError, match=r"a.mp4 \(384x16\): 24 times"):
        next(stream(str(tmp_path / "a.mp4")))


def test_names_are_sorted_by_their_numbers_whatever_they_hold() -> None:
    names = ["image-10", "image-2", "image-²", "image-" + "9" * 5_000, "image-007"]
    assert [name[:9] for name in sorted(names, key=natural_key)] == [
        "image-2", "image-007", "image-10", "image-999", "image-²"
    ]  # fmt: skip


def test_a_request_is_bounded_more_tightly() -> None:
    assert bounds().text_bytes == 10**8
    with reading_a_request():
        assert (bounds().text_bytes, bounds().columns) == (10**6, 100)
    assert bounds().text_bytes == 10**8


def test_a_jpeg_of_many_scans_is_no_image(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", np.zeros((8, 8, 3), np.uint8))
    data = (tmp_path / "a.jpg").read_bytes()
    refused(
        read_image, tmp_path / "b.jpg", data + b"\xff\xda" * 100, "not a readable image"
    )


def test_wide_pixels_are_converted_in_parts() -> None:
    wide = np.arange(2**16, dtype=np.uint16).reshape(512, 128)
    expected = (wide.astype(np.uint32) + 128) // 257
    with frugal(seconds=5, megabytes=0.4):
        grey = as_rgb(wide)
    np.testing.assert_array_equal(grey[..., 0], expected)


@pytest.mark.parametrize("status", [-11, None])
def test_a_matlab_file_that_ends_its_reader_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int | None
) -> None:
    """It is read by another process first, here by one that was killed or does not end."""
    path = tmp_path / "a.mat"
    savemat(path, {"T": np.repeat(np.eye(4)[None], 3, axis=0)})
    assert len(read_robot_poses(path)) == 3
    monkeypatch.setattr(array_files, "status_of", lambda *_, **__: status)
    with pytest.raises(InputError, match="a damaged MATLAB file; save it again"):
        read_robot_poses(path)
