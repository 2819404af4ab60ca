"""Malformed requests as bytes, drawn at random from a seed."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable
from functools import cache

PATHS = ("/localize", "/calibrations", "/check", "/nowhere")


def _request(
    method: str, path: str, body: bytes, kind: str, length: int | None = None
) -> bytes:
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    head += f"Content-Type: {kind}\r\nContent-Length: {len(body) if length is None else length}\r\n"
    return (head + "\r\n").encode("latin-1", "replace") + body


def _form(*parts: tuple[str, str, bytes]) -> bytes:
    body = b""
    for name, file, data in parts:
        body += b"--edge\r\nContent-Disposition: form-data; "
        body += (
            f'name="{name}"; filename="{file}"'.encode() + b"\r\n\r\n" + data + b"\r\n"
        )
    return body + b"--edge--\r\n"


def _garbage(rng: random.Random, most: int = 3000) -> bytes:
    return rng.randbytes(rng.randrange(most))


@cache
def png(side: int, kind: int = 0, size: int | None = None) -> bytes:
    """A black image of side x side pixels; the data of `size` bytes need not fit the header."""

    def chunk(name: bytes, data: bytes) -> bytes:
        checked = name + data
        return (
            struct.pack(">I", len(data))
            + checked
            + struct.pack(">I", zlib.crc32(checked))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, kind, 0, 0, 0))
    data = chunk(
        b"IDAT", zlib.compress(bytes((side + 1) * side if size is None else size))
    )
    return b"\x89PNG\r\n\x1a\n" + header + data + chunk(b"IEND", b"")


PNG = png(8)


def _bomb_png(rng: random.Random) -> bytes:
    """A small file that would be gigabytes of pixels."""
    return png(rng.choice([10_000, 30_000, 2**31 - 1]), rng.choice([0, 2, 6]), 100_000)


def _deep(rng: random.Random) -> bytes:
    escape = {"path": "../" * rng.randrange(1, 50) + "etc/passwd"}
    values = [
        b"[" * 50_000,
        b'{"a":' * 20_000,
        b"1e999",
        b"\xff\xfe",
        b"null",
        b"{}",
        json.dumps(escape).encode(),
    ]
    return rng.choice(values)


def _table(rng: random.Random) -> bytes:
    """A pose table, or intrinsics, that take long: long names and cells, many columns or rows."""
    many = rng.choice([1_000, 30_000, 300_000])
    rows = [
        "x,y,z,qw,qx,qy,qz\n" + "1" * many + ",0,0,1,0,0,0\n" + "0,0,0,1,0,0,0\n" * 200,
        "image,x" + "_" * many + ",y,z,qw,qx,qy,qz\n" + "a,0,0,0,1,0,0,0\n" * 9,
        "image,x,y,z,qw,qx,qy,qz\n" + "same.png,0,0,0,1,0,0,0\n" * (many // 20),
        "x,y,z,qw,qx,qy,qz" + ",a" * many + "\n" + "0," * (many + 7) + "\n",
        "p[" * (many // 2) + "]" * (many // 2),
        "{" * many + "X 1, Y 2",
        "a: &a [1, 2]\nb: &b [*a, *a]\ncamera_matrix: [*b, *b, *b]\n",
        "camera_matrix: " + "[" * min(many, 30_000) + "]" * min(many, 30_000),
        "image_width: " + "9" * min(many, 30_000),
        "- " * min(many, 30_000),
    ]
    return rng.choice(rows).encode()


def _text(rng: random.Random) -> bytes:
    """Intrinsics, poses or a calibration beside an image that is none."""
    name = rng.choice(["camera", "calibration", "robot_poses"])
    path = {"calibration": "/check", "robot_poses": "/calibrations"}.get(
        name, "/localize"
    )
    image = "image" if path == "/localize" else "images"
    body = _form(
        (name, rng.choice(["a.csv", "a.json", "a.yaml", ""]), _table(rng)),
        (image, "a", PNG),
    )
    return _request("POST", path, body, "multipart/form-data; boundary=edge")


def _wrong_length(rng: random.Random) -> bytes:
    length = rng.choice([10**12, 10**30])
    return _request(
        "POST", rng.choice(PATHS[:3]), b"x", "application/octet-stream", length=length
    )


def _images(rng: random.Random) -> bytes:
    data = rng.choice([_garbage, _bomb_png, _deep])(rng)
    name = rng.choice(
        ["image", "images", "camera", "calibration", "robot_poses", "x" * 500]
    )
    body = _form(
        (name, rng.choice(["a.png", "../../a", "a\0b", ""]), data),
        ("images", "b", data),
    )
    cut = rng.randrange(len(body)) if rng.random() < 0.3 else len(body)
    kind = rng.choice(
        ["multipart/form-data; boundary=edge", "multipart/form-data", "a/b; charset=x"]
    )
    return _request("POST", rng.choice(PATHS[:3]), body[:cut], kind)


def _traversal(rng: random.Random) -> bytes:
    up = rng.choice(
        ["..%2F", "%2e%2e/", "../", "..\\", "%c0%ae%c0%ae/"]
    ) * rng.randrange(1, 9)
    method = rng.choice(["GET", "DELETE", "PUT"])
    return _request(method, f"/scenes/{up}etc/passwd", b"", "text/plain")


def _no_http(rng: random.Random) -> bytes:
    return b"\x00" + _garbage(rng) + b"\r\n\r\n"


KINDS: tuple[Callable[[random.Random], bytes], ...] = (
    _images, _images, _images, _text, _text, _traversal, _wrong_length, _no_http,
)  # fmt: skip


def malformed(seed: int) -> bytes:
    """A request that no service may accept."""
    rng = random.Random(seed)
    return rng.choice(KINDS)(rng)


def heavy(seed: int) -> bytes:
    """A request for black images that are small as files and large as pixels."""
    rng = random.Random(seed)
    data = png(3_900)[:-8]
    body = _form(*[("images", f"{i}.png", data) for i in range(rng.choice([1, 25]))])
    return _request("POST", "/calibrations", body, "multipart/form-data; boundary=edge")
