"""Text and JSON files that a user names, and their errors."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from pathlib import Path, PureWindowsPath
from typing import Any

from evercal.bounds import bounds, require_at_most
from evercal.errors import InputError
from evercal.typing import JsonObject

_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]")
_OF_OPENCV = re.compile(r"^%.*$|!!opencv-[a-z-]+", re.MULTILINE)
"""Not valid YAML. cv2.FileStorage can end the process on such files."""


@contextmanager
def named_errors(
    path: Path | str, what: str, remedy: str = "check the path"
) -> Iterator[None]:
    """Turn errors while a file is read into an `InputError` that names it.

    `what` names the contents of the file. A ValueError is about the contents and already says what
    is wrong with them.
    """
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing; {remedy}") from None
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: {what} is not a text file; {remedy}, or save text"
        ) from None
    except (RecursionError, MemoryError):
        raise InputError(f"{path}: {what} is nested too deeply or too large") from None
    except (ValueError, TypeError, OverflowError, EOFError) as error:
        raise InputError(f"{path}: {error}") from None


@contextmanager
def library_errors(
    what: str, remedies: Mapping[str, str] | None = None
) -> Iterator[None]:
    """Turn errors of another library into an `InputError`: damaged files make it raise any type.

    `remedies` are of errors by words in them.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        text = " ".join(str(error).split())[:200]
        remedy = next((v for word, v in (remedies or {}).items() if word in text), "")
        raise InputError(f"{what} ({type(error).__name__}: {text}){remedy}") from None


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Begin the message of a ValueError with the entry that it is about."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from None


def read_text(path: Path, what: str, remedy: str = "check the path") -> str:
    """Read a text file; `what` names its contents in messages."""
    with named_errors(path, what, remedy):
        require_at_most(path.stat().st_size, "text_bytes", "bytes")
        return decoded(path.read_bytes())


def decoded(data: bytes) -> str:
    """Text of UTF-8, of UTF-16, or else of Latin-1; UnicodeDecodeError if that makes no text.

    Every second byte of UTF-16 is mostly zero, so it needs no byte order mark.
    """
    for encoding in (_unicode_of(data), "latin-1"):
        with suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            if encoding == "utf-8-sig" or not _CONTROL.search(text):
                return text.replace("\r\n", "\n").replace("\r", "\n")
    raise UnicodeDecodeError("utf-8", data, 0, 1, "no text")


def _unicode_of(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    many = len(data) // 4
    if data[1::2].count(0) > many:
        return "utf-16-le"
    if data[::2].count(0) > many:
        return "utf-16-be"
    return "utf-8-sig"


def read_json(path: Path, what: str, remedy: str = "check the path") -> JsonObject:
    """Read a JSON object; `what` names its contents in messages."""
    try:
        data = json.loads(read_text(path, what, remedy))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); {remedy}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no JSON object; {remedy}")
    return data


def documents(text: str, is_json: bool) -> list[Any]:
    """Values of JSON, of lines of JSON, or of YAML; ValueError for other text."""
    if not is_json:
        return yaml_documents(text)
    try:
        return [json.loads(text)]
    except json.JSONDecodeError as error:
        if error.msg != "Extra data":
            raise ValueError(f"not valid JSON ({error})") from None
    return [json.loads(line) for line in text.splitlines() if line.strip()]


def yaml_documents(text: str) -> list[Any]:
    """The documents of a YAML text; ValueError for other text, references, tags, deep nesting.

    A reference repeats a value, and references of references multiply it without limit. Some values
    take long to construct, too, such as integers of base 60; so all are bounded before.
    """
    import yaml

    text = _OF_OPENCV.sub("", text)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = nodes = 0
    try:
        for event in yaml.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            nodes += isinstance(event, yaml.NodeEvent)
            word = getattr(event, "value", "")
            is_reference = isinstance(event, yaml.AliasEvent) or word == "<<"
            if is_reference or getattr(event, "tag", None) or depth > bounds().depth:
                raise ValueError(
                    "it holds references (*name), tags (!name) or nests too deeply"
                )
            require_at_most(nodes, "nodes", "values in YAML")
            require_at_most(len(word), "cell_characters", "characters of a value")
        return list(yaml.load_all(text, loader))
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({' '.join(str(error).split())})") from None


def few(names: Sequence[str], near: Iterable[str] = (), most: int = 3) -> str:
    """The first names, and the one of `near` that is most like the first."""
    text = ", ".join(names[:most])
    if len(names) > most:
        text += f" and {len(names) - most} more"
    similar = {name.lower(): name for name in sorted(near)}
    if names:
        for match in get_close_matches(names[0].lower(), similar, 1, 0.7):
            text += f" (nearest: {similar[match]})"
    return text


def refuse_repeated(names: Iterable[str], remedy: str) -> None:
    """Raise ValueError for the first name that came before."""
    known: set[str] = set()
    for name in names:
        if name in known:
            raise ValueError(f"{name!r} comes twice; {remedy}")
        known.add(name)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sorting key that puts `image-2` before `image-10`."""
    return tuple(map(_part_key, re.findall(r"[0-9]+|[^0-9]+", name)))


def _part_key(text: str) -> tuple[int, int, str]:
    if text[0] not in "0123456789":
        return (1, 0, text)
    digits = text.lstrip("0")
    return (0, len(digits), f"{digits} {text}")


def path_inside(path: object, what: str) -> str:
    """Check that a path stays inside the folder of the file that states it; with forward slashes.

    Symbolic links are followed: download caches keep files elsewhere. `what` names the entry.
    """
    # Windows paths split at both kinds of slashes and have an anchor for drives as well.
    relative = PureWindowsPath(str(path))
    if not isinstance(path, str) or not path or relative.anchor:
        raise ValueError(f"{what} is a path relative to the folder, got {path!r}")
    if ".." in relative.parts:
        raise ValueError(f"{what} stays inside the folder, got {path!r}")
    return relative.as_posix()


def is_link(folder: Path) -> bool:
    """Whether a folder lies elsewhere, also by a junction of Windows."""
    return folder.resolve() != folder.parent.resolve() / folder.name


def is_real(value: object) -> bool:
    """Whether a JSON value is a number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
