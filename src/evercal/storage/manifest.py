"""The list of files that make up a folder, with their checksums, written last.

    manifest.json: {"format": "evercal-manifest", "schema": 1, "payload": {...},
                    "files": {"relative/path": {"sha256": hex, "bytes": n}}, "sha256": hex}

Paths are relative with forward slashes. The last entry is the checksum of payload and files
together, so that a manifest that was changed is noticed too.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from evercal.errors import InputError
from evercal.storage.atomic import write_json

MANIFEST = "manifest.json"
_FORMAT = "evercal-manifest"
_SCHEMA = 1


def sha256_file(path: str | os.PathLike[str]) -> str:
    """Checksum of a file's bytes, 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_manifest(
    root: str | os.PathLike[str], payload: dict[str, object], files: Sequence[str]
) -> None:
    """Puts the manifest of `files`, which must be complete on disk, in place atomically.

    Args:
        root: The folder.
        payload: What the caller wants to keep beside the list; JSON.
        files: Paths relative to `root`, forward slashes.

    Raises:
        ValueError: A path that leaves `root`, or a payload that is no JSON.
        FileNotFoundError: One of the files is not there.
    """
    root = Path(root)
    records: dict[str, dict[str, object]] = {}
    for relative in sorted(set(files)):
        if not _stays_inside(relative):
            raise ValueError(f"manifest files lie inside {root}, got {relative!r}")
        path = root / relative
        records[relative] = {"sha256": sha256_file(path), "bytes": path.stat().st_size}
    # Through JSON once, so that the checksum is that of what will be read back.
    body = json.loads(json.dumps({"payload": payload, "files": records}, allow_nan=False))
    write_json(
        root / MANIFEST,
        {"format": _FORMAT, "schema": _SCHEMA, **body, "sha256": _body_sha256(body)},
    )


def read_manifest(root: str | os.PathLike[str]) -> dict[str, object]:
    """The payload; files are not checked, see `verify`.

    Raises:
        InputError: No manifest, a broken one, or one of another schema.
    """
    return _read(Path(root))["payload"]


def listed_files(root: str | os.PathLike[str]) -> tuple[str, ...]:
    """Relative paths of the files that the manifest lists; they are not checked, see `verify`.

    Raises:
        InputError: As `read_manifest`.
    """
    return tuple(_read(Path(root))["files"])


def verify(root: str | os.PathLike[str]) -> list[str]:
    """Compares every listed file with its size and checksum.

    Returns:
        One line per problem, each beginning with the file's path; empty if all is well.

    Raises:
        InputError: As `read_manifest`.
    """
    root = Path(root)
    problems = []
    for relative, record in _read(root)["files"].items():
        path = root / relative
        if not path.is_file():
            problems.append(f"{path}: missing")
        elif path.stat().st_size != record["bytes"]:
            problems.append(f"{path}: {path.stat().st_size} bytes, expected {record['bytes']}")
        elif sha256_file(path) != record["sha256"]:
            problems.append(f"{path}: checksum does not match, its content was changed")
    return problems


def _read(root: Path) -> dict[str, dict]:
    """The whole manifest, its shape and own checksum checked."""
    file = root / MANIFEST
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    try:
        data = json.loads(file.read_bytes())
    except OSError:
        raise InputError(f"{root}: no {MANIFEST} in it, so it is not a store") from None
    except ValueError:
        raise InputError(f"{file}: broken, not valid JSON; restore it from a copy") from None
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise InputError(f"{file}: 'format' is not '{_FORMAT}'; this is another program's file")
    if data.get("schema") != _SCHEMA:
        raise InputError(
            f"{file}: schema {data.get('schema')!r}, this evercal reads {_SCHEMA}; update evercal"
        )
    body = {key: data.get(key) for key in ("payload", "files")}
    if not all(isinstance(value, dict) for value in body.values()):
        raise InputError(f"{file}: broken, 'payload' or 'files' is no object; restore it")
    if data.get("sha256") != _body_sha256(body):
        raise InputError(f"{file}: broken, its own checksum does not match; restore it")
    for relative, record in body["files"].items():  # pyright: ignore[reportOptionalMemberAccess]
        if not _stays_inside(relative) or not isinstance(record, dict):
            raise InputError(f"{file}: broken, entry {relative!r} is no file of this folder")
        if not {"sha256", "bytes"} <= record.keys():
            raise InputError(f"{file}: broken, entry {relative!r} lacks sha256 or bytes")
    return data


def _body_sha256(body: dict) -> str:
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _stays_inside(relative: str) -> bool:
    path = PurePosixPath(relative)
    return bool(relative) and not path.is_absolute() and ".." not in path.parts
