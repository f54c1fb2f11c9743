"""Identification end to end on a synthetic robot: training, calibration, export, evaluation, command lines."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
import yaml
from command_line import fgloc
from refusal import refusal
from synthetic_robot import SECOND, sensing, synthetic, write_bag

from fgloc import se2
from fgloc.errors import ConfigError, ModelError
from fgloc.sensors.learned.card import Input, Kind, Split
from fgloc.sensors.learned.sensor import load_model, read_model, save_model
from fgloc_training import evaluate as evaluation
from fgloc_training import optimize
from fgloc_training import train as training
from fgloc_training.config import (
    AdaptationConfig,
    CalibrationConfig,
    NetworkConfig,
    OptimizationConfig,
    SpeedLimits,
    TrainConfig,
    load_train_config,
)
from fgloc_training.data import Run
from fgloc_training.models import DisplacementNet
from fgloc_training.optimize import Checkpoint, Checkpoints
from fgloc_training.recordings import controls, draw_controls
from fgloc_training.rollouts import roll_kinematics, roll_model, roll_sources
from fgloc_training.train import card_of, new_net, tensors_of


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {f"run{seed}": synthetic(seed) for seed in range(5)}


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize(
    ("kind", "inputs"),
    [(kind, ("commands",)) for kind in get_args(Kind) if kind != "naive"]
    + [(kind, ("commands", "velocity")) for kind in ("displacement", "gru")]
    + [(kind, ("commands", "sideways")) for kind in ("displacement", "gru")],
)
def test_torch_and_numpy_agree(kind: str, inputs: tuple[Input, ...], runs: dict[str, Run], tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = NetworkConfig(kind=kind, hidden=(32, 32), inputs=inputs, dt_s=0.1)
    config = TrainConfig(robot="r", recordings={n: Path(n) for n in runs}, leave_one_out=True, network=network)
    net = new_net(network, list(runs.values()))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    split = training.leave_one_out(list(runs))[0]
    save_model(tmp_path / "m.safetensors", tensors_of([net]), card_of(net, config, split, "a test"))
    model = load_model(tmp_path / "m.safetensors")
    run = runs["run0"]
    samples, starts = net.samples([run]), torch.tensor([50, 200, 333])
    rolled = net.roll(samples, starts, 10).detach().numpy()
    for k, poses in zip(starts.tolist(), rolled, strict=True):
        start = run.origin_ns + round(k * run.dt_s * SECOND)
        velocity = run.velocities[k, [0, 2]] if model.card.family == "velocity" else None
        for steps in (1, 5, 10):
            got = model.predict(run.commands, start, start + steps * SECOND // 10, velocity)
            assert got is not None
            np.testing.assert_allclose(got.motion, poses[steps - 1], atol=1e-6)
        if isinstance(net, DisplacementNet):
            _, x = net.inputs(samples, torch.tensor([k]), 1)
            got = model.predict(run.commands, start, start + SECOND // 10, None)
            assert got is not None
            variances = np.exp(net.log_density(x).detach().numpy()[0, 0]) * 0.1
            np.testing.assert_allclose(np.diag(got.cov), variances, rtol=1e-4)


@pytest.mark.parametrize("kind", ["naive", "lag", "arx", "rate", "velocity"])
def test_a_model_that_reads_no_commands_to_the_side_is_made_though_they_are_named(
    kind: Kind, runs: dict[str, Run]
) -> None:
    """The input `sideways` is passed over: `train --init` names it whatever kind is chosen later."""
    network = NetworkConfig(kind=kind, hidden=(8, 8), inputs=("commands", "sideways"))
    config = TrainConfig(robot="r", recordings={n: Path(n) for n in runs}, leave_one_out=True, network=network)
    net = new_net(network, [runs["run0"]])
    card = card_of(net, config, training.leave_one_out(list(runs))[0], "a test")
    assert "sideways" not in card.inputs
    assert card.kinematics.scale_vy == 0.0


def test_the_variance_starts_from_the_sizes_of_changes(tmp_path: Path) -> None:
    run = sensing(0, 30.0)
    network = NetworkConfig(
        hidden=(32, 32), inputs=("commands", "effort"), edges_s=(0.0, 0.1, 0.3, 0.5), signal_edges_s=(0.0, 0.1, 0.35)
    )
    net = new_net(network, [run])
    assert isinstance(net, DisplacementNet)
    assert isinstance(net.variance, torch.nn.Sequential)
    features = net.samples([run]).features
    told, torque = features[:, :6].reshape(-1, 3, 2), features[:, 6:].reshape(-1, 3, 2)
    units = torch.relu(net.variance[0]((features - net.mean) / net.std)).detach()
    changes = torch.cat([part[:, :-1].sub(part[:, 1:]).flatten(1) for part in (told, torque)], dim=1)
    scales = torch.cat([net.std[:4], net.std[6:10]])
    np.testing.assert_allclose(units[:, 0:16:2] + units[:, 1:16:2], changes.abs() / scales, atol=1e-4)


def test_the_variance_does_not_follow_a_velocity_that_it_was_never_told(runs: dict[str, Run]) -> None:
    network = NetworkConfig(hidden=(16, 16), edges_s=(0.0, 0.1, 0.3, 0.5), inputs=("commands", "velocity"))
    net = new_net(network, list(runs.values()))
    assert isinstance(net, DisplacementNet)
    config = OptimizationConfig(variance_iterations=5, batch=16, variance_horizon_s=1.0)
    optimize.train_variance(net, list(runs.values()), [], config)
    _, x = net.inputs(net.samples(list(runs.values())), torch.tensor([30, 60]), 1)
    told = x.clone()
    told[..., -2:] = 3.0
    assert not torch.equal(net.log_density(x)[0], net.log_density(x)[1])  # it has learned something
    torch.testing.assert_close(net.log_density(told), net.log_density(x))


@pytest.mark.parametrize(
    ("inputs", "edges"),
    [(("commands", "gyro"), (0.0,)), (("commands", "velocity", "gyro", "effort", "wheels"), (0.0, 0.1, 0.35))],
)
def test_torch_and_numpy_agree_on_measured_signals(
    inputs: tuple[Input, ...], edges: tuple[float, ...], tmp_path: Path
) -> None:
    torch.manual_seed(1)
    runs = {f"run{seed}": sensing(seed, 30.0, bias=0.01) for seed in (0, 1)}
    network = NetworkConfig(hidden=(32, 32), inputs=inputs, signal_edges_s=edges)
    split = Split(train=("run0",), validation=("run1",))
    config = TrainConfig(robot="r", recordings={n: Path(n) for n in runs}, split=split, network=network)
    net = new_net(network, [runs["run0"]])
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    save_model(tmp_path / "m.safetensors", tensors_of([net]), card_of(net, config, split, "a test"))
    run = runs["run1"]
    rolled = roll_model(load_model(tmp_path / "m.safetensors"), run, 0.2)
    samples, start = net.samples([run]), 20
    poses = net.roll(samples, torch.tensor([start]), 20).detach().numpy()[0]
    for steps in (2, 10, 20):  # of 0.1 s, all within one window for the network, in steps of 0.2 s for the model
        got = se2.between_array(rolled.track[[start // 2]], rolled.track[[(start + steps) // 2]])[0]
        np.testing.assert_allclose(got[:2], poses[steps - 1, :2], atol=2e-6)
        np.testing.assert_allclose(se2.wrap(got[2] - poses[steps - 1, 2]), 0.0, atol=2e-6)


def test_wheels_with_unequal_radii_are_learned_and_slip_free_odometry_beaten(tmp_path: Path) -> None:
    runs = {f"run{seed}": sensing(seed, 30.0) for seed in range(3)}
    split = Split(train=("run0",), validation=("run1",), test=("run2",))
    base = tiny_config("displacement", list(runs))
    network = base.network.model_copy(update=dict(inputs=("commands", "wheels")))
    optimization = base.optimization.model_copy(update=dict(iterations=20, variance_iterations=10))
    quick = base.calibration.model_copy(update=dict(memory_s=(0.5,), horizons_s=(2.0,)))
    config = base.model_copy(
        update=dict(leave_one_out=False, split=split, network=network, optimization=optimization, calibration=quick)
    )
    card = training.train(config, split, runs, tmp_path / "m.safetensors", "a test")
    assert card.reads("wheels")
    assert card.wheel_kinematics.yaw_per_m == pytest.approx(-0.01 / 0.26 * 2, rel=0.1)
    learned = roll_model(load_model(tmp_path / "m.safetensors"), runs["run2"], 0.2)
    wheels = roll_sources(runs["run2"], 0.2)
    ratio = np.hypot(*learned.errors(5.0)[:, :2].T).mean() / np.hypot(*wheels.errors(5.0)[:, :2].T).mean()
    assert ratio < 0.2


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


def test_ensemble_is_trained_from_different_seeds_and_calibrated_as_one(runs: dict[str, Run], tmp_path: Path) -> None:
    base = tiny_config("displacement", list(runs))
    short = base.optimization.model_copy(update=dict(iterations=200, variance_iterations=40))
    config = base.model_copy(update=dict(network=base.network.model_copy(update=dict(members=2)), optimization=short))
    split = training.leave_one_out(list(runs))[0]
    card = training.train(config, split, runs, tmp_path / "model.safetensors", "a test")
    tensors, read = read_model(tmp_path / "model.safetensors")
    assert read == card
    assert card.members == 2
    assert card.memory is not None
    first, second = tensors["layer0.weight"]
    assert np.abs(first - second).max() > 0.01
    alone = base.model_copy(update=dict(optimization=short))
    training.train(alone, split, runs, tmp_path / "alone.safetensors", "a test")
    np.testing.assert_array_equal(read_model(tmp_path / "alone.safetensors")[0]["layer0.weight"], first)
    learned = evaluation.evaluate([roll_model(load_model(tmp_path / "model.safetensors"), runs["run0"], 0.2)], 10.0)
    assert learned.nis_over_3 is not None
    assert 0.1 < learned.nis_over_3 < 4.0


def test_cross_calibration_hears_every_recording_but_the_tested(runs: dict[str, Run], tmp_path: Path) -> None:
    base = tiny_config("displacement", list(runs))
    short = base.optimization.model_copy(update=dict(iterations=60, variance_iterations=20))
    plain = base.model_copy(update=dict(optimization=short))
    crossed = plain.model_copy(update=dict(calibration=base.calibration.model_copy(update=dict(cross=True))))
    split = training.leave_one_out(list(runs))[0]
    path = tmp_path / "model.safetensors"
    alone = training.train(plain, split, runs, path, "a test")
    weights = read_model(path)[0]
    together = training.train(crossed, split, runs, path, "a test")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.losses.png", "model.safetensors"]
    for name, tensor in read_model(path)[0].items():
        np.testing.assert_array_equal(tensor, weights[name])
    assert together.variance_scale != alone.variance_scale


@pytest.mark.parametrize(("stage", "call"), [("rollout_loss", 45), ("composed_nll", 95)])
def test_killed_training_goes_on_and_ends_at_the_same_bytes(
    stage: str, call: int, runs: dict[str, Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = tiny_config("displacement", list(runs))
    short = base.optimization.model_copy(update=dict(iterations=60, validate_every=20, variance_iterations=60))
    config = base.model_copy(update=dict(optimization=short))
    split = training.leave_one_out(list(runs))[0]
    training.train(config, split, runs, tmp_path / "whole.safetensors", "a test")
    real, calls = getattr(optimize, stage), 0

    def dies(*arguments: object) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return real(*arguments)

    path, kept = tmp_path / "model.safetensors", Checkpoints(tmp_path / "kept")
    with monkeypatch.context() as patched:
        patched.setattr(optimize, stage, dies)
        with pytest.raises(KeyboardInterrupt):
            training.train(config, split, runs, path, "a test", kept)
    assert not path.exists()
    counted = 0

    def counts(*arguments: object) -> torch.Tensor:
        nonlocal counted
        counted += 1
        return real(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(optimize, stage, counts)
        training.train(config, split, runs, path, "a test", kept)
    assert 0 < counted < call
    assert path.read_bytes() == (tmp_path / "whole.safetensors").read_bytes()


def test_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.pt").write_bytes(b"PK not a checkpoint")
    with refusal(ModelError, tmp_path / "c.pt"):
        Checkpoint(tmp_path / "c.pt").load()


def test_command_lines(tmp_path: Path) -> None:
    for seed in range(3):
        write_bag(tmp_path / f"run{seed}" / "bag", seed, 45.0)
    config = tiny_config("displacement", ["run0", "run1", "run2"])
    settings = json.loads(config.model_dump_json(exclude={"split"}))
    settings["optimization"]["iterations"] = 50
    settings["limits"] = {"v_mps": 0.5, "omega_radps": 0.6}
    settings["recordings"] = {f"run{i}": f"run{i}/bag" for i in range(3)}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    arguments = [str(tmp_path / "config.yaml"), "--data", str(tmp_path), "--out", str(tmp_path / "models")]
    code, _, err = fgloc("train", *arguments)
    assert code == 0
    made = sorted(p.name for p in (tmp_path / "models").iterdir())
    names = ("all", *(f"without_run{i}" for i in range(3)))
    assert made == sorted(["controls.png", *(f"{n}.{end}" for n in names for end in ("safetensors", "losses.png"))])
    assert re.search(r"\bv\b.* 0\.38\b.* 0\.5 m/s\b.* 0\.0 s\b.* 5 s\b", err)
    from_all = load_model(tmp_path / "models" / "all.safetensors").card
    assert from_all.split.train == ("run0", "run1", "run2")
    assert from_all.joint is not None
    assert from_all.figures
    report = tmp_path / "figures.json"
    model = tmp_path / "models" / "without_run2.safetensors"
    others = ["--against", str(tmp_path / "models" / "all.safetensors"), "--plots", str(tmp_path / "plots")]
    code, out, _ = fgloc("evaluate-model", model, tmp_path / "run2" / "bag", "--json", report, *others)
    assert code == 0
    assert sorted(p.name for p in (tmp_path / "plots").iterdir()) == ["calibration.png", "growth.png", "tracks.png"]
    assert "calibrated commands" in out
    rows = json.loads(report.read_text())
    assert {row["source"] for row in rows} == {"commands", "calibrated commands", "model", "all"}
    code, _, err = fgloc("evaluate-model", tmp_path / "config.yaml", tmp_path / "run2" / "bag")
    assert code == 1
    assert str(tmp_path / "config.yaml") in err


def test_model_is_adapted_to_another_robot_from_a_minute(runs: dict[str, Run], tmp_path: Path) -> None:
    base = tiny_config("displacement", list(runs))
    short = base.optimization.model_copy(update=dict(iterations=100, variance_iterations=20))
    split = Split(train=("run0", "run1"), validation=("run2",))
    path = tmp_path / "model.safetensors"
    config = base.model_copy(update=dict(optimization=short, leave_one_out=False, split=split))
    training.train(config, split, runs, path, "a test")
    tensors, card = read_model(path)
    other = card.kinematics.model_copy(
        update={"scale_v": 1.04 * card.kinematics.scale_v, "yaw_per_m": card.kinematics.yaw_per_m + 0.04}
    )
    wrong = tmp_path / "other.safetensors"
    save_model(wrong, tensors, card.model_copy(update={"kinematics": other}))
    split = Split(train=("run3",), validation=("run4",))
    loose = AdaptationConfig(scale_sigma=0.1, yaw_per_m_sigma=0.1)
    config = config.model_copy(update=dict(split=split, robot="the other", adaptation=loose))
    found = training.adapt(wrong, config, runs, tmp_path / "adapted.safetensors", "a test")
    assert found == load_model(tmp_path / "adapted.safetensors").card
    assert (found.robot, found.split) == ("the other", split)
    assert abs(found.kinematics.yaw_per_m - card.kinematics.yaw_per_m) < 0.02

    def drift(path: Path) -> float:
        return evaluation.evaluate([roll_model(load_model(path), runs["run4"], 0.2)], 10.0).drift_percent

    assert drift(tmp_path / "adapted.safetensors") < 0.9 * drift(wrong)
    with pytest.raises(ConfigError, match="leave_one_out"):
        training.adapt(wrong, base, runs, tmp_path / "never.safetensors", "a test")


def test_controls_name_what_was_never_told(runs: dict[str, Run], tmp_path: Path) -> None:
    every = list(runs.values())
    assert controls(every, None).missing() == []
    assert controls(every, SpeedLimits(v_mps=0.3, omega_radps=0.6)).missing() == []
    found = controls(every, SpeedLimits(v_mps=0.3, omega_radps=1.2, reverse_mps=0.1))
    assert found.seconds.sum() == pytest.approx(sum(run.valid.sum() * run.dt_s for run in every))
    missing = "; ".join(found.missing())
    for words in ("v from -0.1 to 0 m/s", "ω from -1.2 to -0.86 rad/s", "ω from 0.86 to 1.2 rad/s", "turning left"):
        assert words in missing
    draw_controls(tmp_path / "controls.png", found)
    assert (tmp_path / "controls.png").stat().st_size > 10_000


def test_coverage_of_a_right_covariance() -> None:
    values = np.random.default_rng(0).chisquare(3, 20_000)
    np.testing.assert_allclose(evaluation._coverage(values), [0.6827, 0.9545, 0.9973], atol=0.01)


def test_configuration_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    good = dict(robot="r", recordings=dict(a="a", b="b", c="c"))
    for change, message in (
        ({}, "leave_one_out"),
        ({"leave_one_out": True, "hiden": 3}, "hiden"),
        ({"leave_one_out": True, "network": dict(kind="velocity", members=2)}, "members: 2"),
        ({"split": dict(train=["a"], validation=["x"])}, r"\['x'\]"),
        ({"split": dict(train=["a"], validation=["a"])}, "neither validate nor test"),
        ({"leave_one_out": True, "recordings": dict(a="a")}, "at least 3"),
    ):
        path.write_text(yaml.safe_dump(good | change))
        with pytest.raises(ConfigError, match=message):
            load_train_config(path)
    with refusal(ConfigError, tmp_path / "none.yaml", cause=FileNotFoundError):
        load_train_config(tmp_path / "none.yaml")
    shipped = list((Path(__file__).parent.parent.parent / "training" / "configs").glob("*.yaml"))
    assert shipped
    for file in shipped:
        load_train_config(file)
