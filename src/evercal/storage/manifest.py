"""The list of files that make up a folder, with their checksums, written last.

    manifest.json: {"format": "evercal-manifest", "schema": 1, "payload": {...},
                    "files": {"relative/path": {"sha256": hex, "bytes": n}}, "sha256": hex}

Paths are relative with forward slashes. The last entry is the checksum of payload and files, so
that a changed manifest is detected too.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Self

from evercal.bounds import require_at_most
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.storage.atomic import write_json
from evercal.typing import JsonObject, PathLike

MANIFEST = "manifest.json"
_FORMAT = "evercal-manifest"
_SCHEMA = 1
"""Version of the format of the manifest itself."""

FileRecord = JsonObject
"""`sha256` and `bytes` of a file."""


def sha256_file(path: PathLike) -> str:
    """Checksum of a file's bytes, 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@frozen
class Manifest:
    """The content of a manifest."""

    payload: JsonObject
    """Settings of the writer."""
    files: dict[str, FileRecord]
    """Checksum and size of every file when it was written, by relative path."""

    @classmethod
    def read(cls, root: PathLike) -> Self:
        """Read a manifest; files are not checked, see `problems`."""
        root = Path(root)
        file = root / MANIFEST
        if not root.is_dir():
            raise InputError(f"{root}: no such folder")
        try:
            require_at_most(file.stat().st_size, "manifest_bytes", "bytes")
            return cls.of(file.read_bytes(), file)
        except OSError:
            raise InputError(
                f"{root}: no {MANIFEST} in it, so it is not a store"
            ) from None
        except ValueError as error:
            raise InputError(f"{file}: {error}") from None

    @classmethod
    def of(cls, content: bytes, file: Path) -> Self:
        """The manifest that a file holds, after a check of its shape and its own checksum."""
        whole = _checked(content, file)
        return cls(whole["payload"], whole["files"])

    def problems(self, root: PathLike) -> list[str]:
        """Compare every listed file with its size and checksum.

        Returns:
            One line per problem, beginning with the path of the file; empty if there is none.
        """
        problems = []
        for relative, record in self.files.items():
            path = Path(root) / relative
            try:
                size = path.stat().st_size
                if size != record["bytes"]:
                    problems.append(f"{path}: {size} bytes, expected {record['bytes']}")
                elif sha256_file(path) != record["sha256"]:
                    problems.append(
                        f"{path}: checksum does not match, its content was changed"
                    )
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                problems.append(f"{path}: missing")
        return problems


def write_manifest(
    root: PathLike,
    payload: JsonObject,
    files: Sequence[str],
    before: Manifest | None = None,
) -> None:
    """Write the manifest of files that are complete on disk, atomically.

    Files are relative to `root`, with forward slashes. Records of the manifest `before` are kept,
    so that files that were damaged since then are still detected.

    Raises:
        ValueError: A path that leaves `root`, or a payload that is not JSON.
        FileNotFoundError: One of the files is missing.
    """
    root = Path(root)
    recorded = before.files if before else {}
    records: dict[str, FileRecord] = {}
    for relative in sorted(set(files)):
        if not _stays_inside(relative):
            raise ValueError(f"manifest files lie inside {root}, got {relative!r}")
        path = root / relative
        size = path.stat().st_size
        records[relative] = recorded.get(relative) or {
            "sha256": sha256_file(path),
            "bytes": size,
        }
    # Converted to JSON and back, so that the checksum is that of the values that are read.
    body = json.loads(json.dumps({"payload": payload, "files": records}))
    write_json(
        root / MANIFEST,
        {"format": _FORMAT, "schema": _SCHEMA, **body, "sha256": _body_sha256(body)},
    )


def read_manifest(root: PathLike) -> JsonObject:
    """The payload; files are not checked, see `verify`."""
    return Manifest.read(root).payload


def verify(root: PathLike) -> list[str]:
    """Compare every listed file with its size and checksum; see `Manifest.problems`."""
    while True:
        manifest = Manifest.read(root)
        problems = manifest.problems(root)
        # A writer may have replaced files meanwhile.
        if not problems or Manifest.read(root) == manifest:
            return problems


def _checked(content: bytes, file: Path) -> dict[str, dict]:
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        raise InputError(
            f"{file}: broken, not valid JSON; restore it from a copy"
        ) from None
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise InputError(
            f"{file}: 'format' is not '{_FORMAT}'; this is another program's file"
        )
    if data.get("schema") != _SCHEMA:
        raise InputError(
            f"{file}: schema {data.get('schema')!r}, this evercal reads {_SCHEMA}; update evercal"
        )
    body = {key: data.get(key) for key in ("payload", "files")}
    if not all(isinstance(value, dict) for value in body.values()):
        raise InputError(
            f"{file}: broken, 'payload' or 'files' is no object; restore it"
        )
    if data.get("sha256") != _body_sha256(body):
        raise InputError(f"{file}: broken, its own checksum does not match; restore it")
    for relative, record in body["files"].items():  # pyright: ignore[reportOptionalMemberAccess]
        if not _stays_inside(relative) or not isinstance(record, dict):
            raise InputError(
                f"{file}: broken, entry {relative!r} is no file of this folder"
            )
        kinds = {key: type(value) for key, value in record.items()}
        if kinds != {"sha256": str, "bytes": int}:
            raise InputError(
                f"{file}: broken, entry {relative!r} is not its sha256 and bytes"
            )
    return data


def _body_sha256(body: dict) -> str:
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _stays_inside(relative: str) -> bool:
    # As on Windows, where backslashes and drives lead elsewhere, too.
    path = PureWindowsPath(relative)
    return bool(relative) and not path.anchor and ".." not in path.parts
