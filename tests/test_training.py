"""Identification end to end on a synthetic robot: data, losses, training, calibration, export, evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from datasets.bag import BagWriter
from fgloc import se2
from fgloc.config import NoiseDensity
from fgloc.errors import ConfigError, RecordingError
from fgloc.motion import load_model
from fgloc.motion.card import Kinematics
from fgloc.types import CommandEvent, FloatArray
from training import evaluate as evaluation
from training import train as training
from training.calibrate import fit_joint, fit_kinematics, fit_lag, fit_noise, nis, noise_covs
from training.config import (
    CalibrationConfig,
    DataConfig,
    NetworkConfig,
    OptimizationConfig,
    TrainConfig,
    load_train_config,
)
from training.data import Run, load_run, make_run, mirrored
from training.export import card_of, export
from training.losses import composed_nll, end_errors, rollout_loss
from training.models import integrate, relative
from training.rollouts import Rollout, adjoints, inverses, logs, roll_kinematics, roll_model

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
GAIN_V, GAIN_OMEGA, DELAY, TAU = 0.9, 1.05, 0.08, 0.15


def drive(rng: np.random.Generator, seconds: float) -> tuple[list[CommandEvent], np.ndarray, FloatArray]:
    """A robot with gains, delay and lag that also loses speed in turns: commands at 50 Hz, exact poses at 100 Hz."""
    dt = 0.01
    n = int(seconds / dt)
    t = np.arange(n) * dt
    levels = rng.uniform([0.0, -0.6], [0.3, 0.6], (int(seconds) + 2, 2))
    told = levels[(t[::2]).astype(int)]
    commands = [
        CommandEvent(T0 + round(s * SECOND), 0, "/cmd_vel", float(v), float(w))
        for s, (v, w) in zip(t[::2], told, strict=True)
    ]
    state, pose, poses = np.zeros(2), np.zeros(3), []
    for k in range(n):
        poses.append(pose)
        v, omega = told[max(0, k - round(DELAY / dt)) // 2]
        aim = np.array([GAIN_V * v * (1.0 - abs(omega)), GAIN_OMEGA * omega])
        state = state + dt / TAU * (aim - state)
        pose = se2.compose(pose, se2.exp((state[0] * dt, 0.0, state[1] * dt)))
    return commands, T0 + np.round(t * SECOND).astype(np.int64), np.array(poses)


def synthetic(seed: int, seconds: float = 60.0, dt_s: float = 0.1, name: str = "") -> Run:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    return make_run(name or f"run{seed}", commands, stamps, poses, dt_s, 2.0, DataConfig())


def write_bag(path: Path, seed: int, seconds: float) -> None:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    with BagWriter(path) as bag:
        for c in commands:
            bag.command("/cmd_vel", c.stamp_ns, c.v, c.omega)
        for stamp, (x, y, yaw) in zip(stamps[::2].tolist(), poses[::2], strict=True):
            bag.truth("/truth", stamp, [x, y, 0.0], [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])


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
    commands = [CommandEvent(T0 + i * SECOND, 0, "c", 0.0, 0.0) for i in range(-3, 31)]
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
    with pytest.raises(RecordingError, match="0 messages of truth"):
        load_run(tmp_path / "silent", "silent", 0.1, 2.0, DataConfig())
    commands, stamps, poses = drive(np.random.default_rng(0), 20.0)
    with pytest.raises(RecordingError, match=r"overlap for 0.0 s"):
        make_run("r", commands, stamps + 3600 * SECOND, poses, 0.1, 2.0, DataConfig())


def test_mirrored_run_mirrors_everything() -> None:
    run = synthetic(0, 20.0)
    other = mirrored(run)
    limits = np.arange(0.0, 10.0, 0.1)
    np.testing.assert_allclose(other.track.means(limits), run.track.means(limits) * [1, -1])
    np.testing.assert_allclose(other.velocities, run.velocities * [1, -1, -1])


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
        np.testing.assert_allclose(inverses(poses)[i], se2.inverse(pose), atol=1e-12)
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


@pytest.mark.parametrize("kind", ["velocity", "displacement"])
@pytest.mark.parametrize("use_velocity", [False, True])
def test_torch_and_numpy_agree(kind: str, use_velocity: bool, runs: dict[str, Run], tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = NetworkConfig(kind=kind, hidden=(32, 32), use_velocity=use_velocity, dt_s=0.1)
    config = TrainConfig(robot="r", recordings={n: Path(n) for n in runs}, leave_one_out=True, network=network)
    net = training.new_net(network, list(runs.values()))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    split = training.leave_one_out(list(runs))[0]
    export(net, card_of(net, config, split, "a test"), tmp_path / "m.safetensors")
    model = load_model(tmp_path / "m.safetensors")
    run = runs["run0"]
    samples, starts = net.samples([run]), torch.tensor([50, 200, 333])
    rolled = net.roll(samples, starts, 10).detach().numpy()
    for k, poses in zip(starts.tolist(), rolled, strict=True):
        start = run.origin_ns + round(k * run.dt_s * SECOND)
        velocity = run.velocities[k, [0, 2]] if kind == "velocity" else None
        for steps in (1, 5, 10):
            got = model.predict(run.commands, start, start + steps * SECOND // 10, velocity)
            assert got is not None
            np.testing.assert_allclose(got.motion, poses[steps - 1], atol=1e-6)


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


def test_lag_is_recovered(runs: dict[str, Run]) -> None:
    fitted = fit_lag(list(runs.values()), fit_kinematics(list(runs.values())))
    assert fitted.delay_s == pytest.approx(DELAY, abs=0.03)
    assert fitted.lag_s[1] == pytest.approx(TAU, abs=0.04)


def noisy_rollouts(runs: dict[str, Run], noise: NoiseDensity, seed: int) -> list[Rollout]:
    """Rollouts whose steps differ from the truth by noise of known density."""
    rng, out = np.random.default_rng(seed), []
    for run in runs.values():
        exact = roll_kinematics(Kinematics(), run, 0.2)
        covs = noise_covs(exact, noise)
        track = [np.zeros(3)]
        for motion, cov in zip(exact.motions, covs, strict=True):
            error = np.linalg.cholesky(cov) @ rng.normal(size=3)
            pose = se2.compose(track[-1], se2.compose(motion, se2.exp(error)))
            track.append(pose)
        out.append(
            Rollout(run, 0.2, exact.motions, covs, exact.track, np.array(track), np.ones(len(track), dtype=bool))
        )
    return out


NOISE = NoiseDensity(x_per_sqrt_m=0.05, y_per_sqrt_m=0.02, yaw_per_sqrt_m=0.05, yaw_per_sqrt_rad=0.1)


def test_noise_densities_hold_at_every_horizon(runs: dict[str, Run]) -> None:
    rollouts = [r for seed in range(4) for r in noisy_rollouts(runs, NOISE, seed)]
    fitted = fit_noise(rollouts, CalibrationConfig(horizons_s=(2.0, 5.0)))
    for horizon in (1.0, 5.0, 10.0):
        values = np.concatenate([nis(r.errors(horizon), r.composed(noise_covs(r, fitted), horizon)) for r in rollouts])
        assert values.mean() / 3 == pytest.approx(1.0, abs=0.15)
    assert fitted.x_per_sqrt_m == pytest.approx(0.05, rel=0.2)


def test_joint_errors_are_estimated(runs: dict[str, Run]) -> None:
    shared, own = noisy_rollouts(runs, NOISE, 0), noisy_rollouts(runs, NOISE, 1)
    config = CalibrationConfig(window_s=2.0)
    same, other = fit_joint(shared, shared, config), fit_joint(shared, own, config)
    np.testing.assert_allclose(same.C, same.W, atol=1e-9)
    assert np.abs(other.C).max() < 0.35
    np.testing.assert_allclose(np.diag(other.W), 1.0, atol=0.35)


# --- training ---------------------------------------------------------------------------------------------------------

TINY = dict(horizon_s=1.0, batch=64, iterations=300, validate_every=50, variance_iterations=60, variance_horizon_s=2.0)


def tiny_config(kind: str, names: list[str]) -> TrainConfig:
    return TrainConfig(
        robot="synthetic",
        recordings={name: Path(name) for name in names},
        leave_one_out=True,
        network=NetworkConfig(kind=kind, hidden=(32, 32), edges_s=tuple(0.1 * i for i in range(8)), dt_s=0.1),
        optimization=OptimizationConfig(**TINY),
        calibration=CalibrationConfig(horizons_s=(2.0, 5.0), window_s=2.0),
    )


@pytest.mark.parametrize("kind", ["velocity", "displacement"])
def test_training_beats_calibrated_commands_and_knows_its_error(
    kind: str, runs: dict[str, Run], tmp_path: Path
) -> None:
    config = tiny_config(kind, list(runs))
    split = training.leave_one_out(list(runs))[0]
    assert (split.test, split.validation, split.train) == (("run0",), ("run1",), ("run2", "run3", "run4"))
    path = tmp_path / "model.safetensors"
    card = training.train(config, split, runs, path, "a test")
    model, run = load_model(path), runs["run0"]
    assert model.card == card
    assert model.joint is not None
    learned = evaluation.evaluate([roll_model(model, run, 0.2)], 10.0)
    known = evaluation.evaluate([roll_kinematics(card.kinematics, run, 0.2)], 10.0)
    assert learned.drift_percent < 0.5 * known.drift_percent
    assert learned.nis_over_3 is not None
    assert 0.1 < learned.nis_over_3 < 4.0
    assert card.figures["drift_percent_10s"] == pytest.approx(learned.drift_percent, abs=1e-3)
    again = tmp_path / "again.safetensors"
    training.train(config, split, runs, again, "a test")
    assert again.read_bytes() == path.read_bytes()


def test_command_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in range(3):
        write_bag(tmp_path / f"run{seed}" / "bag", seed, 45.0)
    config = tiny_config("displacement", ["run0", "run1", "run2"])
    settings = json.loads(config.model_dump_json(exclude={"split"}))
    settings["optimization"]["iterations"] = 50
    settings["recordings"] = {f"run{i}": f"run{i}/bag" for i in range(3)}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    arguments = [str(tmp_path / "config.yaml"), "--data", str(tmp_path), "--out", str(tmp_path / "models")]
    assert training.main(arguments) == 0
    made = sorted(p.name for p in (tmp_path / "models").iterdir())
    assert made == ["all.safetensors", *(f"without_run{i}.safetensors" for i in range(3))]
    from_all = load_model(tmp_path / "models" / "all.safetensors").card
    assert from_all.split.train == ("run0", "run1", "run2")
    assert from_all.joint is not None
    assert from_all.figures
    capsys.readouterr()
    report = tmp_path / "figures.json"
    model = tmp_path / "models" / "without_run2.safetensors"
    assert evaluation.main([str(model), str(tmp_path / "run2" / "bag"), "--json", str(report)]) == 0
    assert "calibrated commands" in capsys.readouterr().out
    rows = json.loads(report.read_text())
    assert {row["source"] for row in rows} == {"commands", "calibrated commands", "model"}
    assert evaluation.main([str(tmp_path / "config.yaml"), str(tmp_path / "run2" / "bag")]) == 1
    assert "not a sound safetensors file" in capsys.readouterr().err


def test_coverage_of_a_right_covariance() -> None:
    values = np.random.default_rng(0).chisquare(3, 20_000)
    np.testing.assert_allclose(evaluation._coverage(values), [0.6827, 0.9545, 0.9973], atol=0.01)


def test_configuration_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    good = dict(robot="r", recordings=dict(a="a", b="b", c="c"))
    for change, message in (
        ({}, "leave_one_out"),
        ({"leave_one_out": True, "hiden": 3}, "hiden"),
        ({"split": dict(train=["a"], validation=["x"])}, r"\['x'\]"),
        ({"split": dict(train=["a"], validation=["a"])}, "neither validate nor test"),
        ({"leave_one_out": True, "recordings": dict(a="a")}, "at least 3"),
    ):
        path.write_text(yaml.safe_dump(good | change))
        with pytest.raises(ConfigError, match=message):
            load_train_config(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_train_config(tmp_path / "none.yaml")
    shipped = list((Path(__file__).parent.parent / "training" / "configs").glob("*.yaml"))
    assert shipped
    for file in shipped:
        load_train_config(file)
