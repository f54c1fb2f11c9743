"""The section ``wheels`` of a first ``robot.yaml``, from what a recording of an unknown robot holds."""

from __future__ import annotations

from collections.abc import Iterator

from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.geometry import fit_geometry, wheel_pair
from fgloc.types import Event

_FIRST = 100  # messages whose joints are listed


class WheelsDraft:
    """See `fgloc.sensors.roles.SettingsDraft`."""

    def __init__(self) -> None:
        self._joints: list[JointsEvent] = []
        self._odometry: list[OdometryEvent] = []

    def add(self, event: Event) -> None:
        """Take in one event of a recording."""
        if isinstance(event, JointsEvent):
            self._joints.append(event)
        elif isinstance(event, OdometryEvent):
            self._odometry.append(event)

    def lines(self, missing: list[str]) -> Iterator[str]:
        """Of ``robot.yaml``; sentences on what it lacks are added to ``missing``."""
        names = tuple(dict.fromkeys(name for event in self._joints[:_FIRST] for name in event.names))
        if not names:
            return
        pair = wheel_pair(names)
        geometry = fit_geometry(pair, self._joints, self._odometry) if pair is not None and self._odometry else None
        yield ""
        yield f"# Joints in the recording: {', '.join(names)}."
        if pair is None:
            missing.append(
                f"which joints are the wheels: {', '.join(names)}; give wheels.left_joint and wheels.right_joint, "
                "their radii and the track"
            )
        if geometry is None:
            if pair is not None:
                missing.append("radii and track of the wheels: measure them (wheels.left_radius, right_radius, track)")
            yield "# Fill in to use the angles of the wheels, which are better than the driver's odometry:"
            yield "# wheels:"
            yield "#   source: ticks"
            yield f"#   left_joint: {pair.left if pair else ''}"
            yield f"#   right_joint: {pair.right if pair else ''}"
            yield "#   left_radius:   # m"
            yield "#   right_radius:  # m"
            yield "#   track:         # m, between the wheels' contact points"
            return
        assert pair is not None
        yield "# Radius and track are those with which the driver made its odometry; measure them all the same."
        yield "wheels:"
        yield "  source: ticks"
        yield f"  left_joint: {pair.left}"
        yield f"  right_joint: {pair.right}"
        yield f"  left_radius: {geometry.radius_m:.4g}  # m"
        yield f"  right_radius: {geometry.radius_m:.4g}"
        yield f"  track: {geometry.track_m:.4g}  # m, between the wheels' contact points"
        yield "  # scale_sigma: 0.01  # how far the radii may be off; fgloc calibrate finds by how much they are"
