"""Reading back what the simulator records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from fgloc_datasets.sim.sensors import EPOCH_NS

Row = tuple[int, int, Any]  # header stamp and receive time [ns], message


def messages(bag: Path, until_s: float = np.inf) -> dict[str, list[Row]]:
    """Messages with a header by topic, those with stamps up to a time."""
    out: dict[str, list[Row]] = {}
    with AnyReader([bag]) as reader:
        for connection, received_ns, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if hasattr(message, "header"):
                stamp = message.header.stamp
                stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
                if stamp_ns <= EPOCH_NS + until_s * 1e9:
                    out.setdefault(connection.topic, []).append((stamp_ns, received_ns, message))
    return out
