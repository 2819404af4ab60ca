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


@pytest.mark.parametrize("relative", FILES)
def test_damaged_files_are_named(store: Path, relative: str) -> None:
    file = store / relative
    data = bytearray(file.read_bytes())
    data[500] ^= 1
    file.write_bytes(data)
    assert len(verify(store)) == 1
    assert verify(store)[0].startswith(f"{file}: checksum")
    file.write_bytes(data[:999])
    assert verify(store)[0].startswith(f"{file}: 999 bytes, expected 1000")
    file.unlink()
    assert verify(store) == [f"{file}: missing"]


def test_any_flipped_bit_of_the_manifest_is_refused_or_harmless(store: Path) -> None:
    file = store / MANIFEST
    good = file.read_bytes()
    for i in range(len(good)):
        changed = bytearray(good)
        changed[i] ^= 1
        file.write_bytes(changed)
        try:
            payload = read_manifest(store)
        except InputError as error:
            assert MANIFEST in str(error)  # noqa: PT017 - either outcome is right
        else:
            assert payload == {"stages": ["kitchen"], "threshold": 0.1}


def write(store: Path, **changes: object) -> None:
    data = json.loads((store / MANIFEST).read_text())
    (store / MANIFEST).write_text(json.dumps({**data, **changes}))


def test_what_is_no_store_is_refused(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such folder"):
        read_manifest(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="not a store"):
        verify(tmp_path / "empty")
    write(store, schema=2)
    with pytest.raises(InputError, match="schema 2, this evercal reads 1"):
        read_manifest(store)
    write(store, format="other")
    with pytest.raises(InputError, match="another program"):
        read_manifest(store)
    (store / MANIFEST).write_text('{"format": ')
    with pytest.raises(InputError, match="not valid JSON"):
        read_manifest(store)


def test_files_outside_the_folder_are_refused(store: Path) -> None:
    for relative in ("../a", "/etc/hosts", "", "a/../../b"):
        with pytest.raises(ValueError, match="inside"):
            write_manifest(store, {}, [relative])
    with pytest.raises(FileNotFoundError):
        write_manifest(store, {}, ["absent"])
    assert verify(store) == []  # the manifest that was there still is
