"""The learned motion as a sensor: it has no topic of its own, but reads those of others."""

from __future__ import annotations

from fgloc.sensors.base import BuiltIn
from fgloc.sensors.learned.role import ROLE

LEARNED = BuiltIn(name="learned", title="learned motion", motion=ROLE)
