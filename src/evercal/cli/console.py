"""What every verb prints alike: JSON on stdout, the next command, progress on stderr."""

import json
import shlex
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tqdm import tqdm


def print_json(record: object) -> None:
    """One JSON object on one line of stdout.

    Raises:
        ValueError: inf or nan in it, which JSON has no word for.
    """
    print(json.dumps(record, allow_nan=False))


def print_next(*words: object) -> None:
    """The last line of a command: what to run next; capitals stand for what the user puts in."""
    print("next: " + shlex.join(str(word) for word in words))


def progress_bar(what: str, total: int, unit: str, done: int = 0) -> "tqdm":
    """A bar on stderr with the time left; rare lines where stderr is a file; none for one step."""
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
    """Bytes for people: 1.2 MB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
