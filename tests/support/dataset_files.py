"""Small source files of the public sets, and reading back of what the converters made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from fgloc.recording.messages import default_typestore

Messages = dict[str, list[tuple[int, Any]]]


def read_back(bag: Path) -> tuple[Messages, list[int]]:
    """Messages by topic with their receive times, and all receive times in the order of the file."""
    messages: Messages = {}
    received = []
    with AnyReader([bag], default_typestore=default_typestore()) as reader:
        for connection, received_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            messages.setdefault(connection.topic, []).append((received_ns, message))
            received.append(received_ns)
    return messages, received


def header_ns(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def write_mrclam(
    folder: Path, robots: dict[int, dict[str, np.ndarray]], landmarks: dict[int, tuple[float, float]]
) -> None:
    """Files of the set. A robot has "odometry" (n, 3), "measurement" (m, 4) with barcodes and "groundtruth" (k, 4)."""
    folder.mkdir(parents=True, exist_ok=True)
    barcodes = "".join(f"{subject} \t {barcode(subject)} \n" for subject in range(1, 21))
    (folder / "Barcodes.dat").write_text("# Subject #    Barcode #\n" + barcodes)
    rows = "".join(f"{i} \t {x:.8f} \t {y:.8f} \t 0.0001 \t 0.0002 \n" for i, (x, y) in landmarks.items())
    (folder / "Landmark_Groundtruth.dat").write_text("# Subject #    x [m]    y [m]\n" + rows)
    for number, tables in robots.items():
        for name, table in tables.items():
            lines = "".join(" \t ".join(_number(v, k) for k, v in enumerate(row)) + " \n" for row in table)
            (folder / f"Robot{number}_{name.capitalize()}.dat").write_text("# Time [s] ...\n" + lines)


def barcode(subject: int) -> int:
    """A barcode that is not the subject's number."""
    return 100 - 3 * subject


def _number(value: float, column: int) -> str:
    return f"{value:.3f}" if column == 0 else f"{value:.8f}"
