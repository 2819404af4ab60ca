"""The pictures and the report of `evercal demo`."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evercal.evaluation.tables import SCENE_HEADER, scene_rows
from evercal.reports import (
    Picture,
    Section,
    Table,
    contact_sheet,
    encode_image,
    error_histogram,
    forgetting_curves,
    html_page,
)
from evercal.reports import demo_sentences as told
from evercal.reports.demo_outcome import (
    BUMP_HEADER,
    FIXED_HEADER,
    LEARNED_HEADER,
    METHODS,
    DemoOutcome,
)
from evercal.reports.pictures import draw_landmarks

if TYPE_CHECKING:
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer
    from evercal.recordings import Frame, Recording
    from evercal.recordings.samples import SampleRoom

_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_OVERLAYS_PER_ROOM = 3
_HISTOGRAM_MM = 5.0


def write_pictures(
    out: Path, localizer: "Localizer", places: "Sequence[SampleRoom]", outcome: DemoOutcome
) -> None:
    """Writes `overview.png` and `report.html`.

    Args:
        out: folder, there already.
        localizer: that knows all rooms.
        places: the rooms.
        outcome: what was measured.
    """
    from evercal.storage import write_bytes

    overlays = [_overlays(localizer, place.scene) for place in places]
    overview = _overview([max(found, key=lambda o: o.inliers) for found in overlays[:2]], outcome)
    write_bytes(out / "overview.png", overview)
    sections = [
        *_learning(overview, outcome),
        *_test_images(places, overlays, outcome),
        *_changed_rooms(localizer, places, outcome),
        *_fixed_cameras(outcome),
        *_unknown_room(outcome),
        *_compared(outcome),
    ]
    write_bytes(out / "report.html", html_page("evercal demo", sections).encode())


def _learning(overview: bytes, outcome: DemoOutcome) -> list[Section]:
    """What happened, and what the map is."""
    intro = (
        f"{len(outcome.rooms)} virtual rooms were learned one after the other from posed images"
        f" alone. Nothing was trained: a map holds keyframes, and landmarks with their depths, all"
        f" adjusted together with the camera. The maps of all rooms take"
        f" {outcome.memory_bytes / 1e6:.1f} MB."
    )
    said = "Left: landmarks that were found in two test images. Right: errors of all test images."
    table = Table(LEARNED_HEADER, outcome.learned_rows(), "What learning took and left")
    return [Section("", [intro, Picture(overview, said), table])]


def _test_images(
    places: "Sequence[SampleRoom]", overlays: "list[list[_Overlay]]", outcome: DemoOutcome
) -> list[Section]:
    """How well the test images were located, and with which landmarks."""
    assert outcome.test is not None, "test images are located before a report is made"
    table = Table(SCENE_HEADER, scene_rows(outcome.test), "Test images after the last room")
    histogram = error_histogram(outcome.errors_m, _HISTOGRAM_MM)
    sections = [
        Section(
            "Test images",
            [
                _paragraph(told.about_test_images(outcome)),
                table,
                Picture(histogram, "How many test images have which error"),
                Picture(_sheet(overlays), "Landmarks that were found, and how far off they were"),
            ],
        )
    ]
    return sections


def _changed_rooms(
    localizer: "Localizer", places: "Sequence[SampleRoom]", outcome: DemoOutcome
) -> list[Section]:
    """How well images were located after the rooms had changed."""
    if outcome.changed is None:
        return []
    overlays = [_overlays(localizer, place.changed) for place in places if place.changed]
    table = Table(SCENE_HEADER, scene_rows(outcome.changed), "Images after the change")
    words = "Landmarks that were found again after the change"
    said = _paragraph(told.about_changed_rooms(outcome))
    return [Section("After a change in the rooms", [said, table, Picture(_sheet(overlays), words)])]


def _fixed_cameras(outcome: DemoOutcome) -> list[Section]:
    """Where the cameras that stand still were found, and how far they were bumped."""
    sections = []
    if outcome.fixed:
        said = (
            "A camera stands still while the arm moves. Its pose in the robot's base frame is put"
            " together from its images; no marker, no motion of the camera."
        )
        table = Table(FIXED_HEADER, outcome.fixed_rows(), "base_from_camera against the truth")
        sections.append(Section("Calibration of a fixed camera", [said, table]))
    if outcome.bumps:
        said = (
            "Then somebody bumped into the camera. The images before and after tell by how much it"
            " moved, and how sure that is (standard deviation per axis)."
        )
        table = Table(BUMP_HEADER, outcome.bump_rows(), "Found and true motion of the camera")
        sections.append(Section("A bump", [said, table]))
    return sections


def _unknown_room(outcome: DemoOutcome) -> list[Section]:
    lines = told.about_unknown_room(outcome)
    return [Section("A room that nobody learned", [_paragraph(lines)])] if lines else []


def _compared(outcome: DemoOutcome) -> list[Section]:
    """What the networks remember of the same rooms."""
    if not outcome.accuracy:
        return []
    rooms = outcome.rooms
    curves = {METHODS[key]: _square(rows, len(rooms)) for key, rows in outcome.accuracy.items()}
    said = (
        "Two networks were trained on the same rooms. Fine-tuning has nothing to remember by;"
        " SARS + SPDD replays keyframes with a distillation loss (arXiv 2604.15814)."
    )
    caption = "Test images within 5 cm and 5 deg after each room, per cent"
    table = Table(outcome.compared_header(), outcome.compared_rows(), caption)
    picture = Picture(forgetting_curves(curves, rooms), "What became of each room")
    return [Section("Compared with networks", [said, table, picture])]


def _paragraph(lines: Sequence[str]) -> str:
    return "\n".join(f"{line[:1].upper()}{line[1:]}." for line in lines)


def _square(rows: list[list[float]], count: int) -> np.ndarray:
    matrix = np.full((count, count), np.nan)
    for i, row in enumerate(rows):
        matrix[i, : len(row)] = row
    return matrix


@dataclass(frozen=True, eq=False)
class _Overlay:
    """An image and what was said about it."""

    frame: "Frame"
    """The image."""
    estimate: "PoseEstimate"
    """The answer for it."""
    image: np.ndarray
    """(H, W, 3) uint8 RGB, landmarks drawn in."""

    @property
    def caption(self) -> str:
        """The answer in words."""
        found = self.estimate
        if found.scene is None:
            return found.status.replace("_", " ")
        return f"{found.scene}: {found.inliers} landmarks, {100 * found.inlier_ratio:.0f} %"

    @property
    def inliers(self) -> int:
        """0 without a pose."""
        return self.estimate.inliers if self.estimate.status == "ok" else 0


def _overlays(localizer: "Localizer", scene: "Recording") -> list[_Overlay]:
    """Of test frames spread over the recording."""
    found = []
    for frame in _spread(scene):
        image = frame.read_image()
        estimate = localizer.localize(image, frame.camera)
        found.append(_Overlay(frame, estimate, draw_landmarks(image, estimate, localizer)))
    return found


def _spread(scene: "Recording") -> "list[Frame]":
    """Test frames spread over the recording."""
    places = np.linspace(0, len(scene.test), _OVERLAYS_PER_ROOM, endpoint=False)
    half = len(scene.test) / (2 * _OVERLAYS_PER_ROOM)
    return [scene.test[int(place + half)] for place in places]


def _sheet(overlays: list[list[_Overlay]]) -> bytes:
    """All of them as a JPEG file, a row for each room."""
    flat = [overlay for found in overlays for overlay in found]
    captions = [overlay.caption for overlay in flat]
    images = [overlay.image for overlay in flat]
    return encode_image(contact_sheet(images, _OVERLAYS_PER_ROOM, captions), "jpg")


def _overview(shown: list[_Overlay], outcome: DemoOutcome) -> bytes:
    """Two images with landmarks, and the errors of all test images, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.1), dpi=130, layout="constrained", facecolor="white")
    panels = figure.subplots(1, 3, width_ratios=(1.35, 1.35, 1))
    for panel, overlay in zip(panels, shown, strict=False):
        panel.imshow(overlay.image)
        panel.set_title(overlay.caption, fontsize=9)
        panel.set_axis_off()
    bars = panels[2]
    errors = [
        np.minimum(1000 * np.array(values), 1.02 * _HISTOGRAM_MM)
        for values in outcome.errors_m.values()
    ]
    bins = [*np.linspace(0, _HISTOGRAM_MM, 21).tolist(), 1.05 * _HISTOGRAM_MM]
    colours = [_COLOURS[i % len(_COLOURS)] for i in range(len(errors))]
    bars.hist(errors, bins, stacked=True, color=colours, label=list(outcome.errors_m))
    bars.set_xlim(0, 1.05 * _HISTOGRAM_MM)
    bars.set_xlabel("translation error (mm)", fontsize=9)
    bars.set_title(f"{sum(map(len, errors))} test images", fontsize=9, loc="left")
    bars.tick_params(labelsize=8)
    bars.spines[["top", "right"]].set_visible(False)
    bars.legend(frameon=False, fontsize=9, loc="upper right")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
