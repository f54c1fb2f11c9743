"""What slips say of the floor: where the wheels slipped, the robot slides, and no motion source sees it.

Wheels tell how far they turned and a model how far a robot goes that holds; neither tells the rest. What is missed is
in one direction for as long as a slip lasts, so that its sigma grows with the time; sideways it grows with the
acceleration that holds the robot on its curve. For a while after a slip the next slide is likely, seen or not: the
floor is the same. Slides are rare and large. While there are sightings these show them, and room for them would only
make the motion less worth than it mostly is; in the dark it is the covariance that has to allow for them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgloc.types import FloatArray, MotionMeasurement

BLIND_S = 0.3  # without a fix
_SLIDE = 0.015  # m/s that a slipping robot's speed is wrong by, all along
_SIDESLIP = 0.3  # of the speed sideways of a robot that nothing holds on its curve
_SIDESLIP_S = 1.0  # after which it goes no faster
_MEMORY_S = 20.0  # after a slip
_LOOSE = 0.015  # of the speed: what goes unseen on a slippery floor, per sqrt(s) ...
_LOOSE_SIDEWAYS = 0.05  # s of the acceleration towards the middle of a curve, likewise sideways


@dataclass(frozen=True, slots=True)
class Footing:
    """What is known of it when a step begins.

    Attributes:
        slipping_s: how long the wheels have been slipping.
        firm_s: how long they have not.
        blind: whether sightings are too long ago to show a slide.
    """

    slipping_s: float = 0.0
    firm_s: float = math.inf
    blind: bool = False

    def then(self, slips: bool, dt: float) -> Footing:
        """After a step."""
        return Footing(self.slipping_s + dt, 0.0) if slips else Footing(0.0, self.firm_s + dt)

    def room(self, m: MotionMeasurement, slips: bool) -> FloatArray:
        """Covariance ``(3, 3)`` of what the motion of a step misses.

        Args:
            m: what is believed of it.
            slips: whether the wheels slip during the step.
        """
        if not self.blind or (not slips and self.firm_s > _MEMORY_S):
            return np.zeros((3, 3))
        dt = max((m.stamp_ns - m.start_ns) * 1e-9, 1e-3)
        speed = math.hypot(m.motion[0], m.motion[1]) / dt
        inwards = speed * abs(float(m.motion[2])) / dt
        if slips:
            growth = (self.slipping_s + dt) ** 2 - self.slipping_s**2
            sideways = _SIDESLIP * inwards * min(self.slipping_s + dt, _SIDESLIP_S)
            return np.diag([_SLIDE**2 * growth, sideways**2 * growth, 0.0])
        return np.diag([(_LOOSE * speed) ** 2 * dt, (_LOOSE_SIDEWAYS * inwards) ** 2 * dt, 0.0])
