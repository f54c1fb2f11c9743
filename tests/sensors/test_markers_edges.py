"""Corners from lines fitted to the edges: without the bias of a corner's own neighbourhood."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from marker_scenes import forward_camera, project, render, standing
from numpy.typing import NDArray

from fgloc.config import MarkersConfig
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.edges import refine_all
from fgloc.types import FloatArray

CAMERA = forward_camera()


def scene(rng: np.random.Generator, distance: float, blur_px: float) -> tuple[NDArray[np.uint8], FloatArray]:
    marker = standing(
        int(rng.integers(50)), (distance + 0.1, rng.uniform(-0.3, 0.3), 0.3), np.pi + rng.uniform(-0.5, 0.5)
    )
    image = render(CAMERA, (0.0, 0.0, 0.0), [marker], "DICT_4X4_50", rng, blur_px)
    return image, project(CAMERA, (0.0, 0.0, 0.0), marker.corners())


def perimeter(corners: FloatArray) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
@pytest.mark.parametrize("distance", [1.5, 3.0])
def test_size_is_not_biased_by_blur(distance: float, blur_px: float) -> None:
    """The corner neighbourhood makes markers of 35 px smaller by 1 %: centimetres of range. The edges do not."""
    rng = np.random.default_rng(3)
    detector = MarkerDetector("DICT_4X4_50", MarkersConfig())
    scales = []
    for _ in range(8):
        image, truth = scene(rng, distance, blur_px)
        [(_, corners)] = detector.find(image)
        scales.append(perimeter(corners) / perimeter(truth) - 1.0)
    assert abs(np.mean(scales)) < 0.0015


def test_a_guess_that_is_a_pixel_off_is_corrected() -> None:
    rng = np.random.default_rng(4)
    for _ in range(5):
        image, truth = scene(rng, 2.0, 0.7)
        refined = refine_all(image, truth[None] + rng.uniform(-1.0, 1.0, (1, 4, 2)), cells=6)[0]
        assert np.abs(refined - truth).max() < 0.2


def test_unclear_edges_leave_the_guess_as_it_is() -> None:
    guess = np.array([[50.0, 50.0], [90.0, 50.0], [90.0, 90.0], [50.0, 90.0]])
    plain = np.full((200, 200), 90, np.uint8)
    assert np.array_equal(refine_all(plain, guess[None], 6)[0], guess)
    assert np.array_equal(refine_all(plain, guess[None] * 0.01, 6)[0], guess * 0.01)
    far = plain.copy()
    cv2.rectangle(far, (60, 60), (100, 100), 0, -1)  # the nearest edges are of something else
    assert np.abs(refine_all(far, guess[None], 6)[0] - guess).max() <= 2.5
    at_the_rim = guess - 60.0
    assert np.isfinite(refine_all(far, at_the_rim[None], 6)).all()
