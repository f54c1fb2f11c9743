"""Participants of the tests on ROS 2's wire: loopback, in a domain of this process's own."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import pytest

pytest.importorskip("cyclonedds")

DOMAIN = 1 + os.getpid() % 99  # beside those of other test processes; the benchmarks use 100 and up


def wait_until(
    true: Callable[[], object], timeout_s: float = 60.0, progress: Callable[[], object] = lambda: None
) -> bool:
    """Whether a condition became true; the time runs from the last progress, on a machine however busy."""
    reached, deadline = progress(), time.monotonic() + timeout_s
    while not (done := true()) and time.monotonic() < deadline:
        time.sleep(0.01)
        if (now := progress()) != reached:
            reached, deadline = now, time.monotonic() + timeout_s
    return bool(done)
