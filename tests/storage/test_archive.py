"""Archives are extracted whole and inside their folder, or refused."""

from __future__ import annotations

import stat
import struct
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from evercal.bounds import VARIABLE
from evercal.errors import InputError
from evercal.storage.archive import (
    check_archive,
    extract_archive,
    read_entry,
    write_archive,
)

Tree = Callable[[Path], dict[str, str]]
FILES = {"a.txt": b"first", "deep/er/b.bin": bytes(3_000_000), "deep/empty": b""}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, data in FILES.items():
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_bytes(data)
    return tmp_path / "in"


def zipped(path: Path, *entries: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return path


def test_round_trip_gives_the_same_files_and_bytes(
    folder: Path, tmp_path: Path, tree: Tree
) -> None:
    one = tmp_path / "one.zip"
    two = tmp_path / "two.zip"
    write_archive(one, folder, FILES)
    extract_archive(one, tmp_path / "out")
    assert tree(tmp_path / "out") == tree(folder)
    assert sorted(check_archive(one)) == sorted(FILES)
    write_archive(two, tmp_path / "out", FILES)
    assert two.read_bytes() == one.read_bytes()


def test_folders_of_other_programs_are_made_in_any_order(tmp_path: Path) -> None:
    entries = [("a/b/", b""), ("a/b/c.txt", b"text"), ("a/", b""), ("d/", b"")]
    extract_archive(zipped(tmp_path / "x.zip", *entries), tmp_path / "out")
    made = [
        path.relative_to(tmp_path / "out").as_posix()
        for path in (tmp_path / "out").rglob("*")
    ]
    assert sorted(made) == ["a", "a/b", "a/b/c.txt", "d"]
    assert (tmp_path / "out" / "a" / "b" / "c.txt").read_bytes() == b"text"


def test_an_entry_is_read_alone_up_to_a_bound(folder: Path, tmp_path: Path) -> None:
    write_archive(tmp_path / "x.zip", folder, FILES)
    assert read_entry(tmp_path / "x.zip", "a.txt", 5) == b"first"
    with pytest.raises(InputError, match=r"a\.txt has 5 bytes, at most 4"):
        read_entry(tmp_path / "x.zip", "a.txt", 4)


def test_a_missing_file_leaves_the_old_archive(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "one.zip").write_bytes(b"old")
    with pytest.raises(FileNotFoundError):
        write_archive(tmp_path / "one.zip", folder, [*FILES, "missing"])
    assert (tmp_path / "one.zip").read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "one.zip"]


def info(name: str, mode: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)
    entry.external_attr = mode << 16
    return entry


OUTSIDE = (
    "../evil",
    "a/../../evil",
    "/etc/evil",
    "a//b",
    "./a",
    "..\\evil",
    "C:/evil",
    "a:b",
)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        *(([name], "leaves the folder") for name in (*OUTSIDE, "x" * 300)),
        (["a", "a"], "comes twice"),
        (["a", "a/b"], "is a file and a folder"),
        ([info("link", stat.S_IFLNK | 0o777)], "is a link or device"),
        ([info("pipe", stat.S_IFIFO | 0o644)], "is a link or device"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_entries_that_may_not_be_extracted(
    entries: list[str | zipfile.ZipInfo], message: str, tmp_path: Path, tree: Tree
) -> None:
    path = zipped(tmp_path / "x.zip", *((entry, b"data") for entry in entries))
    before = tree(tmp_path)
    for action in (
        partial(extract_archive, folder=tmp_path / "out" / "er"),
        check_archive,
    ):
        with pytest.raises(InputError, match=message) as refused:
            action(path)
        assert "\n" not in str(refused.value)
    assert tree(tmp_path) == before


def test_more_than_the_limits_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = zipped(tmp_path / "bomb.zip", *((f"{i}", bytes(10**6)) for i in range(20)))
    assert bomb.stat().st_size < 100_000
    limits = {
        "archive_bytes=19e6": "20,000,000 bytes when extracted, at most 19,000,000",
        "archive_files=19": "20 entries, at most 19",
        "archive_ratio=20": r"\d+ times its own size when extracted, at most 20",
    }
    for limit, message in limits.items():
        monkeypatch.setenv(VARIABLE, limit)
        with pytest.raises(InputError, match=message):
            extract_archive(bomb, tmp_path / limit)
    monkeypatch.setenv(VARIABLE, "archive_bytes=2e7,archive_files=20,archive_ratio=1e4")
    extract_archive(bomb, tmp_path / "out3")


def test_an_entry_that_is_larger_than_it_states_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(1000)
    path = zipped(tmp_path / "x.zip", ("noise", noise))
    data = path.read_bytes()
    stated = struct.pack("<I", 1000)
    assert data.count(stated) == 2  # beside the data, and in the directory
    path.write_bytes(data.replace(stated, struct.pack("<I", 100)))
    with pytest.raises(InputError, match="not a readable zip archive"):
        extract_archive(path, tmp_path / "out")
    assert sum(file.stat().st_size for file in (tmp_path / "out").iterdir()) <= 100


def test_other_files_are_refused(tmp_path: Path) -> None:
    for data in (b"", b"PK", b"no archive" * 1000):
        (tmp_path / "x").write_bytes(data)
        with pytest.raises(InputError, match="not a zip archive"):
            check_archive(tmp_path / "x")


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_bytes_are_refused_or_change_nothing_outside(
    data: st.DataObject, tmp_path: Path
) -> None:
    root = Path(tempfile.mkdtemp(dir=tmp_path))
    path = zipped(root / "x.zip", ("a", b"text " * 40), ("b/c", b"text " * 40))
    mutated = bytearray(path.read_bytes())
    positions = st.integers(0, len(mutated) - 1)
    changes = st.dictionaries(positions, st.integers(0, 255), min_size=1, max_size=4)
    for position, value in data.draw(changes).items():
        mutated[position] = value
    path.write_bytes(mutated)
    with suppress(InputError):  # other archives are extracted
        extract_archive(path, root / "out")
    assert {path.name for path in root.iterdir()} <= {"x.zip", "out"}
    assert not any(path.is_symlink() for path in root.rglob("*"))
