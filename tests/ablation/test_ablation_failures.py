"""Each failure does just what it says: to the events it names, by the stated amount, and to nothing else."""

import math
import typing
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from event_makers import command, corners, image, imu, joints, marker_pose, odometry, range_bearing
from pydantic import TypeAdapter, ValidationError

from fgloc import se2
from fgloc.ablation.failures import AnyFailure, corrupt, generators
from fgloc.config import Config, WheelsConfig
from fgloc.frames import quaternion_yaw
from fgloc.sensors.failures import Scene
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import decode
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Landmark, LandmarkMap, TruthEvent

RADIUS, TRACK = 0.05, 0.26
WHEELS = WheelsConfig(left_radius=RADIUS, right_radius=RADIUS, track=TRACK)
MAP = LandmarkMap({i: Landmark(i, np.array([float(i), 1.0, 0.5]), np.eye(3), 0.2) for i in range(5)})
ADAPTER = TypeAdapter(AnyFailure)
FIELDS = {c.model_fields["kind"].default: c.model_fields for c in typing.get_args(typing.get_args(AnyFailure)[0])}


def make(kind, **values):
    return ADAPTER.validate_python({"kind": kind, **values})


def scene(duration=10.0, seed=0, config=None):
    config = config or Config(wheels=WHEELS)
    return Scene(0, duration, config, tuple(MAP.landmarks), generators(1, seed)[0])


def apply(kind, events, seed=0, duration=10.0, **values):
    failure = make(kind, **values)
    return list(failure.apply(iter(events), scene(duration, seed)))


def truth(t):
    return TruthEvent(round(t * 1e9), round(t * 1e9), "/truth", "map", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def driving(seconds=10.0, v=0.4, omega=0.3):
    """Odometry, joints, commands, IMU, sightings and truth of a robot on a circle, ten times a second."""
    events, pose = [], np.zeros(3)
    angles = np.zeros(2)
    speeds = np.array([v - 0.5 * TRACK * omega, v + 0.5 * TRACK * omega]) / RADIUS
    for k in range(round(seconds * 10)):
        t = 0.1 * k
        events += [
            odometry(t, tuple(pose), (v, omega)),
            joints(t, *angles, rates=speeds),
            command(t, v, omega),
            imu(t, omega),
            range_bearing(t, (0, 1.0, 0.1), (3, 2.0, -0.2)),
            truth(t),
        ]
        pose = se2.compose(pose, se2.exp((0.1 * v, 0.0, 0.1 * omega)))
        angles = angles + 0.1 * speeds
    return events


def of(kind, events):
    return [e for e in events if isinstance(e, kind)]


def seconds(events):
    return np.array([e.received_ns * 1e-9 for e in events])


def same(a, b):
    return type(a) is type(b) and all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name)) if f.name != "sightings" else a.sightings is b.sightings
        for f in fields(a)
    )


def assert_only(kinds, before, after):
    """Every event of another kind is the very same object, in its place among its likes."""
    rest = [e for e in before if not isinstance(e, kinds)]
    assert all(a is b for a, b in zip(rest, [e for e in after if not isinstance(e, kinds)], strict=True))


# --- when ---


def test_interval_bounds_are_half_open_and_in_receive_time():
    before = driving()
    after = apply("dropout", before, sensor="command", when={"intervals": [(1.95, 3.95)]})
    assert_only(ControlEvent, before, after)
    left = seconds(of(ControlEvent, after))
    assert len(left) == 80
    assert not ((left > 1.95) & (left < 3.95)).any()


def test_bursts_grow_around_the_same_centers():
    def gap(length):
        when = {"bursts": 1, "burst_s": length, "after_s": 5.0}
        after = apply("dropout", driving(60.0), seed=4, duration=60.0, sensor="command", when=when)
        left = seconds(of(ControlEvent, after))
        k = int(np.argmax(np.diff(left)))
        return left[k], left[k + 1]

    small, large = gap(5.0), gap(6.0)
    assert small[1] - small[0] == pytest.approx(5.0, abs=0.15)
    assert large[1] - large[0] == pytest.approx(6.0, abs=0.15)
    assert min(small[0], large[0]) >= 4.85


def test_share_is_random_and_repeats_for_one_seed():
    def kept(seed):
        return seconds(of(ControlEvent, apply("dropout", driving(60.0), seed, sensor="command", when={"share": 0.3})))

    assert len(kept(1)) == pytest.approx(420, abs=40)
    assert np.array_equal(kept(1), kept(1))
    assert not np.array_equal(kept(1), kept(2))


def test_unknown_keys_and_empty_intervals_are_refused():
    with pytest.raises(ValidationError, match="Extra inputs"):
        make("dropout", sensor="camera", duration=3)
    with pytest.raises(ValidationError, match="is empty"):
        make("dropout", sensor="camera", when={"intervals": [(4.0, 2.0)]})
    with pytest.raises(ValidationError, match=r"\btruncated\b.*'when'"):
        make("truncated", when={"share": 0.5})


@pytest.mark.parametrize("kind", FIELDS)
def test_no_failure_touches_the_truth_or_an_instant_outside_its_interval(kind):
    failure = make(kind, **({"sensor": "wheels"} if "sensor" in FIELDS[kind] else {}))
    if failure.timed:
        later = failure.when.model_copy(update={"intervals": ((50.0, 60.0),), "bursts": 0})
        failure = failure.model_copy(update={"when": later})
        before = driving()
        after = list(failure.apply(iter(before), scene()))
        assert all(a is b or same(a, b) for a, b in zip(before, after, strict=True))
    assert failure.__doc__
    assert all(f.description for name, f in type(failure).model_fields.items() if f.annotation is float), kind


# --- transport and clocks ---


@pytest.mark.parametrize(
    ("sensor", "kinds"),
    [("wheels", (OdometryEvent, JointsEvent)), ("imu", (ImuEvent,)), ("camera", (RangeBearingEvent,))],
)
def test_dropout_silences_one_sensor(sensor, kinds):
    before = driving()
    after = apply("dropout", before, sensor=sensor)
    assert not of(kinds, after)
    assert_only(kinds, before, after)


def test_latency_delays_receipt_and_keeps_order_of_receipt():
    before = driving()
    after = apply("latency", before, sensor="command", delay_s=0.25)
    assert sorted(e.received_ns for e in after) == [e.received_ns for e in after]
    late = of(ControlEvent, after)
    assert len(late) == 100
    assert all(e.received_ns - e.stamp_ns == 250_000_000 for e in late)
    assert_only(ControlEvent, before, after)


def test_jitter_puts_messages_out_of_order():
    late = of(ControlEvent, apply("latency", driving(), sensor="command", jitter_s=0.5))
    stamps = [e.stamp_ns for e in late]
    assert stamps != sorted(stamps)
    assert sorted(stamps) == [e.stamp_ns for e in of(ControlEvent, driving())]


def test_stamped_on_arrival_moves_the_stamp_too():
    late = of(ControlEvent, apply("latency", driving(), sensor="command", delay_s=0.25, stamped_on_arrival=True))
    assert all(e.received_ns == e.stamp_ns for e in late)


def test_clock_offset_and_drift_move_stamps_alone():
    after = apply("clock_offset", driving(), sensor="imu", offset_s=-0.1, drift_ppm=1000.0)
    for event in of(ImuEvent, after):
        t = event.received_ns * 1e-9
        assert event.stamp_ns - event.received_ns == pytest.approx((-0.1 + 1e-3 * t) * 1e9, abs=1)


def test_duplicates_come_later_with_the_same_stamp():
    after = of(ControlEvent, apply("duplicated_messages", driving(), sensor="command", after_s=0.05))
    assert len(after) == 200
    stamps = [e.stamp_ns for e in after]
    assert all(stamps.count(s) == 2 for s in set(stamps))
    assert sum(e.received_ns - e.stamp_ns == 50_000_000 for e in after) == 100


def test_truncated_ends_everything():
    after = apply("truncated", driving(), keep=0.5)
    assert max(seconds(after)) == pytest.approx(5.0)
    assert of(TruthEvent, after)


# --- camera ---


def picture(t=0.0, height=40, width=60):
    pixels = np.tile(np.linspace(0, 255, width).astype(np.uint8), (height, 1))
    return image(t, pixels.tobytes(), compressed=False, width=width, height=height, step=width), pixels


def test_darkness_scales_and_adds_noise():
    event, pixels = picture()
    (dark,) = apply("darkness", [event], gain=0.2, noise=0.0)
    assert np.array_equal(decode(dark), np.rint(pixels * np.float32(0.2)))
    (noisy,) = apply("darkness", [event], gain=0.5, noise=3.0)
    middle = (decode(noisy) - 0.5 * pixels)[:, 10:]
    assert np.std(middle) == pytest.approx(3.0, rel=0.1)


def test_mirrored_image_is_flipped_left_to_right():
    event, pixels = picture()
    (flipped,) = apply("mirrored_image", [event])
    assert np.array_equal(decode(flipped), pixels[:, ::-1])


def test_undecodable_image_passes_as_it_is():
    event = image(0.0, b"not an image")
    assert apply("mirrored_image", [event]) == [event]


def test_frame_rate_keeps_the_given_rate():
    left = seconds(of(RangeBearingEvent, apply("frame_rate", driving(), max_hz=2.0)))
    assert np.allclose(np.diff(left), 0.5)


# --- sightings ---


def test_sighting_noise_has_the_stated_sigma():
    events = [corners(0.01 * k, 1, 2) for k in range(200)]
    after = apply("sighting_noise", events, corner_px=1.5)
    off = np.array([s.corners_px - events[0].sightings[0].corners_px for e in after for s in e.sightings])
    assert np.std(off) == pytest.approx(1.5, rel=0.05)
    ranges = apply("sighting_noise", driving(60.0), range_m=0.2, bearing_rad=0.1)
    first = [e.sightings[0] for e in of(RangeBearingEvent, ranges)]
    assert np.std([s.range_m for s in first]) == pytest.approx(0.2, rel=0.1)
    assert np.std([s.bearing_rad for s in first]) == pytest.approx(0.1, rel=0.1)
    (pose,) = apply("sighting_noise", [marker_pose(0.0)], position_m=0.1)
    assert 0.0 < np.linalg.norm(pose.sightings[0].position - [1.0, 0.0, 0.0]) < 0.6


def test_occluded_ids_stay_hidden_throughout():
    events = [corners(0.1 * k, *range(5)) for k in range(20)]
    seen = [{s.landmark_id for s in e.sightings} for e in apply("occluded_ids", events, ids=[2], part=0.5)]
    assert all(s == seen[0] for s in seen)
    assert len(seen[0]) == 2
    assert 2 not in seen[0]
    assert len(apply("occluded_ids", events, part=1.0)) == 20  # empty messages stay


def test_wrong_ids_are_other_ids_of_the_map():
    events = [corners(0.01 * k, 3) for k in range(1000)]
    ids = [e.sightings[0].landmark_id for e in apply("wrong_ids", events, probability=0.2)]
    assert sum(i != 3 for i in ids) == pytest.approx(200, abs=40)
    assert set(ids) == set(range(5))


def test_duplicated_id_renames_one_marker():
    (event,) = apply("duplicated_id", [corners(0.0, *range(5))], marker_id=1, other=4)
    assert [s.landmark_id for s in event.sightings] == [0, 1, 2, 3, 1]
    (event,) = apply("duplicated_id", [corners(0.0, *range(5))])
    assert len({s.landmark_id for s in event.sightings}) == 4


def test_moved_marker_moves_the_map_by_the_distance():
    failure, at = make("moved_marker", count=2, distance_m=0.4, yaw_rad=0.5), scene()
    moved = failure.corrupt_map(MAP, at).landmarks
    shifts = {i: np.linalg.norm(moved[i].position - MAP.landmarks[i].position) for i in MAP.landmarks}
    assert sorted(round(s, 9) for s in shifts.values()) == [0.0, 0.0, 0.0, 0.4, 0.4]
    assert at.affected["moved_marker"] == 2
    for i, shift in shifts.items():
        turned = moved[i].rotation.T @ MAP.landmarks[i].rotation
        assert math.acos(np.clip((np.trace(turned) - 1) / 2, -1, 1)) == pytest.approx(0.5 if shift else 0.0, abs=1e-7)
        assert moved[i].position[2] == MAP.landmarks[i].position[2]


# --- wheels ---


def travelled(events):
    """Forward distance and turn by odometry's pose and twist, and wheel distances by joints' angles and rates."""
    odometries, encoders = of(OdometryEvent, events), of(JointsEvent, events)
    poses = [np.array([*e.position[:2], quaternion_yaw(e.orientation)]) for e in odometries]
    steps = np.array([se2.log(se2.between(a, b)) for a, b in pairwise(poses)])
    angles = np.array([e.position for e in encoders])
    return (
        steps[:, [0, 2]].sum(axis=0),
        0.1 * np.sum([(e.linear[0], e.angular[2]) for e in odometries[1:]], axis=0),
        (angles[-1] - angles[0]) * RADIUS,
        0.1 * np.sum([e.velocity for e in encoders[1:]], axis=0) * RADIUS,
    )


def assert_all(events, forward, turn):
    by_pose, by_twist, by_angle, by_rate = travelled(events)
    wheels = np.array([forward - 0.5 * TRACK * turn, forward + 0.5 * TRACK * turn])
    assert np.allclose(by_pose, [forward, turn], atol=1e-9)
    assert np.allclose(by_twist, [forward, turn], atol=1e-9)
    assert np.allclose(by_angle, wheels, atol=1e-9)
    assert np.allclose(by_rate, wheels, atol=1e-9)


def test_slip_adds_its_motion_in_all_messages():
    after = apply("wheel_slip", driving(), speed=0.1, yaw_rate=-0.2, when={"intervals": [(1.95, 3.95)]})
    assert_all(after, 9.9 * 0.4 + 2.0 * 0.1, 9.9 * 0.3 - 2.0 * 0.2)


def test_slip_share_and_profiles():
    assert_all(apply("wheel_slip", driving(), share=0.5), 9.9 * 0.4 * 1.5, 9.9 * 0.3 * 1.5)
    ramp = apply("wheel_slip", driving(), speed=0.2, profile="ramp", when={"intervals": [(1.95, 3.95)]})
    assert_all(ramp, 9.9 * 0.4 + 0.2 * 2.0 / 2.0, 9.9 * 0.3)
    pulse = apply("wheel_slip", driving(), speed=0.2, profile="pulse", when={"intervals": [(1.95, 3.95)]})
    assert travelled(pulse)[0][0] == pytest.approx(9.9 * 0.4 + 0.2 * 2.0 * 2.0 / math.pi, rel=0.001)


def test_dead_encoder_of_one_wheel_or_both():
    assert_all(apply("encoder_dead", driving()), 0.0, 0.0)
    right = 0.4 + 0.5 * TRACK * 0.3
    assert_all(apply("encoder_dead", driving(), wheel="left"), 9.9 * right / 2.0, 9.9 * right / TRACK)


def test_wheel_failures_leave_the_other_sensors_alone():
    before = driving()
    assert_only((OdometryEvent, JointsEvent), before, apply("wheel_slip", before, speed=1.0))


def test_quantized_encoder_counts_whole_ticks():
    after = apply("encoder_quantized", driving(), tick_m=0.03)
    distances = np.array([e.position for e in of(JointsEvent, after)]) * RADIUS
    assert np.allclose(distances / 0.03, np.rint(distances / 0.03), atol=1e-6)
    exact = np.array([e.position for e in of(JointsEvent, driving())]) * RADIUS
    assert ((exact - distances > -1e-9) & (exact - distances < 0.03 + 1e-9)).all()
    assert travelled(after)[1] == pytest.approx(travelled(after)[0])


def test_scale_drift_grows_with_time():
    after = apply("wheel_scale_drift", driving(60.0), duration=60.0, left_per_min=0.1, right_per_min=0.1)
    assert of(OdometryEvent, after)[-1].linear[0] == pytest.approx(0.4 * (1.0 + 0.1 * 59.9 / 60.0))
    assert of(OdometryEvent, after)[1].linear[0] == pytest.approx(0.4, rel=1e-3)


def test_frozen_encoder_repeats_then_jumps():
    before = driving()
    after = apply("encoder_frozen", before, when={"intervals": [(1.95, 3.95)]})
    told, exact = of(JointsEvent, after), of(JointsEvent, before)
    assert all(np.array_equal(told[k].position, exact[19].position) for k in range(19, 40))
    assert [e.stamp_ns for e in told] == [e.stamp_ns for e in exact]
    assert told[40] is exact[40]


def test_rollover_wraps_angles():
    before = driving(60.0)
    after = apply("encoder_rollover", before, duration=60.0, range_rad=2.0)
    for a, b in zip(of(JointsEvent, before), of(JointsEvent, after), strict=True):
        assert ((b.position >= 0) & (b.position < 2.0)).all()
        assert np.allclose(np.cos(np.pi * (a.position - b.position)), 1.0)


def test_odometry_reset_counts_from_zero():
    before = driving()
    after = apply("odometry_reset", before, when={"intervals": [(4.95, 99.0)]})
    told = of(OdometryEvent, after)
    assert told[49] is of(OdometryEvent, before)[49]
    assert np.allclose(told[50].position, 0.0)
    assert quaternion_yaw(told[50].orientation) == pytest.approx(0.0)
    assert np.allclose(of(JointsEvent, after)[50].position, 0.0)
    by_pose, exact = (travelled([*events[:6], *events[306:]])[0] for events in (after, before))
    assert not np.allclose(by_pose, exact)
    assert np.allclose(travelled(after[300:])[0], travelled(before[300:])[0])


def test_nan_wheels():
    after = apply("wheel_nan", driving(), when={"share": 0.5})
    corrupted = [e for e in of(OdometryEvent, after) if np.isnan(e.linear).all() and np.isnan(e.position).all()]
    assert 30 < len(corrupted) < 70
    assert 30 < sum(np.isnan(e.position).all() for e in of(JointsEvent, after)) < 70


def test_wrong_covariance_scales_odometry():
    after = of(OdometryEvent, apply("wrong_covariance", driving(), factor=-1.0))
    assert all(np.array_equal(e.twist_cov, -0.01 * np.eye(6)) for e in after)


def test_imu_bias_adds():
    event = of(ImuEvent, apply("imu_bias", driving(), yaw_rate=0.05, acceleration=(0.1, 0.0, 0.0)))[0]
    assert event.angular_velocity == pytest.approx([0.0, 0.0, 0.35])
    assert event.linear_acceleration == pytest.approx([0.1, 0.0, 9.81])


# --- kidnap ---


def test_kidnap_cuts_a_piece_out_of_all_sensors_and_closes_the_gap():
    before = driving()
    after = apply("kidnap", before, when={"intervals": [(1.95, 3.95)]})
    for kind in {type(e) for e in before}:
        left, whole = of(kind, after), of(kind, before)
        assert len(left) == len(whole) - 20
        assert all(a is b for a, b in zip(left[:20], whole[:20], strict=True))
        assert [e.stamp_ns for e in left[20:]] == [e.stamp_ns - 2 * 10**9 for e in whole[40:]]
    assert (np.diff(seconds(after)) >= 0.0).all()


def test_kidnapped_wheels_tell_of_no_motion_and_go_on():
    after = apply("kidnap", driving(), when={"intervals": [(1.95, 3.95)]})
    for events, n in ((after[: 6 * 21], 19), (after, 78)):  # the step over the cut is one of standing still
        by_pose, _, by_angle, _ = travelled(events)
        assert by_pose == pytest.approx([0.1 * n * 0.4, 0.1 * n * 0.3])
        assert by_angle == pytest.approx([0.1 * n * (0.4 - 0.5 * TRACK * 0.3), 0.1 * n * (0.4 + 0.5 * TRACK * 0.3)])


def test_kidnap_twice_and_late_messages_stay_with_their_time():
    late = [replace(image(0.1 * k), received_ns=round((0.1 * k + 0.25) * 1e9)) for k in range(100)]
    before = sorted([*driving(), *late], key=lambda e: e.received_ns)
    after = apply("kidnap", before, when={"intervals": [(6.95, 7.95), (1.95, 3.95), (3.05, 4.95)]})
    stamps = np.array([e.stamp_ns for e in of(type(late[0]), after)]) * 1e-9
    assert np.allclose(stamps, 0.1 * np.arange(60))
    assert (np.diff(seconds(after)) >= 0.0).all()
    by_pose, _, by_angle, _ = travelled(after)
    assert by_pose == pytest.approx([5.7 * 0.4, 5.7 * 0.3])
    assert by_angle[1] == pytest.approx(5.7 * (0.4 + 0.5 * TRACK * 0.3))


def test_a_topic_that_begins_after_the_kidnap_is_only_shifted():
    before = [e for e in driving() if not isinstance(e, JointsEvent) or e.stamp_ns > 4.5e9]
    after = apply("kidnap", before, when={"intervals": [(1.95, 3.95)]})
    told, exact = of(JointsEvent, after), of(JointsEvent, before)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(told, exact, strict=True))


def test_kidnap_needs_bounds_and_takes_all():
    for when in ({"after_s": 1.0}, {"intervals": [(1.0, 2.0)], "share": 0.5}):
        with pytest.raises(ValidationError, match=r"\bkidnap\b.*'when'"):
            make("kidnap", when=when)


# --- chains ---


def test_failures_compose_and_draw_independently():
    chain = [make("dropout", sensor="command", when={"share": 0.5}), make("wrong_ids", probability=0.5)]

    def run(failures, seed, first=0):
        rngs = generators(2, seed)[first:]
        scenes = [Scene(0, 10.0, Config(), tuple(MAP.landmarks), rng) for rng in rngs]
        events = corrupt(failures, "recorded", iter(driving()), scenes)
        return list(corrupt(failures, "sightings", events, scenes)), scenes

    both, scenes = run(chain, 3)
    alone, _ = run(chain[1:], 3, first=1)
    assert 30 < len(of(ControlEvent, both)) < 70
    assert len(of(ControlEvent, alone)) == 100
    ids = [[s.landmark_id for e in of(RangeBearingEvent, r) for s in e.sightings] for r in (both, alone)]
    assert ids[0] == ids[1]
    assert scenes[0].affected["dropout"] == 100 - len(of(ControlEvent, both))
