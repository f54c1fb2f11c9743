"""A rosbag2 folder that takes messages, and the parts that many messages have."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fgloc.recording.messages import default_typestore

Tap = Callable[[str, str, Any, int], None]


class MessageWriter:
    """Writes any message of the typestore. Stamps are integer nanoseconds; ``received_ns`` defaults to the stamp."""

    def __init__(
        self, path: Path, storage: str = "mcap", overwrite: bool = False, compress: bool = False, tap: Tap | None = None
    ) -> None:
        """Open a new bag folder.

        Args:
            path: folder to be made.
            storage: "mcap" or "sqlite3".
            overwrite: replace an existing bag folder (one that holds a metadata.yaml).
            compress: zstd chunks, which readers of MCAP undo by themselves; MCAP only.
            tap: given every message as it is read from the bag, with its topic, type and receive time [ns].

        Raises:
            FileExistsError: the folder exists and is not to be replaced.
        """
        if path.exists():
            if not (overwrite and (path / "metadata.yaml").is_file()):
                raise FileExistsError(f"{path} exists; give another folder or remove it")
            for file in path.iterdir():
                file.unlink()
            path.rmdir()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._store = default_typestore()
        plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
        self._writer = Writer(path, version=9, storage_plugin=plugin)
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}
        self._tap = tap

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._writer.close()

    def copy(self, topic: str, message_type: str, raw: bytes | memoryview, received_ns: int) -> None:
        """Write a message that is already serialized (CDR); its type must be in the typestore."""
        self._writer.write(self._connection(topic, message_type), received_ns, raw)

    def knows(self, message_type: str) -> bool:
        """Whether the typestore defines a type, so that a message of it can be written."""
        return message_type in self._store.types

    def write(self, topic: str, message_type: str, message: Any, received_ns: int) -> None:
        """Write any message of the typestore."""
        raw = self._store.serialize_cdr(message, message_type)
        self._writer.write(self._connection(topic, message_type), received_ns, raw)
        if self._tap is not None:
            self._tap(topic, message_type, self._store.deserialize_cdr(raw, message_type), received_ns)

    def make(self, message_type: str, **fields: Any) -> Any:
        """A message of the typestore, for `write`."""
        return self._make(message_type, **fields)

    # --- parts of messages ---

    def _connection(self, topic: str, message_type: str) -> Connection:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, message_type, typestore=self._store)
        return self._connections[topic]

    def _make(self, message_type: str, **fields: Any) -> Any:
        return self._store.types[message_type](**fields)

    def _write(
        self, topic: str, kind: str, stamp_ns: int, received_ns: int | None, frame_id: str, content: dict[str, Any]
    ) -> None:
        message = self._make(kind, header=self._header(stamp_ns, frame_id), **content)
        self.write(topic, kind, message, stamp_ns if received_ns is None else received_ns)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        time = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def _vector(self, xyz: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Vector3", **xyz_fields(xyz))

    def _quaternion(self, xyzw: Sequence[float]) -> Any:
        x, y, z, w = (float(value) for value in xyzw)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _twist(self, linear: Sequence[float], angular: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Twist", linear=self._vector(linear), angular=self._vector(angular))

    def _planar_pose(self, pose: Sequence[float]) -> Any:
        x, y, yaw = pose
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", **xyz_fields((x, y, 0.0))),
            orientation=self._quaternion((0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))),
        )


def xyz_fields(values: Sequence[float]) -> dict[str, float]:
    """Fields of a vector or point."""
    x, y, z = (float(value) for value in values)
    return {"x": x, "y": y, "z": z}


def flat_cov(cov: ArrayLike | None) -> Any:
    """A covariance ``(6, 6)`` as messages have it; zeros for None."""
    return np.zeros(36) if cov is None else np.asarray(cov, dtype=float).reshape(36)
