"""What sensors offer to motion models as inputs, beside control inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from numpy.typing import ArrayLike
from pydantic import Field, FiniteFloat

from fgloc.files.section import Section
from fgloc.sensors.base import MotionRole
from fgloc.sensors.signals import Signal
from fgloc.types import MotionEvent

_Positive = Annotated[FiniteFloat, Field(gt=0)]


class WheelJoints(Section):
    """Joints of two driven wheels, and their geometry."""

    left: str | None = Field(None, description="joint of the left wheel; None: the one named so")
    right: str | None = None
    left_radius: _Positive | None = Field(None, description="m; the input wheels needs it")
    right_radius: _Positive | None = None
    track: _Positive | None = None

    @property
    def measured(self) -> bool:
        """Whether the geometry is known."""
        return None not in (self.left_radius, self.right_radius, self.track)


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """What a channel may need to know of the robot.

    Attributes:
        joints: of the wheels; None: not known.
        gyro_bias: one number, or one for each inertial event [rad/s].
        imu_up: ``(3,)`` the base's z axis in the axes of the inertial unit.
    """

    joints: WheelJoints | None = None
    gyro_bias: ArrayLike = 0.0
    imu_up: ArrayLike = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One input of a motion model, as a sensor measures it.

    Attributes:
        name: in the card of a model.
        width: how many numbers it has at one time.
        rank: its place among the channels that a network reads. Model files depend on it.
        event: class of the events that it is made of.
        signal: of events in order of stamp, since a time [ns]; None where they do not give it.
        role: of the motion source whose motion it is: a model that reads it depends on that; None: of none.
        needs_joints: whether it takes the names of the wheels' joints.
        needs_geometry: whether it takes their geometry too.
    """

    name: str
    width: int
    rank: int
    event: type[MotionEvent]
    signal: Callable[[Sequence[Any], int, Mounting], Signal | None]
    role: MotionRole | None = None
    needs_joints: bool = False
    needs_geometry: bool = False
