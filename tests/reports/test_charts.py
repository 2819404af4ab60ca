"""Charts: numbers lie where they belong, in SVG as in pixels, and names are escaped."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.reports.charts import INKS, Panel, Shape, paint, rgb, write
from evercal.reports.page import environment
from evercal.reports.scene import Axes, Frustum, Surroundings, view_panel
from evercal.robot.frame_names import FrameNames

from .html_reader import HtmlReader

MARKUP = "<script>x</script> & 'y'"
MINUS = "\N{MINUS SIGN}"
BOX = (400, 200)
NAN = np.array([[np.nan, np.nan]])


def panel(
    *shapes: Shape, low: Any = (-1, 0), high: Any = (3, 10), x: str = "a (m)"
) -> Panel:
    return Panel(BOX, np.array([low, high], np.float64), (x, "b (deg)"), shapes)


def line(points: Any, kind: Any = "line", **style: Any) -> Shape:
    return Shape(kind, np.array(points, np.float64), "orange", **style)


def written(*panels: Panel) -> str:
    """The figure of a chart."""
    source = '{% from "blocks.html" import chart %}{{ chart(panels, caption) }}'
    return environment().from_string(source).render(panels=panels, caption=MARKUP)


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (-1, 3, "-1.0 -0.5 0.0 0.5 1.0 1.5 2.0 2.5 3.0"),
        (0.4, 5.6, "1 2 3 4 5"),
        (0.4, 140.6, "20 40 60 80 100 120 140"),
        (0, 0.001, "0.0000 0.0002 0.0004 0.0006 0.0008 0.0010"),
        (-0.31, -0.12, "-0.30 -0.25 -0.20 -0.15"),
        (1190, 1207, "1190 1195 1200 1205"),
        (-5e4, 1e5, "-40000 -20000 0 20000 40000 60000 80000 100000"),
    ],
)
def test_ticks_are_few_round_numbers_at_their_places(
    low: float, high: float, words: str
) -> None:
    texts = panel(low=(low, 0), high=(high, 1)).texts
    ticks = [(word, x) for word, x, y, _ in texts if y == BOX[1] + 18]
    assert " ".join(word for word, _ in ticks) == words.replace("-", MINUS)
    for word, x in ticks:
        number = float(word.replace(MINUS, "-"))
        assert x == pytest.approx((number - low) / (high - low) * BOX[0], abs=0.06)


def test_numbers_of_the_y_axis_lie_beside_their_lines() -> None:
    chart = panel()
    beside = {word: y - 4 for word, x, y, align in chart.texts if align == 2}
    assert beside == {"0": 200, "2": 160, "4": 120, "6": 80, "8": 40, "10": 0}
    grid = chart.pixels(chart.drawn[0].points).reshape(-1, 3, 2)[:, :2]
    across = grid[(grid[:, 0, 1] == grid[:, 1, 1])]
    assert sorted(across[:, 0, 1]) == sorted(beside.values())
    assert (across[:, :, 0] == (0, 400)).all()


def test_an_axis_without_a_label_has_no_numbers() -> None:
    assert {align for *_, align in panel(x="").texts if align != 1} == {0, 2}
    assert [words for words, *_, align in panel(x="").texts if align == 1] == [""]


def test_paths_are_those_of_the_points() -> None:
    corner = (-1, 0)
    middle = (1, 5)
    end = (3, 10)
    chart = panel()
    assert chart.path(line([corner, middle, end])) == "M0,200 200,100 400,0"
    gap = np.concatenate([NAN, [corner, middle], NAN, NAN, [end, middle], NAN])
    assert (
        chart.path(line(gap)).replace(" M", "M").strip()
        == "M 0,200 200,100M 400,0 200,100"
    )
    assert chart.path(line([corner, end], "dots")) == "M0,200h0M400,0h0"
    assert (
        chart.path(line(np.zeros((0, 2))))
        == chart.path(line(np.zeros((0, 2)), "dots"))
        == ""
    )


def test_a_chart_holds_its_shapes_and_escaped_names() -> None:
    shapes = line([(0, 1), (1, 2)], width=2.5), line([(0, 1)], "dots", opacity=0.3)
    text = written(panel(*shapes, x=MARKUP), panel(x=""))
    reader = HtmlReader(text)
    assert "script" not in reader.tags
    assert MARKUP in reader.text("text").splitlines()
    assert reader.text("figcaption") == MARKUP
    assert reader.tags.count("path") == 2 * 2 + len(shapes)  # each grid, and the axes
    assert (
        'class="line" style="color: var(--orange); stroke-width: 2.5; stroke-opacity: 1.0"'
        in text
    )
    assert 'stroke-opacity: 0.3" d="M100,180h0"' in text
    # Two charts of a page do not collide.
    assert not re.search(r"url\(|href| id=", text)


def test_every_ink_differs_from_both_papers() -> None:
    def light(colour: str) -> float:
        levels = np.array([*bytes.fromhex(colour[1:])]) / 255
        return float(levels**2.2 @ (0.2126, 0.7152, 0.0722))

    for name in INKS.keys() - {"grid"}:
        on_light, on_dark = map(light, INKS[name])
        assert 1.05 / (on_light + 0.05) > 3  # WCAG 2 for graphics
        assert (on_dark + 0.05) / (light("#0d1117") + 0.05) > 3
    assert rgb("blue") == (0, 114, 178)


def test_frames_show_shapes_where_they_belong() -> None:
    frame = np.full((300, 520, 3), 255, np.uint8)
    tall = line([(1, -9), (1, 99)], width=2), line([(2, 5)], "dots", width=10)
    paint(frame, panel(*tall), 80, 40)
    orange = np.abs(frame.astype(int) - rgb("orange")).max(2) < 40
    rows, columns = np.nonzero(orange[:, :330])
    # X = 1 is the middle of the box.
    assert (columns.min(), columns.max()) == (
        279,
        280,
    )
    assert (rows.min(), rows.max() > 230) == (40, True)  # and nothing lies outside
    rows, columns = np.nonzero(orange[:, 330:])
    assert (rows.mean() - 40, columns.mean() + 250) == pytest.approx((100, 300), abs=1)
    assert np.ptp(rows) == pytest.approx(10, abs=2)
    dark = np.all(frame < 60, axis=2)
    assert dark[:, 79:82].any(1).sum() >= 195  # the axis
    assert dark[255:266, 230:330].any()  # numbers


def test_a_dot_is_as_pale_as_its_opacity() -> None:
    frame = np.full((300, 520, 3), 255, np.uint8)
    paint(frame, panel(line([(2, 5)], "dots", width=10, opacity=0.5)), 80, 40)
    np.testing.assert_allclose(
        frame[140, 380], (255 + np.array(rgb("orange"))) / 2, atol=1
    )


@pytest.mark.parametrize("align", [0, 1, 2])
def test_words_are_aligned(align: int) -> None:
    image = np.full((40, 400, 3), 255, np.uint8)
    write(image, (f"{MINUS}0.5 été", 200, 25, align))
    columns = np.flatnonzero((image < 128).any((0, 2)))
    ends = columns[0], columns[-1]
    assert (ends[0], (ends[0] + ends[1]) / 2, ends[1])[align] == pytest.approx(
        200, abs=3
    )


def test_a_view_has_one_scale_and_shows_what_lies_inside() -> None:
    points = np.array([[0.5, 0.5, 9.0], [0.6, -0.4, 0.0], [50.0, 0.0, 0.0]])
    around = Surroundings(points, np.array([0, 255, 90], np.uint8))
    view = Frustum.of(SE3.identity(), Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    seen = np.array([[0.0, 0.0, 0.0], [2.0, 0.5, 1.0]])
    shown = view_panel((300, 200), Axes(unit="unit unknown"), around, seen, view)
    x, y = np.ptp(shown.limits, axis=0)
    assert x / y == pytest.approx(1.5)
    assert (shown.limits[0] < seen[:, :2].min(0)).all()
    assert (shown.limits[1] > seen[:, :2].max(0)).all()
    assert shown.labels == ("x of base (unit unknown)", "y of base (unit unknown)")
    dots = [shape for shape in shown.shapes if shape.kind == "dots"]
    drawn = {float(d.opacity): d.points.tolist() for d in dots if len(d.points)}
    dark, bright = sorted(drawn, reverse=True)
    assert (drawn[dark], drawn[bright]) == ([[0.5, 0.5]], [[0.6, -0.4]])
    assert [s.ink for s in shown.shapes if s.kind == "line"] == [
        "red",
        "green",
        "blue",
        "orange",
    ]


@pytest.mark.slow("src/evercal/reports/templates", "src/evercal/reports/charts.py")
@pytest.mark.parametrize("width", [1100, 390])
def test_charts_in_a_browser_keep_their_words_inside(
    browser: Any, tmp_path: Path, width: int
) -> None:
    from .test_calibration_page import full, read

    file = tmp_path / "page.html"
    frame = "a_parent_frame_with_a_long_name"
    file.write_text(
        read(full(frames=FrameNames(frame, camera="camera")))[1].html, encoding="utf-8"
    )
    colours = []
    for scheme in ("light", "dark"):
        visit = browser.new_page(
            viewport={"width": width, "height": 800}, color_scheme=scheme
        )
        visit.goto(file.as_uri())
        outside = visit.evaluate("""() =>
            [...document.querySelectorAll(".chart text")].filter(t => {
            const own = t.getBoundingClientRect();
            const box = t.closest("svg").getBoundingClientRect();
            return t.textContent && (own.left < box.left || own.right > box.right
              || own.top < box.top || own.bottom > box.bottom); }).map(t => t.textContent)""")
        assert outside == []
        overlap = visit.evaluate("""() => {
            const boxes = [...document.querySelectorAll(".chart text")].filter(t => t.textContent)
              .map(t => t.getBoundingClientRect());
            return boxes.filter((a, i) => boxes.some((b, j) => j > i && a.left < b.right
              && b.left < a.right && a.top < b.bottom - 2 && b.top < a.bottom - 2)).length; }""")
        assert overlap == 0
        style = "getComputedStyle(document.querySelector('.chart .area')).stroke"
        colours.append(visit.evaluate(style))
        visit.close()
    assert colours == ["rgb(213, 94, 0)", "rgb(230, 159, 0)"]
