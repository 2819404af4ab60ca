"""The summary of `benchmarks calibration`."""

from benchmarks import calibration
from benchmarks.accuracy import Row


def test_trials_are_summarized_by_number_of_images() -> None:
    rows: list[Row] = [
        {"images": images, "mm": mm, "deg": 0.1, "squared_mahalanobis": squared}
        for images, mm, squared in ((25, 1.0, 3.0), (5, 4.0, 3.0), (25, 2.0, 20.0), (5, 8.0, 4.0))
    ]
    many, five = calibration.summary(rows).splitlines()
    assert "25 images: 2 trials, median 1.50 mm" in many
    assert "worst 2.00 mm" in many
    assert "50.0 % inside" in many
    assert "5 images: 2 trials, median 6.00 mm" in five
    assert "100.0 % inside" in five
