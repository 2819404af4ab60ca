"""Text and JSON files that a user names."""

import json
from pathlib import Path

from evercal.errors import InputError


def read_text(path: Path, what: str, remedy: str = "check the path") -> str:
    """Read a text file; `what` names its contents in messages.

    Raises:
        InputError: The file is missing, cannot be read, or is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing; {remedy}") from None
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: {what} is not a text file; {remedy}") from None


def read_json(path: Path, what: str, remedy: str = "check the path") -> dict[str, object]:
    """Read a JSON object.

    Raises:
        InputError: As `read_text`, or the file holds something else.
    """
    try:
        data = json.loads(read_text(path, what, remedy))
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error}); {remedy}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no JSON object; {remedy}")
    return data
