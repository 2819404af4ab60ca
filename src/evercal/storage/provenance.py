"""What made a result: version, command and inputs, so that it can be made again.

The command line and the methods of `Map` open a `call`. Whatever is made inside of it, in the same
thread, asks for `current()`. The outermost call counts.
"""

import hashlib
import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from evercal.classes import frozen
from evercal.errors import without_secrets
from evercal.processes import command_line
from evercal.storage.manifest import MANIFEST, sha256_file
from evercal.typing import JsonObject, Record, Strings

_PATHS = ("images", "recording", "recordings", "robot_poses")
"""Arguments whose text may be a path."""


def now() -> str:
    """The time in ISO 8601 with zone, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@frozen
class Made:
    """What made a result."""

    version: str
    """Of evercal."""
    command: Strings
    """Words of the command line with its options; or the function in Python."""
    inputs: Mapping[str, str]
    """Number and checksum of the files that were given, by their path as it was given."""
    date: str
    """ISO 8601 time with zone."""

    @classmethod
    def of(cls, command: Strings, arguments: Record) -> Self:
        """The record of a command that is given arguments; inputs are read now."""
        inputs = {}
        for name, value in arguments.items():
            inputs |= _inputs(name, value)
        return cls(
            version("evercal"),
            tuple(map(_shown, command)),
            inputs,
            now(),
        )

    @classmethod
    def from_dict(cls, data: Record | None) -> Self | None:
        """The inverse of `asdict`; None of files without a record."""
        if not data:
            return None
        return cls(
            data["version"],
            tuple(map(str, data["command"])),
            dict(data["inputs"]),
            data["date"],
        )

    def __str__(self) -> str:
        return f"evercal {self.version}, {self.date}: {command_line(self.command)}"

    def changes(self, later: Self) -> list[str]:
        """What differs later, one sentence each: version and inputs."""
        found = {"evercal": later.version, **later.inputs}
        sentences = []
        for name, old in {"evercal": self.version, **self.inputs}.items():
            new = found.get(name, "gone")
            if new != old:
                sentences.append(f"{name} was {old} and is {new}")
        return sentences


_CALL: ContextVar[Callable[[], Made | None]] = ContextVar("call")


@contextmanager
def call(command: Strings, arguments: Record) -> Iterator[None]:
    """What is made in this block was made by a command; an outer call keeps its own."""
    made = _CALL.get(cache(partial(Made.of, command, arguments)))
    token = _CALL.set(made)
    try:
        yield
    finally:
        _CALL.reset(token)


def current() -> Made | None:
    """The record of the call that runs in this thread, if any."""
    made = _CALL.get(None)
    return made and made()


def recorded() -> JsonObject:
    """An entry `made` with that record for a JSON object; nothing without a call."""
    made = current()
    return {"made": asdict(made)} if made else {}


class _Checksum:
    """A file whose content only goes into a checksum: images in memory are not copied."""

    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()

    def write(self, data: Any) -> None:
        """Add bytes."""
        self.sha256.update(data)


def _inputs(name: str, value: Any) -> dict[str, str]:
    """What an argument gives: files, those of folders and lists by their endings, or values."""
    if is_dataclass(value):
        file = _Checksum()
        try:
            pickle.dump(value, file, protocol=5)
        except TypeError:  # images of an open bag or video
            return {name: type(value).__name__}
        return {name: f"sha256 {file.sha256.hexdigest()}"}
    paths = []
    for item in value if isinstance(value, list | tuple) else [value]:
        if isinstance(item, Path) or (isinstance(item, str) and name in _PATHS):
            paths.append(Path(item))
    groups: dict[str, list[Path]] = {}
    for path in paths:
        store = path / MANIFEST
        if store.exists():  # it has the checksums of all files
            path = store
        files = path.glob if name == "images" else path.rglob
        for file in [path, *sorted(files("[!.]*"))]:
            group = path / f"*{file.suffix}" if file != path else path
            if file.is_file():
                groups.setdefault(_shown(str(group)), []).append(file)
    return {group: _checksum(files) for group, files in groups.items()}


def _checksum(files: Sequence[Path]) -> str:
    total = hashlib.sha256()
    for file in files:
        total.update(f"{file.name} {sha256_file(file)}\n".encode())
    return f"files: {len(files)}, sha256: {total.hexdigest()[:32]}"


def _shown(text: str) -> str:
    """A text that names neither passwords of addresses nor the user's folder."""
    home = os.path.expanduser("~").rstrip(os.sep) or os.devnull
    return without_secrets(text).replace(f"{home}{os.sep}", f"~{os.sep}")
