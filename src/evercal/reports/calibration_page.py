"""The report of `evercal report`: what a calibration is, what it is good for, and on what it rests.

Nothing is invented: what a calibration does not hold is named in one sentence where it would stand.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.verdict import TIERS, expected_error, tier, verdict
from evercal.reports import (
    Picture,
    Section,
    Table,
    contact_sheet,
    ellipsoid_shadows,
    encode_image,
    error_terms,
    html_page,
    residual_bars,
)
from evercal.reports.calibration_comparison import Older, older_sentences
from evercal.reports.calibration_facts import check_rows, other_rows, source_rows
from evercal.reports.calibration_views import Views

Block = str | Picture | Table
_SHARE = 0.95


class Missing(str):
    """A sentence that stands where something could not be shown."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What a report is about."""

    file: str
    """Name of the calibration's file."""
    found: Calibration
    """The calibration."""
    views: Views = field(default_factory=Views)
    """Images with what was drawn into them."""
    store: str | None = None
    """The store whose landmarks were drawn."""
    older: Older | None = None
    """What it is compared with."""


@dataclass(frozen=True)
class Page:
    """A report."""

    html: str
    """The whole file."""
    missing: tuple[str, ...]
    """Sentences on what could not be shown."""


def calibration_page(subject: Subject) -> Page:
    """The whole report.

    Args:
        subject: what it is about.

    Raises:
        InputError: A check whose value is no number.
    """
    found = subject.found
    sections = [
        _verdict(found),
        _transform(found),
        *_comparison(subject),
        _in_the_images(subject),
        _images(found),
        _uncertainty(found),
        _checks(found),
        _source(subject),
    ]
    missing = tuple(str(b) for s in sections for b in s.blocks if isinstance(b, Missing))
    title = f"{subject.file}: {found.parent_frame}_from_{found.child_frame}"
    return Page(html_page(title, sections), missing)


def _verdict(found: Calibration) -> Section:
    checks = check_rows(found)  # refuses what is no number before anything rests on it
    good = tier(found)
    rows: list[tuple[str, str | float, str | float, str]] = []
    for level in TIERS:
        reached = good is not None and TIERS.index(level) >= TIERS.index(good)
        told = "good enough" if reached else "not good enough"
        rows.append((level.name, level.mm, level.deg, told))
    rows.append(("unusable", "-", "-", "yes: do not use it" if good is None else "no"))
    header = (
        "use",
        "error of position, at most mm",
        "of rotation, at most deg",
        "this calibration",
    )
    blocks: list[Block] = [
        found.verdict or verdict(found),
        Table(header, rows, "Tiers of use; what fits none of them is unusable"),
    ]
    if _states_uncertainty(found):
        millimetres, degrees = expected_error(found)
        blocks.append(
            f"The expected error, {millimetres:.2f} mm and {degrees:.3f} deg, is the largest of"
            " the length of the uncertainty (1.73 standard deviations per axis) and of the errors"
            " that the checks below found."
        )
    else:
        rest = "The verdict rests on the checks below alone." if checks else "Trust no verdict."
        blocks.append(Missing(f"No uncertainty: the calibration states none. {rest}"))
    return Section("", blocks)


def _transform(found: Calibration) -> Section:
    parent, child, pose = found.parent_frame, found.child_frame, found.parent_from_child
    stands = "stands still" if found.mount == "eye_to_hand" else "is carried by the gripper"
    said = (
        f"{parent}_from_{child} is the {found.meaning}. The camera {stands} ({found.mount}). Axes"
        f" of {child}: x right, y down, z forward in the image."
    )
    w, x, y, z = pose.rotation_wxyz
    plain = Table(
        ("", "x", "y", "z", "w"),
        [
            ("translation, mm", *(f"{1000 * value:.3f}" for value in pose.translation_m), ""),
            ("quaternion", f"{x:.8f}", f"{y:.8f}", f"{z:.8f}", f"{w:.8f}"),
        ],
    )
    rows = [
        (f"{axis} of {parent}", *(f"{value:.8f}" for value in row))
        for axis, row in zip("xyz", pose.matrix()[:3], strict=True)
    ]
    header = ("", *(f"{axis} of {child}" for axis in "xyz"), "origin, m")
    matrix = Table(header, [*rows, ("", "0", "0", "0", "1")], "As a 4x4 matrix")
    blocks: list[Block] = [said, plain, matrix]
    if _states_uncertainty(found):
        blocks.append(_sigma_table(found))
    return Section("Transform", blocks)


def _sigma_table(found: Calibration) -> Table:
    sigma = np.sqrt(np.clip(np.diag(found.covariance), 0.0, None))
    millimetres, degrees = 1000 * sigma[:3], np.rad2deg(sigma[3:])
    return Table(
        ("", "x", "y", "z", "root mean square"),
        [
            (
                f"position along the axes of {found.parent_frame}, mm",
                *(f"{value:.3f}" for value in millimetres),
                f"{found.sigma_mm:.3f}",
            ),
            (
                f"rotation about the axes of {found.child_frame}, deg",
                *(f"{value:.4f}" for value in degrees),
                f"{found.sigma_deg:.4f}",
            ),
        ],
        "Standard deviations",
    )


def _comparison(subject: Subject) -> list[Section]:
    if subject.older is None:
        return []
    said = older_sentences(subject.found, subject.older, subject.views)
    return [Section(f"Compared with {subject.older.file}", said)]


def _in_the_images(subject: Subject) -> Section:
    views, found = subject.views, subject.found
    blocks: list[Block] = []
    if views.views and views.axes is not None:
        blocks.append(_axes_sentence(subject))
        landmarks = any(view.landmarks is not None for view in views.views)
        if landmarks:
            puts = "the calibration puts them"
            if found.mount == "eye_in_hand":
                puts = "the image's own pose puts them (this camera moves)"
            blocks.append(
                f"Dots are landmarks of {subject.store} that were found in the images: dark ones"
                f" lie where {puts}, yellow ones further off."
            )
        else:
            blocks.append(Missing("No landmarks: give the store with --store to see them."))
        if views.other_map:
            blocks.append(
                f"The map in {subject.store} is not the one that the calibration was made with."
            )
        captions = [f"{_name(view.name)}: {view.use}" for view in views.views]
        sheet = contact_sheet([v.image for v in views.views], 2, captions, cell_width=640)
        blocks.append(Picture(encode_image(sheet, "jpg"), _sheet_caption(subject)))
        if views.close_up is not None:
            told = f"The origin of {found.parent_frame} in the first of them, enlarged"
            blocks.append(Picture(encode_image(views.close_up, "jpg"), told))
        if landmarks:
            blocks.append(_landmark_table(views))
    blocks += [Missing(sentence) for sentence in views.missing]
    return Section("In the images", blocks)


def _axes_sentence(subject: Subject) -> str:
    axes, frame = subject.views.axes, subject.found.parent_frame
    assert axes is not None, "there are pictures"
    if axes.where:
        return (
            f"The origin of {frame} lies {axes.where}, so it cannot be seen where it is."
            " The corner of each image shows which way its axes point."
        )
    x, y = axes.origin_px
    return (
        f"The calibration puts the origin of {frame} at pixel ({x:.1f}, {y:.1f}). Its axes are"
        " drawn from there, 100 mm long: x red, y green, z blue. They should stand on the real one."
    )


def _sheet_caption(subject: Subject) -> str:
    axes, before, frame = subject.views.axes, subject.views.older, subject.found.parent_frame
    if axes is not None and axes.where:
        told = f"Which way the axes of {frame} point, as the calibration has it"
    else:
        told = f"The axes of {frame} where the calibration sees them"
    if before is not None and subject.older is not None and not before.where:
        told += f"; pale and dashed, where {subject.older.file} sees them"
    return told


def _landmark_table(views: Views) -> Table:
    rows = [
        (
            _name(view.name),
            "-" if view.landmarks is None else view.landmarks,
            "-" if view.median_px is None else f"{view.median_px:.2f}",
            view.status,
        )
        for view in views.views
    ]
    header = ("image", "landmarks found", "median residual px", "why none")
    if not any(view.status for view in views.views):
        return Table(header[:3], [row[:3] for row in rows], "Landmarks in these images")
    return Table(header, rows, "Landmarks in these images")


def _images(found: Calibration) -> Section:
    heading = "Used and left out"
    if not found.images:
        return Section(heading, [Missing("No list of images: the calibration holds none.")])
    used = sum(image.used for image in found.images)
    folder = _common_folder([image.name for image in found.images])
    rows = [
        (
            str(number),
            image.name[len(folder) :],
            "yes" if image.used else "no",
            image.reason,
            "-" if image.residual_mm is None else f"{image.residual_mm:.2f}",
            "-" if image.residual_deg is None else f"{image.residual_deg:.3f}",
        )
        for number, image in enumerate(found.images, 1)
    ]
    header = ("no.", "image", "used", "reason", "residual mm", "residual deg")
    caption = f"{used} of {len(found.images)} used" + (
        f"; all of them in {folder}" if folder else ""
    )
    blocks: list[Block] = []
    if any(i.residual_mm is not None or i.residual_deg is not None for i in found.images):
        bars = residual_bars(
            [image.residual_mm for image in found.images],
            [image.residual_deg for image in found.images],
            [image.used for image in found.images],
        )
        blocks.append(Picture(bars, "How far each of them lies from the answer"))
    else:
        blocks.append(Missing("No chart of residuals: the calibration holds none."))
    return Section(heading, [*blocks, Table(header, rows, caption)])


def _uncertainty(found: Calibration) -> Section:
    heading = "Uncertainty"
    if not _states_uncertainty(found):
        return Section(heading, [Missing("No ellipsoid: the calibration states no uncertainty.")])
    blocks: list[Block] = [_ellipsoid_sentence(found)]
    shadows = ellipsoid_shadows(1e6 * found.covariance[:3, :3], found.parent_frame, _SHARE)
    said = "The 95 % ellipsoid of the translation, seen along each axis of"
    blocks.append(Picture(shadows, f"{said} {found.parent_frame}; the answer is in the middle"))
    if found.error_terms:
        bars = error_terms(
            [*(term.name for term in found.error_terms), "all together"],
            [*(term.translation_mm for term in found.error_terms), found.sigma_mm],
            [*(term.rotation_deg for term in found.error_terms), found.sigma_deg],
        )
        named = "; ".join(term.name for term in found.error_terms)
        blocks.append(Picture(bars, f"What the error is made of: {named}"))
    else:
        blocks.append(Missing("No parts of the error: the calibration does not name them."))
    return Section(heading, blocks)


def _ellipsoid_sentence(found: Calibration) -> str:
    from scipy import stats

    values, vectors = np.linalg.eigh(found.covariance[:3, :3])
    halves = 1000 * np.sqrt(stats.chi2.ppf(_SHARE, 3) * np.clip(values, 0.0, None))
    longest = vectors[:, 2]
    forward = found.parent_from_child.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(longest @ forward), 0.0, 1.0)))
    x, y, z = longest if longest[np.argmax(np.abs(longest))] > 0 else -longest
    return (
        "The true position lies inside the ellipsoid with a probability of 95 %, if the calibration"
        f" judges itself rightly. Its half axes are {halves[2]:.2f}, {halves[1]:.2f} and"
        f" {halves[0]:.2f} mm. The longest points along ({x:.2f}, {y:.2f}, {z:.2f}) of"
        f" {found.parent_frame}, {angle:.0f} deg from the camera's viewing direction."
    )


def _checks(found: Calibration) -> Section:
    rows = check_rows(found)
    blocks: list[Block] = []
    if rows:
        blocks.append(Table(("check", "mm", "deg"), [row.cells for row in rows]))
    names = {row.key for row in rows}
    if "repeatability" in names and found.mount == "eye_to_hand":
        blocks.append(
            "Both halves see the same landmarks from the same spot, so they share the errors of"
            " the map: their difference says how well images agree, not how right they are."
        )
    if "repeatability" not in names:
        blocks.append(
            Missing("No repeatability: the calibration holds no comparison of two halves.")
        )
    if "held_out" not in names:
        blocks.append(Missing("No held-out error: the calibration holds none."))
    others = other_rows(found)
    if others:
        blocks.append(Table(("what", "value"), others, "Other numbers that were kept"))
    return Section("Repeatability and held-out error", blocks)


def _source(subject: Subject) -> Section:
    rows = source_rows(subject.found, subject.file)
    blocks: list[Block] = [Table(("what", "value"), rows)]
    if subject.found.camera is None:
        blocks.append(Missing("No intrinsics: the calibration holds none."))
    if not subject.found.source:
        blocks.append(Missing("No source: the calibration does not say what made it."))
    return Section("Source", blocks)


def _states_uncertainty(found: Calibration) -> bool:
    return bool(np.trace(found.covariance) > 0)


def _common_folder(names: Sequence[str]) -> str:
    """The folder that all names begin with, with its slash; empty for none."""
    folders = {name[: name.rfind("/") + 1] for name in names}
    return folders.pop() if len(folders) == 1 else ""


def _name(path: str) -> str:
    return os.path.basename(path)
