"""Motion sources compared: no false alarms, quick detection, where it began, when it ends, what failed."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest

from fgloc.config import Config, WeightsConfig
from fgloc.estimation.faults import Contradicted, GlrTest
from fgloc.estimation.motion import MotionFaultMonitor, MotionSources
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import MotionMeasurement, MotionReadings, Step

DT = 0.1
COV = np.diag([0.004, 0.001, 0.008]) ** 2  # of the difference over a step
TRACK = 0.3
SPEED, TURN = 0.4, 0.5


def judged(test: GlrTest, differences):
    return [test.judge(DT, d, COV) for d in differences]


def white(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.multivariate_normal(np.zeros(3), COV, n)


def test_sources_that_agree_as_they_say_are_not_flagged():
    """Half an hour; the statistic is the largest of some twenty windows with three degrees of freedom."""
    rng = np.random.default_rng(0)
    verdicts = judged(GlrTest(WeightsConfig()), white(rng, 18_000))
    alarms = sum(v.since > 0 for v in verdicts)
    assert alarms <= 1
    assert 12.0 < np.quantile([v.nis for v in verdicts], 0.999) < 30.0  # it does look at all windows


@pytest.mark.parametrize("slip", [(0.008, 0.0, 0.0), (0.0, 0.0, 0.016), (-0.006, 0.0, 0.012)])
def test_a_small_constant_slip_is_found_within_a_window_and_its_beginning_told(slip):
    """Of two sigmas a step in all: no single step shows it."""
    delays, misses = [], []
    for seed in range(20):
        differences = white(np.random.default_rng(seed), 60)
        differences[30:] += slip
        verdicts = judged(GlrTest(WeightsConfig()), differences)
        first = next(i for i, v in enumerate(verdicts) if v.flagged)
        assert first >= 30
        delays.append(first - 29)
        misses.append(verdicts[first].since - delays[-1])
    assert np.median(delays) * DT <= 1.0
    assert max(delays) * DT <= WeightsConfig().window_s
    assert abs(np.median(misses)) <= 1.0  # steps
    assert np.quantile(np.abs(misses), 0.9) <= 5.0


def test_the_onset_does_not_depend_on_the_length_of_the_steps():
    spans = []
    for dt in (0.05, 0.2):
        test, n = GlrTest(WeightsConfig()), round(0.6 / dt)
        for _ in range(30):
            test.judge(dt, np.zeros(3), COV * dt / DT)
        for _ in range(n):
            verdict = test.judge(dt, np.array([0.01, 0.0, 0.02]) * dt / DT, COV * dt / DT)
            if verdict.since:
                spans.append(verdict.since * dt)
                break
    assert spans[0] == pytest.approx(spans[1], abs=0.21)


def test_a_flag_is_raised_once_held_and_released_after_agreement():
    config = WeightsConfig()
    test = GlrTest(config)
    slip, none = np.array([0.03, 0.0, 0.05]), np.zeros(3)
    during = judged(test, [slip] * 30)
    raised = [v.since for v in during if v.since]
    assert len(raised) == 1
    assert all(v.flagged for v in during[2:])
    # one step of agreement does not end it, nor does a pause shorter than the release
    assert all(v.flagged for v in judged(test, [none, slip, none, none, slip]))
    after = [v.flagged for v in judged(test, [none] * 30)]
    held_s = after.index(False) * DT
    assert config.release_s <= held_s <= 2.0 * config.release_s + DT
    assert not any(after[after.index(False) :])
    again = judged(test, [none] * 3 + [slip] * 10)  # what came before the release is forgotten
    (since,) = [v.since for v in again if v.since]
    assert since <= 10


def test_differences_usually_smaller_than_their_covariance_show_smaller_slips_and_shrink_it_while_calm():
    """Half the sigmas, and a slip of a sigma a step as given, so two of the true ones."""
    delays, smallest = {1.0: [], 0.5: []}, {1.0: 9.0, 0.5: 9.0}
    for seed, share in itertools.product(range(6), delays):
        test, rng = GlrTest(WeightsConfig()), np.random.default_rng(seed)
        calm = judged(test, share * white(rng, 600))
        assert not any(v.flagged for v in calm)
        smallest[share] = min(smallest[share], *(v.scale for v in calm[300:]))
        later = judged(test, share * white(rng, 60) + np.array([0.004, 0.0, 0.0]))
        delays[share].append(next((i for i, v in enumerate(later) if v.flagged), 60) * DT)
    assert max(delays[0.5]) <= 2.0
    assert np.median(delays[0.5]) < 0.5 * np.median(delays[1.0])
    assert 0.25 <= smallest[0.5] < 0.6 * smallest[1.0]


# --- which source, and why --------------------------------------------------------------------------------------------


class Witness:
    """A learned model as far as trust is concerned: of commands alone."""

    class model:  # noqa: N801
        class card:  # noqa: N801
            inputs = ("commands",)

            @staticmethod
            def reads(role):
                return False


def trust_in(distrust=(), learned=True, track=TRACK, attribution=None, **weights) -> MotionFaultMonitor:
    config = Config.model_validate({"weights": {"distrust": distrust, **weights}})
    sources = MotionSources(config, MotionSensors(WheelMotion(config.wheels), Witness() if learned else None))
    trust = MotionFaultMonitor(config.weights, sources, track, attribution)
    trust.begin(Step(0, 0, 10**18, 10**18))
    return trust


def reading(source: str, i: int, v: float, omega: float, cov=COV / 2) -> MotionMeasurement:
    start = 10**18 + round(i * DT * 1e9)
    return MotionMeasurement(source, start, start + 10**8, np.array([v * DT, 0.0, omega * DT]), cov)


def run(trust: MotionFaultMonitor, n: int, told, did=(SPEED, TURN), first: int = 0, witness: str = "learned"):
    found = []
    for i in range(first, first + n):
        wheels, other = reading("wheels", i, *told), reading(witness, i, *did)
        step = Step(i, 0, wheels.start_ns, wheels.stamp_ns)
        found.append(trust.judge(step, MotionReadings(wheels, **{witness: other})))
    return found


def sides(left: float, right: float) -> tuple[float, float]:
    """Speed and yaw rate of wheels that say these speeds."""
    return 0.5 * (left + right), (right - left) / TRACK


LEFT, RIGHT = SPEED - 0.5 * TRACK * TURN, SPEED + 0.5 * TRACK * TURN


@pytest.mark.parametrize(
    ("told", "reason"),
    [
        (sides(0.0, 0.0), "frozen"),
        (sides(0.0, RIGHT), "left_wheel_dead"),
        (sides(LEFT, 0.0), "right_wheel_dead"),
        (sides(1.4 * LEFT, 1.5 * RIGHT), "slip"),
    ],
)
def test_fault_31_a_stuck_or_slipping_wheel_is_told_apart(told, reason):
    trust = trust_in()
    assert not any(t.budget.rejected for t in run(trust, 20, sides(LEFT, RIGHT)))
    found = run(trust, 20, told, first=20)
    assert found[-1].budget.rejected == {"wheels": reason}
    raised = [i for i, t in enumerate(found) if t.budget.rejected]
    assert raised[0] * DT < 0.5
    assert found[raised[0]].span <= raised[0] + 1 + 3
    assert sum(trust.flags.values()) == 1
    assert trust.flags[f"wheels.{reason}"] == 1


def test_a_failure_whose_kind_shows_later_is_one_failure():
    """First both wheels slip, then one stands still: told as what it turned out to be."""
    trust = trust_in()
    run(trust, 20, sides(LEFT, RIGHT))
    run(trust, 8, sides(1.5 * LEFT, 1.5 * RIGHT), first=20)
    found = run(trust, 30, sides(0.0, RIGHT), first=28)
    assert found[-1].budget.rejected == {"wheels": "left_wheel_dead"}
    assert trust.flags == Counter({"wheels.left_wheel_dead": 1})


@pytest.mark.parametrize("told", [sides(0.0, 0.0), sides(0.0, 0.5 * RIGHT)])
def test_wheels_at_rest_while_the_robot_slides_on_are_neither_dead_nor_frozen(told):
    trust = trust_in()
    run(trust, 20, sides(LEFT, RIGHT))
    slides = run(trust, 3, told, first=20)
    stands = run(trust, 20, sides(0.0, 0.0), did=sides(0.0, 0.0), first=23)
    assert any(t.budget.rejected for t in slides)
    assert {t.budget.rejected.get("wheels", "slip") for t in (*slides, *stands)} == {"slip"}


@pytest.mark.parametrize("did", [(0.1, 0.0), (0.0, 0.8)])
def test_frozen_encoders_of_a_slow_or_turning_robot_are_named(did):
    trust = trust_in()
    run(trust, 30, did, did=did)
    assert run(trust, 40, (0.0, 0.0), did=did, first=30)[-1].budget.rejected == {"wheels": "frozen"}


def test_fault_21_a_step_longer_than_what_is_kept_of_the_travel_is_taken_in():
    trust, start = trust_in(), 10**18
    for i in range(3):
        stamp = start + (i + 1) * 4 * 10**9
        moved = [
            MotionMeasurement(source, stamp - 4 * 10**9, stamp, np.array([2.0, 0.0, 0.1]), COV / 2)
            for source in ("wheels", "learned")
        ]
        verdict = trust.judge(Step(i, 0, stamp - 4 * 10**9, stamp), MotionReadings(moved[0], learned=moved[1]))
        assert not verdict.budget.rejected


def test_without_the_track_no_wheel_is_accused():
    trust = trust_in(track=None)
    run(trust, 20, sides(LEFT, RIGHT))
    found = run(trust, 20, sides(0.0, RIGHT), first=20)
    assert found[-1].budget.rejected == {"wheels": "slip"}


def test_a_model_that_has_not_agreed_with_the_wheels_accuses_them_no_more_than_itself():
    """Nothing tells which of them is wrong: the wheels are kept with room for a slip, and only they."""
    trust = trust_in()
    found = run(trust, 40, sides(1.4 * LEFT, 1.5 * RIGHT))
    assert found[-1].budget.rejected == {"wheels": "doubted", "learned": "doubted"}
    readings = MotionReadings(reading("wheels", 40, SPEED, TURN), learned=reading("learned", 40, SPEED, TURN))
    (kept,) = found[-1].budget.combine(readings, trust._sources.rules)
    assert kept.source == "wheels"
    assert np.sqrt(kept.cov[0, 0]) > 10.0 * np.sqrt(COV[0, 0])
    # having agreed since for longer than they differed, it may
    run(trust, 80, sides(LEFT, RIGHT), first=40)
    assert run(trust, 20, sides(1.4 * LEFT, 1.5 * RIGHT), first=120)[-1].budget.rejected == {"wheels": "slip"}


def test_the_gyro_alone_witnesses_a_wrong_turn():
    trust = trust_in(learned=False)
    assert not any(t.budget.rejected for t in run(trust, 20, (SPEED, TURN), witness="gyro"))
    found = run(trust, 20, (SPEED, TURN + 0.4), first=20, witness="gyro")
    assert found[-1].budget.rejected == {"wheels": "slip"}
    forward = run(trust_in(learned=False), 40, (2.0 * SPEED, TURN), witness="gyro")
    assert not any(t.budget.rejected for t in forward)  # of the way it knows nothing


def test_without_a_witness_or_without_adaptation_nothing_is_flagged():
    wild = sides(0.0, 3.0 * RIGHT)
    assert not any(t.budget.rejected for t in run(trust_in(adaptive=False), 20, wild))
    alone = trust_in()
    for i in range(20):
        wheels = reading("wheels", i, *wild)
        assert not alone.judge(Step(i, 0, wheels.start_ns, wheels.stamp_ns), MotionReadings(wheels)).budget.rejected


def test_known_failures_are_believed_in_their_intervals_alone():
    trust = trust_in(
        [{"source": "learned", "start_s": 0.5, "end_s": 1.0}, {"source": "wheels", "start_s": 0.75, "end_s": 0.76}]
    )
    found = run(trust, 20, (SPEED, TURN))
    off = {
        source: [i for i, t in enumerate(found) if t.budget.rejected.get(source) == "distrusted"]
        for source in ("learned", "wheels")
    }
    assert off == {"learned": [5, 6, 7, 8, 9], "wheels": [7]}
    assert not any(reason != "distrusted" for t in found for reason in t.budget.rejected.values())


@pytest.mark.parametrize("begins", [lambda trust: trust.reset(), lambda trust: trust.begin(Step(20, 1, 0, 1))])
def test_a_new_segment_begins_without_a_flag(begins):
    trust = trust_in()
    assert run(trust, 20, sides(0.0, RIGHT))[-1].budget.rejected
    begins(trust)
    assert not any(t.budget.rejected for t in run(trust, 20, (SPEED, TURN), first=20))


def test_a_witness_known_to_be_wrong_accuses_nobody():
    trust = trust_in([{"source": "learned", "start_s": 0.0, "end_s": 2.0}])
    assert {tuple(t.budget.rejected) for t in run(trust, 20, (SPEED, TURN), did=(0.0, 0.0))} == {("learned",)}
    assert not trust.flags


def test_wheels_known_to_be_wrong_are_not_found_out_again():
    """Nor is their failure taken for the beginning of another, before or after."""
    trust = trust_in([{"source": "wheels", "start_s": 1.0, "end_s": 2.0}])
    before, during = run(trust, 10, (SPEED, TURN)), run(trust, 10, (0.0, 0.0), first=10)
    after = run(trust, 10, (SPEED, TURN), first=20)
    assert [t.budget.rejected for t in (*before, *after)] == [{}] * 20
    assert [t.budget.rejected for t in during] == [{"wheels": "distrusted"}] * 10
    assert not trust.flags


def test_wheels_that_differ_by_less_than_an_alarm_are_worth_less_back_to_the_onset():
    """A slip of one sigma a step; told as the number of steps for which the larger covariance holds."""
    trust = trust_in()
    run(trust, 300, (SPEED, TURN))
    found = run(trust, 6, (SPEED + 0.03, TURN), first=300)
    assert not any(t.budget.rejected for t in found)
    assert [t.span for t in found] == [1, 2, 3, 4, 5, 6]
    assert [t.budget.scale for t in found] == sorted(t.budget.scale for t in found)
    assert found[0].budget.scale < 1.0
    assert 4.0 < found[-1].budget.scale < 5.0


@pytest.mark.parametrize(("left", "reasons"), [(0.1 * LEFT, {"doubted"}), (0.0, {"doubted", "left_wheel_dead"})])
def test_a_model_that_was_never_right_makes_no_slow_wheel_a_dead_one(left, reasons):
    """A wheel that counts nothing is dead whoever says that it should turn."""
    found = run(trust_in(), 40, sides(left, RIGHT))
    assert {t.budget.rejected["wheels"] for t in found if t.budget.rejected} == reasons


class Sightings:
    """Says what sightings contradict from a step on; before, nothing can be seen."""

    memory_s = 10.0

    def __init__(self, sources: frozenset[str]) -> None:
        self.sources, self.seen = sources, False

    def contradicted(self, steps):
        return Contradicted(self.sources, 5) if self.seen else None


@pytest.mark.parametrize(
    ("wrong", "earlier"), [({"learned"}, {"learned": "contradicted"}), ({"wheels"}, {"wheels": "slip"})]
)
def test_a_model_that_sightings_contradict_was_wrong_for_as_long_as_both_were_doubted(wrong, earlier):
    """A slip of the wheels says nothing of the time before."""
    sightings = Sightings(frozenset(wrong))
    trust = trust_in(attribution=sightings)
    assert run(trust, 100, sides(1.4 * LEFT, 1.5 * RIGHT))[-1].budget.rejected.keys() == {"wheels", "learned"}
    sightings.seen = True
    found = run(trust, 1, sides(1.4 * LEFT, 1.5 * RIGHT), first=100)[0]
    assert found.budget.rejected == found.earlier.rejected == earlier
    assert found.doubted == (101 if wrong == {"learned"} else 0)
