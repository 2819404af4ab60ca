"""Arms drawn into one picture of a room: hundreds of times faster than `rooms.renderer`.

The full meshes are rasterized at four times the resolution with light from one side, averaged in
linear light, hidden by what is nearer, and shadow what is behind. The room stays as it is.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import look_at
from rooms.arm_shapes import ArmShapes, Part
from rooms.renderer import sensor_bytes

_FINER = 4
"""Rows and columns that are averaged in a pixel."""
_FAR_M = 30.0
_LIGHTS = 4
"""Points of the lamp, which soften its shadow."""


@dataclass(frozen=True, eq=False)
class Stage:
    """A picture of a room without an arm."""

    camera: Camera
    base_from_camera: SE3
    rgb: np.ndarray
    """(H, W, 3) uint8, without sensor noise."""
    depth: np.ndarray
    """(H, W) metres along the optical axis; 0 where nothing is."""
    light_m: np.ndarray
    """(3,) position of a lamp in the base frame."""


def draw(
    shapes: ArmShapes,
    joints: np.ndarray,
    stage: Stage,
    rng: np.random.Generator,
    noise: float = 0.012,
) -> np.ndarray:
    """Draw an arm with joint values (k,) into a room; sRGB (H, W, 3) uint8."""
    vertices, normals, faces, colours = _meshes_at(shapes.parts, shapes, joints)
    shade = _shade(vertices, normals, stage.light_m) * colours
    camera_from_base = stage.base_from_camera.inverse()
    colour, cover = _rasterized(stage, camera_from_base.apply(vertices), faces, shade)
    room = linear_light(stage.rgb) * _shadow(stage, vertices, faces)[..., None]
    mixed = colour + (1 - cover[..., None]) * room
    mixed = cv2.GaussianBlur(mixed, (0, 0), 0.35)
    return sensor_bytes(mixed, noise, rng)


def linear_light(rgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB bytes."""
    levels = np.arange(256) / 255
    curve = np.where(
        levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4
    )
    return curve.astype(np.float32)[rgb]


def draw_beside(
    rgb: np.ndarray, shapes: ArmShapes, joints: np.ndarray, added: Part, stage: Stage
) -> np.ndarray:
    """Draw one more part onto an image (H, W, 3) that shows the arm, hidden by the arm."""
    vertices, normals, faces, colours = _meshes_at(
        [added, *shapes.parts], shapes, joints
    )
    shade = _shade(vertices, normals, stage.light_m) * colours
    shade[len(added.vertices_m) :] = -1.0
    seen = stage.base_from_camera.inverse().apply(vertices)
    colour, cover = _rasterized(stage, seen, faces, shade)
    mixed = colour + (1 - cover[..., None]) * linear_light(rgb)
    return sensor_bytes(mixed, 0.0, np.random.default_rng(0))


def coverage(shapes: ArmShapes, joints: np.ndarray, stage: Stage) -> np.ndarray:
    """(H, W) share of each pixel that an arm covers."""
    vertices, _, faces, colours = _meshes_at(shapes.parts, shapes, joints)
    seen = stage.base_from_camera.inverse().apply(vertices)
    return _rasterized(stage, seen, faces, colours)[1]


def _meshes_at(
    parts: list[Part], shapes: ArmShapes, joints: np.ndarray
) -> tuple[np.ndarray, ...]:
    frames = shapes.frames(joints)
    vertices, normals, faces, colours = [], [], [], []
    first = 0
    for part in parts:
        frame = frames[part.link]
        vertices.append(part.vertices_m @ frame[:3, :3].T + frame[:3, 3])
        normals.append(part.normals @ frame[:3, :3].T)
        faces.append(part.faces + first)
        colours.append(np.broadcast_to(part.colour, part.vertices_m.shape))
        first += len(part.vertices_m)
    stacks = [np.concatenate(each) for each in (vertices, normals, faces, colours)]
    return tuple(stacks)


def _shade(vertices: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(n, 1) light on each vertex: a lamp, and the room from above and from below."""
    towards = light - vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lamp = np.maximum(0, (normals * towards).sum(1))
    return (0.28 + 0.14 * normals[:, 2] + 0.6 * lamp)[:, None]


def _rasterized(
    stage: Stage, points: np.ndarray, faces: np.ndarray, shade: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colour times coverage (H, W, 3), and coverage (H, W), of points in the camera frame."""
    camera = stage.camera
    size = (camera.width, camera.height)
    colour = np.zeros((camera.height, camera.width, 3), np.float32)
    cover = colour[..., 0].copy()
    pixels = camera.project(points[points[:, 2] > 0.05])
    low = np.clip(np.floor(pixels.min(0)) - 1, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 2, 0, size).astype(int)
    if (high <= low).any():
        return colour, cover
    width, height = (high - low) * _FINER
    focal = camera.fx * _FINER
    centre = (np.array([camera.cx, camera.cy]) - low + 0.5) * _FINER
    fine, depth = rasterize(points, faces, shade, focal, centre, (width, height))
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    before = cv2.resize(
        stage.depth[window], (width, height), interpolation=cv2.INTER_NEAREST
    )
    seen = (depth < 0.99 * _FAR_M) & ((depth < before) | (before == 0))
    seen &= fine[..., 0] >= 0
    fine[~seen] = 0
    shrunk = tuple((high - low).tolist())
    area = cv2.INTER_AREA
    colour[window] = cv2.resize(fine, shrunk, interpolation=area)
    cover[window] = cv2.resize(seen.astype(np.float32), shrunk, interpolation=area)
    return colour, cover


def rasterize(
    points: np.ndarray,
    faces: np.ndarray,
    colours: np.ndarray,
    focal: float,
    centre: np.ndarray,
    size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of a mesh in the camera frame.

    Args:
        points: Vertices (n, 3), metres.
        faces: Triangles (m, 3).
        colours: (n, 3), interpolated.
        focal: Focal length, pixels.
        centre: Principal point from the corner of the image, pixels.
        size: Width and height.
    """
    width, height = size
    shift = (centre - np.array(size) / 2) / focal
    x = points[:, 0] + points[:, 2] * shift[0]
    y = points[:, 1] + points[:, 2] * shift[1]
    turned = np.stack([x, -y, -points[:, 2]], 1).astype(np.float32)
    settings = cv2.TriangleRasterizeSettings()
    settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings = settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    colour = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), _FAR_M, np.float32)
    view = 2 * np.arctan(height / 2 / focal)
    paint = np.ascontiguousarray(colours, np.float32)
    cv2.triangleRasterize(
        turned, faces.astype(np.int32), paint, colour, depth, np.eye(4), view,
        0.05, _FAR_M, settings,
    )  # fmt: skip
    return colour, depth


def _shadow(stage: Stage, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(H, W) factor of the light on the room behind an arm."""
    camera = stage.camera
    step = 2
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    rays = camera.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float))
    depth = stage.depth[::step, ::step].reshape(-1, 1)
    points = stage.base_from_camera.apply(rays * depth)
    middle = vertices.mean(0)
    dark = np.zeros(u.shape, np.float32)
    focal = 200 * float(np.linalg.norm(stage.light_m - middle))
    blank = np.zeros_like(vertices)
    for k in range(_LIGHTS):
        turn = 2 * np.pi * k / _LIGHTS
        lamp = stage.light_m + 0.12 * np.array([np.cos(turn), np.sin(turn), 0])
        camera_from_base = looking(lamp, middle).inverse()
        seen = camera_from_base.apply(vertices)
        _, near = rasterize(seen, faces, blank, focal, np.full(2, 256.0), (512, 512))
        x, y, z = (
            camera_from_base.apply(points).astype(np.float32).T.reshape(3, *u.shape)
        )
        x, y = (focal * a / np.maximum(z, 0.05) + 255.5 for a in (x, y))
        near = cv2.remap(
            near,
            x,
            y,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=_FAR_M,
        )
        dark += (near < z - 0.01) / _LIGHTS
    dark = cv2.GaussianBlur(dark, (0, 0), 1.5)
    return 1 - 0.45 * cv2.resize(dark, (camera.width, camera.height))


def looking(eye: np.ndarray, target: np.ndarray) -> SE3:
    """base_from_camera of a camera that looks from a point to another."""
    return look_at(eye, target + np.array([1e-4, 0, 0]))
