"""Changed, truncated and missing files are named."""

import hashlib
import json
from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.storage import MANIFEST, read_manifest, sha256_file, verify, write_manifest

FILES = ["head.bin", "stages/0/scene.json"]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    for i, relative in enumerate(FILES):
        (tmp_path / relative).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / relative).write_bytes(bytes([i]) * 1000)
    write_manifest(tmp_path, {"stages": ["kitchen"], "threshold": 0.1}, FILES)
    return tmp_path


def test_the_payload_comes_back_and_all_is_well(store: Path) -> None:
    assert read_manifest(store) == {"stages": ["kitchen"], "threshold": 0.1}
    assert verify(store) == []


def test_checksums_are_sha256_of_the_bytes(store: Path) -> None:
    assert sha256_file(store / FILES[0]) == hashlib.sha256(bytes(1000)).hexdigest()
    records = json.loads((store / MANIFEST).read_text())["files"]
    assert records[FILES[0]] == {"sha256": sha256_file(store / FILES[0]), "bytes": 1000}


def test_a_payload_that_is_no_json_changes_nothing(store: Path) -> None:
    before = (store / MANIFEST).read_bytes()
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="JSON"):
            write_manifest(store, {"threshold": value}, FILES)
    assert (store / MANIFEST).read_bytes() == before


@pytest.mark.parametrize("relative", FILES)
def test_damaged_files_are_named(store: Path, relative: str) -> None:
    file = store / relative
    data = bytearray(file.read_bytes())
    data[500] ^= 1
    file.write_bytes(data)
    changed = "checksum does not match, its content was changed"
    assert verify(store) == [f"{file}: {changed}"]
    file.write_bytes(data[:999])
    assert verify(store) == [f"{file}: 999 bytes, expected 1000"]
    file.unlink()
    assert verify(store) == [f"{file}: missing"]


def test_any_flipped_bit_of_the_manifest_is_refused_or_harmless(store: Path) -> None:
    file = store / MANIFEST
    good = file.read_bytes()
    for i, byte in enumerate(good):
        file.write_bytes(good[:i] + bytes([byte ^ 1]) + good[i + 1 :])
        try:
            payload = read_manifest(store)
        except InputError as error:
            assert MANIFEST in str(error)  # noqa: PT017 - either outcome is right
        else:
            assert payload == {"stages": ["kitchen"], "threshold": 0.1}


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such folder"):
        read_manifest(tmp_path / "nowhere")
    with pytest.raises(InputError, match="not a store"):
        verify(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"schema": 1', '"schema": 2', "schema 2, this evercal reads 1"),
        ("evercal-manifest", "other", "another program"),
        ("}", "", "not valid JSON"),
    ],
)
def test_a_manifest_of_another_program_or_version_is_refused(
    store: Path, old: str, new: str, message: str
) -> None:
    file = store / MANIFEST
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(InputError, match=message):
        read_manifest(store)


def test_files_outside_the_folder_are_refused(store: Path) -> None:
    for relative in ("../a", "/etc/hosts", "", "a/../../b", "..\\a", "C:/a"):
        with pytest.raises(ValueError, match="inside"):
            write_manifest(store, {}, [relative])
    with pytest.raises(FileNotFoundError):
        write_manifest(store, {}, ["absent"])
    assert verify(store) == []  # the manifest that was there still is
