"""Motion of any drive over steps: derivatives, roll-over, missing joints, commands, and geometry that a run finds."""

import math

import numpy as np
import pytest
from event_makers import in_order_of_receipt, ns, run, stepper
from robot_world import points, polar

from fgloc import se2
from fgloc.config import Config, WheelsConfig, yaml_of
from fgloc.errors import ConfigError
from fgloc.intake.validation import EventValidator
from fgloc.runner import run as run_recording
from fgloc.sensors.maps import write_map
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
WHEELS = ["fl", "fr", "rl", "rr"]
MECANUM = {"kind": "mecanum", "wheels": WHEELS, "radius": 0.05, "half_sum": 0.4}
TRICYCLE = {
    "kind": "tricycle",
    "wheel": "traction",
    "steering_joint": "steering",
    "radius": 0.1,
    "wheelbase": 1.2,
    "ticks_per_turn": 5000,
    "steering_ticks": 8192,
    "steering_zero": 0.05,
}
BEACONS = {0: (4.0, 0.5), 1: (0.5, 4.0), 2: (-4.0, -0.5), 3: (-0.5, -4.0)}


def wheels(drive, **more):
    return WheelsConfig.model_validate({"drive": drive, **more})


def turned(t):
    """Angles of four mecanum wheels [rad] that go in all directions."""
    return [9.0 * t + 2.0 * math.sin(t), 10.0 * t - 3.0 * math.cos(t), 8.0 * t, 9.5 * t + 4.0 * math.sin(0.7 * t)]


def ticks(t):
    """Steering and travel [ticks]: the first is counted up to a turn, the second rolls over after 1.5 s."""
    return [(8000.0 + 900.0 * math.sin(t)) % 8192, (2.0**32 - 3000.0 + 2000.0 * t) % 2.0**32]


def messages(angles_at, names, hz=50, seconds=6.0):
    for k in range(round(seconds * hz)):
        stamp = ns(k / hz)
        yield JointsEvent(stamp, stamp, "/joints", tuple(names), np.array(angles_at(k / hz)), np.empty(0), np.empty(0))


def motion_over(config, events):
    measured, last = WheelMotion(config), None
    for step in run(stepper(), in_order_of_receipt(events)):
        m = measured.measure(step)
        if m is not None:
            last = step, m
    step, m = last
    return m.motion, measured.derivatives(step, m), measured


def twist_of(config, events):
    """Mean twist over the last step."""
    measured = WheelMotion(config)
    ends = [(m, step.dt) for step in run(stepper(), in_order_of_receipt(events)) if (m := measured.measure(step))]
    return se2.log(ends[-1][0].motion) / ends[-1][1]


@pytest.mark.parametrize(
    ("drive", "names", "angles", "more"),
    [
        (MECANUM, WHEELS, turned, {}),
        ({**TRICYCLE, "rolls_over": 2.0**32}, ["steering", "traction"], ticks, {}),
        ({**TRICYCLE, "rolls_over": 2.0**32}, ["steering", "traction"], ticks, {"slowdown": 0.3, "scale_v": 1.1}),
    ],
)
def test_derivatives_over_a_step_are_those_of_differences(drive, names, angles, more):
    config, h = wheels(drive, **more), 1e-6
    _, by, _ = motion_over(config, messages(angles, names))
    assert config.drive.states
    for name in config.drive.states:
        there, back = (
            motion_over(
                config.model_copy(update={"drive": config.drive.with_values({name: config.drive.value(name) + s * h})}),
                messages(angles, names),
            )[0]
            for s in (1.0, -1.0)
        )
        numeric = se2.log(se2.between(back, there)) / (2.0 * h)
        assert by[f"wheels.drive.{name}"] == pytest.approx(numeric, abs=1e-5), name


def test_a_counter_that_rolls_over_goes_on():
    config = wheels({**TRICYCLE, "rolls_over": 2.0**32})
    rolled = messages(ticks, ["steering", "traction"], seconds=1.55)
    plain = messages(lambda t: (ticks(t)[0], 2000.0 * t), ["steering", "traction"], seconds=1.55)
    motion, _, measured = motion_over(config, rolled)
    assert not measured.rejections
    assert motion == pytest.approx(motion_over(wheels(TRICYCLE), plain)[0], abs=1e-9)
    assert np.hypot(*motion[:2]) > 0.01


def test_rates_of_ticks_are_not_used():
    stamps = [ns(0.02 * k) for k in range(100)]
    events = [
        JointsEvent(t, t, "/j", tuple(WHEELS), np.full(4, 3.0 * k), np.full(4, 1e4), np.empty(0))
        for k, t in enumerate(stamps)
    ]
    twist = twist_of(wheels({**MECANUM, "ticks_per_turn": 100}), events)
    assert twist[0] == pytest.approx(50 * 3.0 / 100 * math.tau * 0.05, rel=1e-6)


def test_missing_joints_are_named_with_those_that_there_are():
    names = ["f_l", "fr", "rl", "rr"]
    with pytest.raises(ConfigError, match=r" fl \(.*'f_l'.*\).* f_l, fr, rl, rr"):
        motion_over(wheels(MECANUM), messages(turned, names))


def test_joints_without_values_are_named():
    events = (
        JointsEvent(ns(t), ns(t), "/j", tuple(WHEELS), np.full(4, np.nan), np.empty(0), np.empty(0))
        for t in np.arange(0, 2, 0.02)
    )
    with pytest.raises(ConfigError, match=", ".join(WHEELS)):
        motion_over(wheels(MECANUM), events)


def commands(seconds=4.0, **values):
    return [ControlEvent(ns(t), ns(t), "/cmd", **values) for t in np.arange(0.0, seconds, 0.05)]


def test_commands_move_a_drive_sideways_only_if_it_can():
    sideways = commands(v=0.1, omega=0.0, vy=0.5)
    assert twist_of(wheels(MECANUM, source="command"), sideways) == pytest.approx([0.1, 0.5, 0.0], abs=1e-9)
    assert twist_of(wheels(None, source="command"), sideways) == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)


def test_a_commanded_steering_angle_needs_a_wheelbase():
    steered = commands(v=0.5, omega=0.0, steering=0.3)
    car = {"kind": "ackermann", "wheelbase": 2.5}
    assert twist_of(wheels(car, source="command"), steered)[2] == pytest.approx(0.5 * math.tan(0.3) / 2.5)
    with pytest.raises(ConfigError, match=r"set wheels\.drive"):
        motion_over(wheels(None, source="command"), steered)


# --- a run ------------------------------------------------------------------------------------------------------------

TRUE = {"radius": 0.0512, "half_sum": 0.388, "lateral": 0.97}


def write_mecanum(folder, seconds=60.0, seed=1):
    """A mecanum robot of `TRUE` geometry that slides and turns among four beacons."""
    rng = np.random.default_rng(seed)
    true = wheels({**MECANUM, **TRUE}).drive
    inverse = true.equations(np.zeros(4), np.zeros(0)).A
    pose, angles, beacons = np.zeros(3), np.zeros(4), points(BEACONS).landmarks
    with BagWriter(folder / "bag") as bag:
        for k in range(round(100 * seconds)):
            t, stamp = 0.01 * k, START_NS + k * 10_000_000
            if k % 2 == 0:
                bag.joints("/joint_states", stamp, WHEELS, angles.tolist())
            if k % 10 == 0:
                bag.planar_truth("/truth", stamp, pose)
                seen = [(i, *(polar(pose, m) + rng.normal(0.0, (0.02, 0.005)))) for i, m in beacons.items()]
                bag.range_bearing("/landmarks", stamp, seen[(k // 10) % 2 :: 2])
            way = np.array([0.4 * math.cos(0.5 * t), 0.4 * math.sin(0.7 * t), 0.4 * math.sin(0.3 * t)]) * 0.01
            angles = angles + inverse @ way / TRUE["radius"]
            pose = se2.compose(pose, se2.exp(way + rng.normal(0.0, 2e-4, 3)))
    write_map(points(BEACONS), folder / "map.yaml")
    config = Config.model_validate(
        {
            "wheels": {
                "drive": {**MECANUM, "sigmas": {"radius": 0.002, "half_sum": 0.02, "lateral": 0.05}},
                "noise": {
                    "x_per_sqrt_m": 0.005,
                    "y_per_sqrt_m": 0.005,
                    "yaw_per_sqrt_m": 0.005,
                    "yaw_per_sqrt_rad": 0.005,
                },
            },
            "landmarks": {"range_sigma_m": 0.02, "bearing_sigma_rad": 0.005, "range_scale_sigma": 0.0},
            "map": {"position_sigma_m": 0.0},
        }
    )
    (folder / "robot.yaml").write_text(yaml_of(config, folder))
    return config


@pytest.fixture(scope="module")
def mecanum(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mecanum")
    return folder, write_mecanum(folder)


@pytest.mark.parametrize("mode", ["batch", pytest.param("online", marks=pytest.mark.slow)])
def test_a_run_finds_the_geometry_of_a_mecanum_drive(mecanum, mode):
    folder, config = mecanum
    result = run_recording(folder / "bag", folder / "map.yaml", config, mode)
    found = {s.name.removeprefix("wheels.drive."): s for s in result.found.settings if "drive" in s.name}
    assert found.keys() == TRUE.keys()
    for name, value in TRUE.items():
        s = found[name]
        assert abs(s.found - value) < 4.0 * s.sigma, (name, s)
        assert s.sigma < 0.3 * s.prior_sigma
        assert abs(s.given - value) > 3.0 * s.sigma  # it is found, not given
    known = result.trajectory.stamps_ns <= result.truth.stamps_ns[-1]
    true = result.truth.interpolate(result.trajectory.stamps_ns[known])
    errors = np.hypot(*(result.trajectory.poses[known] - true)[:, :2].T)
    assert np.sqrt(np.mean(errors**2)) < (0.02 if mode == "batch" else 0.05)


def test_a_measured_speed_of_a_car_is_no_reset():
    drive = {"kind": "ackermann", "wheelbase": 2.8}
    names, nothing = ("speed", "steering_angle"), np.empty(0)
    events = [
        JointsEvent(
            ns(k / 20), ns(k / 20), "/joints", names, np.array([math.nan, 0.0]), np.array([30.0, math.nan]), nothing
        )
        for k in range(60)
    ]
    assert twist_of(wheels(drive), events) == pytest.approx([30.0, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("arm", [False, True])
def test_positions_that_stay_at_zero_while_the_wheels_turn_are_none(arm):
    names, more = (*WHEELS, "arm") if arm else tuple(WHEELS), [0.3] if arm else []
    gate = EventValidator(Config().gate)
    position, rates = np.array([0.0] * 4 + more), np.array([4.0] * 4 + [0.0] * len(more))
    events = [JointsEvent(ns(k / 50), ns(k / 50), "/j", names, position, rates, np.empty(0)) for k in range(1, 100)]
    passed = [event for event in map(gate.check, events) if event is not None]
    assert len(passed) == len(events)
    assert not gate.rejections
    assert twist_of(wheels(MECANUM), passed) == pytest.approx([0.2, 0.0, 0.0], abs=1e-9)


def test_joints_that_come_in_several_messages_are_said_to():
    def parts():
        for k in range(100):
            for of, later in ((WHEELS[:2], 0), (WHEELS[2:], 5_000_000)):
                stamp = ns(k / 50) + later
                yield JointsEvent(stamp, stamp, "/j", tuple(of), np.zeros(2), np.empty(0), np.empty(0))

    with pytest.raises(ConfigError, match=r"recording\.joints"):
        motion_over(wheels(MECANUM), parts())
