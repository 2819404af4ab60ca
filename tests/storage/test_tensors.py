"""Arrays are read from an open file by offset: what happens to the file is an error, no signal."""

from __future__ import annotations

import gc
import json
import os
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from evercal.errors import InputError
from evercal.storage.tensors import open_tensors, save_tensors

NUMBERS = np.arange(300_000, dtype=np.float32).reshape(-1, 3)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"numbers": NUMBERS, "none": np.zeros((0, 4), np.int64)})
    return path


def header(path: Path, text: bytes, content: bytes = bytes(80)) -> None:
    path.write_bytes(len(text).to_bytes(8, "little") + text + content)


@pytest.mark.parametrize("kind", ["?", "u1", "i1", "u2", "i2", "f2", "i4", "f8", "u8"])
def test_slices_are_those_of_the_array(tmp_path, kind):
    array = np.arange(60).reshape(5, 3, 4).astype(kind)
    save_tensors(tmp_path / "a", {"b": array}, {"written": "by a test"})
    rows = open_tensors(tmp_path / "a")["b"]
    assert len(rows) == 5
    for part in (slice(None), slice(1, 3), slice(-2, None), slice(4, 2), slice(9, 10)):
        np.testing.assert_array_equal(rows[part], array[part])
        assert rows[part].dtype == array.dtype
        assert rows[part].flags.writeable


def test_a_file_that_is_overwritten_in_place_is_an_error(file):
    content = file.read_bytes()
    for change in (content[:500_000], b"", content[:-4] + b"abcd", content + b"a"):
        file.write_bytes(content)
        rows = open_tensors(file)["numbers"]
        assert rows[7:9].tolist() == NUMBERS[7:9].tolist()
        file.write_bytes(change)
        os.utime(file, ns=(1, 1))  # clocks of file systems are coarse
        with pytest.raises(InputError, match=r"a\.safetensors: .* overwritten in pla"):
            _ = rows[:]


def test_a_file_that_is_replaced_stays_open_and_is_closed_once(file):
    def descriptors() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    before = descriptors()
    arrays = open_tensors(file)
    assert descriptors() == before + 1
    numbers = arrays["numbers"]
    del arrays
    save_tensors(file, {"numbers": np.zeros((1, 1))})
    assert (numbers[:] == NUMBERS).all()
    del numbers
    assert descriptors() == before


def test_more_files_than_are_allowed_at_first(file):
    resource = pytest.importorskip("resource")
    kind = resource.RLIMIT_NOFILE
    soft, hard = resource.getrlimit(kind)
    try:
        resource.setrlimit(kind, (len(os.listdir("/proc/self/fd")) + 5, hard))
        opened = [open_tensors(file) for _ in range(20)]
    finally:
        resource.setrlimit(kind, (soft, hard))
    assert all(arrays["numbers"][3:4].tolist() == [[9, 10, 11]] for arrays in opened)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": [3, 4]}, "'b' has not the size of its shape"),
        ({"shape": [-2, -5]}, "must be non-negative"),
        ({"shape": []}, "'b' has not the size of its shape"),
        ({"shape": [2.0, 5]}, "cannot be interpreted as an integer"),
        ({"shape": [10**30, 0]}, "not readable"),
        ({"shape": {}}, "not readable"),
        ({"data_offsets": [0, 81]}, "'b' has not the size of its shape"),
        ({"data_offsets": [8, 88]}, "'b' does not lie in the file"),
        ({"data_offsets": [-8, 72]}, "'b' does not lie in the file"),
        ({"data_offsets": [0.0, 80.0]}, "cannot be interpreted as an integer"),
        ({"data_offsets": [0]}, "not readable"),
        ({"dtype": "F9"}, "'F9'"),
        ({"dtype": []}, "not readable"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path, changes, message):
    entry = {"dtype": "F64", "shape": [2, 5], "data_offsets": [0, 80]}
    header(tmp_path / "a", json.dumps({"b": entry}).encode())
    assert open_tensors(tmp_path / "a")["b"][:].shape == (2, 5)
    header(tmp_path / "a", json.dumps({"b": {**entry, **changes}}).encode())
    with pytest.raises(InputError, match=message):
        open_tensors(tmp_path / "a")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x08",
        (2**60).to_bytes(8, "little") + b"{}",
        (2_000_000).to_bytes(8, "little") + b" " * 2_000_000,
        save({})[:-3],
        (4).to_bytes(8, "little") + b"[{}]",
        (3).to_bytes(8, "little") + b"{}}",
        (4).to_bytes(8, "little") + b"\xff\xff\xff\xff",
        (11).to_bytes(8, "little") + b'{"a":[1,2]}',
    ],
)
def test_what_is_no_header_is_refused(tmp_path, content):
    (tmp_path / "a.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.safetensors: not readable \("):
        open_tensors(tmp_path / "a.safetensors")
