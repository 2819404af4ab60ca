"""`evercal arm-in-view`, its report, and `evercal check` of a camera by its arm."""

from pathlib import Path

import pytest

from evercal.cli import main
from tests import arm_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, `camera.json` made of it, and the report."""
    folder = tmp_path_factory.mktemp("arm")
    arm_cell.write(folder / "recording")
    words = ["arm-in-view", str(folder / "recording"), "--out", f"{folder}/camera.json"]
    assert main([*words, "--report", f"{folder}/report.html"]) == 0
    return folder


def test_the_report_draws_the_outline_of_the_arm(cell: Path) -> None:
    page = (cell / "report.html").read_text("utf-8")
    assert page.count("% of the outline shown") >= 4
    for name in ("Lines are the outline of the arm", "<td>fore</td>", "<td>hand</td>"):
        assert name in page
    assert "residual (deg)" not in page
    assert "--store MAP" not in page
