"""Learning a scene in a process of its own, so that the service answers meanwhile."""

import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from evercal.errors import InputError
from evercal.learning.many import end_with_parent

LEARNING, DONE, FAILED = "learning", "done", "failed"
_EVERY_S = 0.2
"""Interval of progress reports."""


@dataclass(frozen=True)
class Request:
    """A recording to learn."""

    map: Path
    """Folder of the map."""
    recording: Path
    """Folder or bag of the recording, or a zip archive of one."""
    is_archive: bool
    """Whether it is an archive that was sent."""
    name: str | None = None
    """Name of the scene; the recording's own by default."""
    memory: str | None = None
    """Keyframes to keep, as for `Map.learn`."""
    device: str = "auto"
    unpacked_bytes: int = 20 * 10**9
    """Size of an archive when it is extracted, at most."""

    @property
    def extracted(self) -> Path:
        """Folder that an archive is extracted into; the service removes both."""
        return self.recording.with_suffix("")


def run(request: Request, out: Connection) -> None:
    """Learn a scene; the target of a new process.

    Args:
        request: What to learn.
        out: Where pairs are sent: (`learning`, (step, done, total)) while it works, then
            (`done`, report) or (`failed`, message).
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the service ends its jobs itself
    end_with_parent()
    with suppress(OSError):
        os.nice(5)  # requests come first
    try:
        out.send((DONE, _learned(request, _sender(out))))
    except InputError as error:
        out.send((FAILED, str(error)))
    except Exception as error:
        out.send((FAILED, f"internal error: {error!r}"))


def _sender(out: Connection) -> Callable[[str, int, int], None]:
    last = [0.0, ""]

    def send(step: str, done: int, total: int) -> None:
        now = time.monotonic()
        if step != last[1] or done >= total or now - float(last[0]) > _EVERY_S:
            last[:] = now, step
            out.send((LEARNING, (step, done, total)))

    return send


def _learned(request: Request, on_progress: Callable[[str, int, int], None]) -> dict[str, Any]:
    from evercal.map import Map
    from evercal.recordings import load_recording
    from evercal.storage.archive import ArchiveLimits, extract_archive

    root = request.recording
    if request.is_archive:
        on_progress("extracting", 0, 1)
        extract_archive(root, request.extracted, ArchiveLimits(request.unpacked_bytes))
        root = _inside(request.extracted)
        _require_paths_inside(root)
    try:
        recording = load_recording(root, name=request.name)
    except InputError as error:
        raise InputError(str(error).replace(str(root), root.name)) from None
    _require_inside(root, recording.train)
    opened = Map.open(request.map, device=request.device)
    report = opened.learn(recording, memory=request.memory, on_progress=on_progress)
    return asdict(report)


def _require_paths_inside(root: Path) -> None:
    """Refuse a sent nerfstudio recording that names files elsewhere, before one is opened."""
    folder = root if root.is_dir() else root.parent
    for file in folder.rglob("*.json"):
        with suppress(ValueError, OSError):
            content = json.loads(file.read_text(encoding="utf-8"))
            frames = content.get("frames") if isinstance(content, dict) else None
            for frame in frames if isinstance(frames, list) else []:
                name = frame.get("file_path") if isinstance(frame, dict) else None
                path = (file.parent / str(name)).resolve()
                if name and not path.is_relative_to(folder.resolve()):
                    raise InputError(f"{file.name}: image {name} lies outside the recording")


def _inside(folder: Path) -> Path:
    """The recording in an extracted archive: its only folder or file, if there is just one."""
    entries = list(folder.iterdir())
    return entries[0] if len(entries) == 1 else folder


def _require_inside(root: Path, frames: Any) -> None:
    """Refuse a recording whose files lie elsewhere on this machine."""
    resolved = root.resolve()
    for frame in frames:
        for path in (frame.image, frame.depth):
            if isinstance(path, Path) and not path.resolve().is_relative_to(resolved):
                raise InputError(f"{root.name}: image {path.name} lies outside the recording")
