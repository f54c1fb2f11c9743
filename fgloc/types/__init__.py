"""What crosses module borders: events, steps, measurements, estimates.

Data flows one way: ``Event → validation → Step → Measurement → association → factor → Estimate``. Everything here is
frozen. Times are ``stamp_ns`` (when the sensor measured) and ``received_ns`` (when the recorder got it), both integers;
everything else is SI.
"""

from __future__ import annotations

from fgloc.types.arrays import FloatArray, IntArray
from fgloc.types.events import (
    CameraInfoEvent,
    ControlEvent,
    Event,
    InertialEvent,
    MotionEvent,
    OdometerPose,
    RawEvent,
    SensorEvent,
    Sighting,
    SightingsEvent,
    TransformEvent,
    TruthEvent,
)
from fgloc.types.findings import Finding, Severity, note, ordered
from fgloc.types.maps import Camera, Landmark, LandmarkMap
from fgloc.types.measurements import (
    FrameMeasurement,
    InertialReading,
    LandmarkMeasurement,
    LandmarkSighting,
    MotionMeasurement,
    MotionReadings,
    PixelMeasurement,
    PointMeasurement,
    PoseMeasurement,
)
from fgloc.types.results import (
    PLANAR,
    Decision,
    Estimate,
    Ground,
    InstallationFound,
    Mode,
    RunResult,
    Setting,
    TopicTimes,
    Trajectory,
)
from fgloc.types.steps import Step, by_class

MAX_LANDMARK_ID = 2**31 - 1  # int32 of the messages; the graph's keys have room for 56 bits

__all__ = [
    "MAX_LANDMARK_ID",
    "PLANAR",
    "Camera",
    "CameraInfoEvent",
    "ControlEvent",
    "Decision",
    "Estimate",
    "Event",
    "Finding",
    "FloatArray",
    "FrameMeasurement",
    "Ground",
    "InertialEvent",
    "InertialReading",
    "InstallationFound",
    "IntArray",
    "Landmark",
    "LandmarkMap",
    "LandmarkMeasurement",
    "LandmarkSighting",
    "Mode",
    "MotionEvent",
    "MotionMeasurement",
    "MotionReadings",
    "OdometerPose",
    "PixelMeasurement",
    "PointMeasurement",
    "PoseMeasurement",
    "RawEvent",
    "RunResult",
    "SensorEvent",
    "Setting",
    "Severity",
    "Sighting",
    "SightingsEvent",
    "Step",
    "TopicTimes",
    "Trajectory",
    "TransformEvent",
    "TruthEvent",
    "by_class",
    "note",
    "ordered",
]
