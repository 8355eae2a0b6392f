"""What is looked at first: how much of it there may be, and what the libraries print meanwhile."""

from __future__ import annotations

import os
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from avatar.errors import UserError
from data_prep.progress import silent
from data_prep.track.faces.detect import quiet
from data_prep.track.first_pass import look_at
from data_prep.track.footage.source import Span


def test_recordings_that_are_too_long_together_are_refused_before_any_is_looked_at() -> None:
    joined: Any = SimpleNamespace(is_joined=True, width=64, height=64, duration=200.0, rate=25.0)
    with pytest.raises(UserError, match="the recordings have 5000 times together; give at most 3600"):
        look_at(joined, Span(), silent)


def test_two_threads_that_are_quiet_leave_the_standard_error_where_it_was() -> None:
    before, first_in, second_in, first_out = os.fstat(2), *(threading.Event() for _ in range(3))

    def first() -> None:
        with quiet():
            first_in.set()
            second_in.wait(0.3)  # which it cannot be
        first_out.set()

    def second() -> None:
        first_in.wait()
        with quiet():
            second_in.set()
            first_out.wait()

    threads = [threading.Thread(target=act) for act in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert os.path.samestat(os.fstat(2), before)
