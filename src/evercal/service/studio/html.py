"""HTML of the studio's panel; all texts are escaped."""

from collections.abc import Mapping, Sequence
from html import escape

from evercal.live.coverage import AxisCoverage, Coverage
from evercal.service.studio.devices import Image, Seen
from evercal.service.studio.jobs import Message
from evercal.service.studio.steps import TITLES, Step, StepState
from evercal.service.viewer.answers import AMBER, BLUE, GREEN, GREY, RED
from evercal.service.viewer.text import FAINT, block, chip, jpeg_url, picture_html, table

_SMALL = "font-size:0.82em;line-height:1.4"
_OF_STATUS = {"locked": GREY, "open": BLUE, "done": GREEN}
_OF_KIND = {"good": GREEN, "working": BLUE, "error": RED}
_MARKS = {"locked": "", "open": "", "done": "✓ "}
_THUMBNAIL_PX, _PICTURE_PX = 56, 400


def step_html(state: StepState) -> str:
    """Title, status and sentence of a step."""
    colour = _OF_STATUS[state.status]
    words = {"locked": "waits", "open": "to do", "done": "done"}[state.status]
    title = f'<b style="font-size:1.05em">{escape(state.title)}</b> {chip(words, colour)}'
    return block(f"<div>{title}</div>", f'<div style="{_SMALL}">{escape(state.says)}</div>')


def way_html(states: Sequence[StepState], shown: Step) -> str:
    """All steps in a row; the one that is shown is underlined."""
    parts = []
    for state in states:
        red, green, blue = _OF_STATUS[state.status]
        line = f"2px solid rgb({red},{green},{blue})" if state.step == shown else "none"
        weight = "font-weight:700;" if state.step == shown else ""
        faint = f"opacity:{FAINT};" if state.status == "locked" else ""
        text = f"{_MARKS[state.status]}{TITLES[state.step]}"
        style = f"white-space:nowrap;{weight}{faint}border-bottom:{line}"
        parts.append(f'<span style="{style}">{escape(text)}</span>')
    return block(f'<div style="{_SMALL}">{" → ".join(parts)}</div>')


def message_html(message: Message) -> str:
    """The last message in one line."""
    if not message.text:
        return ""
    red, green, blue = _OF_KIND[message.kind]
    style = f"border-left:4px solid rgb({red},{green},{blue});padding:1px 8px;{_SMALL}"
    role = "alert" if message.kind == "error" else "status"
    return block(
        f'<div role="{role}" style="{style};overflow-wrap:anywhere">{escape(message.text)}</div>'
    )


def command_html(*commands: str) -> str:
    """The equal command lines."""
    style = (
        "display:block;white-space:pre-wrap;overflow-wrap:anywhere;user-select:all;"
        f"font-size:0.75em;opacity:{FAINT};padding:3px 0"
    )
    lines = [f'<code style="{style}">{escape(command)}</code>' for command in commands]
    heading = f'<div style="{_SMALL};opacity:{FAINT}">The same on the command line:</div>'
    return block(heading, *lines)


def seen_html(seen: Seen) -> str:
    """What arrives from camera and robot."""
    image = "nothing yet" if seen.image is None else f"{seen.image.shape[1]}x{seen.image.shape[0]}"
    rows = [("camera", seen.camera_problem or image)]
    if seen.fixed_problem:
        rows.append(("fixed camera", seen.fixed_problem))
    if seen.base_from_gripper is None:
        rows.append(("gripper pose", seen.robot_problem or "nothing yet"))
    else:
        x, y, z = 1000 * seen.base_from_gripper.translation_m
        rows.append(("gripper pose", seen.robot_problem or f"{x:+.1f} {y:+.1f} {z:+.1f} mm"))
        still = seen.still_s()
        rows.append(("arm", f"stands still for {still:.0f} s" if still > 1 else "moves"))
    return block(table(rows))


def coverage_html(covered: Coverage, limits: tuple[float, float]) -> str:
    """Bars of rotations (degrees) and positions (millimetres) up to their limits."""
    rows = [_bar(axis, "°", limits[0]) for axis in covered.rotations]
    rows += [_bar(axis, " mm", limits[1]) for axis in covered.positions]
    words = "Spread of the good samples; full is enough:"
    heading = f'<div style="{_SMALL};opacity:{FAINT}">{words}</div>'
    return block(heading, f'<table style="width:100%;{_SMALL}">{"".join(rows)}</table>')


def _bar(axis: AxisCoverage, unit: str, limit: float) -> str:
    share = 100 * min(axis.spread / limit, 1.0)
    red, green, blue = GREEN if axis.covered else AMBER
    inner = f"width:{share:.0f}%;height:6px;border-radius:3px;background:rgb({red},{green},{blue})"
    bar = f'<div style="background:rgba(128,128,128,0.25);border-radius:3px"><div style="{inner}">'
    return (
        f'<tr><td style="opacity:{FAINT};width:46%">{escape(axis.name)}</td>'
        f'<td style="width:34%">{bar}</div></div></td>'
        f'<td style="text-align:right">{axis.spread:.0f}{unit}</td></tr>'
    )


def samples_html(covered: Coverage, thumbnails: Mapping[str, str]) -> str:
    """A list of the samples, the last one first."""
    rows = []
    for row in reversed(covered.samples):
        red, green, blue = RED if row.problems else GREEN
        words = "; ".join(row.problems) or f"good, sharpness {100 * row.sharpness:.0f} %"
        rows.append(
            f'<tr><td style="width:{_THUMBNAIL_PX + 8}px"><img src="{thumbnails[row.name]}" '
            f'alt="" style="display:block;border-left:4px solid rgb({red},{green},{blue})"></td>'
            f'<td style="width:5em">{escape(row.name)}</td><td>{escape(words)}</td></tr>'
        )
    if not rows:
        return ""
    style = f"max-height:190px;overflow-y:auto;{_SMALL}"
    return block(f'<div style="{style}"><table style="width:100%">{"".join(rows)}</table></div>')


def live_html(image: Image) -> str:
    """The live picture."""
    return picture_html(image, "live image", _PICTURE_PX, "max-height:200px")


def thumbnail_url(image: Image) -> str:
    """A small JPEG as the address of an HTML image."""
    return jpeg_url(image, _THUMBNAIL_PX)
