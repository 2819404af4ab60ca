"""Rectangles with images as one binary glTF file: a browser draws all of them at once."""

import json
import math
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.images import encode_jpeg
from evercal.reports.scene.map_parts import resized

Array = NDArray[np.floating]
Image = NDArray[np.uint8]

MOST_PX = 4096
"""Largest side of a texture that every browser accepts."""
_JPEG_QUALITY = 75
_FLOAT, _UINT = 5126, 5125
_GLB_JSON, _GLB_BINARY = 0x4E4F534A, 0x004E4942


def images_glb(corners_m: Array, images: Sequence[Image], width: int) -> bytes:
    """A mesh of rectangles that show images unshaded from both sides.

    Args:
        corners_m: (n, 4, 3) top left, top right, bottom right, bottom left.
        images: (n,) RGB.
        width: of an image in the texture, pixels; smaller if many would not fit.
    """
    texture, places = atlas(images, width)
    count = len(images)
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 2, 1], [0, 3, 2]])
    points = np.ascontiguousarray(corners_m, np.float32).reshape(-1, 3)
    parts = [
        points.tobytes(),
        places.astype(np.float32).tobytes(),
        faces.astype(np.uint32).tobytes(),
        encode_jpeg(texture, _JPEG_QUALITY),
    ]
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    limits = {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    accessors = [
        {"bufferView": 0, "componentType": _FLOAT, "count": 4 * count, "type": "VEC3", **limits},
        {"bufferView": 1, "componentType": _FLOAT, "count": 4 * count, "type": "VEC2"},
        {"bufferView": 2, "componentType": _UINT, "count": 6 * count, "type": "SCALAR"},
    ]
    scene = _UNSHADED | {
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return _packed(json.dumps(scene).encode(), binary)


def atlas(images: Sequence[Image], width: int) -> tuple[Image, Array]:
    """All images in one, and where their corners are, (n, 4, 2) as shares of its sides.

    Each image keeps half a pixel from its borders, so that neighbours do not shine through.
    """
    columns = math.ceil(math.sqrt(len(images)))
    rows = math.ceil(len(images) / columns)
    aspect = max(image.shape[0] / image.shape[1] for image in images)
    width = max(1, min(width, MOST_PX // columns, int(MOST_PX / (rows * aspect))))
    small = [resized(image, width) for image in images]
    height = max(image.shape[0] for image in small)
    whole = np.zeros((rows * height, columns * width, 3), np.uint8)
    places = np.zeros((len(small), 4, 2))
    for i, image in enumerate(small):
        top, left = height * (i // columns), width * (i % columns)
        whole[top : top + image.shape[0], left : left + width] = image
        low = np.array([left, top]) + 0.5
        high = np.array([left + width, top + image.shape[0]]) - 0.5
        places[i] = [low, (high[0], low[1]), high, (low[0], high[1])]
    return whole, places / (whole.shape[1], whole.shape[0])


_UNSHADED = {
    "asset": {"version": "2.0"},
    "extensionsUsed": ["KHR_materials_unlit"],
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [
        {
            "primitives": [
                {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
            ]
        }
    ],
    "materials": [
        {
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
            "doubleSided": True,
            "extensions": {"KHR_materials_unlit": {}},
        }
    ],
    "textures": [{"source": 0}],
    "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
}


def _packed(scene: bytes, binary: bytes) -> bytes:
    """The container: a header and two chunks."""
    scene += b" " * (-len(scene) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(scene) + 8 + len(binary))
    chunks = struct.pack("<II", len(scene), _GLB_JSON) + scene
    return head + chunks + struct.pack("<II", len(binary), _GLB_BINARY) + binary
