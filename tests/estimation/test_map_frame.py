"""Frame of the map while it is being made: poses that were given stay where they are as well as they can."""

from dataclasses import replace

import numpy as np
import pytest
from robot_world import START_NS, Chain, World, beacons, config, position_error

from fgloc import se2
from fgloc.estimation.localizer import MapFrame


class Drifting:
    """A graph whose poses turn by a drift until a loop corrects them all."""

    def __init__(self, n, drift_rad):
        self.true = [np.array([np.cos(a), np.sin(a), a + np.pi / 2]) for a in np.linspace(0.0, 2.0 * np.pi, n)]
        first = self.true[0]
        self.true = [se2.between(first, pose) for pose in self.true]
        self.drifted = [se2.compose((0.0, 0.0, drift_rad * k / n), pose) for k, pose in enumerate(self.true)]
        self.closed = False

    def smoothed(self, k):
        return (self.true if self.closed else self.drifted)[k]


def test_without_a_loop_the_frame_is_that_of_the_first_pose():
    graph, frame = Drifting(50, 0.1), MapFrame()
    given = [frame.place(k, graph.smoothed(k), graph) for k in range(50)]
    assert np.array(given) == pytest.approx(np.array(graph.drifted), abs=1e-12)


def test_after_a_loop_poses_are_given_in_the_frame_in_which_those_before_move_least():
    graph, frame = Drifting(50, 0.1), MapFrame()
    given = [frame.place(k, graph.smoothed(k), graph) for k in range(40)]
    graph.closed = True
    given += [frame.place(k, graph.smoothed(k), graph) for k in range(40, 50)]
    moved = np.array([se2.compose(frame.T_map_graph, pose) for pose in graph.true])
    assert np.array(given[40:]) == pytest.approx(moved[40:], abs=1e-9)

    def apart(poses):
        return float(np.sqrt(np.mean(np.sum((np.array(given[:40]) - poses[:40])[:, :2] ** 2, axis=1))))

    assert apart(moved) < 0.6 * apart(np.array(graph.true))


def test_poses_after_a_gap_fix_no_frame_until_the_graph_connects_them_with_those_before():
    graph, frame = Drifting(50, 0.0), MapFrame()
    given = [frame.place(k, graph.smoothed(k), graph) for k in range(40)]
    frame.begin_segment()
    graph.drifted[40:] = [se2.compose((0.7, -0.3, 0.2), pose) for pose in graph.drifted[40:]]  # a guess
    given += [frame.place(k, graph.smoothed(k), graph) for k in range(40, 45)]
    graph.closed = True
    given += [frame.place(k, graph.smoothed(k), graph) for k in range(45, 50)]
    assert np.array(given[:40] + given[45:]) == pytest.approx(np.array(graph.true[:40] + graph.true[45:]), abs=1e-9)


def test_a_long_run_compares_a_bounded_number_of_poses():
    graph, frame = Drifting(3000, 0.5), MapFrame()
    for k in range(2990):
        frame.place(k, graph.smoothed(k), graph)
    asked = []
    smoothed, graph.closed = graph.smoothed, True
    graph.smoothed = lambda k: (asked.append(k), smoothed(k))[1]
    frame.place(2990, smoothed(2990), graph)
    assert 50 < len(asked) < 500


def test_after_a_clock_jump_a_map_goes_on_in_its_frame_though_the_robot_drove_meanwhile():
    world, back_ns = World(beacons(), seed=1, seconds=9.0, rate=5), 10**12
    events, jump_ns = world.events(), START_NS + 4 * 10**9
    later = [e for e in events if e.stamp_ns > jump_ns + 1.5e9]
    later = [replace(e, stamp_ns=e.stamp_ns - back_ns, received_ns=e.received_ns - back_ns) for e in later]
    chain = Chain(config(estimator={"kind": "isam2"}), None)
    made = chain.run([*(e for e in events if e.stamp_ns < jump_ns), *later])
    start = se2.compose(made[0].pose, se2.inverse(world.truth(made[0].stamp_ns)))
    found = made[-12:]
    off = [position_error(e, se2.compose(start, world.truth(e.stamp_ns + back_ns))) for e in found]
    assert all(e.stamp_ns < START_NS for e in found)
    assert max(off) < 0.09
