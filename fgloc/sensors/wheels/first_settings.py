"""The wheels' section of a first ``robot.yaml``."""

from __future__ import annotations

from fgloc.sensors.first_settings import FirstLook, FirstSection, FirstSettings
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.geometry import NAMED_BY, WheelGeometry, WheelPair, fit_geometry, wheel_pair
from fgloc.types import ControlEvent


def section(look: FirstLook) -> FirstSection:
    """Joints, radii and track, as far as the recording shows them."""
    joints = [event for event in look.events[JointsEvent] if isinstance(event, JointsEvent)]
    odometry = [event for event in look.events[OdometryEvent] if isinstance(event, OdometryEvent)]
    names = tuple(dict.fromkeys(name for event in joints[:NAMED_BY] for name in event.names))
    if not names:
        return FirstSection()
    pair = wheel_pair(names)
    commands = [event for event in look.events[ControlEvent] if isinstance(event, ControlEvent)]
    geometry = None if pair is None or not odometry else fit_geometry(pair, joints, odometry, commands)
    head = f"# Joints in the recording: {', '.join(names)}."
    if pair is not None and geometry is not None:
        return FirstSection((head, *_found(pair, geometry)))
    if pair is None:
        missing = (
            f"which joints are the wheels: {', '.join(names)}; give wheels.left_joint and wheels.right_joint, their "
            "radii and the track"
        )
    else:
        missing = "radii and track of the wheels: measure them (wheels.left_radius, right_radius, track)"
    return FirstSection((head, *_to_fill_in(pair)), (missing,))


def _found(pair: WheelPair, geometry: WheelGeometry) -> tuple[str, ...]:
    track = "the track that with which it obeys commands" if geometry.by_commands else "likewise the track"
    return (
        f"# The radius is that with which the driver made its odometry, {track}; measure them all the same.",
        "wheels:",
        "  source: ticks",
        f"  left_joint: {pair.left}",
        f"  right_joint: {pair.right}",
        f"  left_radius: {geometry.radius_m:.4g}  # m",
        f"  right_radius: {geometry.radius_m:.4g}",
        f"  track: {geometry.track_m:.4g}  # m, between the wheels' contact points",
        "  # scale_sigma: 0.01  # how far the radii may be off; fgloc calibrate finds by how much they are",
    )


def _to_fill_in(pair: WheelPair | None) -> tuple[str, ...]:
    return (
        "# Fill in to use the angles of the wheels, which are better than the driver's odometry:",
        "# wheels:",
        "#   source: ticks",
        f"#   left_joint: {pair.left if pair else ''}",
        f"#   right_joint: {pair.right if pair else ''}",
        "#   left_radius:   # m",
        "#   right_radius:  # m",
        "#   track:         # m, between the wheels' contact points",
    )


FIRST_SETTINGS = FirstSettings((JointsEvent, OdometryEvent, ControlEvent), section)
