"""Keyframes: the frames of a scene that are stored.

They are grey JPEG images at working size and not features: an image of 320x240 takes about 25 kB,
its 1,200 features of 128 half floats 307 kB. The frozen encoder computes the same features from the
image in milliseconds. A map adds depths, landmarks and a descriptor to each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.features.views import working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.landmarks import Landmarks
from evercal.recordings.frame import Frame
from evercal.recordings.images import encode_jpeg

JPEG_QUALITY = 95
_LANDMARK_FIELDS = {
    "pixels": np.int16,
    "inverse_depth": np.float32,
    "slope": np.float32,
    "sigma": np.float32,
}
"""Fields of `Landmarks`, in order, and how they are stored: 20 bytes a landmark."""


@dataclass(frozen=True)
class Keyframes:
    """The stored frames of one scene."""

    images: tuple[bytes, ...]
    """Grey JPEG files at working size."""
    cameras: tuple[Camera, ...]
    """Intrinsics at working size, one per image."""
    base_from_camera: SE3
    """(n,) poses in the scene's base frame."""
    inverse_depth: tuple[NDArray[np.float16], ...] = ()
    """(cells,) half floats of each image, per metre along the optical axis; empty without a map."""
    landmarks: tuple[Landmarks, ...] = ()
    """Of each image; empty without a map."""
    descriptors: NDArray[np.float16] | None = None
    """(n, width) VLAD of each image, half floats; None without a map."""

    @property
    def bytes(self) -> int:
        """Size of `to_tensors`."""
        return sum(tensor.nbytes for tensor in self.to_tensors().values())

    def __len__(self) -> int:
        return len(self.images)

    def take(self, index: NDArray[np.int64]) -> "Keyframes":
        """The keyframes of an index."""
        rows = index.tolist()
        return Keyframes(
            images=tuple(self.images[i] for i in rows),
            cameras=tuple(self.cameras[i] for i in rows),
            base_from_camera=self.base_from_camera[index],
            inverse_depth=tuple(self.inverse_depth[i] for i in rows) if self.inverse_depth else (),
            landmarks=tuple(self.landmarks[i] for i in rows) if self.landmarks else (),
            descriptors=None if self.descriptors is None else self.descriptors[index],
        )

    def grey(self, i: int) -> np.ndarray:
        """(h, w) uint8 image of a keyframe, decoded."""
        import cv2

        grey = cv2.imdecode(np.frombuffer(self.images[i], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert grey is not None, "stored images have checksums"
        return np.asarray(grey, np.uint8)

    def frames(self) -> list[Frame]:
        """The keyframes, decoded."""
        images = [np.repeat(self.grey(i)[..., None], 3, axis=-1) for i in range(len(self))]
        views = zip(images, self.cameras, self.base_from_camera, strict=True)
        return [Frame(f"memory-{i:05d}", *view) for i, view in enumerate(views)]

    def to_tensors(self) -> dict[str, NDArray[Any]]:
        """Convert to named arrays.

        Returns:
            `images` (bytes, concatenated), `lengths` (n,), `cameras` (n, 14), `distortion` (n,)
            number of coefficients, negative of a fisheye, `poses` (n, 7) quaternion wxyz and
            metres. With depths also `inverse_depth` (concatenated) and `cells` (n,). With landmarks
            also their fields (concatenated, `landmark_*`), `landmark_counts` (n,) and `descriptors`
            (n, width).
        """
        joined = np.frombuffer(b"".join(self.images), np.uint8).copy()
        cameras = np.zeros((len(self.images), 14))
        for i, c in enumerate(self.cameras):
            cameras[i, :6] = c.width, c.height, c.fx, c.fy, c.cx, c.cy
            cameras[i, 6 : 6 + len(c.distortion)] = c.distortion
        pose = self.base_from_camera
        poses = np.concatenate([pose.rotation_wxyz, pose.translation_m], -1)
        tensors = {
            "images": joined,
            "lengths": np.array([len(image) for image in self.images], np.int64),
            "cameras": cameras,
            "distortion": np.array([_signed_count(c) for c in self.cameras], np.int64),
            "poses": poses.reshape(-1, 7),
        }
        if self.inverse_depth:
            tensors["inverse_depth"] = np.concatenate(self.inverse_depth)
            tensors["cells"] = np.array([len(depth) for depth in self.inverse_depth], np.int64)
        if self.descriptors is not None:
            tensors["descriptors"] = self.descriptors
        if self.landmarks:
            counts = [len(marks) for marks in self.landmarks]
            tensors["landmark_counts"] = np.array(counts, np.int64)
            for name, kind in _LANDMARK_FIELDS.items():
                joined = np.concatenate([getattr(marks, name) for marks in self.landmarks])
                tensors[f"landmark_{name}"] = joined.astype(kind)
        return tensors

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[Any]]) -> "Keyframes":
        """The inverse of `to_tensors`."""
        joined = tensors["images"].tobytes()
        ends = np.cumsum(tensors["lengths"])
        images = tuple(
            joined[end - n : end] for end, n in zip(ends, tensors["lengths"].tolist(), strict=True)
        )
        cameras = zip(tensors["cameras"].tolist(), tensors["distortion"].tolist(), strict=True)
        poses = tensors["poses"]
        depths: tuple[NDArray[np.float16], ...] = ()
        if "cells" in tensors:
            depths = _split(tensors["inverse_depth"], tensors["cells"])
        return cls(
            images=images,
            cameras=tuple(
                Camera(
                    *row[:6],
                    distortion=row[6 : 6 + abs(k)],
                    model="fisheye" if k < 0 else "pinhole",
                )
                for row, k in cameras
            ),
            base_from_camera=SE3(poses[:, :4], poses[:, 4:]),
            inverse_depth=depths,
            landmarks=_landmarks_of(tensors) if "landmark_counts" in tensors else (),
            descriptors=tensors.get("descriptors"),
        )


def _landmarks_of(tensors: Mapping[str, NDArray[Any]]) -> tuple[Landmarks, ...]:
    counts = tensors["landmark_counts"]
    columns = [
        [part.astype(np.float64) for part in _split(tensors[f"landmark_{name}"], counts)]
        for name in _LANDMARK_FIELDS
    ]
    return tuple(Landmarks(*fields) for fields in zip(*columns, strict=True))


def _signed_count(camera: Camera) -> int:
    return len(camera.distortion) * (-1 if camera.model == "fisheye" else 1)


def _split(joined: NDArray[Any], counts: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    return tuple(np.split(joined, np.cumsum(counts)[:-1])) if len(counts) else ()


def store_keyframes(frames: Sequence[Frame], short_side: int) -> Keyframes:
    """Store frames at working size."""
    images, cameras = [], []
    for frame in frames:
        grey, camera = working_image(frame.read_image(), frame.camera, short_side)
        images.append(jpeg(grey))
        cameras.append(camera)
    poses = [frame.base_from_camera or SE3.identity() for frame in frames]
    return Keyframes(tuple(images), tuple(cameras), SE3.stack(poses))


def jpeg(grey: np.ndarray) -> bytes:
    """Encode a (h, w) uint8 image of a keyframe."""
    return encode_jpeg(grey, JPEG_QUALITY)
