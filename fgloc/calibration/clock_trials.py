"""Whose clock is wrong: corrections are applied to the recording and compared before one is recommended."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fgloc.calibration.contradictions import CODES, contradicted
from fgloc.config import Config
from fgloc.sensors import registry
from fgloc.types import Finding, InstallationFound, RunResult, Setting, Severity

_LATE_S = 0.03  # less is within what drivers mean by a stamp
_SAME_S = 0.01
_BETTER = (
    10.0  # of the cost, a negative log-likelihood: what it changes by where sightings only come to other keyframes
)
_AS_GOOD = 0.02  # share of the gain that trials may lack of the best one, the earlier of them being taken
_MODEL_S = 0.003  # what the model of a robot leaves out
_WHEELS = ("joints", "odometry")


@dataclass(frozen=True, slots=True)
class Trial:
    """A value of ``recording.stamp_offset_s`` for a role [s]."""

    role: str
    offset_s: float


def clock_trials(found: InstallationFound, seen: Mapping[str, float], config: Config) -> tuple[Trial, ...]:
    """Corrections worth a trial.

    Args:
        found: by the graph; a contradicted prior is taken out of the value.
        seen: offsets by role that the windows of the run suggest.
        config: as the run used it.
    """
    if found.wheels not in _WHEELS:  # a robot follows its commands late: that is no clock's fault
        return ()
    trials = [Trial(role, offset) for role, offset in seen.items()]
    off = {s.name.split(".")[1]: s for s in found.settings if s.name.startswith("stamp_offset_s.") and _late(s)}
    for role, s in off.items():
        trials.append(Trial(role, s.given + s.unpulled))
    if len(off) > 1 and len({s.unpulled > 0.0 for s in off.values()}) == 1:  # all but the gyro's, to one side
        given = config.recording.stamp_offset_s.get("imu", 0.0)
        trials.append(Trial("imu", given - sum(s.unpulled for s in off.values()) / len(off)))
    kept: list[Trial] = []
    for trial in trials:
        if not any(t.role == trial.role and abs(t.offset_s - trial.offset_s) < _SAME_S for t in kept):
            kept.append(trial)
    return tuple(kept)


def clock_findings(
    trials: tuple[Trial, ...], config: Config, again: Callable[[Config], RunResult], beyond: bool
) -> list[Finding]:
    """The correction that makes the run fit best, and what of the installation is off with it.

    None if no correction makes it fit clearly better.

    Args:
        trials: what to try.
        config: as the run used it.
        again: the same run in batch, with another configuration.
        beyond: whether a constant was beyond the gate of its prior without a correction: then the run's poses have the
            wrong clock in them.
    """
    if not trials:
        return []
    plain = again(config).cost
    done = [(trial, again(_with(config, trial))) for trial in trials]
    costs = [math.inf if result.cost is None else result.cost for _, result in done]
    if plain is None or min(costs) > plain - _BETTER:
        return []
    best = next(i for i, cost in enumerate(costs) if cost <= min(costs) + _AS_GOOD * (plain - min(costs)))
    trial, result = done[best]
    assert result.found is not None
    given = {str(r): offset for r, offset in config.recording.stamp_offset_s.items()}.get(trial.role, 0.0)
    left = next((s for s in result.found.settings if s.name == f"stamp_offset_s.{trial.role}"), None)
    clocks = [s for s in result.found.settings if s.name.startswith("stamp_offset_s.")]
    setting = trial.offset_s if left is None else left.found
    sigma = math.hypot(_MODEL_S, max((s.sigma for s in clocks), default=0.0) if left is None else left.sigma)
    late = given - setting
    if abs(late) < _LATE_S:
        return []
    has_gyro = any(s.name.startswith(f"{registry.motion_names().rate}.") for s in result.found.settings)
    name, against = _names(trial.role, has_gyro)
    sentence = (
        f"The stamps of the {name} are {abs(late):.3f} ± {sigma:.3f} s {'late' if late > 0 else 'early'} against the "
        f"{against}: set recording.stamp_offset_s: {{{trial.role}: {setting:.3f}}}; tried, and the recording fits "
        "better."
    )
    severity = Severity.ERROR if beyond else Severity.WARNING
    lines = {"recording.stamp_offset_s": f"{{{trial.role}: {setting:.3f}}}"}
    left_over = [f for f in result.findings if f.code in CODES]
    return [Finding("clock.offset", sentence, severity, lines, abs(late), sigma), *left_over]


def _late(s: Setting) -> bool:
    return contradicted(s) and abs(s.unpulled) > _LATE_S


def _with(config: Config, trial: Trial) -> Config:
    offsets = config.recording.stamp_offset_s | {trial.role: trial.offset_s}
    return config.model_copy(update={"recording": config.recording.model_copy(update={"stamp_offset_s": offsets})})


def _names(role: str, has_gyro: bool) -> tuple[str, str]:
    """Of the clock that is wrong, and of those that it is compared to."""
    if role == "imu":
        return registry.motion_names().rate, "wheels and sightings, which agree"
    if role in _WHEELS:
        return (
            registry.motion_names().odometer,
            "sightings and gyro" if has_gyro else "sightings (either clock may be wrong)",
        )
    return "sightings", "wheels and gyro, which agree" if has_gyro else "wheels (either clock may be wrong)"
