"""Bounds on what a file or a request may hold; the variable `EVERCAL_LIMITS` changes them.

Whoever writes a file or sends a request decides how much work it makes. So sizes are checked before
the work: in headers before bodies, and before patterns, tables and decoders.
"""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from functools import cache
from typing import TypeVar

from evercal.classes import frozen
from evercal.errors import InputError

Kind = TypeVar("Kind", bound="Bounds")
VARIABLE = "EVERCAL_LIMITS"
"""Environment variable `NAME=NUMBER,...` of changed bounds; worker processes inherit it."""


class TooLargeError(InputError):
    """More than a bound allows; status 413 of the service."""


@frozen
class Bounds:
    """Sizes above which a file is refused."""

    name_characters: int = 200
    """Name of a scene, column, joint or key."""
    cell_characters: int = 1_000
    """Cell of a table."""
    columns: int = 1_000
    """Columns of a table."""
    text_bytes: int = 100_000_000
    """Text file."""
    nodes: int = 20_000
    """Values in a YAML file."""
    elements: int = 500_000
    """Elements of a URDF; a chain of 20,000 links has 140,000."""
    mesh_bytes: int = 200_000_000
    """All mesh files of a robot."""
    faces: int = 2_000_000
    """Triangles of all meshes of a robot."""
    numbers: int = 10_000_000
    """Numbers of an array, and cells of a table."""
    recording_files: int = 200_000
    """Files of a recording at an address."""
    recording_bytes: int = 50 * 10**9
    """Bytes of these files."""
    pixels: int = 100_000_000
    """Pixels of an image."""
    aspect: int = 5
    """Longer side of an image, as a multiple of its shorter side."""
    scans: int = 100
    """Scans of a JPEG file; progressive files have about ten."""
    depth: int = 50
    """Levels of nesting in a YAML file."""
    map_side: int = 4_000
    """Side of an image of a map, pixels."""
    manifest_bytes: int = 20_000_000
    """Manifest of a map."""
    archive_bytes: int = 20_000_000_000
    """All files of an archive."""
    archive_files: int = 200_000
    """Entries of an archive."""
    archive_ratio: int = 10
    """Size of its files as a multiple of its own size; maps are packed uncompressed."""
    tensor_header_bytes: int = 1_000_000
    """Header of a safetensors file."""


@frozen
class RequestBounds(Bounds):
    """Sizes above which a request is refused, and how many requests may wait."""

    text_bytes: int = 1_000_000
    """Intrinsics, robot poses or a calibration."""
    columns: int = 100
    """Columns of a table."""
    numbers: int = 50_000
    """Numbers of an array, and cells of a table."""
    pixels: int = 16_000_000
    """Pixels of one image."""
    header_bytes: int = 32 * 1024
    """Headers and path of a request."""
    body_bytes: int = 128 * 10**6
    """Body of a request with images."""
    request_pixels: int = 300 * 10**6
    """Pixels of all images of a request."""
    images: int = 500
    """Images of one calibration."""
    requests: int = 64
    """Requests whose body has arrived; those beyond are refused with status 429."""
    held_bytes: int = 256 * 10**6
    """Bytes of bodies that have arrived."""
    connections: int = 100
    """Open connections; the oldest without a request gives way to a new one."""
    streams: int = 8
    """Streams of frames among them."""
    frame_bytes: int = 8 * 10**6
    """A frame of a stream."""
    stream_bytes: int = 32 * 10**6
    """Frames of a stream that wait; the rest waits at the client."""
    wait_s: float = 10.0
    """Time for headers, for the next part of a body, and for reading an answer, seconds."""
    bytes_per_s: float = 250_000.0
    """Slowest body, after `wait_s`."""


_of_request: ContextVar[RequestBounds | None] = ContextVar("_of_request", default=None)


def bounds() -> Bounds:
    """The bounds in force: the default ones, changed by `EVERCAL_LIMITS`."""
    return _of_request.get() or _changed(Bounds, os.environ.get(VARIABLE, ""))


def request_bounds() -> RequestBounds:
    """The bounds of requests in force."""
    return _changed(RequestBounds, os.environ.get(VARIABLE, ""))


@contextmanager
def reading_a_request(limits: RequestBounds | None = None) -> Iterator[None]:
    """Bound what is read inside as a part of a request; by default with `request_bounds`."""
    token = _of_request.set(limits or request_bounds())
    try:
        yield
    finally:
        _of_request.reset(token)


@cache
def _changed(kind: type[Kind], changes: str) -> Kind:
    known = {field.name for field in fields(RequestBounds)}
    values = {}
    for change in filter(None, changes.split(",")):
        name, _, number = change.strip().partition("=")
        try:
            values[name] = int(float(number))
        except (ValueError, OverflowError):
            name = ""
        if name not in known:
            names = ", ".join(sorted(known))
            raise InputError(
                f"limit {change!r}: give NAME=NUMBER, the name one of {names}"
            )
    own = {field.name for field in fields(kind)}
    return kind(**{name: values[name] for name in own & values.keys()})


def require_at_most(count: int, name: str, what: str) -> None:
    """Raise ValueError if there is more of `what` than the bound of this name allows."""
    most = getattr(bounds(), name)
    if count > most:
        remedy = "add `limits`"
        if _of_request.get():
            remedy = "whoever runs the service can raise it by --limits"
        raise ValueError(
            f"{count:,} {what}, at most {most:,} are read; if it is right, {remedy}"
            f" {name}={count}"
        )


def require_image_size(width: int, height: int, name: str = "image") -> None:
    """Refuse an image with too many pixels, or with one side far longer than the other.

    The shorter side is resized to the working size, so the longer one decides the memory.
    """
    aspect = max(width, height) / max(1, min(width, height))
    try:
        require_at_most(width * height, "pixels", "pixels")
        require_at_most(math.ceil(aspect), "aspect", "times longer than wide")
    except ValueError as error:
        raise TooLargeError(f"{name} ({width}x{height}): {error}") from None
