"""Participants of the tests on ROS 2's wire: loopback, in a domain of this process's own."""

from __future__ import annotations

import os
import time

import pytest

pytest.importorskip("cyclonedds")

DOMAIN = 1 + os.getpid() % 99  # beside those of other test processes; the benchmarks use 100 and up


def wait_until(true, timeout_s: float = 10.0) -> bool:
    """Whether a condition became true in time."""
    deadline = time.monotonic() + timeout_s
    while not (done := true()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return bool(done)
