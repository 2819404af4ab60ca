"""Text and JSON files that a user names, and their errors."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
from typing import Any

from evercal.bounds import require_at_most
from evercal.errors import InputError

_DEPTH = 50
"""Nested lists and objects in YAML."""


@contextmanager
def named_errors(path: Path | str, what: str, remedy: str = "check the path") -> Iterator[None]:
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
        raise InputError(f"{path}: {what} is not a text file; {remedy}") from None
    except (RecursionError, MemoryError):
        raise InputError(f"{path}: {what} is nested too deeply or too large") from None
    except (ValueError, TypeError, OverflowError, EOFError) as error:
        raise InputError(f"{path}: {error}") from None


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Begin the message of a ValueError with the entry that it is about."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from None


def read_text(path: Path, what: str, remedy: str = "check the path") -> str:
    """Read a UTF-8 text file; `what` names its contents in messages."""
    with named_errors(path, what, remedy):
        require_at_most(path.stat().st_size, "text_bytes", "bytes")
        return path.read_text(encoding="utf-8-sig")


def read_json(path: Path, what: str, remedy: str = "check the path") -> dict[str, Any]:
    """Read a JSON object; `what` names its contents in messages."""
    try:
        data = json.loads(read_text(path, what, remedy))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); {remedy}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no JSON object; {remedy}")
    return data


def yaml_documents(text: str) -> list[Any]:
    """The documents of a YAML text; ValueError for other text, references, tags, deep nesting.

    A reference repeats a value, and references of references multiply it without limit. Some values
    take long to construct, too, such as integers of base 60; so all are bounded before.
    """
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = nodes = 0
    try:
        for event in yaml.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            nodes += isinstance(event, yaml.NodeEvent)
            word, tag = getattr(event, "value", ""), getattr(event, "tag", None)
            if isinstance(event, yaml.AliasEvent) or word == "<<" or tag or depth > _DEPTH:
                raise ValueError("it holds references (*name), tags (!name) or nests too deeply")
            require_at_most(nodes, "nodes", "values in YAML")
            require_at_most(len(word), "cell_characters", "characters of a value")
        return list(yaml.load_all(text, loader))
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({' '.join(str(error).split())})") from None


def refuse_repeated(names: Iterable[str], remedy: str) -> None:
    """Raise ValueError for the first name that came before."""
    known: set[str] = set()
    for name in names:
        if name in known:
            raise ValueError(f"{name!r} comes twice; {remedy}")
        known.add(name)


def path_inside(path: object, what: str) -> str:
    """Check that a path of a file with forward slashes stays inside the file's folder.

    Symbolic links are followed: download caches keep files elsewhere. `what` names the entry.
    """
    # Windows paths split at both kinds of slashes and have an anchor for drives as well.
    if not isinstance(path, str) or not path or PureWindowsPath(path).anchor:
        raise ValueError(f"{what} is a path relative to the folder, got {path!r}")
    if ".." in PureWindowsPath(path).parts:
        raise ValueError(f"{what} stays inside the folder, got {path!r}")
    return path


def is_real(value: object) -> bool:
    """Whether a JSON value is a number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
