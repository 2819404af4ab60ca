"""What is shown of a located image: colour by status, frusta, picture with residuals, numbers."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.reports.answers import finite_pose, unit_known
from evercal.reports.pictures import draw_residuals, landmark_errors
from evercal.reports.scene.frusta import Ellipsoid, Frustum
from evercal.reports.scene.map_parts import resized

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
State = Literal["located", "tracking", "relocalized", "lost", "ambiguous", "unknown", "failed"]

GREEN, AMBER, RED, GREY = (22, 163, 74), (245, 158, 11), (220, 38, 38), (150, 150, 150)
BLUE = (37, 99, 235)
"""Stated poses."""
COLOURS: dict[State, Colour] = {
    "located": GREEN,
    "tracking": GREEN,
    "relocalized": GREEN,
    "ambiguous": AMBER,
    "unknown": RED,
    "failed": RED,
    "lost": RED,
}
_OF_STATUS: dict[str, State] = {
    "ok": "located",
    "ambiguous": "ambiguous",
    "unknown_scene": "unknown",
    "failed": "failed",
}
_PICTURE_PX = 640
_BAR_PX = 8
"""Width of the coloured border around a picture."""


def shares_of_light(colours: ArrayLike) -> NDArray[np.float64]:
    """Shares of light, 0 to 1, of sRGB values from 0 to 255 (IEC 61966-2-1)."""
    shares = np.asarray(colours, np.float64) / 255
    return np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True, eq=False)
class LocatedImage:
    """An image and its answer."""

    name: str
    image: Image
    """(h, w, 3) RGB."""
    estimate: PoseEstimate
    tracked: Literal["tracking", "relocalized", "lost"] | None = None
    """State of a tracked frame; None for a single image."""
    stated: SE3 | None = None
    """base_from_camera that the estimate is compared with, if there is one."""
    stated_by: str = "stated pose"
    """Where it comes from."""

    @property
    def state(self) -> State:
        """Status and state of tracking in one word; an ambiguous frame of a stream is ambiguous."""
        status = self.estimate.status
        if status == "ok" and self.tracked is not None:
            return self.tracked
        if status in ("unknown_scene", "failed") and self.tracked is not None:
            return "lost"
        return _OF_STATUS[status]


@dataclass(frozen=True, eq=False)
class AnswerView:
    """What is shown of a located image."""

    state: State
    scene: str | None
    """Scene in whose frame the frusta are; None without a pose."""
    frusta: tuple[Frustum, ...]
    """One, two for an ambiguous image, none without a pose."""
    stated: Frustum | None
    """The stated pose."""
    ellipsoid: Ellipsoid | None
    picture: Image
    """(h, w, 3) the image with landmarks and residuals, framed in the colour of the state."""
    rows: tuple[tuple[str, str], ...]
    """Names and values."""

    @property
    def colour(self) -> Colour:
        """Colour of the state."""
        return COLOURS[self.state]


def answer_view(located: LocatedImage, localizer: Localizer, at_stated: bool = False) -> AnswerView:
    """Compute what is shown of a located image.

    With `at_stated`, landmarks are projected from the stated pose instead of the estimate.
    """
    estimate, state = located.estimate, located.state
    camera = estimate.camera or _camera(localizer, located)
    poses = estimate.alternatives
    if estimate.status == "ok" and estimate.base_from_camera is not None:
        poses = (estimate.base_from_camera,)
    stated = None if located.stated is None else Frustum.of(located.stated, camera)
    pose = finite_pose(estimate) if estimate.status == "ok" else None
    picture, drawn = _picture(located, localizer, camera, located.stated if at_stated else None)
    rows = [("image", located.name), *_estimate_rows(located, localizer), *drawn]
    return AnswerView(
        state=state,
        scene=estimate.scene if poses else None,
        frusta=tuple(Frustum.of(pose, camera) for pose in poses),
        stated=stated,
        ellipsoid=None if pose is None else Ellipsoid.of(pose),
        picture=_framed(picture, COLOURS[state]),
        rows=tuple(rows),
    )


def _estimate_rows(located: LocatedImage, localizer: Localizer) -> list[tuple[str, str]]:
    estimate, rows = located.estimate, []
    if estimate.reason:
        rows.append(("reason", estimate.reason))
    metric = unit_known(localizer, estimate.scene)
    pose, uncertain = estimate.base_from_camera, finite_pose(estimate)
    if pose is not None and estimate.status == "ok":
        rows.append(("scene", str(estimate.scene)))
        if metric:
            x, y, z = 1000 * pose.translation_m
            rows.append(("position", f"{x:+.1f} {y:+.1f} {z:+.1f} mm"))
        else:
            rows.append(("position", "in the map's unit of length, which is unknown"))
        if uncertain is not None and metric:
            rows.append(
                ("1 sigma per axis", f"{uncertain.sigma_mm:.2g} mm, {uncertain.sigma_deg:.2g}°")
            )
        if located.stated is not None:
            mm, deg = pose_distance_mm_deg(located.stated, pose)
            error = f"{mm:.1f} mm, {deg:.2f}°" if metric else f"{deg:.2f}°"
            rows.append((f"from {located.stated_by}", error))
    required = [s.min_support for s in localizer.contents.scenes if s.name == estimate.scene]
    least = f", at least {required[0]:.2f}" if required else ""
    rows.append(("support", f"{estimate.support:.2f}{least}"))
    share = f" ({100 * estimate.inlier_ratio:.0f} % of those visible)"
    rows.append(("inliers", f"{estimate.inliers}{share}"))
    rows.append(("time", f"{estimate.milliseconds:.0f} ms"))
    return rows


def _picture(
    located: LocatedImage, localizer: Localizer, camera: Camera, pose: SE3 | None
) -> tuple[Image, list[tuple[str, str]]]:
    """The image with residuals at a pose, by default the estimate, and a row about them."""
    large = resized(located.image, _PICTURE_PX)
    errors = None
    if located.estimate.status == "ok":
        errors = landmark_errors(located.estimate, localizer, camera, pose)
    if errors is None:
        return large, []
    scale = min(located.image.shape[:2]) / localizer.contents.short_side
    drawn, times = draw_residuals(large, errors, scale)
    finite = errors.errors_px[np.isfinite(errors.errors_px)]
    middle = f"median {scale * float(np.median(finite)):.2f} px" if len(finite) else "none visible"
    where = f" at the {located.stated_by}" if pose is not None else ""
    return drawn, [("residuals", f"{middle}{where}, lines x {times}")]


def _camera(localizer: Localizer, located: LocatedImage) -> Camera:
    """Intrinsics for an image without a pose: those of the scene, else of the first one."""
    scenes = localizer.contents.scenes
    scene = next((s for s in scenes if s.name == located.estimate.scene), scenes[0])
    height, width = located.image.shape[:2]
    return scene.adjusted_camera.resized(width, height)


def _framed(picture: Image, colour: Colour) -> Image:
    height, width = picture.shape[0] + 2 * _BAR_PX, picture.shape[1] + 2 * _BAR_PX
    framed = np.full((height, width, 3), colour, np.uint8)
    framed[_BAR_PX:-_BAR_PX, _BAR_PX:-_BAR_PX] = picture
    return framed
