from __future__ import annotations

import time

from avatar.bench.clock import paired_medians, time_of


def test_functions_take_turns_and_the_warm_up_is_not_counted() -> None:
    calls: list[str] = []
    slow_once = iter([0.05, 0.0, 0.0, 0.0])

    def first() -> None:
        calls.append("first")
        time.sleep(next(slow_once))

    times = paired_medians({"first": first, "second": lambda: calls.append("second")}, repeats=3)
    assert calls == ["first", "second"] * 4
    assert times["first"].repeats == 3
    assert 0 < times["first"].median <= times["first"].p95 < 50


def test_a_sleep_is_measured_in_milliseconds() -> None:
    assert 20 <= paired_medians({"": lambda: time.sleep(0.02)}, repeats=1)[""].median < 2000


def test_a_time_is_the_median_and_the_95th_percentile() -> None:
    time = time_of([float(i) for i in reversed(range(21))])
    assert (time.median, time.p95, time.repeats) == (10.0, 19.0, 21)
