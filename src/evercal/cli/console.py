"""Output that all verbs share: JSON, the next command, progress bars, checks of output paths."""

import json
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    from tqdm import tqdm


def print_json(record: object) -> None:
    """Print one JSON object on one line of stdout.

    Raises:
        ValueError: It contains inf or nan, which JSON cannot represent.
    """
    print(json.dumps(record, allow_nan=False), flush=True)


def print_next(*words: object) -> None:
    """Print the command to run next; words in capitals are placeholders."""
    print("next: " + shlex.join(str(word) for word in words))


def progress_bar(what: str, total: int, unit: str, done: int = 0) -> "tqdm":
    """A progress bar on stderr; occasional lines if stderr is a file, nothing for a single step."""
    from tqdm import tqdm

    return tqdm(
        desc=what,
        total=total,
        unit=unit,
        initial=done,
        file=sys.stderr,
        disable=total == 1,
        mininterval=0.2 if sys.stderr.isatty() else 10.0,
        dynamic_ncols=True,
    )


def size(count: float) -> str:
    """Format bytes: 1.2 MB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def require_writable(path: Path | None, option: str) -> None:
    """Refuse an output file that cannot be written, before any work is done.

    Args:
        path: the file; None if the option was omitted.
        option: its name, for the message.

    Raises:
        InputError: The path is a folder, or its folder is missing or not writable.
    """
    if path is None:
        return
    folder = path.resolve().parent
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; give a file name")
    if not folder.is_dir():
        raise InputError(f"{option} {path}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} {path}: folder {folder} is not writable")


def require_folder(path: Path | None, option: str) -> None:
    """Create an output folder, before any work is done.

    Raises:
        InputError: It cannot be created or written.
    """
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {path}: cannot be created ({error.strerror})") from None
    if not os.access(path, os.W_OK):
        raise InputError(f"{option} {path}: is not writable")
