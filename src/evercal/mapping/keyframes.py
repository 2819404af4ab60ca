"""What stays of a scene: a few frames, as the encoder saw them, counted in bytes.

The frames are kept as grey JPEG images at working size, not as feature rows: an image of 320x240
takes about 25 kB, its 1,200 rows of 128 half floats 307 kB. From the image, the frozen encoder
makes the same rows again in milliseconds, and augmented views besides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from evercal.datasets.frame import Frame
from evercal.features.views import working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3

JPEG_QUALITY = 95


@dataclass(frozen=True)
class Keyframes:
    """A few frames of one scene that stay with it."""

    images: tuple[bytes, ...]
    """Grey JPEG files at working size."""
    cameras: tuple[Camera, ...]
    """Intrinsics at working size, one per image."""
    base_from_camera: SE3
    """(n,) poses in the scene's base frame."""
    inverse_depth: tuple[Tensor, ...] = ()
    """(cells,) half floats of each image, per metre along the optical axis; none where a strategy
    does not match keyframes."""

    @property
    def bytes(self) -> int:
        """Size of `to_tensors`: images, their lengths, poses, intrinsics and inverse depths."""
        depths = sum(depth.nbytes + 8 for depth in self.inverse_depth)
        return sum(map(len, self.images)) + len(self.images) * 8 * (1 + 14 + 1 + 7) + depths

    def frames(self) -> list[Frame]:
        """The remembered frames, decoded."""
        import cv2

        frames = []
        for i, data in enumerate(self.images):
            grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
            assert grey is not None, "a remembered image always decodes: its file is checksummed"
            image = np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
            frames.append(
                Frame(f"memory-{i:05d}", image, self.cameras[i], self.base_from_camera[i])
            )
        return frames

    def to_tensors(self) -> dict[str, Tensor]:
        """As named tensors.

        `images` (bytes, joined), `lengths` (n,), `cameras` (n, 14), `distortion` (n,) number of
        coefficients, `poses` (n, 7) quaternion wxyz and metres; with depths also `inverse_depth`
        (joined) and `cells` (n,), how many of each image.
        """
        joined = np.frombuffer(b"".join(self.images), np.uint8).copy()
        cameras = np.zeros((len(self.images), 14))
        for i, c in enumerate(self.cameras):
            cameras[i, :6] = c.width, c.height, c.fx, c.fy, c.cx, c.cy
            cameras[i, 6 : 6 + len(c.distortion)] = c.distortion
        poses = np.concatenate(
            [self.base_from_camera.rotation_wxyz, self.base_from_camera.translation_m], -1
        )
        depths = {}
        if self.inverse_depth:
            depths["inverse_depth"] = torch.cat(self.inverse_depth)
            depths["cells"] = torch.tensor([len(depth) for depth in self.inverse_depth])
        return depths | {
            "images": torch.from_numpy(joined),
            "lengths": torch.tensor([len(image) for image in self.images]),
            "cameras": torch.from_numpy(cameras),
            "distortion": torch.tensor([len(c.distortion) for c in self.cameras]),
            "poses": torch.from_numpy(poses.reshape(-1, 7)),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> "Keyframes":
        """The inverse of `to_tensors`."""
        joined = tensors["images"].numpy().tobytes()
        ends = np.cumsum(tensors["lengths"].numpy())
        images = tuple(
            joined[end - n : end] for end, n in zip(ends, tensors["lengths"].tolist(), strict=True)
        )
        cameras = []
        counts = tensors["distortion"].tolist()
        for row, count in zip(tensors["cameras"].tolist(), counts, strict=True):
            width, height, *rest = row
            distortion = tuple(rest[4 : 4 + count])
            fx, fy, cx, cy = rest[:4]
            cameras.append(Camera(int(width), int(height), fx, fy, cx, cy, distortion))
        poses = tensors["poses"].numpy()
        each: tuple[Tensor, ...] = ()
        if "cells" in tensors:
            each = tensors["inverse_depth"].split(tensors["cells"].tolist())
        return cls(images, tuple(cameras), SE3(poses[:, :4], poses[:, 4:]), each)


def store_keyframes(frames: Sequence[Frame], short_side: int) -> Keyframes:
    """Keeps frames at working size.

    Args:
        frames: posed frames, already selected.
        short_side: pixels of the shorter image side.
    """
    import cv2

    images, cameras = [], []
    for frame in frames:
        grey, camera = working_image(frame.read_image(), frame.camera, short_side)
        done, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        assert done, "OpenCV encodes any uint8 image"
        images.append(data.tobytes())
        cameras.append(camera)
    poses = [frame.base_from_camera or SE3.identity() for frame in frames]
    return Keyframes(tuple(images), tuple(cameras), SE3.stack(poses))
