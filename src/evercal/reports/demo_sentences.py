"""The outcome of a demo in sentences, for the terminal and for the report."""

import statistics
from typing import TYPE_CHECKING

from evercal.evaluation.tables import distance
from evercal.reports.demo_outcome import DemoOutcome, located

if TYPE_CHECKING:
    from collections.abc import Iterable

    from evercal.evaluation import SceneScores


def about_test_images(outcome: DemoOutcome) -> list[str]:
    """How well the test images were located."""
    if outcome.test is None:
        return []
    rows = outcome.test.scenes.values()
    errors = [error for room in outcome.errors_m.values() for error in room]
    return [
        f"{located(errors)} of {len(errors)} test images were located in the right room, though"
        f" nothing says which room an image shows: median error"
        f" {distance(statistics.median(errors))} and {_degrees(rows)} deg,"
        f" {_mean(rows, 'accuracy_5mm_05deg'):.0f} % within 5 mm and 0.5 deg;"
        f" {outcome.test.ms_per_image:.0f} ms per image"
    ]


def about_changed_rooms(outcome: DemoOutcome) -> list[str]:
    """How well images were located after the rooms had changed."""
    if outcome.changed is None:
        return []
    rows, errors = outcome.changed.scenes.values(), outcome.changed_errors_m
    wrong = sum(round(row.wrong_scene * row.frames / 100) for row in rows)
    found = [error for error in errors if error < float("inf")]
    median = distance(statistics.median(found)) if found else "none"
    return [
        f"after things in the rooms were moved and lamps were switched, {len(found)} of"
        f" {len(errors)} images were located, with a median error of {median};"
        f" {len(errors) - len(found) - wrong} were refused and {wrong} were taken for another room"
    ]


def about_fixed_cameras(outcome: DemoOutcome) -> list[str]:
    """Where the fixed cameras were found, and how far they were bumped."""
    lines = []
    for camera in outcome.fixed:
        said = f"the fixed camera in the {camera.room} was "
        if camera.error_mm is None or camera.error_deg is None:
            lines.append(f"{said}not found in any of {camera.images} images")
            continue
        lines.append(
            f"{said}calibrated from {camera.used} of {camera.images} images:"
            f" {camera.error_mm:.2f} mm and {camera.error_deg:.3f} deg from the truth"
        )
    for bump in outcome.bumps:
        verdict = "its bump was noticed" if bump.moved else "no bump was noticed"
        lines.append(
            f"the fixed camera in the {bump.room} seems to have moved by {bump.shift_mm:.2f} mm"
            f" and {bump.shift_deg:.3f} deg, so {verdict}; in truth it moved by"
            f" {bump.true_mm:.2f} mm and {bump.true_deg:.3f} deg"
        )
    return lines


def about_unknown_room(outcome: DemoOutcome) -> list[str]:
    """What was said about a room that was never learned."""
    if outcome.unknown is None:
        return []
    shown, refused = outcome.unknown.images, outcome.unknown.refused
    return [f"{refused} of {shown} images of a room that was never learned were refused"]


def _degrees(rows: "Iterable[SceneScores]") -> str:
    return f"{_mean(rows, 'median_rotation_deg'):.3f}"


def _mean(rows: "Iterable[SceneScores]", field: str) -> float:
    return statistics.fmean(getattr(row, field) for row in rows)
