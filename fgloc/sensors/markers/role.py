"""The detector of markers, to the rest of fgloc."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fgloc.sensors.roles import RawLandmarksRole, with_values
from fgloc.types import LandmarkMap

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.detection import SensorDetector


def _detector(config: Config, landmark_map: LandmarkMap | None) -> SensorDetector:
    from fgloc.sensors.markers.detector import configured_detector  # OpenCV takes a while to load

    return configured_detector(config, landmark_map)


def _given(config: Config, dictionary: str | None, size_m: float | None) -> Config:
    now = config.markers
    values = {"dictionary": dictionary or now.dictionary, "default_size_m": size_m or now.default_size_m}
    return with_values(config, "markers", values)


def _ids(dictionary: str) -> int:
    from fgloc.sensors.markers.dictionaries import load_dictionary

    return len(load_dictionary(dictionary).bytesList)


def _fitting_dictionary(recording: Any) -> str | None:
    from fgloc.sensors.markers.hints import fitting_dictionary

    return fitting_dictionary(recording)


ROLE = RawLandmarksRole(
    size=lambda config: config.markers.default_size_m,
    dictionary=lambda config: config.markers.dictionary,
    given=_given,
    ids=_ids,
    sigma_px=lambda config: config.markers.sigma_px,
    detector=_detector,
    fitting_dictionary=_fitting_dictionary,
)
