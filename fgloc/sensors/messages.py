"""Parts that the messages of several sensors share, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fgloc.types import FloatArray


def nanoseconds(stamp: Any) -> int:
    """Of a ``builtin_interfaces/Time``."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def xyz(v: Any) -> FloatArray:
    """A vector or point ``(3,)``."""
    return np.array((v.x, v.y, v.z), dtype=float)


def xyzw(q: Any) -> FloatArray:
    """A quaternion ``(4,)``."""
    return np.array((q.x, q.y, q.z, q.w), dtype=float)


def vector(values: Any) -> FloatArray:
    """Numbers ``(n,)``."""
    return np.asarray(values, dtype=float)


def matrix(values: Any, n: int) -> FloatArray:
    """Numbers ``(n, n)``, row by row."""
    return np.asarray(values, dtype=float).reshape(n, n)


def byte_array(values: Any) -> NDArray[np.uint8]:
    """Bytes ``(n,)``."""
    return np.asarray(values, dtype=np.uint8)
