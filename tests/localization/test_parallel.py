"""Many items at once, in order."""

from __future__ import annotations

import threading
import time

import pytest

from evercal.localization.parallel import in_parallel


def test_results_come_in_the_order_of_the_items(two_threads: None) -> None:
    workers = set()

    def slowest_first(item: int) -> int:
        workers.add(threading.get_ident())
        time.sleep(0.02 if item == 0 else 0.005)
        return item * item

    assert list(in_parallel(slowest_first, range(6))) == [i * i for i in range(6)]
    assert len(workers) == 2
    # One item needs no other thread.
    assert list(in_parallel(lambda _: threading.get_ident(), [0])) == [
        threading.get_ident()
    ]
    assert list(in_parallel(lambda item: item, [])) == []


def test_an_error_is_raised_in_its_turn_and_what_follows_is_left_out(
    two_threads: None,
) -> None:
    begun = []

    def work(item: int) -> int:
        begun.append(item)
        if item == 2:
            raise ValueError("two")
        time.sleep(0.01)
        return item

    results = in_parallel(work, range(100))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
    assert len(begun) < 20
