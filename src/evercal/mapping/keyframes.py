"""Keyframes: the frames of a scene that are stored.

They are grey JPEG images at working size and not features: an image of 320x240 takes about 25 kB,
its 1,200 features of 128 half floats 307 kB. The frozen encoder computes the same features from the
image in milliseconds. A map adds depths, landmarks and a descriptor to each.
"""

from collections.abc import Callable, Sequence, Sized
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.features.views import working_image
from evercal.geometry import SE3, Camera
from evercal.mapping.landmarks import Landmarks
from evercal.recordings.frame import Frame
from evercal.recordings.images import encode_jpeg
from evercal.typing import IntArray, Record

JPEG_QUALITY = 95
"""Quality of stored images, percent."""
Part = TypeVar("Part")
_LANDMARK_FIELDS = ("pixels", "inverse_depth", "slope", "sigma")
"""Fields of `Landmarks`, in order; 20 bytes a landmark."""
_STORED = {
    "images": (np.uint8, ()),
    "lengths": (np.int64, ()),
    "cameras": (np.float64, (14,)),
    "distortion": (np.int64, ()),
    "poses": (np.float64, (7,)),
    "inverse_depth": (np.float16, ()),
    "cells": (np.int64, ()),
    "descriptors": (np.float16, None),
    "landmark_counts": (np.int64, ()),
    "landmark_pixels": (np.int16, (2,)),
    "landmark_inverse_depth": (np.float32, ()),
    "landmark_slope": (np.float32, (2,)),
    "landmark_sigma": (np.float32, ()),
}
"""Type of the numbers of each stored array, and shape of its rows."""


@frozen
class Keyframes:
    """The stored frames of one scene."""

    images: Sequence[bytes]
    """Grey JPEG files at working size."""
    cameras: tuple[Camera, ...]
    """Intrinsics at working size, one per image."""
    base_from_camera: SE3
    """(n,) poses in the scene's base frame."""
    inverse_depth: Sequence[NDArray[np.float16]] = ()
    """(cells,) half floats of each image, per metre along the optical axis; empty without a map."""
    landmarks: Sequence[Landmarks] = ()
    """Of each image; empty without a map."""
    descriptors: NDArray[np.float16] | None = None
    """(n, width) VLAD of each image, half floats; None without a map."""

    @cached_property
    def bytes(self) -> int:
        """Size of `to_tensors`."""
        return sum(tensor.nbytes for tensor in self.to_tensors().values())

    def __len__(self) -> int:
        return len(self.images)

    def take(self, index: IntArray) -> "Keyframes":
        """The keyframes of an index."""
        descriptors = self.descriptors
        if descriptors is not None:
            descriptors = descriptors[index]
        return Keyframes(
            images=_taken(self.images, index),
            cameras=_taken(self.cameras, index),
            base_from_camera=self.base_from_camera[index],
            inverse_depth=_taken(self.inverse_depth, index),
            landmarks=_taken(self.landmarks, index),
            descriptors=descriptors,
        )

    def joined(self, other: "Keyframes") -> "Keyframes":
        """These keyframes and those of another map of the same encoder."""
        assert self.descriptors is not None, "a map has descriptors"
        assert other.descriptors is not None, "a map has descriptors"
        poses = [*self.base_from_camera, *other.base_from_camera]
        return Keyframes(
            images=(*self.images, *other.images),
            cameras=self.cameras + other.cameras,
            base_from_camera=SE3.stack(poses),
            inverse_depth=(*self.inverse_depth, *other.inverse_depth),
            landmarks=(*self.landmarks, *other.landmarks),
            descriptors=np.concatenate([self.descriptors, other.descriptors]),
        )

    def grey(self, i: int) -> np.ndarray:
        """(h, w) uint8 image of a keyframe, decoded."""
        import cv2

        grey = cv2.imdecode(
            np.frombuffer(self.images[i], np.uint8), cv2.IMREAD_GRAYSCALE
        )
        if grey is None:
            raise InputError(f"keyframe {i} is no image; restore the map from a copy")
        return np.asarray(grey, np.uint8)

    def frames(self) -> list[Frame]:
        """The keyframes, decoded."""
        frames = []
        for i, pose in enumerate(self.base_from_camera):
            image = np.repeat(self.grey(i)[..., None], 3, axis=-1)
            frames.append(Frame(f"memory-{i:05d}", image, self.cameras[i], pose))
        return frames

    def to_tensors(self) -> dict[str, NDArray[Any]]:
        """Convert to named arrays.

        Returns:
            `images` (bytes, concatenated), `lengths` (n,), `cameras` (n, 14), `distortion` (n,)
            number of coefficients, negative of a fisheye, `poses` (n, 7) quaternion wxyz and
            metres. With depths also `inverse_depth` (concatenated) and `cells` (n,). With landmarks
            also their fields (concatenated, `landmark_*`), `landmark_counts` (n,) and `descriptors`
            (n, width).
        """
        cameras = np.zeros((len(self.images), 14))
        distortion = np.zeros(len(self.images), np.int64)
        for i, c in enumerate(self.cameras):
            count = len(c.distortion)
            cameras[i, :6] = c.width, c.height, c.fx, c.fy, c.cx, c.cy
            cameras[i, 6 : 6 + count] = c.distortion
            distortion[i] = count
            if c.model == "fisheye":
                distortion[i] = -count
        pose = self.base_from_camera
        poses = np.concatenate([pose.rotation_wxyz, pose.translation_m], -1)
        tensors = {
            "images": np.frombuffer(b"".join(self.images), np.uint8).copy(),
            "lengths": _lengths(self.images),
            "cameras": cameras,
            "distortion": distortion,
            "poses": poses.reshape(-1, 7),
        }
        if self.inverse_depth:
            tensors["inverse_depth"] = np.concatenate(self.inverse_depth)
            tensors["cells"] = _lengths(self.inverse_depth)
        if self.descriptors is not None:
            tensors["descriptors"] = self.descriptors
        if self.landmarks:
            tensors["landmark_counts"] = _lengths(self.landmarks)
            for field in _LANDMARK_FIELDS:
                values = [getattr(marks, field) for marks in self.landmarks]
                name = f"landmark_{field}"
                kind, _ = _STORED[name]
                tensors[name] = np.concatenate(values).astype(kind)
        return tensors

    @classmethod
    def from_tensors(cls, tensors: Record) -> "Keyframes":
        """The inverse of `to_tensors`.

        Arrays of `storage.tensors.open_tensors` stay in their file: images, depths and landmarks
        are read when they are used, so that processes share the memory.
        """
        for name, array in tensors.items():
            kind, row = _STORED[name]
            if array.dtype != kind or row not in (None, array.shape[1:]):
                raise ValueError(f"{name} is {array.dtype}, {array.shape}")
        cameras = []
        counts = tensors["distortion"][:].tolist()
        for row, count in zip(tensors["cameras"][:].tolist(), counts, strict=True):
            model = "pinhole"
            if count < 0:
                model = "fisheye"
            distortion = row[6 : 6 + abs(count)]
            cameras.append(Camera(*row[:6], distortion=distortion, model=model))
        poses = tensors["poses"][:]
        depths: Sequence[NDArray[np.float16]] = ()
        landmarks: Sequence[Landmarks] = ()
        if "cells" in tensors:
            inverse = tensors["inverse_depth"]
            depths = _Parts(tensors["cells"][:], (inverse,), lambda part: inverse[part])
        if "landmark_counts" in tensors:
            stored = [tensors[f"landmark_{name}"] for name in _LANDMARK_FIELDS]
            landmarks = _Parts(
                tensors["landmark_counts"][:],
                stored,
                lambda part: Landmarks(
                    *(field[part].astype(float) for field in stored)
                ),
            )
        images = tensors["images"]
        lengths = tensors["lengths"][:]
        descriptors = None
        if "descriptors" in tensors:
            descriptors = tensors["descriptors"][:]
        return cls(
            images=_Parts(lengths, (images,), lambda part: images[part].tobytes()),
            cameras=tuple(cameras),
            base_from_camera=SE3(poses[:, :4], poses[:, 4:]),
            inverse_depth=depths,
            landmarks=landmarks,
            descriptors=descriptors,
        )


class _Parts(Sequence[Part]):
    """Parts of stored arrays, one for each keyframe."""

    def __init__(
        self,
        counts: IntArray,
        stored: Sequence[Any],
        read: Callable[[slice], Part],
    ):
        lengths = _lengths(stored)
        if (counts < 0).any() or (lengths != counts.sum()).any():
            raise ValueError(
                f"parts of {counts.tolist()[:9]} rows do not make up their arrays"
            )
        self._ends = [0, *np.cumsum(counts).tolist()]
        self._read = read

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return tuple(self[k] for k in range(*i.indices(len(self))))
        i = range(len(self))[i]
        return self._read(slice(self._ends[i], self._ends[i + 1]))


def _taken(parts: Sequence[Part], index: IntArray) -> tuple[Part, ...]:
    """Parts of some keyframes; none where no keyframe has any."""
    if not parts:
        return ()
    return tuple(parts[i] for i in index)


def _lengths(parts: Sequence[Sized]) -> IntArray:
    return np.array([len(part) for part in parts], np.int64)


def store_keyframes(frames: Sequence[Frame], short_side: int) -> Keyframes:
    """Store frames at working size."""
    images = []
    cameras = []
    for frame in frames:
        grey, camera = working_image(frame.read_image(), frame.camera, short_side)
        images.append(jpeg(grey))
        cameras.append(camera)
    poses = [frame.base_from_camera or SE3.identity() for frame in frames]
    return Keyframes(tuple(images), tuple(cameras), SE3.stack(poses))


def jpeg(grey: np.ndarray) -> bytes:
    """Encode a (h, w) uint8 image of a keyframe."""
    return encode_jpeg(grey, JPEG_QUALITY)
