"""The robot is picked up and carried while the recording goes on: wheels in the air, hands that shake the IMU."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pydantic import Field, model_validator

from fgloc.sensors import registry
from fgloc.sensors.failures import Carriage, Failure, Scene, When
from fgloc.types import Event, RawEvent, SightingsEvent


class Lift(Failure):
    """Inside each interval the robot is lifted, carried along the way that the recording drives, and set down.

    No time is cut out (`Kidnap` does that), and the truth stays: it is carried where it went, turning as it did.
    Wheels stand, or spin in the air at ``spin_m_s`` of their rims without load; commands are zero, or ask for that
    spinning. The IMU keeps its turning and its horizontal accelerations; added are the rise and descent by ``height_m``
    (minimum jerk, ``rise_s`` each), the bounce of a walking person, a tilt and the hands' sway. The IMU is taken to be
    level. Markers are hidden unless ``markers`` is "shown". Times are stamps, from the first message received.
    """

    kind: Literal["lift"] = "lift"
    when: When = When(bursts=1)
    wheels: Literal["still", "spin"] = "still"
    spin_m_s: float = Field(0.3, description="m/s, of the rims")
    markers: Literal["hidden", "shown"] = "hidden"
    height_m: float = Field(0.5, gt=0, description="m")
    rise_s: float = Field(1.0, gt=0, description="s")

    @model_validator(mode="after")
    def _bounded(self) -> Lift:
        if self.when.share != 1.0 or not (self.when.intervals or self.when.bursts):
            raise ValueError("lift needs a beginning and an end: give 'when' intervals or bursts, and no share")
        return self

    def apply(self, events: Iterator[Event], scene: Scene) -> Iterator[Event]:
        """The events, in order of receipt."""
        spin = self.spin_m_s if self.wheels == "spin" else 0.0
        intervals = self.when.schedule(scene).intervals
        carriage = Carriage(intervals, spin, self.height_m, self.rise_s, scene)
        carried = registry.carried(carriage)
        for event in events:
            held = carriage.interval(event) is not None
            if (tell := carried.get(type(event))) is not None:
                changed: Event | None = tell(event)
            else:
                hidden = self.markers == "hidden" and isinstance(event, RawEvent | SightingsEvent)
                changed = None if held and hidden else event
            if changed is not event:
                self.touch(scene)
            if changed is not None:
                yield changed
