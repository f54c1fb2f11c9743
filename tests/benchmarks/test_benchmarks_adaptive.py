"""The benchmark of adaptive weights: its scores are right on runs whose outcome is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from event_makers import command, corners

from benchmarks import adaptive
from benchmarks.adaptive_fixed import constant
from benchmarks.adaptive_mrclam import _with_odometry
from benchmarks.adaptive_recordings import Recorded, moved_interval, scenario, slip_intervals
from benchmarks.adaptive_runs import CASES, changed, distrusting, failure, moved_id
from benchmarks.adaptive_scores import Figures, Slips, flags, found_again, lost, slips
from fgloc.config import Config, load_config, with_value
from fgloc.runner import RunResult
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Decision, Landmark, LandmarkMap, Mode, Trajectory

START_NS = 10**18
MAP = LandmarkMap({i: Landmark(i, np.zeros(3), np.eye(3), 0.2) for i in range(4)})


def recorded(slipping=(), seconds=20.0, speed=0.5, events=()):
    """A straight drive along x; the wheels turn 0.1 m/s too fast in the given intervals."""
    t = np.arange(0.0, seconds, 0.02)
    flag = np.zeros(len(t), dtype=bool)
    for start, end in slipping:
        flag |= (t >= start - 1e-9) & (t <= end + 1e-9)
    slip = np.column_stack([np.where(flag, -0.1, 0.0), np.zeros(len(t)), np.zeros(len(t))])
    truth = np.column_stack([t, speed * t, np.zeros(len(t)), np.zeros(len(t))])
    where = ("made", Path(), Path())
    return Recorded(*where, Config(), MAP, tuple(events), START_NS, t, flag, slip, truth, seconds)


def decisions(*flagged, step_s=0.2, seconds=20.0, revised=()):
    """Wheels' rows of ``steps.csv``, with a reason inside the flagged intervals; then rows of steps judged again."""
    rows = []
    for k in range(round(seconds / step_s)):
        t = k * step_s
        reason = "slip" if any(a - 1e-9 <= t <= b + 1e-9 for a, b in flagged) else ""
        rows.append(Decision(k, START_NS + round(t * 1e9), "wheels", -1, 0.0, 0.0, 3, 1.0, reason))
        for at, earlier in revised:
            if abs(at - t) < 1e-9:
                rows.append(Decision(k, START_NS + round(earlier * 1e9), "wheels", -1, 0.0, 0.0, 3, 0.0, "slip"))
    return tuple(rows)


def result(truth, poses, stamps, rows=(), modes=None):
    modes = modes or (Mode.OK,) * len(stamps)
    estimate, exact = Trajectory(stamps, poses), Trajectory(stamps, truth)
    return RunResult(estimate, modes, tuple(rows), {}, {}, (), np.ones(len(stamps)), 1.0, truth=exact)


def figures(ate, batch=1.0, slip=None, named=()):
    return Figures(0, ate, 0.0, 1.0, batch, 1.0, np.ones(10), frozenset(named), frozenset({3}), slip, None, {})


def test_slips_close_together_are_one_and_instants_are_none():
    made = recorded([(2.0, 3.0), (3.2, 4.0), (8.0, 8.04), (12.0, 12.5)])
    assert np.allclose(slip_intervals(made), [(2.0, 4.0), (12.0, 12.5)])


def test_flags_count_from_the_step_that_raised_them():
    rows = decisions((5.0, 6.0), (9.0, 9.0), revised=[(5.0, 4.2), (5.0, 4.4)])
    assert np.allclose(flags(recorded(), rows), [(5.0, 6.0), (9.0, 9.0)])


def test_slips_are_found_missed_and_imagined():
    made = recorded([(2.0, 3.0), (8.0, 9.0), (12.0, 12.5)])
    rows = decisions((2.2, 3.4), (12.8, 13.0), (17.0, 17.4))
    poses = np.zeros((2, 3))
    scored = slips(made, result(poses, poses, np.array([0, 1]), rows))
    assert scored.delays_s == pytest.approx((0.2, 0.8))
    assert scored.found_m == pytest.approx((0.1, 0.05), abs=0.003)
    assert scored.missed_m == pytest.approx((0.1,), abs=0.003)
    assert scored.false_alarms == 1
    assert scored.path_m == pytest.approx(10.0, abs=0.02)


@pytest.mark.parametrize(("right_from", "expected"), [(6.0, 0.8), (None, 14.8), (2.0, 0.0)])
def test_time_to_be_found_again(right_from, expected):
    t = np.arange(0.0, 20.2, 0.2)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    truth = np.column_stack([0.5 * t, 0.0 * t, 0.0 * t])
    poses = truth.copy()
    wrong = (t > 4.9) & (t < (99.0 if right_from is None else right_from) - 1e-9)
    poses[wrong, 1] += 2.0
    seen = replace(corners(0.0, 1), stamp_ns=START_NS + 5_200_000_000)
    again = found_again(recorded(), result(truth, poses, stamps), 5.0, [seen])
    assert again == pytest.approx(expected, abs=1e-6)


def test_a_pose_that_is_right_but_lost_is_not_found():
    t = np.arange(0.0, 10.0, 0.2)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    truth = np.column_stack([0.5 * t, 0.0 * t, 0.0 * t])
    modes = tuple(Mode.LOST if 5.0 < s < 7.0 else Mode.OK for s in t)
    seen = replace(corners(0.0, 1), stamp_ns=START_NS + 5_200_000_000)
    assert found_again(recorded(), result(truth, truth, stamps, modes=modes), 5.0, [seen]) == pytest.approx(1.8)


def test_kidnap_lasts_until_the_robot_is_away():
    start, end = moved_interval(recorded(), 5.0, 3.0)
    assert (start, end) == pytest.approx((5.0, 11.0), abs=0.03)
    swinging = recorded()
    swinging.truth[:, 1] = 2.0 * np.sin(2.0 * np.pi * swinging.truth[:, 0] / 20.0)  # 2 m to either side
    start, end = moved_interval(swinging, 0.0, 3.0)
    assert start == pytest.approx(2.0, abs=0.05)  # the first whole second from which 3 m lie ahead: x is 1.18
    assert 10.0 < end < 15.0
    with pytest.raises(ValueError, match="never 30"):
        moved_interval(recorded(), 5.0, 30.0)


def test_every_case_describes_failures_and_intervals():
    made = recorded([(2.0, 3.0)], seconds=80.0, events=[corners(1.0, 2), corners(2.0, 1, 2), corners(3.0, 9)])
    assert moved_id(made) == 2
    for case in CASES.values():
        chain = [failure(described) for described in case.chain(made)]
        if case.wheels_wrong is not None:
            told = changed(Config(), distrusting(case.wheels_wrong(made))).weights.distrust
            assert told
            assert all(d.end_s > d.start_s for d in told)
        assert len(chain) <= 1
    assert {case.floor for case in CASES.values()} == {"unequal_radii", "patches", "slippery"}


def test_scenarios_are_the_suites_with_the_splits_control():
    test, validation = scenario("patches", "test"), scenario("patches", "validation")
    assert test.world == validation.world
    assert test.control != validation.control
    assert test.camera is not None
    assert test.duration_s >= 80.0


def test_constant_covariances_scale_the_noise_of_the_robot():
    base, scaled = (changed(Config(), constant(*f)).wheels.noise for f in ((1.0, 1.0), (2.0, 5.0)))
    assert scaled.x_per_sqrt_m == pytest.approx(2.0 * base.x_per_sqrt_m)
    assert scaled.yaw_per_sqrt_rad == pytest.approx(5.0 * base.yaw_per_sqrt_rad)


def test_smallest_slip_that_is_found():
    assert adaptive.smallest_found([1.0, 2.0, 3.0], [0.5, 0.1]) == 1.0
    assert adaptive.smallest_found([1.0, 2.0], [3.0]) is None


def test_rows_are_ratios_of_means_and_say_what_is_missing():
    slip = Slips((0.1, 0.3), (0.2, 0.1), (0.05,), 1, 500.0)
    found = {
        ("slip", "ours"): [figures(1.0, 0.5, slip), figures(2.0, 0.5, slip)],
        ("slip", "fixed"): [figures(2.0, 1.0), figures(4.0, 1.0)],
        ("moved", "ours"): [figures(1.0, named=[3]), figures(1.0, named=[3, 4])],
        ("ids50", "ours"): [figures(1.0), lost(1)],
        ("none", "ours"): [figures(1.0), figures(1.0)],
    }
    table = {row.id: row for row in adaptive.rows(found | {("none", "fixed"): found["none", "ours"]})}
    assert table["slip.over_fixed"].value == pytest.approx(0.5)
    assert table["batch.slip.over_fixed"].value == pytest.approx(0.5)
    assert table["batch.slip.over_online"].value == pytest.approx(1.0 / 3.0)
    assert table["moved.named"].value == pytest.approx(0.5)
    assert table["detector.delay_s"].value == pytest.approx(0.2)
    assert table["detector.false_per_km"].value == pytest.approx(2.0)
    assert table["ids50.over_none"].value is None
    assert "1 of 2 runs" in table["ids50.over_none"].reason
    assert table["dark30.over_oracle"].value is None
    assert table["dark30.over_oracle"].reason == "left out of a quick run"


def test_made_odometry_repeats_the_commands():
    events = list(_with_odometry([command(0.0, 0.2, 0.0), command(1.0, 0.0, 0.5), command(3.0, 0.1, 0.0)]))
    made = [e for e in events if isinstance(e, OdometryEvent)]
    assert [(e.linear[0], e.angular[2]) for e in made] == [(0.2, 0.0), (0.0, 0.5), (0.1, 0.0)]
    assert made[1].position[0] == pytest.approx(0.2)
    assert made[2].position[:2] == pytest.approx([0.2, 0.0])
    assert [e.stamp_ns for e in events[::2]] == [e.stamp_ns for e in events[1::2]]


def test_settings_of_a_file_can_be_changed():
    samples = Path(__file__).parents[2] / "datasets" / "samples"
    config = load_config(samples / "first_run" / "robot.yaml")
    assert changed(config, {"gate": {"max_speed": 3.5}}) == with_value(config, "gate.max_speed", 3.5)
