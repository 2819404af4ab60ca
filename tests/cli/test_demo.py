"""`evercal demo`, made small."""

import functools
import json
import re
from pathlib import Path
from typing import Any

import pytest

from evercal.cli import demo
from evercal.cli.demo import DemoOptions
from evercal.cli.demo_outcome import DemoOutcome
from evercal.datasets import read_image


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    options = functools.partial(DemoOptions, train_frames=16, test_frames=4)
    monkeypatch.setattr(demo, "DemoOptions", options)


@pytest.mark.usefixtures("small")
def test_demo_leaves_a_report_a_picture_and_a_store(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    outcome = json.loads(run("demo", "--out", out, "--json").out)
    assert outcome["rooms"] == ["box-room-41", "box-room-42"]
    for method in ("evercal", "finetune"):
        first, second = outcome["accuracy_5cm_5deg"][method]
        assert (len(first), len(second)) == (1, 2)
        assert all(0 <= value <= 100 for value in first + second)
    assert outcome["memory_bytes"] > 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["overview.png", "query.png", "report.html", "store"]
    height, width, _ = read_image(out / "overview.png").shape
    assert width > 2 * height > 400
    page = (out / "report.html").read_text()
    assert page.count('<img src="data:image/') == 3
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    assert "fine-tuning" in page
    assert run("localize", out / "store", out / "query.png").code in (0, 1)
    scenes = json.loads(run("info", out / "store", "--json").out)["scenes"]
    assert [scene["name"] for scene in scenes] == outcome["rooms"]


@pytest.mark.usefixtures("small")
def test_what_is_in_the_way_stays(run: Any, tmp_path: Path, snapshot: Any) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store/letter.txt").write_text("dear")
    before = snapshot(tmp_path)
    ran = run("demo", "--out", tmp_path)
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(tmp_path) == before


def test_rows_leave_rooms_not_yet_learned_blank() -> None:
    outcome = DemoOutcome(["a", "b"], {"finetune": [[90.0], [0.0, 92.5]]})
    assert outcome.rows() == [
        ["fine-tuning", "+ a", "90.0", ""],
        ["fine-tuning", "+ b", "0.0", "92.5"],
    ]
    assert "92.5" in outcome.table()
