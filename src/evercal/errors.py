"""The one exception that a user is meant to read."""

import importlib
import math
import platform
import re
import unicodedata
from collections.abc import Iterable
from typing import Any

_LONGEST = 2_000
"""Characters of a message, which may repeat what came from outside."""
_USER = re.compile(
    r"(:/{1,2})([^\s/@:'\"]*:(?!:|\d+(/|\s|$))((?!::)[^\s'\"])*@|[^\s/@'\"]*@)"
)
_QUERY = re.compile(r"(:/{1,2}[^\s?'\"]*)\?((?!::)[^\s'\"])*?(?=:?(\s|['\"]|::|$))")
_FIELD = re.compile(r"`([a-z]\w*)`")
"""An argument in a message: `robot_poses`."""
NO_WHEELS = {
    ("colmap", "Linux", "aarch64"): (
        "which has no wheel for Linux arm64: make the model with COLMAP itself"
        " (apt-get install colmap), models are read without pycolmap; or reconstruct on another"
        " computer"
    ),
    ("ros2", "Linux", "aarch64"): (
        "and cyclonedds has no wheel for Linux arm64: build it there from its source package and"
        " Cyclone DDS, or run evercal on another computer of the same network"
    ),
}
"""The way on where an extra has no wheels, by extra, system and machine."""


class InputError(Exception):
    """Misuse or bad input.

    The message is one line that names the thing, shows what came and says what to do next. The
    command line prints it and exits with status 2; anything else that is raised is a bug. Line
    breaks become spaces, and other control characters are escaped: names from damaged files can
    hold any character. Addresses are shown without secrets. Arguments stand in backquotes, by their
    names in Python.
    """

    def __init__(self, message: str = ""):
        text = str(message)
        if len(text) > _LONGEST:
            text = f"{text[:_LONGEST]} ..."
        super().__init__(printable(without_secrets(" ".join(text.splitlines()))))

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the arguments that the message is about."""
        return tuple(_FIELD.findall(str(self)))


class UnavailableError(InputError):
    """A map that cannot be read now; status 503 of the service."""


def without_secrets(text: str) -> str:
    """A text whose addresses lack user, password and query; also chained, and as paths (`s3:/`)."""
    return _QUERY.sub(r"\1", _USER.sub(r"\1", text))


def with_options(text: str) -> str:
    """A text for a terminal: `robot_poses` becomes --robot-poses."""
    return _FIELD.sub(lambda match: "--" + match[1].replace("_", "-"), text)


def is_plain(character: str) -> bool:
    """Whether a terminal shows a character; it may be a wide or unbreakable space."""
    return character.isprintable() or unicodedata.category(character) == "Zs"


def printable(text: str) -> str:
    """Escape the characters that a terminal obeys or that cannot be seen, but line breaks."""
    characters = []
    for character in text:
        if not is_plain(character) and character != "\n":
            character = character.encode("unicode_escape").decode()
        characters.append(character)
    return "".join(characters)


def require_numbers(
    options: object, names: Iterable[str], least: float, most: float = math.inf
) -> None:
    """Refuse an options record with a field that is not a finite number from `least` to `most`."""
    allowed = f"{least:g} or more"
    if most < math.inf:
        allowed = f"{least:g} to {most:g}"
    for name in names:
        value = getattr(options, name)
        if not (math.isfinite(value) and least <= value <= most):
            kind = type(options).__name__
            raise InputError(f"{kind}.{name} is {value}; it is a number, {allowed}")


def missing_extra(need: str, extra: str) -> InputError:
    """Return the error for an optional package that is not installed.

    Args:
        need: What needs which package, such as "a client needs urllib3".
        extra: The extra of evercal that holds it.
    """
    way_on = NO_WHEELS.get((extra, platform.system(), platform.machine()))
    if way_on:
        return InputError(f"{need}, {way_on}")
    command = f"python -m pip install -c constraints.txt '.[{extra}]'"
    return InputError(f"{need}; in the checkout of evercal, run: {command}")


def optional_module(name: str, need: str, extra: str) -> Any:
    """Import a module of an optional package, or raise the error of `missing_extra`."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise missing_extra(need, extra) from None
