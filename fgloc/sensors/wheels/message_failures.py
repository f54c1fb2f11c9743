"""Failures in the contents of the wheels' messages: frozen, reset, rolled over, not a number, wrong covariance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from fgloc import se2
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.sensors.failures import Change, EventFailure, Failure, Scene
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event, FloatArray


class EncoderFrozen(Failure):
    """Odometry and wheel angles go on with new stamps but repeat their last values; then they jump to the present.

    Joint efforts, which motor drivers measure, go on as they are.
    """

    kind: Literal["encoder_frozen"] = "encoder_frozen"

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule = self.when.schedule(scene)
        last: dict[str, Event] = {}
        for event in events:
            if not isinstance(event, (OdometryEvent, JointsEvent)):
                yield event
            elif schedule.hits(event) and event.topic in last:
                self.touch(scene)
                frozen = replace(last[event.topic], stamp_ns=event.stamp_ns, received_ns=event.received_ns)
                if isinstance(frozen, JointsEvent) and isinstance(event, JointsEvent):
                    frozen = replace(frozen, names=event.names, effort=event.effort)
                yield frozen
            else:
                last[event.topic] = event
                yield event


class EncoderRollover(EventFailure):
    """Joint angles are counted modulo ``range_rad``: they fall back to 0 when they reach it."""

    kind: Literal["encoder_rollover"] = "encoder_rollover"
    range_rad: float = Field(6.283185307179586, gt=0, description="rad")

    def targets(self) -> tuple[type[Event], ...]:
        """Joint states."""
        return (JointsEvent,)

    def begin(self, scene: Scene) -> Change:
        """Wrap the angles."""

        def wrap(event: Event) -> Event:
            assert isinstance(event, JointsEvent)
            return replace(event, position=np.mod(event.position, self.range_rad))

        return wrap


class OdometryReset(Failure):
    """At the start of each interval odometry and wheel angles begin again at zero; after it they jump back."""

    kind: Literal["odometry_reset"] = "odometry_reset"

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The corrupted events, in order of receive time."""
        schedule = self.when.schedule(scene)
        origins: dict[tuple[str, float], FloatArray] = {}
        for event in events:
            interval = schedule.inside(event)
            if interval is None or not isinstance(event, OdometryEvent | JointsEvent) or not schedule.hits(event):
                yield event
                continue
            self.touch(scene)
            key = (event.topic, interval[0])
            if isinstance(event, JointsEvent):
                origin = origins.setdefault(key, event.position)
                same = len(origin) == len(event.position)
                yield replace(event, position=event.position - origin) if same else event
                continue
            pose = np.array([event.position[0], event.position[1], quaternion_yaw(event.orientation)])
            x, y, yaw = se2.between(origins.setdefault(key, pose), pose)
            yield replace(event, position=np.array([x, y, event.position[2]]), orientation=yaw_quaternion(float(yaw)))


class WheelNan(EventFailure):
    """Odometry's pose and twist, joints' angles and rates are not a number."""

    kind: Literal["wheel_nan"] = "wheel_nan"

    def targets(self) -> tuple[type[Event], ...]:
        """Odometry and joints."""
        return (OdometryEvent, JointsEvent)

    def begin(self, scene: Scene) -> Change:
        """Fill with NaN."""

        def corrupt(event: Event) -> Event:
            pose = ("position", "orientation", "linear", "angular")
            names = pose if isinstance(event, OdometryEvent) else ("position", "velocity")
            changes: dict[str, Any] = {name: np.full_like(getattr(event, name), np.nan) for name in names}
            return replace(event, **changes)

        return corrupt


class WrongCovariance(EventFailure):
    """Odometry's covariances are ``factor`` times what they were: 0 is unknown, a negative one invalid."""

    kind: Literal["wrong_covariance"] = "wrong_covariance"
    factor: float = Field(0.01, description="of variances")

    def targets(self) -> tuple[type[Event], ...]:
        """Odometry."""
        return (OdometryEvent,)

    def begin(self, scene: Scene) -> Change:
        """Multiply."""

        def scale(event: Event) -> Event:
            assert isinstance(event, OdometryEvent)
            return replace(event, pose_cov=event.pose_cov * self.factor, twist_cov=event.twist_cov * self.factor)

        return scale
