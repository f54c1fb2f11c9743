"""An installation that is known exactly: settings under which there is no state beside the poses."""

from __future__ import annotations

from robot_world import config

from fgloc.config import Config

EXACT = {
    "recording": {"clock_sigma_s": 0.0},
    "wheels": {"scale_sigma": 0.0, "turn_scale_sigma": 0.0, "yaw_per_m_sigma": 0.0, "time_offset_sigma_s": 0.0},
    "gyro": {"scale_sigma": 0.0},
    "camera": {
        "position_sigma_m": 0.0,
        "rotation_sigma_rad": 0.0,
        "focal_sigma": 0.0,
        "principal_sigma_px": 0.0,
        "distortion_sigma": 0.0,
        "time_offset_sigma_s": 0.0,
        "time_jitter_s": 0.0,
    },
    "landmarks": {"range_scale_sigma": 0.0, "bearing_bias_sigma_rad": 0.0, "time_offset_sigma_s": 0.0},
    "map": {"position_sigma_m": 0.0, "rotation_sigma_rad": 0.0},
    "motion": {"scale_sigma": 0.0, "adaptation_sigma": 0.0},
}


def exact(**sections) -> Config:
    """The settings of the synthetic world, with changes by section, where map, mounting and gains are as stated."""
    return config(**{k: EXACT.get(k, {}) | sections.get(k, {}) for k in {*EXACT, *sections}})
