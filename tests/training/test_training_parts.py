"""Parts of identification: samples from recordings, geometry, losses, calibration."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusal import refusal
from scipy.signal import lfilter
from synthetic_robot import DELAY, SECOND, T0, TAU, drive, synthetic, write_bag

from fgloc import se2
from fgloc.config import NoiseDensity, config_of
from fgloc.errors import RecordingError, TrajectoryError
from fgloc.files.outputs import write_covariance_csv, write_steps_csv, write_tum
from fgloc.sensors.learned.card import ErrorMemory, Kinematics
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import ControlEvent, Decision, Trajectory
from fgloc_datasets.bag import BagWriter
from fgloc_training.calibrate import fit_joint, fit_kinematics, fit_lag, fit_noise, fit_variance, nis, noise_covs
from fgloc_training.config import CalibrationConfig, DataConfig, OptimizationConfig
from fgloc_training.data import Run, SensorRecord, cut, load_run, make_run
from fgloc_training.models import integrate, relative
from fgloc_training.optimize import composed_nll, end_errors, rollout_loss
from fgloc_training.rollouts import Rollout, adjoints, logs, roll_kinematics


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {f"run{seed}": synthetic(seed) for seed in range(5)}


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


# --- data -------------------------------------------------------------------------------------------------------------


def test_body_velocities_come_from_smoothed_truth() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0, 30, 1 / 60)
    v, omega = 0.2 + 0.05 * np.sin(t), 0.3 * np.cos(0.7 * t)
    yaw = np.concatenate([[0.0], np.cumsum(omega[:-1]) / 60])
    xy = np.cumsum(np.column_stack([v * np.cos(yaw), v * np.sin(yaw)]), axis=0) / 60
    noisy = np.column_stack([xy, yaw]) + rng.normal(size=(len(t), 3)) * [0.001, 0.001, 0.002]
    noisy[:, 2] = se2.wrap_array(noisy[:, 2])
    commands = [ControlEvent(T0 + i * SECOND, 0, "c", 0.0, 0.0) for i in range(-3, 31)]
    run = make_run("r", commands, T0 + np.round(t * SECOND).astype(np.int64), noisy, 0.1, 1.0, DataConfig())
    at = run.times + (run.origin_ns - T0) * 1e-9
    raw = np.diff(noisy[:, 0]) * 60
    assert np.abs(run.velocities[:, 0] - np.interp(at, t, v)).std() < 0.1 * raw.std()
    np.testing.assert_allclose(run.velocities[:, 0], np.interp(at, t, v), atol=0.015)
    np.testing.assert_allclose(run.velocities[:, 1], 0.0, atol=0.015)
    np.testing.assert_allclose(run.velocities[:, 2], np.interp(at, t, omega), atol=0.03)


def test_samples_are_cut_at_gaps_of_the_truth() -> None:
    commands, stamps, poses = drive(np.random.default_rng(0), 30.0)
    silent = (stamps > T0 + 10 * SECOND) & (stamps < T0 + 11 * SECOND)
    run = make_run("r", commands, stamps[~silent], poses[~silent], 0.1, 2.0, DataConfig())
    at = run.times + (run.origin_ns - T0) * 1e-9
    np.testing.assert_array_equal(run.valid, ~((at > 9.73) & (at < 11.26)))
    starts = run.starts(20)
    assert len(starts)
    assert not any(9.73 < t < 11.26 for k in starts for t in at[k : k + 21])


def test_samples_are_cut_where_the_truth_jumps_sideways() -> None:
    commands, stamps, poses = drive(np.random.default_rng(0), 30.0)
    jumped = poses.copy()
    after = stamps >= T0 + 10 * SECOND
    jumped[after, 1] += 0.05 * np.cos(poses[after, 2])
    jumped[after, 0] -= 0.05 * np.sin(poses[after, 2])
    believing = make_run("r", commands, stamps, jumped, 0.1, 2.0, DataConfig())
    assert believing.valid.all()
    run = make_run("r", commands, stamps, jumped, 0.1, 2.0, DataConfig(max_sideways_mps=0.05))
    at = run.times + (run.origin_ns - T0) * 1e-9
    assert not run.valid[np.abs(at - 10.0) < 0.25].any()
    assert run.valid[np.abs(at - 10.0) > 0.75].all()


def test_smoothed_trajectory_stands_in_for_the_truth(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", 4, 20.0)
    _, stamps, poses = drive(np.random.default_rng(4), 20.0)
    keyframes = slice(None, None, 20)
    stamps, poses = stamps[keyframes], poses[keyframes] + [1.0, 2.0, 0.0]  # in another map
    covs = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (len(stamps), 1, 1))
    lost = (stamps > T0 + 8 * SECOND) & (stamps < T0 + 11 * SECOND)
    covs[lost] *= 100.0
    poses[lost] += 3.0
    folder = tmp_path / "smoothed"
    write_tum(folder / "trajectory.tum", Trajectory(stamps, poses))
    config = DataConfig(max_truth_gap_s=0.35)
    with_lost = load_run(tmp_path / "bag", "b", 0.1, 2.0, config, folder)
    assert with_lost.valid.all()
    write_covariance_csv(folder / "covariance.csv", Trajectory(stamps, poses, covs))
    run = load_run(tmp_path / "bag", "b", 0.1, 2.0, config, folder)
    at = run.times + (run.origin_ns - T0) * 1e-9
    assert not run.valid[(at > 8.0) & (at < 11.0)].any()
    assert run.valid[(at < 7.4) | (at > 11.6)].all()
    own = load_run(tmp_path / "bag", "b", 0.1, 2.0, config)
    picked = [np.interp(at[run.valid], own.times + (own.origin_ns - T0) * 1e-9, column) for column in own.poses.T]
    np.testing.assert_allclose(run.poses[run.valid] - [1.0, 2.0, 0.0], np.column_stack(picked), atol=0.02)
    with pytest.raises(TrajectoryError, match=r"\b0\.01 m\b.*\b0\.014 m"):
        load_run(tmp_path / "bag", "b", 0.1, 2.0, DataConfig(max_truth_sigma_m=0.01), folder)
    with refusal(TrajectoryError, tmp_path / "elsewhere"):
        load_run(tmp_path / "bag", "b", 0.1, 2.0, config, tmp_path / "elsewhere")
    (folder / "covariance.csv").write_text("stamp,xx\n1.0,oops\n")
    with refusal(TrajectoryError, folder / "covariance.csv", "oops"):
        load_run(tmp_path / "bag", "b", 0.1, 2.0, config, folder)


@pytest.mark.parametrize("sure", [True, False])
def test_poses_of_a_lost_robot_are_no_truth(tmp_path: Path, sure: bool) -> None:
    """By the run's own word, whatever its covariance says."""
    write_bag(tmp_path / "bag", 4, 20.0)
    _, stamps, poses = drive(np.random.default_rng(4), 20.0)
    stamps, poses = stamps[::10], poses[::10]
    folder = tmp_path / "smoothed"
    write_tum(folder / "trajectory.tum", Trajectory(stamps, poses))
    if sure:
        covs = np.tile(1e-6 * np.eye(3), (len(stamps), 1, 1))
        write_covariance_csv(folder / "covariance.csv", Trajectory(stamps, poses, covs))
    rows = [Decision(k, stamp, "mode", -1, 1.0, math.nan, 0, 0.0, "lost") for k, stamp in enumerate(stamps.tolist())]
    write_steps_csv(folder / "steps.csv", rows[80:110])
    run = load_run(tmp_path / "bag", "b", 0.1, 2.0, DataConfig(), folder)
    at = run.times + (run.origin_ns - T0) * 1e-9
    assert not run.valid[(at > 8.0) & (at < 10.9)].any()
    assert run.valid[(at < 7.6) | (at > 11.4)].all()
    write_steps_csv(folder / "steps.csv", rows)
    with refusal(TrajectoryError, folder, "LOST", len(rows)):
        load_run(tmp_path / "bag", "b", 0.1, 2.0, DataConfig(), folder)


def test_part_of_a_run_equals_the_run() -> None:
    whole = synthetic(1)
    part = cut(whole, "part", 100, 300)
    assert part.name == "part"
    np.testing.assert_array_equal(part.poses, whole.poses[100:300])
    limits = np.arange(-1.0, 19.0, 0.1)  # the past is known to the part as well
    np.testing.assert_allclose(part.track.means(limits), whole.track.means(limits + 100 * whole.dt_s), atol=1e-9)
    predicted = roll_kinematics(Kinematics(), part, 0.2).motions
    np.testing.assert_allclose(predicted, roll_kinematics(Kinematics(), whole, 0.2).motions[50:149], atol=1e-9)


def test_bag_equals_memory(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", 4, 20.0)
    from_bag = load_run(tmp_path / "bag", "b", 0.1, 2.0, DataConfig())
    commands, stamps, poses = drive(np.random.default_rng(4), 20.0)
    direct = make_run("b", commands, stamps[::2], poses[::2], 0.1, 2.0, DataConfig())
    np.testing.assert_allclose(from_bag.poses, direct.poses, atol=1e-9)
    limits = np.arange(0.0, 10.0, 0.1)
    np.testing.assert_allclose(from_bag.track.means(limits), direct.track.means(limits), atol=1e-12)


def test_recordings_that_cannot_identify_a_robot(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "silent") as bag:
        bag.command("/cmd_vel", T0, 0.1, 0.0)
        bag.command("/cmd_vel", T0 + SECOND, 0.1, 0.0)
    with pytest.raises(RecordingError, match=r"\b0\b.*\btruth\b"):
        load_run(tmp_path / "silent", "silent", 0.1, 2.0, DataConfig())
    commands, stamps, poses = drive(np.random.default_rng(0), 20.0)
    with pytest.raises(RecordingError, match=r"overlap for 0.0 s"):
        make_run("r", commands, stamps + 3600 * SECOND, poses, 0.1, 2.0, DataConfig())


# --- models and losses ------------------------------------------------------------------------------------------------


def test_torch_geometry_equals_se2() -> None:
    rng = np.random.default_rng(1)
    twists = rng.normal(size=(4, 12, 3)) * [0.1, 0.02, 0.4]
    twists[0, 3] = 0.0
    poses = integrate(torch.tensor(twists)).numpy()
    for row, result in zip(twists, poses, strict=True):
        pose = np.zeros(3)
        for twist, got in zip(row, result, strict=True):
            pose = se2.compose(pose, se2.exp(twist))
            np.testing.assert_allclose([*got[:2], se2.wrap(got[2])], pose, atol=1e-12)
    truth = torch.tensor(np.concatenate([np.zeros((4, 1, 3)), poses + rng.normal(size=poses.shape) * 0.05], axis=1))
    error, ads = end_errors(torch.tensor(poses), truth)
    for i in range(4):
        start, end = poses[i, -1], truth[i, -1].numpy()
        np.testing.assert_allclose(error[i], se2.log(se2.between(start, end)), atol=1e-6)
        for k in range(12):
            back = se2.between(poses[i, -1], poses[i, k])
            np.testing.assert_allclose(ads[i, k], se2.adjoint(back), atol=1e-6)


def test_array_geometry_equals_se2() -> None:
    poses = np.random.default_rng(2).normal(size=(30, 3))
    poses[0] = 0.0
    for i, pose in enumerate(poses):
        np.testing.assert_allclose(logs(poses)[i], se2.log(pose), atol=1e-12)
        inverses = se2.between_array(poses, np.zeros_like(poses))
        np.testing.assert_allclose(inverses[i], se2.inverse(pose), atol=1e-12)
        np.testing.assert_allclose(adjoints(poses)[i], se2.adjoint(pose), atol=1e-12)


def test_losses_are_least_at_the_truth() -> None:
    config = OptimizationConfig()
    poses = integrate(torch.full((2, 10, 3), 0.02, dtype=torch.float64))
    truth = torch.cat([torch.zeros(2, 1, 3), poses], dim=1)
    moved = relative(torch.tensor([1.0, 2.0, 0.5]), torch.zeros(3))  # seen from elsewhere: the loss must not care
    c, s = torch.cos(moved[2]), torch.sin(moved[2])
    x, y, yaw = truth.unbind(dim=-1)
    elsewhere = torch.stack([moved[0] + c * x - s * y, moved[1] + s * x + c * y, moved[2] + yaw], dim=-1)
    best = rollout_loss(poses.float(), elsewhere, 0.1, config)
    assert best < 0.03
    for axis in range(3):
        wrong = poses.float().clone()
        wrong[..., axis] += 0.01
        assert rollout_loss(wrong, elsewhere, 0.1, config) > best + 0.1
    rng = torch.Generator().manual_seed(0)
    error = 0.3 * torch.randn(4000, 3, generator=rng)
    eye = torch.eye(3).expand(4000, 5, 3, 3)
    losses = {
        sigma: float(composed_nll(error, eye, torch.full((4000, 5, 3), 2 * np.log(sigma)), 0.2))
        for sigma in (0.2, 0.3, 0.45)
    }
    assert min(losses, key=losses.__getitem__) == 0.3


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0])
def test_beta_lets_unsure_windows_pull_as_hard(beta: float) -> None:
    eye = torch.eye(3).expand(2, 1, 3, 3)
    log_density = (2 * torch.log(torch.tensor([0.01, 1.0]))).reshape(2, 1, 1).expand(2, 1, 3)
    error = (2.0 * torch.tensor([[0.01], [1.0]]).expand(2, 3)).clone().requires_grad_(True)
    composed_nll(error, eye, log_density, 1.0, beta).backward()
    sure, unsure = error.grad[:, 0].tolist()
    assert sure / unsure == pytest.approx(100.0 ** (1.0 - 2.0 * beta), rel=1e-3)
    at_best = [float(composed_nll(error.detach(), eye, log_density + shift, 1.0, beta)) for shift in (1.0, 1.386, 1.8)]
    assert np.argmin(at_best) == 1  # the scale that fits is the same for every beta


# --- calibration ------------------------------------------------------------------------------------------------------


def test_kinematics_are_recovered() -> None:
    commands, stamps, _ = drive(np.random.default_rng(3), 60.0)
    track = make_run("r", commands, stamps, np.zeros((len(stamps), 3)), 0.1, 2.0, DataConfig()).track
    t = (stamps - T0) * 1e-9 + (T0 - commands[0].stamp_ns) * 1e-9
    offset = (commands[0].stamp_ns - track.origin_ns) * 1e-9
    told = track.means(np.append(t, t[-1] + 0.01) - 0.2 + offset)
    pose, poses = np.zeros(3), []
    for v, omega in told:
        poses.append(pose)
        pose = se2.compose(pose, se2.exp((0.9 * v * 0.01, 0.0, (1.1 * omega - 0.05 * 0.9 * v) * 0.01)))
    fitted = fit_kinematics([make_run("r", commands, stamps, np.array(poses), 0.1, 2.0, DataConfig())])
    assert fitted.scale_v == pytest.approx(0.9, abs=0.01)
    assert fitted.scale_omega == pytest.approx(1.1, abs=0.01)
    assert fitted.yaw_per_m == pytest.approx(-0.05, abs=0.01)
    assert fitted.delay_s == pytest.approx(0.2, abs=0.02)


def test_the_scale_of_commands_to_the_side_is_recovered() -> None:
    rng = np.random.default_rng(5)
    commands, stamps, _ = drive(rng, 60.0)
    commands = [replace(c, vy=0.2 * math.sin(0.7 * k / 50.0)) for k, c in enumerate(commands)]
    track = make_run("r", commands, stamps, np.zeros((len(stamps), 3)), 0.1, 2.0, DataConfig()).track
    t = (stamps - track.origin_ns) * 1e-9
    pose, poses = np.zeros(3), []
    for v, omega, vy in track.means(np.append(t, t[-1] + 0.01) - 0.2, sideways=True):
        poses.append(pose)
        pose = se2.compose(pose, se2.exp((0.9 * v * 0.01, 0.7 * vy * 0.01, 1.1 * omega * 0.01)))
    run = make_run("r", commands, stamps, np.array(poses), 0.1, 2.0, DataConfig())
    fitted = fit_kinematics([run], sideways=True)
    assert fitted.scale_vy == pytest.approx(0.7, abs=0.02)
    assert fitted.scale_v == pytest.approx(0.9, abs=0.02)
    assert fit_kinematics([run]).scale_vy == 0.0


def test_lag_is_recovered(runs: dict[str, Run]) -> None:
    fitted = fit_lag(list(runs.values()), fit_kinematics(list(runs.values())))
    assert fitted.delay_s == pytest.approx(DELAY, abs=0.03)
    assert fitted.lag_s[1] == pytest.approx(TAU, abs=0.04)


def noisy_rollouts(
    runs: dict[str, Run], noise: NoiseDensity, seed: int, memory: ErrorMemory | None = None
) -> list[Rollout]:
    """Rollouts whose steps differ from the truth by noise of known density over long windows, and known memory."""
    rng, out = np.random.default_rng(seed), []
    for run in runs.values():
        exact = roll_kinematics(Kinematics(), run, 0.2)
        covs = noise_covs(exact, noise)
        white = rng.normal(size=(len(covs), 3))
        if memory is not None:
            keep, share = np.exp(-0.2 / memory.time_s[0]), np.array(memory.share)
            slow = lfilter([1.0 - keep], [1.0, -keep], rng.normal(size=white.shape), axis=0)  # long sums as white's
            white = np.sqrt(1.0 - share) * white + np.sqrt(share) * slow
        track = [np.zeros(3)]
        for motion, cov, unit in zip(exact.motions, covs, white, strict=True):
            error = np.linalg.cholesky(cov) @ unit
            pose = se2.compose(track[-1], se2.compose(motion, se2.exp(error)))
            track.append(pose)
        out.append(
            Rollout(run, 0.2, exact.motions, covs, exact.track, np.array(track), np.ones(len(track), dtype=bool))
        )
    return out


@pytest.mark.parametrize(("names", "rolls"), [(("speed", "steering_angle"), True), (("shoulder", "elbow"), False)])
def test_joints_of_an_arm_are_no_wheels_of_a_car_that_is_commanded(names: tuple[str, ...], rolls: bool) -> None:
    """Its drive is given for what the steering angles of the commands mean."""
    commands, stamps, _ = drive(np.random.default_rng(0), 5.0)
    made = [JointsEvent(int(s), int(s), "/joints", names, np.zeros(2), np.zeros(2), np.zeros(0)) for s in stamps[::6]]
    car = config_of({"wheels": {"drive": {"kind": "ackermann", "wheelbase": 0.5}}})
    assert SensorRecord([*commands, *made], car).has_wheels is rolls


NOISE = NoiseDensity(x_per_sqrt_m=0.05, y_per_sqrt_m=0.02, yaw_per_sqrt_m=0.05, yaw_per_sqrt_rad=0.1)


def test_noise_densities_hold_at_every_horizon(runs: dict[str, Run]) -> None:
    rollouts = [r for seed in range(4) for r in noisy_rollouts(runs, NOISE, seed)]
    fitted = fit_noise(rollouts, CalibrationConfig(horizons_s=(2.0, 5.0)))
    for horizon in (1.0, 5.0, 10.0):
        values = np.concatenate([nis(r.errors(horizon), r.composed(noise_covs(r, fitted), horizon)) for r in rollouts])
        assert values.mean() / 3 == pytest.approx(1.0, abs=0.15)
    assert fitted.x_per_sqrt_m == pytest.approx(0.05, rel=0.2)


def test_variance_holds_over_short_and_long_windows_though_errors_last(runs: dict[str, Run]) -> None:
    memory = ErrorMemory(time_s=(1.0, 1.0, 1.0), share=(0.8, 0.5, 0.7))
    steady = NoiseDensity(xy_per_sqrt_s=0.01, yaw_per_sqrt_s=0.02)
    rollouts = [r for seed in range(8) for r in noisy_rollouts(runs, steady, seed, memory)]
    doubted = [replace(r, covs=4.0 * r.covs) for r in rollouts]
    scale, found = fit_variance(doubted, CalibrationConfig())
    np.testing.assert_allclose(scale, 0.25, rtol=0.3)
    assert found.time_s[0] in (0.5, 1.0, 2.0)
    factors = np.sqrt(scale)
    held = [replace(r, covs=r.covs * np.outer(factors, factors), memory=found) for r in doubted]
    for horizon in (0.2, 1.0, 5.0, 10.0):
        values = np.concatenate([nis(r.errors(horizon), r.end_covs(horizon)) for r in held])
        assert values.mean() / 3 == pytest.approx(1.0, abs=0.25)
    as_white = np.concatenate([nis(r.errors(0.2), replace(r, memory=None).end_covs(0.2)) for r in held])
    assert as_white.mean() / 3 < 0.6


def test_errors_that_cancel_weigh_more_over_short_windows(runs: dict[str, Run]) -> None:
    steady = NoiseDensity(xy_per_sqrt_s=0.004, yaw_per_sqrt_s=0.004)
    rollouts, rng = noisy_rollouts(runs, steady, 0), np.random.default_rng(1)
    seen = [replace(r, truth=r.truth + rng.normal(size=r.truth.shape) * [0.0, 0.01, 0.0]) for r in rollouts]
    scale, memory = fit_variance(seen, CalibrationConfig())
    assert memory.share[1] < -1.0
    factors = np.sqrt(scale)
    held = [replace(r, covs=r.covs * np.outer(factors, factors), memory=memory) for r in seen]
    for horizon in (0.2, 1.0, 5.0, 10.0):
        values = np.concatenate([nis(r.errors(horizon), r.end_covs(horizon)) for r in held])
        assert values.mean() / 3 == pytest.approx(1.0, abs=0.25)


def test_errors_that_cancel_altogether_leave_doubt(runs: dict[str, Run]) -> None:
    exact = noisy_rollouts(runs, NoiseDensity(xy_per_sqrt_s=1e-4, yaw_per_sqrt_s=1e-4), 0)
    straight = [replace(r, covs=np.tile(1e-4 * np.eye(3), (len(r.covs), 1, 1))) for r in exact]
    rng = np.random.default_rng(1)
    seen = [replace(r, truth=r.truth + rng.normal(size=r.truth.shape) * 0.01) for r in straight]
    scale, memory = fit_variance(seen, CalibrationConfig())
    assert max(memory.share) < 0.0
    assert min(memory.share) >= -9.0 - 1e-6  # a tenth of what one step shows stays
    assert min(scale) > 0.02


def test_joint_errors_are_estimated(runs: dict[str, Run]) -> None:
    shared, own = noisy_rollouts(runs, NOISE, 0), noisy_rollouts(runs, NOISE, 1)
    config = CalibrationConfig(window_s=2.0)
    same, other = fit_joint(shared, shared, config), fit_joint(shared, own, config)
    np.testing.assert_allclose(same.C, same.W, atol=1e-9)
    assert np.abs(other.C).max() < 0.35
    np.testing.assert_allclose(np.diag(other.W), 1.0, atol=0.35)
