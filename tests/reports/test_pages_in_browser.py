"""Every report in a browser: contrast in both colour schemes, narrow screens, the first heading."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.calibration.checks import Checks
from evercal.evaluation import FrameResult
from evercal.reports.demo_page import DemoResult, FixedCamera, LearnedRoom, demo_page
from evercal.reports.page import Picture, Table

from .test_calibration_page import full, read, solved
from .test_page import PHOTO, page

pytestmark = pytest.mark.slow("src/evercal/reports/templates")

CONTRAST = """() => {
  const levels = c => c.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(v => v / 255).map(
    v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4
  ).reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const back = e => {
    for (; e; e = e.parentElement) {
      const [r, g, b, a = 1] = levels(getComputedStyle(e).backgroundColor);
      if (a === 1) return [r, g, b];
    }
    return [255, 255, 255];
  };
  const found = [];
  for (const e of document.body.querySelectorAll("*")) {
    const own = [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim());
    if (!own) continue;
    const [a, b] = [light(levels(getComputedStyle(e).color)), light(back(e))].sort((x, y) => y - x);
    found.push([(a + 0.05) / (b + 0.05), e.tagName, e.textContent.trim().slice(0, 40)]);
  }
  return found;
}"""


def demonstrated() -> str:
    rows = [FrameResult("a", "1", 0.001, 0.001, "ok", "a", False, 1.0, 9, 0.5)]
    result = DemoResult(
        learned=[LearnedRoom("a", 90, 9, 4000, 0.3, 5.0)],
        test=rows,
        changed=rows,
        cameras=[FixedCamera("a", 5, 5, 0.8, 0.02, 0.5, 5.1, 5.0, True)],
        unknown_images=2,
        unknown_refused=2,
    )
    return demo_page(result, [Picture(PHOTO)])


WIDE = Table([f"column {i}" for i in range(14)], [["evercal", *np.arange(13) / 7]])
PAGES = {
    "good": lambda: read(full())[1].html,
    "bad": lambda: (
        read(full(checks=Checks.from_dict({"repeatability_mm": 100.0}), verdict=""))[
            1
        ].html
    ),
    "solved": lambda: read(solved(), name="a_long_name_without_a_space" * 4)[1].html,
    "demo": demonstrated,
    "wide table": lambda: page(WIDE, Picture(PHOTO)),
}


@pytest.mark.parametrize("name", PAGES)
def test_pages_are_legible(name: str, browser: Any, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(PAGES[name](), encoding="utf-8")
    for scheme in ("light", "dark"):
        visit = browser.new_page(
            viewport={"width": 390, "height": 800}, color_scheme=scheme
        )
        visit.goto(file.as_uri())
        faint = [entry for entry in visit.evaluate(CONTRAST) if entry[0] < 4.5]
        assert faint == []
        assert visit.evaluate("document.documentElement.scrollWidth") <= 390
        first = visit.evaluate(
            "document.querySelector('h1, h2, h3, h4, h5, h6').tagName"
        )
        assert first == "H1"
        above = "document.querySelector('h1').getBoundingClientRect().bottom"
        assert visit.evaluate(above) < 400
        visit.close()
