"""Random damage to files, drawn from a seed."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from typing import Any

NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
NUMBERS = (
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e999",
    b"-1e308",
    b"99999999999999999999",
    b"0.1",
    b"",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1e300,
    10**30,
    "",
    "x" * 50,
    [],
    {},
    [[]],
    [1, "a"],
)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """The content of a file after one kind of damage."""
    return rng.choice(DAMAGE)(data, rng)


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 30))):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _slice(data: bytes, rng: random.Random) -> tuple[int, int]:
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return a, b


def _cut(data: bytes, rng: random.Random) -> bytes:
    a, b = _slice(data, rng)
    return data[:a] + data[b:]


def _repeated(data: bytes, rng: random.Random) -> bytes:
    a, b = _slice(data, rng)
    return data[:b] + data[a:b] + data[b:]


def _truncated(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice((0, rng.randrange(len(data) + 1)))]


def _inserted(data: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(data) + 1)
    more = rng.choice(
        (rng.randbytes(20), b"\x00" * 8, b"\xff\xfe", b"\n\n", b"{[", b'"')
    )
    return data[:a] + more + data[a:]


def _other_number(data: bytes, rng: random.Random) -> bytes:
    found = list(NUMBER.finditer(data[:200_000]))
    if not found:
        return _flip(data, rng)
    for match in sorted(
        rng.sample(found, min(len(found), rng.choice((1, 1, 4)))), key=_from_end
    ):
        data = data[: match.start()] + rng.choice(NUMBERS) + data[match.end() :]
    return data


def _from_end(match: re.Match[bytes]) -> int:
    return -match.start()


def _other_value(data: bytes, rng: random.Random) -> bytes:
    """A value somewhere in a JSON document is another one, or is missing."""
    try:
        document = json.loads(data)
    except ValueError:
        return _other_number(data, rng)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        keys = node if isinstance(node, dict) else range(len(node))
        for key in keys:
            places.append((node, key))
            if isinstance(node[key], dict | list):
                visit(node[key])

    if not isinstance(document, dict | list) or not document:
        return _flip(data, rng)
    visit(document)
    node, key = rng.choice(places)
    if rng.random() < 0.3:
        del node[key]
    else:
        node[key] = rng.choice(VALUES)
    return json.dumps(document).encode()


DAMAGE: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip,
    _cut,
    _repeated,
    _truncated,
    _inserted,
    _other_number,
    _other_number,
    _other_value,
    _other_value,
)
