"""Malformed requests as bytes, drawn at random from a seed."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable

PATHS = ("/localize", "/calibrations", "/check", "/nowhere")


def request(
    method: str, path: str, body: bytes, kind: str, more: str = "", length: int | None = None
) -> bytes:
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
    head += f"Content-Type: {kind}\r\nContent-Length: {len(body) if length is None else length}\r\n"
    return (head + more + "\r\n").encode("latin-1", "replace") + body


def form(*parts: tuple[str, str, bytes], boundary: bytes = b"edge") -> bytes:
    body = b""
    for name, file, data in parts:
        body += b"--" + boundary + b"\r\nContent-Disposition: form-data; "
        body += f'name="{name}"; filename="{file}"'.encode() + b"\r\n\r\n" + data + b"\r\n"
    return body + b"--" + boundary + b"--\r\n"


def garbage(rng: random.Random, most: int = 3000) -> bytes:
    return rng.randbytes(rng.randrange(most))


def bomb_png(rng: random.Random) -> bytes:
    """A small file that decodes to gigabytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    side = rng.choice([10_000, 30_000, 2**31 - 1])
    header = struct.pack(">IIBBBBB", side, side, 8, rng.choice([0, 2, 6]), 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(bytes(100_000)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


def deep(rng: random.Random) -> bytes:
    values: list[bytes] = [b"[" * 50_000, b'{"a":' * 20_000, b"1e999", b"\xff\xfe", b"null", b"{}"]
    values += [json.dumps({"path": "../" * rng.randrange(1, 50) + "etc/passwd"}).encode()]
    return rng.choice(values)


def _wrong_length(rng: random.Random) -> bytes:
    length = rng.choice([10**12, 10**30])
    return request("POST", rng.choice(PATHS[:3]), b"x", "application/octet-stream", length=length)


def _images(rng: random.Random) -> bytes:
    data = rng.choice([garbage, bomb_png, deep])(rng)
    name = rng.choice(["image", "images", "camera", "calibration", "robot_poses", "x" * 500])
    body = form((name, rng.choice(["a.png", "../../a", "a\0b", ""]), data), ("images", "b", data))
    cut = rng.randrange(len(body)) if rng.random() < 0.3 else len(body)
    kind = rng.choice(
        ["multipart/form-data; boundary=edge", "multipart/form-data", "a/b; charset=x"]
    )
    return request("POST", rng.choice(PATHS[:3]), body[:cut], kind)


def _traversal(rng: random.Random) -> bytes:
    up = rng.choice(["..%2F", "%2e%2e/", "../", "..\\", "%c0%ae%c0%ae/"]) * rng.randrange(1, 9)
    method = rng.choice(["GET", "DELETE", "PUT"])
    return request(method, f"/scenes/{up}etc/passwd", b"", "text/plain")


def _no_http(rng: random.Random) -> bytes:
    return b"\x00" + garbage(rng) + b"\r\n\r\n"


KINDS: tuple[Callable[[random.Random], bytes], ...] = (
    _images, _images, _images, _traversal, _wrong_length, _no_http,
)  # fmt: skip


def malformed(seed: int) -> bytes:
    """A request that no service may accept."""
    rng = random.Random(seed)
    return rng.choice(KINDS)(rng)
