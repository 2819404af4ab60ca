"""`benchmarks arm-in-view`: what a summary counts, and the conditions."""

import pytest

from benchmarks.arm_in_view import WHAT, Rows, summary
from benchmarks.arm_parts import PARTS, without
from benchmarks.rows import Row
from evercal.calibration.arm_in_view import solve

RIGHT: Row = {
    "condition": "a", "mm": 1.0, "deg": 0.02, "sigma_mm": 1.0, "sigma_deg": 0.02,
    "squared_mahalanobis": 4.0, "seconds": 8.0, "warnings": "", "confirmed": 0.5,
}  # fmt: skip


def test_a_summary_counts_wrong_answers_with_and_without_a_warning() -> None:
    far = RIGHT | {"mm": 12.0, "squared_mahalanobis": 26.0}
    wide = RIGHT | {"mm": 12.0, "squared_mahalanobis": 5.0}
    warned = far | {"warnings": "the background moves"}
    refused: Row = {"condition": "a", "refused": "no arm", "seconds": 2.0}
    (row,) = summary([RIGHT, far, wide, warned, refused])
    assert (row["draws"], row["refused"], row["warned"]) == (5, 1, 1)
    assert (row["wrong"], row["wrong_unwarned"]) == (2, 1)
    assert row["inside_95"] == pytest.approx(50)
    (row,) = summary([refused])
    assert "mm" not in row


def test_rows_are_measured_once(tmp_path) -> None:
    rows = Rows(tmp_path)
    rows.add("main", "a", 3, RIGHT)
    again = Rows(tmp_path)
    assert again.has("main", "a", 3)
    assert not again.has("main", "a", 4)


def test_the_mass_has_all_arms_and_faults_at_seeds_for_development() -> None:
    cells = {
        condition.setting(condition.first_seed).name
        for condition in WHAT["mass"].values()
    }
    assert len(WHAT["mass"]) == len(cells) * (1 + len(WHAT["wrong"]))
    assert all(name.startswith("drawn-") for name in cells)


def test_a_part_is_left_out_for_one_calibration_only() -> None:
    before = solve.robot_body
    with without("rough meshes, 3 mm"):
        assert solve.robot_body is not before
    assert before is solve.robot_body
    assert all(hasattr(solve, name) for name, _ in PARTS.values())
