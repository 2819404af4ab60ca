"""The pictures and the report of `evercal demo`."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evercal.reports.demo_outcome import FIXED_HEADER, METHODS, DemoOutcome
from evercal.reports.pictures import draw_estimate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evercal.datasets import Frame, Scene
    from evercal.drawing import Section
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer
    from evercal.simulation.mini import CellRoom

_COLOURS = ("#0072B2", "#D55E00")
_OVERLAYS_PER_ROOM = 3


def write_pictures(
    out: Path, localizer: "Localizer", places: "Sequence[CellRoom]", outcome: DemoOutcome
) -> None:
    """Writes `overview.png` and `report.html`.

    Args:
        out: folder, there already.
        localizer: evercal's after the last room.
        places: the rooms.
        outcome: what was measured.
    """
    from evercal.drawing import html_page
    from evercal.storage import write_bytes

    overlays = [_overlays(localizer, place.scene) for place in places]
    overview = _overview([max(found, key=lambda o: o.inliers) for found in overlays[:2]], outcome)
    write_bytes(out / "overview.png", overview)
    sections = [
        *_results(overview, len(places[0].scene.train), outcome),
        *_points(places, overlays),
        *_fixed_cameras(outcome),
    ]
    write_bytes(out / "report.html", html_page("evercal demo", sections).encode())


def _results(overview: bytes, images: int, outcome: DemoOutcome) -> "list[Section]":
    """What happened, and how accurate each method was after each room."""
    from evercal.drawing import Picture, Section, Table, forgetting_curves

    rooms = outcome.rooms
    curves = {METHODS[key]: _square(rows, len(rooms)) for key, rows in outcome.accuracy.items()}
    header = ["method", "after", *(f"{room} %" for room in rooms)]
    seconds = [second for times in outcome.seconds.values() for second in times]
    intro = (
        f"{len(rooms)} virtual rooms were learned one after the other, from {images}"
        f" posed images each, by one small network. Fine-tuning is the same network and the same"
        f" number of steps without anything to remember by. A room took {np.mean(seconds):.0f} s on"
        f" average; evercal keeps {outcome.memory_bytes / 1e6:.1f} MB of the rooms in memory. At"
        f" test time nothing says which room an image is from."
    )
    table = Table(header, outcome.rows(), "Test frames within 5 cm and 5 deg, per cent")
    picture = Picture(forgetting_curves(curves, rooms), "What became of each room")
    return [
        Section("", [intro, Picture(overview, "Left: two test images; right: the first room")]),
        Section("Accuracy after each room", [table, picture]),
    ]


def _points(places: "Sequence[CellRoom]", overlays: "list[list[_Overlay]]") -> "list[Section]":
    """Test images with the points that agree, and with the room's bare shapes over them."""
    from evercal.drawing import Picture, Section, contact_sheet, encode_image

    said = "Test images with the scene points that agree"
    sheet = encode_image(_sheet(overlays), "jpg")
    sections = [Section("Predicted points", [Picture(sheet, said)])]
    pairs = zip(places, overlays, strict=True)
    rendered = [image for place, found in pairs for image in _untextured_overlays(place, found)]
    if rendered:
        sheet = encode_image(contact_sheet(rendered, _OVERLAYS_PER_ROOM), "jpg")
        said = "The room's bare shapes, rendered at the estimated pose, laid over the test image."
        sections.append(Section("Rendered at the estimated pose", [said, Picture(sheet)]))
    return sections


def _fixed_cameras(outcome: DemoOutcome) -> "list[Section]":
    """Where the cameras that stand still were found."""
    from evercal.drawing import Section, Table

    if not outcome.fixed:
        return []
    said = (
        "A camera stands still while the arm moves. Its pose in the robot's base frame is the"
        " robust mean over its images; no marker, no motion of the camera."
    )
    table = Table(FIXED_HEADER, outcome.fixed_rows(), "evercal after the last room")
    return [Section("Calibration of a fixed camera", [said, table])]


def _square(rows: list[list[float]], count: int) -> np.ndarray:
    matrix = np.full((count, count), np.nan)
    for i, row in enumerate(rows):
        matrix[i, : len(row)] = row
    return matrix


@dataclass(frozen=True, eq=False)
class _Overlay:
    """A test image and what was said about it."""

    frame: "Frame"
    """The test image."""
    estimate: "PoseEstimate"
    """The answer for it."""
    image: np.ndarray
    """(H, W, 3) uint8 RGB, scene points drawn in."""

    @property
    def caption(self) -> str:
        """The answer in words."""
        found = self.estimate
        said = f"in {found.scene}" if found.scene else found.status.replace("_", " ")
        return f"{said}, {100 * found.inlier_ratio:.0f} % inliers"

    @property
    def inliers(self) -> int:
        """0 without a pose."""
        return self.estimate.inliers if self.estimate.status == "ok" else 0


def _overlays(localizer: "Localizer", scene: "Scene") -> list[_Overlay]:
    """Of test frames spread over the recording."""
    found = []
    for frame in _spread(scene):
        image = frame.read_image()
        estimate = localizer.localize(image, frame.camera)
        found.append(_Overlay(frame, estimate, draw_estimate(image, estimate, frame.camera)))
    return found


def _untextured_overlays(place: "CellRoom", overlays: list[_Overlay]) -> list[np.ndarray]:
    """Test images of a room with its bare shapes over them; none where they cannot be rendered."""
    from evercal.simulation.mini import untextured_renders

    frames, poses = [], []
    for overlay in overlays:
        pose = overlay.estimate.base_from_camera
        if overlay.estimate.scene == place.scene.name and pose is not None:
            frames.append(overlay.frame)
            poses.append(pose)
    if place.model is None or not frames:
        return []
    views = untextured_renders(place.model, frames, poses)
    return [
        ((frame.read_image().astype(int) + view) // 2).astype(np.uint8)
        for frame, view in zip(frames, views, strict=False)
    ]


def _spread(scene: "Scene") -> "list[Frame]":
    """Test frames spread over the recording."""
    places = np.linspace(0, len(scene.test), _OVERLAYS_PER_ROOM, endpoint=False)
    half = len(scene.test) / (2 * _OVERLAYS_PER_ROOM)
    return [scene.test[int(place + half)] for place in places]


def _sheet(overlays: list[list[_Overlay]]) -> np.ndarray:
    """All of them, a row for each room."""
    from evercal.drawing import contact_sheet

    flat = [overlay for found in overlays for overlay in found]
    captions = [overlay.caption for overlay in flat]
    return contact_sheet([overlay.image for overlay in flat], _OVERLAYS_PER_ROOM, captions)


def _overview(shown: list[_Overlay], outcome: DemoOutcome) -> bytes:
    """Two images with points, and what became of the first room with both methods, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.1), dpi=130, layout="constrained", facecolor="white")
    panels = figure.subplots(1, 3, width_ratios=(1.35, 1.35, 1))
    for panel, overlay in zip(panels, shown, strict=False):
        panel.imshow(overlay.image)
        panel.set_title(overlay.caption, fontsize=9)
        panel.set_axis_off()
    bars = panels[2]
    first, last = outcome.rooms[0], outcome.rooms[-1]
    for i, (method, rows) in enumerate(outcome.accuracy.items()):
        heights = [rows[0][0], rows[-1][0]]
        places = np.arange(2) + 0.4 * (i - 0.5)
        drawn = bars.bar(places, heights, 0.38, color=_COLOURS[i], label=METHODS[method])
        bars.bar_label(drawn, fmt="%.0f", fontsize=9)
    bars.set_xticks([0, 1], [f"after learning\n{first}", f"after learning\n{last}"], fontsize=9)
    bars.set_ylim(0, 135)  # room for the legend
    bars.set_yticks([0, 50, 100])
    bars.set_title(f"{first}: % within 5 cm, 5 deg", fontsize=9, loc="left")
    bars.spines[["top", "right"]].set_visible(False)
    bars.legend(frameon=False, fontsize=9, loc="upper right", bbox_to_anchor=(1, 0.97))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
