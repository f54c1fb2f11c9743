"""The learned motion as a sensor: it has no topic of its own, but reads those of others."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn, MotionRole
from fgloc.sensors.learned.installation import INSTALLATION

LEARNED = BuiltIn(name="learned", title="learned motion", role=MotionRole.MODEL, installation=INSTALLATION)
