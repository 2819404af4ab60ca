"""Commands that are killed leave a map that opens, answers and can be changed."""

import json
from pathlib import Path

import pytest

from benchmarks import faults

GOOD = {"command", "fault", "runs", "before", "after", "done, after", "refused in one line, before"}


@pytest.mark.slow
def test_killed_commands_and_full_disks(tmp_path: Path) -> None:
    faults.run(8, 1, ("remove", "rename"), tmp_path / "rooms", tmp_path / "out.json")
    rows = json.loads((tmp_path / "out.json").read_text())
    assert {row["fault"] for row in rows} == {"kill -9", "full disk", "read-only"}
    for row in rows:
        assert set(row) <= {*GOOD, "no mount"}, row
