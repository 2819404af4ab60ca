"""What `benchmarks calibration` prints of its trials."""

import pytest

from benchmarks import calibration


def test_trials_with_different_numbers_of_images_are_told_apart(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows: list[dict[str, object]] = [
        {"images": images, "mm": mm, "deg": 0.1, "squared_mahalanobis": squared}
        for images, mm, squared in ((25, 1.0, 3.0), (5, 4.0, 3.0), (25, 2.0, 20.0), (5, 8.0, 4.0))
    ]
    calibration._summary(rows)
    of_all, of_five = capsys.readouterr().out.splitlines()
    assert "25 images: 2 trials, median 1.50 mm" in of_all
    assert "worst 2.00 mm" in of_all
    assert "50.0 % inside" in of_all
    assert "5 images: 2 trials, median 6.00 mm" in of_five
    assert "100.0 % inside" in of_five
