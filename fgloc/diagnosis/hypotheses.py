"""What gross mistake of the set-up would make sightings, map and motion fit, where as configured nothing does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgloc.diagnosis.pose_text import OPTICAL_TO_BODY, pose_text
from fgloc.diagnosis.window import Fit, Window, fit_window, spread_ratio
from fgloc.types import FloatArray

_FITS = 2.0  # median whitened residual of a window that an explanation fits
_SHARE = 0.7  # of the windows that an explanation must fit

Known = Mapping[int, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A mistake: what is wrong, what to do, and how to undo it in the data."""

    wrong: str
    remedy: Callable[[FloatArray], str]  # given the place of the sensor that fits
    place: Callable[[FloatArray], FloatArray] = lambda T: T
    known: Callable[[Known], Known] = lambda k: k
    window: Callable[[Window], Window] = lambda w: w


def explanation(windows: Sequence[Window], T_base_sensor: FloatArray, known: Known, camera: bool) -> str | None:
    """The hypothesis that makes most of these windows fit, in words; None if none does.

    Args:
        windows: that do not fit as configured.
        T_base_sensor: ``(4, 4)`` as configured.
        known: the map.
        camera: whether the sensor's axes are optical.
    """
    best: tuple[float, str] | None = None
    scale = float(np.median([spread_ratio(w, T_base_sensor, known) for w in windows]))
    for hypothesis in [*_hypotheses(camera), _scaled(scale)]:
        place = hypothesis.place(T_base_sensor)
        landmarks = hypothesis.known(known)
        fits = [fit_window(hypothesis.window(w), place, landmarks, any_clock=False) for w in windows]
        good = [fit for fit in fits if isinstance(fit, Fit) and fit.misfit < _FITS and not fit.inconsistent]
        if len(good) < _SHARE * len(windows):
            continue
        misfit = float(np.median([fit.misfit for fit in good]))
        if best is None or misfit < best[0]:
            best = misfit, f"{hypothesis.wrong}: {hypothesis.remedy(place)}"
    return None if best is None else best[1]


def _hypotheses(camera: bool) -> list[Hypothesis]:
    def mounted(T: FloatArray) -> str:
        return f"correct the transform, or set {pose_text(T, camera)}"

    what = "camera" if camera else "sensor of the sightings"
    over = np.diag([-1.0, -1.0, 1.0]) if camera else np.diag([1.0, -1.0, -1.0])
    found = [Hypothesis(f"the {what} is mounted upside down", mounted, place=_turned(over))]
    for degrees, side in ((180, "backward"), (90, "to the left"), (-90, "to the right")):
        found.append(
            Hypothesis(f"the {what} looks {side} of the direction of its transform", mounted, place=_yawed(degrees))
        )
    found += [
        Hypothesis(
            f"the {what}'s transform is given without the optical axes' rotation (z forward, x right, y down)",
            mounted,
            place=_turned(OPTICAL_TO_BODY),
        ),
        Hypothesis(
            f"the {what}'s transform has the optical axes' rotation twice", mounted, place=_turned(OPTICAL_TO_BODY.T)
        ),
        Hypothesis(f"the {what}'s transform is inverted (parent and child exchanged)", mounted, place=_inverted),
        Hypothesis(
            "the wheels turn the other way (left and right exchanged)",
            lambda T: "exchange wheels.left_joint and wheels.right_joint, or correct the odometry's yaw",
            window=_exchanged,
        ),
        Hypothesis(
            "the map is mirrored",
            lambda T: "change the sign of one axis of its positions (and of its markers' directions)",
            known=lambda k: {i: np.array([p[0], -p[1]]) for i, p in k.items()},
        ),
    ]
    return found


def _scaled(scale: float) -> Hypothesis:
    return Hypothesis(
        f"the map's distances are about {scale:.2g} times those that wheels and sightings measure",
        lambda T: "correct its unit or scale",
        known=lambda k: {i: p / scale for i, p in k.items()},
    )


def _turned(R: FloatArray) -> Callable[[FloatArray], FloatArray]:
    def place(T: FloatArray) -> FloatArray:
        turned = T.copy()
        turned[:3, :3] = T[:3, :3] @ R
        return turned

    return place


def _yawed(degrees: float) -> Callable[[FloatArray], FloatArray]:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def place(T: FloatArray) -> FloatArray:
        turned = T.copy()
        turned[:3, :3] = turn @ T[:3, :3]
        return turned

    return place


def _inverted(T: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(T), dtype=np.float64)


def _exchanged(window: Window) -> Window:
    return replace(window, motions=window.motions * (1.0, -1.0, -1.0))
