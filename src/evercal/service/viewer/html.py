"""Texts of the panels; names of files and scenes are escaped."""

from collections.abc import Sequence
from html import escape

from evercal.calibration.calibration import Calibration
from evercal.errors import with_options
from evercal.geometry import SE3
from evercal.reports.scene import Ellipsoid

GREEN = (22, 163, 74)
AMBER = (217, 119, 6)
RED = (220, 38, 38)
GREY = (107, 114, 128)
BLUE = (37, 99, 235)
MAGENTA = (192, 38, 211)
PALE = (150, 156, 166)
"""Lines of the floor, on light and on dark paper."""
Colour = tuple[int, int, int]
_COLOURS = {
    "waits": GREY,
    "to do": BLUE,
    "working": BLUE,
    "failed": RED,
    "lost": RED,
    "ended": RED,
}
"""Colours of states; all other states are green."""
_TEXT = "padding:2px 12px 6px;font-size:0.85em;line-height:1.4;overflow-wrap:anywhere"


def chip_html(state: str, text: str = "") -> str:
    """A state on its colour, and a sentence below it, which names options."""
    colour = _COLOURS.get(state, GREEN)
    style = f"background:rgb{colour};color:white;border-radius:4px;padding:1px 8px;font-weight:600"
    chip = f'<span style="{style}">{escape(state)}</span>'
    return f'<div style="{_TEXT}">{chip}<div>{escape(with_options(text))}</div></div>'


def rows_html(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values, one pair a line."""
    if not rows:
        return ""
    html = f'<div style="{_TEXT}"><table style="width:100%">'
    for name, value in rows:
        html += f'<tr><td style="width:46%;vertical-align:top">{escape(name)}</td>'
        html += f"<td>{escape(with_options(value))}</td></tr>"
    return html + "</table></div>"


def position_mm(pose: SE3, digits: int = 1) -> str:
    """Position of a pose: x, y, z."""
    form = f"{{:+.{digits}f}}".format
    return " ".join(map(form, 1000 * pose.translation_m)) + " mm"


def calibration_rows(calibration: Calibration) -> list[tuple[str, str]]:
    """Names and values of a calibration."""
    position = position_mm(calibration.parent_from_child)
    spread = f"{calibration.sigma_mm:.2g} mm, {calibration.sigma_deg:.2g}°"
    principal = Ellipsoid.of(calibration.uncertain_pose).sigmas_mm
    return [
        ("mount", "on the gripper" if calibration.on_gripper else "fixed"),
        (f"in {calibration.parent_frame}", position),
        ("1 sigma per axis", spread),
        ("principal axes", f"{principal} mm"),
    ]
