"""A motion model of another robot, as a user may take one that comes with the package."""

from pathlib import Path

import pytest

import fgloc
from fgloc.ablation.failures import events_of
from fgloc.config import load_config
from fgloc.estimation.log import OVERRULED
from fgloc.evaluation.metrics import compute_metrics
from fgloc.live import Live
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.base import with_values
from fgloc.types import RawEvent

MODEL = Path(fgloc.__file__).parent / "sensors" / "learned" / "models" / "mrclam" / "all.safetensors"
SAMPLES = Path(__file__).parent.parent.parent / "datasets" / "samples"
SAMPLE = SAMPLES / "installed_run"


def test_a_model_of_another_robot_is_named_and_left_out():
    folder = SAMPLES / "patches_run"
    foreign = with_values(load_config(folder / "robot.yaml"), "motion", {"model": MODEL})
    result = run(folder / "bag", folder / "map.yaml", foreign, "online")
    assert result.findings[0].code == "motion.model"
    assert result.notes[0] == result.mistakes[0]
    metrics = compute_metrics(result, result.config)
    assert metrics.ate_mean_m < 0.006  # with it 0.06
    assert metrics.nees_over_3 < 1.4  # with it 358
    reasons = [d.reason for d in result.decisions if d.kind == "learned"]
    assert reasons.count("contradicted") > 0.5 * len(reasons)
    with (
        open_recording(folder / "bag", foreign.recording) as recording,
        Live(foreign, folder / "map.yaml", roles=recording.roles) as live,
    ):
        for event in recording.events():
            live.push(event)
            if isinstance(event, RawEvent):
                live.wait()  # no image is dropped
        live.wait()
        assert live.status().findings[0].code == "motion.model"


def dark(first_s, last_s, end_s):
    """Filter of events: the camera is dark from ``first_s`` to ``last_s`` after the start, and the run ends."""

    def chosen(events):
        start_ns = None
        for event in events:
            start_ns = event.stamp_ns if start_ns is None else start_ns
            seconds = (event.stamp_ns - start_ns) * 1e-9
            if seconds > end_s:
                return
            if not (isinstance(event, events_of("camera")) and first_s <= seconds < last_s):
                yield event

    return chosen


@pytest.mark.parametrize("gyro", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_model_that_was_never_right_accuses_no_sound_wheels(gyro):
    """Finding R10: markers are dark before the model could be held against them; wheels and model are both doubted."""
    config = with_values(load_config(SAMPLE / "robot.yaml"), "motion", {"model": MODEL})
    config = with_values(config, "gyro", {"use": gyro})
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", config, "online", events=dark(1.0, 21.0, 26.0))
    metrics = compute_metrics(result, result.config)
    assert metrics.ate_mean_m < 0.06  # without: 1.0 m, with a gyro 0.34 m
    assert metrics.nees_over_3 < 2.0  # without: 994 and 706
    reasons = {(d.kind, d.reason) for d in result.decisions}
    assert ("wheels", "slip") not in reasons
    assert {("wheels", "doubted"), ("learned", "doubted"), ("learned", "contradicted")} <= reasons
    assert not {"quarantined", "landmark_moved"} & {reason for _, reason in reasons}


def test_the_doubted_stretch_is_revised_once_sightings_contradict_the_model():
    """The motions of its steps enter the graph anew, without the model."""
    config = with_values(load_config(SAMPLE / "robot.yaml"), "motion", {"model": MODEL})
    config = with_values(config, "gyro", {"use": False})
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", config, "online", events=dark(0.6, 9.0, 14.0))
    learned = [d for d in result.decisions if d.kind == "learned"]
    doubted, revised = ({d.step for d in learned if d.reason == why} for why in ("doubted", "contradicted"))
    assert len(doubted) > 40
    assert len(doubted & revised) > 0.9 * len(doubted)


@pytest.mark.slow
def test_no_landmark_is_named_by_a_pose_that_sightings_overrule():
    """Wheels alone slip on ice: what its only marker says of the robot's wrong place is no evidence against it."""
    folder = SAMPLES / "patches_run"
    config = with_values(load_config(folder / "robot.yaml"), "motion", {"model": MODEL})
    config = with_values(config, "gyro", {"use": False})
    result = run(folder / "bag", folder / "map.yaml", config, "online", events=dark(2.0, 22.0, 48.0))
    reasons = [d.reason for d in result.decisions]
    assert OVERRULED in reasons
    assert "landmark_moved" not in reasons


@pytest.mark.slow
def test_the_robots_own_model_is_used():
    config = load_config(SAMPLE / "robot.yaml")
    result = run(SAMPLE / "bag", SAMPLE / "map.yaml", config, "online")
    assert not result.mistakes
    assert not any("motion model" in note for note in result.notes)
