"""The adaptive mechanisms of fgloc, and how `benchmarks.mechanisms` takes each of them away.

A mechanism adapts a weight, a covariance, an association or a state by evidence. Not in the table: the graph itself
with its installation parameters and the marginal covariances, noise that is calibrated and follows no evidence (blur of
corners, correlation of the errors of one landmark, or of wheels and learned motion), checks of single messages
(``intake``, encoder resets), the handling of errors inside GTSAM, and what only an unknown map needs. What only works
together is one row, and so is one filter.
"""

from __future__ import annotations

from benchmarks.mechanisms_off_motion import OF_MOTION
from benchmarks.mechanisms_off_sightings import OF_LANDMARKS, OF_SIGHTINGS
from benchmarks.mechanisms_off_tracking import OF_TRACKING
from benchmarks.mechanisms_switch import Mechanism

MECHANISMS: tuple[Mechanism, ...] = (*OF_SIGHTINGS, *OF_LANDMARKS, *OF_MOTION, *OF_TRACKING)
BY_NAME = {m.name: m for m in MECHANISMS}
