"""A run from bag to result: repeatable, honest about what it could not use, batch better than online."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from robot_world import START_NS, World, beacons, config
from world_bags import write_world

import fgloc_datasets
from fgloc import se2
from fgloc.config import load_config
from fgloc.errors import EstimatorError
from fgloc.recording.storage import find_beside
from fgloc.runner import RunResult, run
from fgloc.sensors.maps import write_map
from fgloc.types import LandmarkMap, Mode, TruthEvent


def errors(result: RunResult) -> np.ndarray:
    """Distance [m] to the truth of each pose, by the world's own interpolated truth."""
    truth = se2.interpolate(result.truth.stamps_ns, result.truth.poses, result.trajectory.stamps_ns)
    return np.hypot(*(result.trajectory.poses - truth)[:, :2].T)


@pytest.mark.slow
def test_batch_is_at_least_as_accurate_as_online_over_seeds(tmp_path):
    online, batch = [], []
    for seed in range(4):
        (tmp_path / str(seed)).mkdir()
        bag = write_world(tmp_path / str(seed), World(beacons(), seed=seed, seconds=12.0, blind=((5.0, 8.0),)))
        map_path = find_beside(bag, "map.yaml")
        online.append(errors(run(bag, map_path, config(), "online")).mean())
        batch.append(errors(run(bag, map_path, config(), "batch")).mean())
    assert np.mean(batch) < 0.8 * np.mean(online)
    assert np.mean(batch) < 0.02


def test_every_keyframe_counts_and_every_factor_is_told(tmp_path):
    result = run(write_world(tmp_path, World(beacons(), seconds=8.0)), tmp_path / "map.yaml", config(), "online")
    keyframes = {d.step for d in result.decisions}
    assert result.counts["wheels"] == len(keyframes) - 1
    assert len(keyframes) - len(result.trajectory) in (0, 1)  # the start waits for a third beacon, to be checked by
    fused = [d for d in result.decisions if d.kind == "range_bearing" and not d.reason]
    assert result.counts["range_bearing"] == len(fused)
    refused = sum(n for reason, n in result.rejections.items() if reason.startswith("sightings."))
    assert len(fused) + refused == 2 * 80
    assert set(result.modes[2:]) == {Mode.OK}
    assert len(result.step_ms) >= len(result.trajectory)


@pytest.mark.parametrize(("blind_s", "named"), [(12.0, True), (4.0, False)])
def test_a_place_that_is_known_late_is_named_with_the_time(tmp_path, blind_s, named):
    bag = write_world(tmp_path, World(beacons(), seconds=20.0, blind=((0.0, blind_s),)))
    result = run(bag, tmp_path / "map.yaml", config(), "online")
    found = [f for f in result.findings if f.code == "place.late"]
    assert bool(found) is named
    assert not named or (found[0].value == pytest.approx(result.first_pose_s) and result.first_pose_s > 12.0)


def test_the_truth_is_moved_from_its_body_to_the_base(tmp_path):
    body = (0.12, -0.05, math.radians(87.0))
    bag = write_world(tmp_path, World(beacons(), seconds=6.0), body=body)
    settings = config(truth={"offset_m": body[:2], "yaw_offset_rad": body[2]})
    result, raw = (run(bag, tmp_path / "map.yaml", c, "batch") for c in (settings, config()))
    world = World(beacons())
    for stamp, pose in zip(result.truth.stamps_ns[::10], result.truth.poses[::10], strict=True):
        assert np.allclose(se2.between(pose, world.truth(int(stamp))), 0.0, atol=1e-9)
    assert errors(result).mean() < 0.02
    assert 0.1 < errors(raw).mean() < 0.2


def test_without_a_fix_the_error_says_what_was_heard_and_what_was_rejected(tmp_path):
    world = World(beacons(), seconds=4.0)
    bag = write_world(tmp_path, world)
    (tmp_path / "other.yaml").write_text("landmarks:\n  - {id: 99, position: [1.0, 2.0]}\n")
    with pytest.raises(EstimatorError) as caught:
        run(bag, tmp_path / "other.yaml", config(), "batch")
    message = str(caught.value)
    assert "/odom 80" in message
    assert "sightings.unknown_id 80" in message
    assert "estimator.initial_pose" in message


def test_without_sightings_a_given_first_pose_is_enough(tmp_path):
    world = World(beacons(), seconds=4.0)
    bag = write_world(tmp_path, world, sightings=False)
    settings = config(estimator={"initial_pose": tuple(world.truth(START_NS))})
    result = run(bag, tmp_path / "map.yaml", settings, "online")
    assert result.modes[-1] is Mode.DEAD_RECKONING
    assert errors(result).max() < 0.15


def test_a_first_pose_that_holds_against_the_map_holds_in_batch_as_online(tmp_path):
    truth = beacons()
    world = World(truth, seconds=19.0)
    bag = write_world(tmp_path, world)
    shifted = {i: replace(m, position=m.position + np.array([1.0, 0.0, 0.0])) for i, m in truth.landmarks.items()}
    write_map(LandmarkMap(shifted, None), tmp_path / "shifted.yaml")
    settings = config(estimator={"initial_pose": tuple(world.truth(START_NS))})
    for mode in ("online", "batch"):
        result = run(bag, tmp_path / "shifted.yaml", settings, mode, check=False)
        assert errors(result).max() < 0.4, mode


def test_without_a_map_landmarks_are_estimated_and_returned(tmp_path):
    truth = beacons()
    world = World(truth, seconds=19.0)
    result = run(write_world(tmp_path, world), None, config(), "batch")
    assert set(result.landmarks.landmarks) == set(truth.landmarks)
    start = world.truth(int(result.trajectory.stamps_ns[0]))
    for number, landmark in result.landmarks.landmarks.items():
        expected = se2.between(start, (*truth.landmarks[number].position[:2], 0.0))[:2]
        error = landmark.position[:2] - expected
        assert error @ np.linalg.solve(landmark.cov, error) < 20.0
        assert np.hypot(*error) < 0.15


def test_progress_and_steps_are_told(tmp_path):
    bag = write_world(tmp_path, World(beacons(), seconds=4.0))
    told, steps = [], []
    result = run(
        bag,
        tmp_path / "map.yaml",
        config(),
        "online",
        progress=lambda done, length: told.append((done, length)),
        on_step=lambda step, estimate: steps.append(estimate),
    )
    assert told[-1] == pytest.approx((3.95, 3.95), abs=0.06)
    assert [e for e, _ in told] == sorted(e for e, _ in told)
    assert sum(e is not None for e in steps) == len(result.trajectory)


def test_a_paced_replay_takes_its_time(tmp_path):
    bag = write_world(tmp_path, World(beacons(), seconds=2.0))
    paced = run(bag, tmp_path / "map.yaml", config(), "online", pace=2.0)
    free = run(bag, tmp_path / "map.yaml", config(), "online")
    assert 0.9 < paced.wall_s < 3.0
    assert np.array_equal(paced.trajectory.poses, free.trajectory.poses)


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_times_of_messages_count_from_the_first_pose_of_the_result(tmp_path, mode):
    """Also where that is not the pose that the replay found first, as its time came again."""
    second = World(beacons(), seed=1, seconds=5.0, start_ns=START_NS - 2 * 10**9, start_s=9.0)
    bag = write_world(tmp_path, World(beacons(), seconds=3.0), second)
    result = run(bag, tmp_path / "map.yaml", config(), mode)
    first_pose = int(result.trajectory.stamps_ns[0])
    assert first_pose < START_NS - 10**9
    for span in result.spans.values():
        assert first_pose + round(1e9 * span.times.min()) == pytest.approx(second.start_ns, abs=2e8)


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_fault_15_a_bag_whose_clock_is_set_back_still_gives_a_trajectory_in_order_of_time(tmp_path, mode):
    """The stamps of the second drive come again: of two poses at one time the later word holds."""
    first = World(beacons(), seconds=6.0)
    second = World(beacons(), seed=1, seconds=5.0, start_ns=START_NS + 3 * 10**9, start_s=9.0)
    bag = write_world(tmp_path, first, second)
    result = run(bag, tmp_path / "map.yaml", config(), mode)
    assert (np.diff(result.trajectory.stamps_ns) > 0).all()
    assert any(re.search(r"\bclock\b.* 3\.\d s\b", note) for note in result.notes)
    late = result.trajectory.stamps_ns > START_NS + 4 * 10**9
    truth = [second.truth(int(s)) for s in result.trajectory.stamps_ns[late]]
    assert np.hypot(*(result.trajectory.poses[late] - np.array(truth))[:, :2].T).mean() < 0.05
    assert len(result.modes) == len(result.trajectory) == len(result.trajectory.covs)
    assert errors(result).mean() < 0.05
    known = [
        (stamp, pose)
        for stamp, pose in zip(result.truth.stamps_ns, result.truth.poses, strict=True)
        if stamp > START_NS
    ]
    assert len(known) == 8 * 20 - 1
    for stamp, pose in known:
        world = first if stamp < second.start_ns else second
        assert np.allclose(se2.between(pose, world.truth(int(stamp))), 0.0, atol=1e-6)


def test_a_single_stray_stamp_of_the_truth_costs_nothing(tmp_path):
    bag = write_world(tmp_path, World(beacons(), seconds=5.0))

    def one_stray(events):
        for k, event in enumerate(events):
            if isinstance(event, TruthEvent) and k >= 150 and not strayed:
                strayed.append(event.stamp_ns)
                event = replace(event, stamp_ns=event.stamp_ns - 2 * 10**9 - 7)
            yield event

    strayed: list[int] = []
    result = run(bag, tmp_path / "map.yaml", config(), "online", events=one_stray)
    assert len(strayed) == 1
    assert len(result.truth) == 100


def test_find_beside_looks_in_the_folder_and_in_the_one_that_holds_it(tmp_path):
    bag = tmp_path / "run" / "bag"
    bag.mkdir(parents=True)
    file = bag / "bag_0.mcap"
    file.touch()
    assert find_beside(bag, "map.yaml") is None
    (tmp_path / "run" / "map.yaml").touch()
    assert find_beside(bag, "map.yaml") == tmp_path / "run" / "map.yaml"
    assert find_beside(file, "map.yaml") == tmp_path / "run" / "map.yaml"
    (bag / "map.yaml").touch()
    assert find_beside(bag, "map.yaml") == bag / "map.yaml"
    assert find_beside(file, "map.yaml") == bag / "map.yaml"


def test_images_whose_markers_are_not_on_the_map_have_arrived(tmp_path):
    """The error names the ids that were seen and those of the map, and does not say that no image came."""
    sample = fgloc_datasets.SAMPLE.parent
    text = (sample / "map.yaml").read_text()
    (tmp_path / "map.yaml").write_text(re.sub(r"id: (\d)", r"id: 4\1", text))
    config = load_config(sample / "robot.yaml")

    def begun(events):
        first = None
        for event in events:
            first = first or event.received_ns
            if event.received_ns > first + 4_000_000_000:
                return
            yield event

    with pytest.raises(EstimatorError) as caught:
        run(sample / "bag", tmp_path / "map.yaml", config, "online", events=begun)
    said = str(caught.value)
    assert re.search(r"\bids\b.* \(\d[\d, ]*\) .* 40, 41\b", said)
    assert "(image)" not in said  # as of a topic that never spoke
