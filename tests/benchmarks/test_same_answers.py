"""`benchmarks same-answers`: what counts as different."""

from benchmarks.same_answers import compare


def test_equal_answers_differ_in_nothing_but_volatile_values() -> None:
    before = {"mm": [1.0, 2], "seconds": 3.0, "status": "ok"}
    row = compare(before, {**before, "seconds": 4.0})
    assert (row["values"], row["different"], row["first"]) == (3, 0, "")


def test_differences_are_counted_and_the_largest_is_shown() -> None:
    row = compare({"mm": [1.0, 2.0]}, {"mm": [1.0, 2.5]})
    assert (row["different"], row["largest relative difference"]) == (1, 0.2)
    assert row["first"] == "/mm/1"
    for other in ({"mm": ["1", 2.0]}, {"mm": [1.0]}):
        row = compare({"mm": [1.0, 2.0]}, other)
        assert row["largest relative difference"] == float("inf")
