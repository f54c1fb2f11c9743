"""Answer sheet of `benchmarks.field`: peculiarities of each recording that are to be found, and what is sound in it.

A trap is found if a finding of a run in ``metrics.json`` has its code, or if it, ``init`` or ``info`` says its
sentence, and the figure, if it has one, is within the tolerance of what was measured by hand (signs are not compared: a lag is
ahead or behind as one looks at it). Patterns of sentences are alternatives of plain words for the one thing.
"""

# ruff: noqa: E501 (a table)
from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Mode = Literal["batch", "online"]
MODES: tuple[Mode, ...] = ("batch", "online")


@dataclass(slots=True)
class Outcome:
    """Results of one recording.

    Attributes:
        said: what ``init``, ``info``, ``smooth`` and ``online`` printed.
        codes: their exit codes; 124: longer than the limit.
        metrics: ``metrics.json`` of the two modes; empty: none was written.
        ate: of "odometry", "textbook.batch", "textbook.online", "alike.batch", "alike.online", "batch", "online" [m].
        error: why the recording could not be read for the comparison.
    """

    said: dict[str, str] = field(default_factory=dict)
    codes: dict[str, int] = field(default_factory=dict)
    metrics: dict[str, dict[str, Any]] = field(default_factory=dict)
    ate: dict[str, float] = field(default_factory=dict)
    error: str = ""

    def findings(self, mode: Mode) -> list[dict[str, Any]]:
        """Findings of a run, the gravest first; its error, if it gave no result."""
        if mode in self.metrics:
            return list(self.metrics[mode].get("findings", []))
        lines = [line for line in self.said.get(mode, "").splitlines() if line.startswith("error")]
        return [{"code": "error", "severity": "error", "text": line} for line in lines[:1]]

    def best(self, mode: Mode, textbook: str = "textbook") -> float:
        """Least ATE of odometry and a textbook ("textbook" or "alike") [m]; infinite: there is none."""
        return min((self.ate[k] for k in ("odometry", f"{textbook}.{mode}") if k in self.ate), default=math.inf)


@dataclass(frozen=True, slots=True)
class Trap:
    """A peculiarity of a recording.

    Attributes:
        recording: its name.
        what: the peculiarity.
        code: pattern of the whole code of a finding; empty: there is none for it.
        said: pattern within a finding's sentence or a line of ``init`` or ``info`` (they show no codes), with the figure
            in a group ``value`` if it has one; empty: the code is enough.
        figure: that was measured by hand; None: there is none.
        tolerance: of the figure.
    """

    recording: str
    what: str
    code: str
    said: str = ""
    figure: float | None = None
    tolerance: float = 0.0


@dataclass(frozen=True, slots=True)
class Sound:
    """Pattern of whole codes that are false on a recording."""

    recording: str
    code: str


def found(trap: Trap, o: Outcome) -> bool:
    """Whether ``init``, ``info`` or a run's findings name a peculiarity, with its figure."""
    for finding in (*o.findings("batch"), *o.findings("online")):
        coded = bool(trap.code) and re.fullmatch(trap.code, finding["code"]) is not None
        if (coded and (trap.figure is None or _near(trap, finding.get("value")))) or _said(trap, finding["text"]):
            return True
    return any(_said(trap, line) for name in ("init", "info") for line in _lines(o.said.get(name, "")))


def right_cause(recording: str, findings: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the first finding is a peculiarity of the recording."""
    if not findings:
        return False
    first = findings[0]
    traps = [t for t in SHEET if t.recording == recording]
    named = any(t.code and re.fullmatch(t.code, first["code"]) for t in traps)
    return named or any(t.said and re.search(t.said, first["text"]) for t in traps)


def false_findings(recording: str, o: Outcome) -> list[str]:
    """Codes, with the recording's name, that are sound in it."""
    codes = {finding["code"] for mode in ("batch", "online") for finding in o.findings(mode)}  # type: ignore[arg-type]
    patterns = [s.code for s in SOUND if s.recording == recording]
    return sorted(f"{recording}: {code}" for code in codes if any(re.fullmatch(p, code) for p in patterns))


def _lines(text: str) -> Iterator[str]:
    """Lines as they were before they were wrapped: a line that begins with a space continues the one before."""
    return iter(re.sub(r"\n\s+", " ", text).splitlines())


def _near(trap: Trap, value: float | None) -> bool:
    return trap.figure is not None and value is not None and abs(abs(value) - abs(trap.figure)) <= trap.tolerance


def _said(trap: Trap, line: str) -> bool:
    matches = re.finditer(trap.said, line, re.IGNORECASE) if trap.said else ()
    return any(trap.figure is None or _near(trap, float(match["value"])) for match in matches)


_NUMBER = r"(?<![\d.])(?P<value>[-−]?\d+(?:\.\d+)?)"  # a whole one: a greedy pattern before it leaves no digit behind
_TB3 = {"17_25_46": (31.5, 43.2), "17_00_32": (20.6, 26.9), "17_30_33": (None, 22.6)}  # held, turned by hand [s]

SHEET: tuple[Trap, ...] = (
    Trap("duarte", "positions in the optical frame", r"sightings\.axes", r"optical frame"),
    Trap("duarte", "odometry's header clock", r"clock\.odometry", r"header stamps of odometry are of another clock"),
    Trap("duarte", "truth's yaw offset 87°", "", rf"truth.*turned by {_NUMBER}", 87.0, 4.0),
    Trap("duarte", "truth in bursts", "", r"(truth|mocap).*burst"),
    Trap("pinto1", "positions in the optical frame", r"sightings\.axes", r"optical frame"),
    Trap("pinto1", "odometry's header clock", r"clock\.odometry", r"header stamps of odometry are of another clock"),
    Trap("pinto1", "truth's yaw offset 53-57°", "", rf"truth.*turned by {_NUMBER}", 55.0, 4.0),
    Trap("turtlebot_aruco", "odometry 0.05-0.07 s after the truth", r"clock\.(truth|odometry)",
         rf"truth.*{_NUMBER} s (ahead|before|earl|behind|after|late)", 0.06, 0.03),
    Trap("turtlebot_aruco", "range is depth", r"sightings\.depth", r"[Rr]anges are distances along the sensor's axis"),
    Trap("turtlebot_aruco", "range 0.044 m long", r"sightings\.scale", r"(range|distance).* long"),
    *(
        trap
        for k in range(1, 6)
        for trap in (
            Trap(f"mrclam6_{k}", "range is depth", r"sightings\.depth", r"[Rr]anges are distances along the sensor's axis"),
            Trap(f"mrclam6_{k}", "gaps of the commands", "", r"/cmd_vel.*(silence|gap)"),
            Trap(f"mrclam6_{k}", "no encoder: commands", "", r"command(s|ed).*(stand|used|alone|no (encoder|odometry|wheel))"),
            Trap(f"mrclam6_{k}", "ids of robots are not in the map", r"sightings\.unused|map\.ids", r"not in the map|unknown.?id"),
            Trap(f"mrclam6_{k}", "robot follows commands later", r"clock\.\w+", rf"(late|delay|behind|lag).*{_NUMBER} s", 0.17, 0.08),
        )
    ),
    Trap("turtlebot3_15_11_34", "spikes in the twist", "", rf"yaw rate.*up to {_NUMBER}", 125.0, 3.0),
    Trap("turtlebot3_15_11_34", "nine ids, eight coordinates", "", r"unequal length|9 ids?\b|nine ids"),
    Trap("turtlebot3_15_11_34", "blackout of 21 s", "", rf"landmarks.*longest {_NUMBER} s", 21.0, 1.5),
    Trap("turtlebot3_14_27_38", "spikes in the twist", "", rf"yaw rate.*up to {_NUMBER}", 125.0, 3.0),
    *(
        trap
        for name, (held, hand) in _TB3.items()
        for trap in (
            Trap(f"turtlebot3_{name}", "yaw of the odometry is the gyro's", r"odometry\.yaw_is_gyro"),
            *((Trap(f"turtlebot3_{name}", "held", r"motion\.held", "", held, 3.0),) if held else ()),
            Trap(f"turtlebot3_{name}", "turned by hand", r"motion\.lifted", "", hand, 3.0),
            Trap(f"turtlebot3_{name}", "|a| 10.25 m/s² at rest", r"imu\.gravity_scale"),
            Trap(f"turtlebot3_{name}", "header stamps 0.2 s ahead", "", r"stamps?.*(ahead|future)|received before"),
        )
    ),
    Trap("turtlebot3_17_30_33", "gaps of odometry, the longest 4.3 s", "", rf"/odom.*longest {_NUMBER} s", 4.3, 0.4),
    *(
        trap
        for name in ("mecanum_bag1", "mecanum_bag2")
        for trap in (
            Trap(name, "ticks for angles", r"wheels\.ticks", r"ticks|not (angles|radians|rad)"),
            Trap(name, "moves sideways", r"wheels\.sideways|odometry\.sideways", r"sideways|mecanum|omnidirectional"),
            Trap(name, "wheels 7 % short", r"(wheels|truth)\.scale", "", 1.073, 0.02),
            *((Trap(name, "turns 10 % more (wheels, and 0.358 m for 0.369)", r"wheels\.turn", "", 1.10, 0.02),)
              if name == "mecanum_bag2" else ()),
            Trap(name, "truth freezes", r"truth\.frozen"),
            Trap(name, "truth's plane tilted by 3.2°", r"truth\.tilt"),
        )
    ),
    Trap("tricycle", "guessed geometry", r"wheels\.(scale|turn)|truth\.scale"),
    Trap("tricycle", "the traction counter wraps", r"wheels\.roll_over"),
    Trap("tricycle", "truth is of a sensor ahead of the axle (1.8 m)", r"truth\.mounting", rf"sits at \+?{_NUMBER}", 1.795, 0.15),
    Trap("car_park", "laser is not used", "", r"/scan.*(not used|unused|no (role|sensor))"),
    Trap("car_park", "GPS of a place without heading", r"truth\.no_yaw", r"/gps.*(not used|unused|no (role|sensor|yaw|heading))"),
    Trap("car_gnss", "no wheel odometry that can be read", "", r"no (wheel )?odometry|/speedsteer"),
    Trap("car_gnss", "GNSS is not used", "", r"/swiftnav.*(not used|unused|no (role|sensor))|NavSatFix"),
    Trap("plaza", "ranges 7 % long", r"uwb\.\w+", rf"uwb\.scale.*{_NUMBER}", 1.069, 0.01),
    Trap("plaza", "the truth's heading is the odometry's gyro", r"truth\.yaw_is_odometry"),
    Trap("uwb_indoor", "ranges 0.07 to 0.15 m long", r"uwb\.\w+", rf"uwb\.bias_m.*{_NUMBER}", 0.11, 0.05),
    Trap("uwb_indoor", "wheels swapped, half the track", r"wheels\.(sign|turn)|yaw\.sign|truth\.yaw_sign", r"swapped|exchanged|mirror"),
    Trap("robot_localization", "IMU on its side, y is up", r"imu\.(axes|gravity)", r"gyro's y axis|gravity (lies )?along y"),
    Trap("robot_localization", "odometry 0.39 s behind the IMU", r"clock\.(odometry|imu)", rf"{_NUMBER} s", 0.39, 0.04),
    Trap("robot_localization", "fix is not used", r"positions\.unused"),
    *(Trap(f"mrclam5_{k}", "ranges are not used", "", r"/ranges.*(not used|unused|no (role|sensor))") for k in "ABCDE"),
    *(Trap(f"mrclam5_{k}", "gaps of the odometry", "", r"/odom.*(silence|gap)") for k in "ABCDE"),
)  # fmt: skip

_MAPPED = r"sightings\.(axes|mirrored)|map\.(mirrored|ids|unit|scale)|truth\.(axes|yaw_sign|scale|no_yaw)"
_PLAIN = r"floor\.\w+|odometry\.(twist_unit|twist_frame|yaw_sign|yaw_unit)|wheels\.sign|yaw\.sign"

SOUND: tuple[Sound, ...] = (
    *(Sound(name, rf"{_PLAIN}|wheels\.turn|imu\.\w+|sightings\.mirrored|map\.\w+|truth\.(axes|yaw_sign|scale)")
      for name in ("duarte", "pinto1")),
    Sound("turtlebot_aruco", rf"{_PLAIN}|{_MAPPED}|wheels\.turn|imu\.\w+"),
    *(Sound(f"mrclam6_{k}", rf"{_PLAIN}|{_MAPPED.replace('|ids', '')}|imu\.\w+") for k in range(1, 6)),
    *(Sound(f"mrclam5_{k}", rf"{_PLAIN}|{_MAPPED}|imu\.\w+") for k in "ABCDE"),
    Sound("turtlebot3_15_11_34", r"floor\.\w+|sightings\.(axes|mirrored|depth)|map\.(mirrored|ids|unit|scale)|wheels\.sign"),
    *(Sound(f"turtlebot3_{name}", r"floor\.\w+|imu\.(axes|sign|unit|gravity)|wheels\.sign|yaw\.sign|odometry\.yaw_\w+unit")
      for name in _TB3),
    *(Sound(name, rf"{_PLAIN}|truth\.(axes|yaw_sign)") for name in ("mecanum_bag1", "mecanum_bag2", "plaza", "car_park")),
    Sound("tricycle", r"floor\.\w+|odometry\.(twist_unit|twist_frame|yaw_unit)|truth\.(axes|yaw_sign)"),
    Sound("uwb_indoor", r"floor\.\w+|odometry\.(twist_unit|twist_frame|yaw_unit)"),
    Sound("robot_localization", rf"{_PLAIN}|imu\.(unit|sign)"),
)  # fmt: skip
