"""Results for other tools: MCAP, KITTI, and the folder read back."""

import json
from dataclasses import replace

import numpy as np
import pytest
from evo.tools import file_interface
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from run_results import figure_eight
from typer.testing import CliRunner

import fgloc
from fgloc import se2
from fgloc.cli import app
from fgloc.cli.runs import foxglove_layout
from fgloc.errors import OutputError, TrajectoryError
from fgloc.estimation.log import mode_decisions
from fgloc.evaluation.results import read_results
from fgloc.files.outputs import write_kitti
from fgloc.recording.mcap_export import TYPES, write_mcap
from fgloc.types import Mode, Trajectory

MODES = [Mode.UNCONFIRMED] * 20 + [Mode.OK] * 130 + [Mode.DEAD_RECKONING] * 50 + [Mode.OK] * 100


def messages(path):
    """By topic: stamp and message, as rosbags reads them."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    return found


def test_mcap_holds_every_pose_with_its_covariance(tmp_path):
    result = figure_eight(modes=MODES)
    write_mcap(result, tmp_path / "run.mcap", "base_footprint")
    found = messages(tmp_path / "run.mcap")
    assert set(found) == set(TYPES)
    t = result.trajectory
    assert [stamp for stamp, _ in found["/fgloc/odometry"]] == t.stamps_ns.tolist()
    for (stamp, message), pose, cov in zip(found["/fgloc/odometry"], t.poses, t.covs, strict=True):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        assert (message.header.frame_id, message.child_frame_id) == ("map", "base_footprint")
        assert (message.pose.pose.position.x, message.pose.pose.position.y) == (pose[0], pose[1])
        yaw = 2 * np.arctan2(message.pose.pose.orientation.z, message.pose.pose.orientation.w)
        assert np.cos(yaw - pose[2]) == pytest.approx(1.0, abs=1e-12)
        given = message.pose.covariance.reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
        assert (given == cov).all()
    (path,) = found["/fgloc/path"]
    assert len(path[1].poses) == len(t)
    assert len(found["/fgloc/map"][0][1].markers) == 2 * len(result.landmarks.landmarks)
    assert {m.transforms[0].child_frame_id for _, m in found["/tf"]} == {"base_footprint"}


def test_the_layout_for_foxglove_shows_topics_that_are_written():
    layout = json.loads(foxglove_layout().read_text())
    panels = layout["configById"]
    scene = panels["3D!fgloc"]["topics"]
    plotted = {path["value"].partition(".")[0] for path in panels["Plot!fgloc"]["paths"]}
    shown = {*scene, *plotted, panels["DiagnosticSummary!fgloc"]["topicToRender"]}
    assert {"/fgloc/map", "/fgloc/path", "/fgloc/truth_path", "/fgloc/pose", "/diagnostics"} == shown
    assert shown < set(TYPES)
    places, arranged = [layout["layout"]], set()
    while places:
        place = places.pop()
        if isinstance(place, dict):
            places += [place["first"], place["second"]]
        else:
            arranged.add(place)
    assert arranged == set(panels)


def test_mcap_odometry_has_the_twist_of_the_base(tmp_path):
    result = figure_eight(modes=MODES)
    write_mcap(result, tmp_path / "run.mcap")
    t = result.trajectory
    twists = [m.twist.twist for _, m in messages(tmp_path / "run.mcap")["/fgloc/odometry"]]
    moved = se2.log(se2.between(t.poses[3], t.poses[4])) / ((t.stamps_ns[4] - t.stamps_ns[3]) * 1e-9)
    assert np.allclose([twists[4].linear.x, twists[4].linear.y, twists[4].angular.z], moved)


def test_mcap_is_in_the_order_of_time_and_read_by_its_own_library(tmp_path):
    write_mcap(figure_eight(modes=MODES), tmp_path / "run.mcap")
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        stamps = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
        schemas = {schema.name for schema in reader.get_summary().schemas.values()}
    assert stamps == sorted(stamps)
    assert schemas == set(TYPES.values())


def test_mcap_diagnostics_name_each_change_of_mode(tmp_path):
    result = figure_eight(modes=MODES)
    write_mcap(result, tmp_path / "run.mcap")
    told = [m.status[0].message for _, m in messages(tmp_path / "run.mcap")["/diagnostics"]]
    runs = [mode.value for k, mode in enumerate(result.modes) if k == 0 or mode is not result.modes[k - 1]]
    assert [mode for k, mode in enumerate(told) if k == 0 or mode != told[k - 1]] == runs


def test_mcap_of_nothing_is_refused(tmp_path):
    empty = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    with pytest.raises(TrajectoryError, match=r"run\.mcap"):
        write_mcap(replace(figure_eight(), trajectory=empty), tmp_path / "run.mcap")
    assert not (tmp_path / "run.mcap").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_mcap(figure_eight(modes=MODES), tmp_path / "file" / "run.mcap")


def test_kitti_is_read_by_evo(tmp_path):
    t = figure_eight(modes=MODES).trajectory
    write_kitti(tmp_path / "poses.txt", t)
    read = file_interface.read_kitti_poses_file(tmp_path / "poses.txt")
    assert np.allclose(read.positions_xyz, np.column_stack([t.poses[:, :2], np.zeros(len(t))]), atol=1e-9)
    assert np.allclose([np.arctan2(p[1, 0], p[0, 0]) for p in read.poses_se3], np.arctan2(*_sin_cos(t)), atol=1e-9)


def _sin_cos(trajectory):
    return np.sin(trajectory.poses[:, 2]), np.cos(trajectory.poses[:, 2])


def test_a_folder_is_read_back_as_it_was(tmp_path):
    made = figure_eight(modes=MODES)
    stamps = made.trajectory.stamps_ns.tolist()
    rows = [d for k, mode in enumerate(MODES) for d in mode_decisions(k, stamps[k], mode, 3.0, 2.0)]
    result = replace(made, decisions=(*made.decisions, *rows))
    result.write(tmp_path / "out")
    read = fgloc.read_results(tmp_path / "out")
    assert list(read.modes) == MODES
    assert (read.trajectory.stamps_ns == result.trajectory.stamps_ns).all()
    assert np.allclose(read.trajectory.poses, result.trajectory.poses, atol=1e-8)
    assert np.allclose(read.trajectory.covs, result.trajectory.covs, rtol=1e-8)
    assert read.metrics["keyframes"] == len(result.trajectory)
    for ours, theirs in zip(read.decisions, result.decisions, strict=True):
        assert (ours.step, ours.stamp_ns, ours.kind, ours.landmark_id, ours.dof, ours.reason) == (
            (theirs.step, theirs.stamp_ns, theirs.kind, theirs.landmark_id, theirs.dof, theirs.reason)
        )
        assert ours.nis == pytest.approx(theirs.nis, rel=1e-5, nan_ok=True)


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("trajectory.tum", None, "trajectory.tum"),
        ("covariance.csv", "stamp,xx\n", r"covariance\.csv: 0 "),
        ("steps.csv", "step,stamp,kind\nx,1.0,wheels\n", r"steps\.csv, line 2: "),
        (
            "steps.csv",
            "step,stamp,kind,landmark_id,residual,nis,dof,weight\n1,inf,wheels,1,1,1,1,1\n",
            r"steps\.csv, line 2: stamp inf\b",
        ),
        ("metrics.json", "[1]", r"metrics\.json: .*\blist\b"),
        ("config.json", "{", r"config\.json: .*JSON"),
    ],
)
def test_a_damaged_folder_is_named(tmp_path, file, content, named):
    figure_eight(modes=MODES).write(tmp_path)
    if content is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(content)
    with pytest.raises(TrajectoryError, match=named):
        read_results(tmp_path)


def test_a_run_on_uneven_ground_is_read_back_in_space(tmp_path):
    """Its trajectory has height, roll and pitch, its covariances are 6 x 6; both go into the bag."""
    flat = figure_eight(modes=MODES)
    t = flat.trajectory
    rng = np.random.default_rng(5)
    n = len(t)
    roots = rng.normal(0.0, 0.02, (n, 6, 6)) + 0.1 * np.eye(6)
    spatial = roots @ roots.transpose(0, 2, 1)
    ground = rng.uniform(-0.2, 0.2, (n, 3))
    planar = spatial[:, (0, 1, 5)][:, :, (0, 1, 5)]
    result = replace(flat, trajectory=Trajectory(t.stamps_ns, t.poses, planar, ground, spatial))
    result.write(tmp_path / "out")
    back = read_results(tmp_path / "out").trajectory
    assert np.allclose(back.ground, ground, atol=1e-8)
    assert np.allclose(back.poses, t.poses, atol=1e-8)
    assert np.allclose(back.ground_covs, spatial, rtol=1e-8)
    assert np.allclose(back.covs, planar, rtol=1e-8)
    done = CliRunner().invoke(app, ["export", str(tmp_path / "out"), "--mcap", str(tmp_path / "run.mcap")])
    assert done.exit_code == 0, done.output
    (_, first), *_ = messages(tmp_path / "run.mcap")["/fgloc/pose"]
    assert first.pose.pose.position.z == pytest.approx(ground[0, 0], abs=1e-8)
    assert np.allclose(first.pose.covariance.reshape(6, 6), spatial[0], rtol=1e-8)


def test_what_is_no_folder_of_a_run_is_named(tmp_path):
    with pytest.raises(TrajectoryError, match=rf"{tmp_path}.* trajectory\.tum"):
        read_results(tmp_path)


def test_the_command_exports_a_folder(tmp_path):
    figure_eight(modes=MODES).write(tmp_path / "out")
    arguments = ["export", str(tmp_path / "out"), "--mcap", str(tmp_path / "a.mcap"), "--kitti", str(tmp_path / "b")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert len(messages(tmp_path / "a.mcap")["/fgloc/pose"]) == len((tmp_path / "b").read_text().splitlines())
    nothing = CliRunner().invoke(app, ["export", str(tmp_path / "out")])
    assert nothing.exit_code == 1
    assert "give --mcap FILE or --kitti FILE" in nothing.output
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["keyframes"] > 0
