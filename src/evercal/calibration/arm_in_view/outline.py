"""Outlines of an arm: points of its silhouette, and where the images show it.

The silhouette of a mesh consists of edges between a face that looks to the camera and one that
looks away. Those where the drawn arm ends are its outline: with them, the points on the links are
known, and pixels are not rounded.
"""

from typing import NamedTuple

import cv2
import numpy as np

from evercal.calibration.arm_in_view.views import ArmViews
from evercal.geometry import Camera, unit_vectors
from evercal.robot.link_shapes import LinkShape
from evercal.typing import Array, BoolArray, Float32Array, IntArray

_BESIDE_PX = 1.5
"""Distance from an outline at which the drawn arm ends, pixels; drawn pixels are rounded."""
_CONTRAST = 6.0
"""Differences from the background that are this many times the noise are the arm."""
_AROUND = 4.0
"""Length of the sides of an outline that are compared, pixels."""
_FINE_PX = 6.0
"""Up to this search distance, outlines are where intensities change most."""
_SIDE = 2.0
"""Length of the sides whose intensities are compared, pixels; hands of small arms are thin."""
_BLURRED = 1.0
"""Half of the width of a blurred edge, pixels."""
_INSIDE = 0.2
"""Least mean of the likeness of the inner side to the arm, -1 to 1."""
_OUTSIDE = -0.5
"""Largest mean of the outer side."""


class LinkEdges(NamedTuple):
    """Edges of the surface of a link, and the two faces beside each."""

    shape: LinkShape
    normals: Array
    """(faces, 3)."""
    vertices: IntArray
    """(edges, 2)."""
    faces: IntArray
    """(edges, 2); twice the same where it is not between two faces."""


class OutlinePoints(NamedTuple):
    """Points of an outline in one image."""

    link: IntArray
    """(m,) number of the link."""
    in_camera: Array
    """(m, 3)."""
    pixels: Array
    """(m, 2)."""
    normals: Array
    """(m, 2) away from the arm, unit vectors."""

    def at(self, chosen: BoolArray) -> "OutlinePoints":
        """Some of the points."""
        return OutlinePoints(
            self.link[chosen],
            self.in_camera[chosen],
            self.pixels[chosen],
            self.normals[chosen],
        )


def link_edges(shape: LinkShape) -> LinkEdges:
    """Find the edges of a mesh."""
    corners = shape.vertices[shape.faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    pairs = shape.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    owners = np.repeat(np.arange(len(shape.faces)), 3)
    pairs = np.sort(pairs, 1)
    edges, first, edge, count = np.unique(
        pairs, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    faces = np.stack([owners[first], owners[first]], 1)
    # The face of the last half edge is the other one.
    faces[edge.ravel(), 1] = owners
    faces[count != 2, 1] = faces[count != 2, 0]
    return LinkEdges(
        shape,
        unit_vectors(sides),
        edges,
        faces,
    )


def outline_points(
    edges: list[LinkEdges],
    camera_from_link: Array,
    camera: Camera,
    drawing: IntArray,
    spacing_px: float,
) -> OutlinePoints:
    """Points every `spacing_px` along the outline of an arm with link poses (links, 4, 4)."""
    parts = []
    for number, link in enumerate(edges):
        pose = camera_from_link[number]
        on_link, along = _sampled(
            link,
            pose,
            camera,
            spacing_px,
        )
        in_camera = on_link @ pose[:3, :3].T + pose[:3, 3]
        pixels = camera.project(in_camera)
        normals = np.stack([-along[:, 1], along[:, 0]], 1)
        owner = np.full(len(on_link), number)
        parts.append(
            OutlinePoints(
                owner,
                in_camera,
                pixels,
                normals,
            )
        )
    points = OutlinePoints(*map(np.concatenate, zip(*parts, strict=True)))
    right = _link_at(drawing, points.pixels + _BESIDE_PX * points.normals)
    left = _link_at(drawing, points.pixels - _BESIDE_PX * points.normals)
    outwards = (right == -1) & (left == points.link)
    inwards = (left == -1) & (right == points.link)
    sign = np.where(
        inwards,
        -1.0,
        1.0,
    )
    points = points._replace(normals=points.normals * sign[:, None])
    return points.at(outwards | inwards)


def _sampled(
    link: LinkEdges, pose: Array, camera: Camera, spacing_px: float
) -> tuple[Array, Array]:
    """(m, 3) points on the silhouette of a link, in its frame, and (m, 2) its direction."""
    position = -pose[:3, 3] @ pose[:3, :3]
    towards = position - link.shape.vertices[link.shape.faces[:, 0]]
    faces_camera = (towards * link.normals).sum(1) > 0
    first, second = link.faces.T
    is_open = first == second
    is_silhouette = is_open | (faces_camera[first] != faces_camera[second])
    ends = link.shape.vertices[link.vertices[is_silhouette]]
    pixels = camera.project(ends @ pose[:3, :3].T + pose[:3, 3])
    along = pixels[:, 1] - pixels[:, 0]
    length = np.hypot(*along.T)
    usable = length > 0
    ends = ends[usable]
    along = along[usable]
    length = length[usable]
    reached = np.cumsum(length)
    total = reached[-1] if len(reached) else 0.0
    at = np.arange(
        spacing_px / 2,
        total,
        spacing_px,
    )
    edge = np.searchsorted(reached, at)
    share = (reached[edge] - at) / length[edge]
    points = ends[edge, 1] + share[:, None] * (ends[edge, 0] - ends[edge, 1])
    return points, along[edge] / length[edge, None]


def _link_at(drawing: IntArray, pixels: Array) -> IntArray:
    """(m,) number of the link that is drawn at pixels (m, 2), -1 for none, -2 outside."""
    height, width = drawing.shape
    x, y = np.rint(pixels).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    numbers = np.full(len(pixels), -2)
    numbers[inside] = drawing[y[inside], x[inside]]
    return numbers


class Offsets(NamedTuple):
    """Where images show an outline."""

    px: Array
    """(m,) distance from the drawn outline along its normals."""
    confirmed: BoolArray
    """(m,) whether the image shows the end of the arm there."""
    testable: BoolArray
    """(m,) whether the background beside it is known."""


def image_offsets(
    views: ArmViews, i: int, points: OutlinePoints, reach_px: float
) -> Offsets:
    """Find where image `i` ends to differ from the background, along the normals of points."""
    if not len(points.link):  # the arm is beside the image
        none = np.zeros(0)
        return Offsets(none, none > 0, none > 0)
    is_fine = reach_px <= _FINE_PX
    step = 0.5 if is_fine else 1.0
    end = reach_px + _AROUND
    along = np.arange(-end, end + step / 2, step)
    normals = points.normals[:, None]
    grid = points.pixels[:, None] + along[:, None] * normals
    differs = _sampled_at(views.difference[i], grid)
    known = _sampled_at(views.known.astype(np.float32), grid) > 0.99
    contrast = differs / (_CONTRAST * views.noise)
    like = np.clip(contrast - 1, -1, 1) * known
    if is_fine:
        signed = _sampled_at(views.signed(i), grid)
        profile = _profile(signed, along)
        side = round(_SIDE / step)
        best = _best(_steps(profile, side), along, reach_px)
        crossing = _crossing(profile, best, side)
    else:
        # The best end of the arm: like it before, unlike it after.
        total = np.cumsum(like, 1)
        score = 2 * total - total[:, -1:]
        best = _best(score, along, reach_px)
        crossing = best + 0.5
    px = along[0] + step * crossing
    near = round(_AROUND / step)
    blurred = round(_BLURRED / step)
    around = _beside(like, best, near)
    inside = around[:, : near - blurred].mean(1)
    outside = around[:, near + blurred + 1 :].mean(1)
    confirmed = np.isfinite(px)
    confirmed &= np.abs(px) <= reach_px
    confirmed &= inside > _INSIDE
    confirmed &= outside < _OUTSIDE
    close = np.abs(along) <= _AROUND
    testable = np.all(known[:, close], 1)
    shown = np.where(confirmed, px, 0.0)
    return Offsets(shown, confirmed, testable)


def _beside(values: Array, at: IntArray, near: int) -> Array:
    """(m, 2 near + 1) values (m, k) around samples (m,)."""
    window = at[:, None] + np.arange(-near, near + 1)
    window = np.clip(
        window,
        0,
        values.shape[1] - 1,
    )
    return np.take_along_axis(
        values,
        window,
        1,
    )


def _best(score: Array, along: Array, reach_px: float) -> IntArray:
    """(m,) sample with the largest score (m, k) within reach."""
    return np.where(
        np.abs(along) <= reach_px,
        score,
        -np.inf,
    ).argmax(1)


def _profile(signed: Float32Array, along: Array) -> Float32Array:
    """(m, k) differences in the channel of (m, k, 3) that differs most inside, positive there."""
    inside = (along < 0) & (along >= -_SIDE)
    within = signed[:, inside].mean(1)
    channel = np.abs(within).argmax(1)[:, None]
    sign = np.sign(
        np.take_along_axis(
            within,
            channel,
            1,
        )
    )
    return (
        np.take_along_axis(
            signed,
            channel[:, None],
            2,
        )[..., 0]
        * sign
    )


def _steps(profile: Float32Array, near: int) -> Array:
    """(m, k) mean of `near` samples before each, minus that of as many after it."""
    total = np.cumsum(
        profile,
        1,
        dtype=float,
    )
    total = np.pad(
        total,
        ((0, 0), (near + 1, near)),
        mode="edge",
    )
    total[:, : near + 1] = 0
    count = profile.shape[1]
    before = total[:, near : near + count] - total[:, :count]
    after = total[:, 2 * near + 1 :][:, :count] - total[:, near + 1 :][:, :count]
    return (before - after) / near


def _crossing(profile: Float32Array, best: IntArray, side: int) -> Array:
    """(m,) place nearest to `best` at which a profile falls to its middle there, or NaN."""
    beside = _beside(
        profile,
        best,
        side + 1,
    )
    level = (beside[:, :side].mean(1) + beside[:, -side:].mean(1)) / 2
    rows = np.arange(len(best))
    place = np.full(len(best), np.nan)
    for k in (0, -1, 1, -2, 2, -3):
        a = np.clip(
            best + k,
            0,
            profile.shape[1] - 2,
        )
        high = profile[rows, a]
        low = profile[rows, a + 1]
        falls = np.isnan(place) & (high >= level) & (low < level)
        share = (high - level) / np.maximum(high - low, 1e-6)
        place = np.where(
            falls,
            a + share,
            place,
        )
    return place


def _sampled_at(image: Float32Array, grid: Array) -> Float32Array:
    """Values of an image (h, w) at pixels (m, k, 2); 0 outside."""
    x, y = np.moveaxis(
        grid,
        -1,
        0,
    ).astype(np.float32)
    values = cv2.remap(
        image,
        x,
        y,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
    )
    return np.asarray(values, np.float32)
