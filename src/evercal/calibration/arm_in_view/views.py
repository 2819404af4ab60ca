"""`ArmViews`: images of an arm before a background that stands still, and what differs from it."""

from collections.abc import Sequence
from typing import Self

import cv2
import numpy as np

from evercal.geometry import Camera
from evercal.recordings.frame import Frame
from evercal.robot.link_shapes import RobotBody
from evercal.typing import Array, BoolArray, Float32Array, Image

MOVES = 8.0
"""A pixel that differs from the background by this many standard deviations of the noise moves."""
LEAST_NOISE = 1.0
"""Least standard deviation of the intensities of any camera."""
LEAST_UNCOVERED = 2
"""Images in which a pixel of the background must be uncovered to be known."""
_SMOOTHING_PX = 0.7
"""Standard deviation of the filter that suppresses noise of pixels."""
_DARK = 20
"""Darker pixels do not count in the brightness of an image."""


class ArmViews:
    """Images of an arm by one fixed camera, without distortion."""

    images: Image
    """(n, h, w, 3) uint8."""
    valid: BoolArray
    """(h, w) pixels that the distorted images cover."""
    difference: Float32Array
    """(n, h, w) largest difference of the channels from the background."""
    known: BoolArray
    """(h, w) whether the background of a pixel is known."""
    uncovered: BoolArray
    """(h, w) pixels that the arm covers in no image, as far as its pose is known."""
    noise: float
    """Standard deviation of `difference` where nothing moves."""

    def __init__(
        self,
        images: Image,
        valid: BoolArray,
        camera: Camera,
        body: RobotBody,
        values: Array,
    ) -> None:
        self.images = images
        self.valid = valid
        self.camera = camera
        self.body = body
        self.values = values
        middle = np.median(images, 0)
        self.uncovered = valid
        self._of_same_brightness(middle)
        self._set_background(middle.astype(np.float32), valid)

    @classmethod
    def of(cls, frames: Sequence[Frame], body: RobotBody) -> Self:
        """Read the images of frames of one camera with joint values."""
        camera = frames[0].camera
        plane = camera.pinhole
        x, y = camera.project(plane.unproject(_pixels_of(plane))).astype(np.float32).T
        size = camera.height, camera.width
        valid = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        images = []
        for frame in frames:
            image = frame.read_image()
            if camera != plane:
                pixels = x.reshape(size), y.reshape(size)
                image = cv2.remap(image, *pixels, cv2.INTER_LINEAR)
            images.append(cv2.GaussianBlur(image, (3, 3), _SMOOTHING_PX))
        values = np.array([frame.joints_rad for frame in frames])
        return cls(np.stack(images), valid.reshape(size), plane, body, values)

    def __len__(self) -> int:
        return len(self.images)

    def _of_same_brightness(self, middle: Array) -> None:
        """Compute the gains (n, 3) of the images against their median over time."""
        bright = self.valid & (middle.min(-1) > _DARK)
        self._gains = np.ones((len(self), 3), np.float32)
        if not bright.any():
            return
        reference = middle[bright]
        for i, image in enumerate(self.images):
            self._gains[i] = np.median(reference / np.maximum(image[bright], 1), 0)

    def _corrected(self, i: int) -> Float32Array:
        return self.images[i] * self._gains[i]

    def signed(self, i: int) -> Float32Array:
        """(h, w, 3) image `i`, at the brightness of the background, minus the background."""
        return self._corrected(i) - self._background

    def _set_background(self, background: Float32Array, known: BoolArray) -> None:
        self._background = background
        self.known = known & self.valid
        self.difference = np.empty(self.images.shape[:3], np.float32)
        for i in range(len(self)):
            apart = cv2.absdiff(self._corrected(i), background)
            self.difference[i] = apart.max(-1)
        noise = np.median(self.difference[:, self.known]) / 0.67
        self.noise = max(LEAST_NOISE, float(noise))

    def learn_background(self, covered: BoolArray) -> None:
        """Take the median of the images in which the arm does not cover a pixel, (n, h, w)."""
        self.uncovered = self.valid & ~covered.any(0)
        count = (~covered).sum(0)
        some = covered.any(0) & (count > 0)
        colours = np.stack([self._corrected(i)[some] for i in range(len(self))])
        colours[covered[:, some]] = np.inf
        colours.sort(0)
        middle = (count[some] - 1) // 2
        background = self._background.copy()
        background[some] = np.take_along_axis(colours, middle[None, :, None], 0)[0]
        self._set_background(background, count >= LEAST_UNCOVERED)

    def masks(self, scale: float) -> Float32Array:
        """(n, h, w) share of moving pixels, at a smaller scale."""
        width = round(self.camera.width * scale)
        height = round(self.camera.height * scale)
        small = []
        for difference in self.difference:
            moves = (difference > MOVES * self.noise).astype(np.uint8)
            moves = cv2.morphologyEx(moves, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            moves = cv2.morphologyEx(moves, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
            share = moves.astype(np.float32)
            small.append(cv2.resize(share, (width, height), None, 0, 0, cv2.INTER_AREA))
        return np.stack(small)


def _pixels_of(camera: Camera) -> Array:
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([x.ravel(), y.ravel()], 1).astype(float)
