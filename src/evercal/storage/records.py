"""JSON files that evercal wrote: they state their format and version."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from evercal.errors import InputError
from evercal.typing import PathLike, Record

Content = TypeVar("Content")


def of_format(
    data: object,
    format: str,
    version: int,
    read: Callable[[Record], Content],
) -> Content:
    """Convert JSON values that state their format and version.

    Raises:
        ValueError: The format or version is another one, or an entry is missing or broken.
    """
    if not isinstance(data, dict) or data.get("format") != format:
        raise ValueError(f"'format' is not {format!r}")
    if data.get("version") != version:
        raise ValueError(
            f"version {data.get('version')!r}; this evercal reads {version}"
        )
    try:
        return read(data)
    except KeyError as error:
        raise ValueError(f"{error} is missing") from None
    except (TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"an entry has the wrong kind of value ({error})") from None


def read_record(
    path: PathLike, what: str, convert: Callable[[object], Content]
) -> Content:
    """Read a JSON file and convert its values; `what` names it in messages."""
    try:
        return convert(json.loads(Path(path).read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {error}; give the JSON that evercal wrote") from None
