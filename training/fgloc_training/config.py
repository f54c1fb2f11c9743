"""Settings of a training run: strict, from YAML, stored in every model it makes."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from fgloc.config import Section
from fgloc.files.settings import Settings
from fgloc.sensors.learned.card import Input, Kind, Split


class DataConfig(Section):
    """How recordings become samples at a fixed time step."""

    smoothing_s: float = Field(0.5, gt=0, description="window of the local cubic fit that smooths the truth")
    max_truth_gap_s: float = Field(0.15, gt=0, description="no samples across longer gaps of the truth")
    max_sideways_mps: float | None = Field(
        None,
        gt=0,
        description="no samples where the truth slides faster sideways",
    )
    max_truth_sigma_m: float | None = Field(0.05, gt=0, description="largest sigma of a smoothed truth")
    margin_s: float = Field(0.5, ge=0, description="left out at both ends")
    history_s: float = Field(3.0, ge=0, description="commands before the first sample")
    apart_s: float = Field(10.0, gt=0, description="a longer gap begins another run")
    shortest_s: float = Field(10.0, gt=0, description="a shorter recording is refused")


class NetworkConfig(Section):
    """Form and size of the model."""

    kind: Kind = Field("displacement", description="naive, lag, arx, velocity, rate, displacement or gru")
    hidden: tuple[int, ...] = Field(
        (128, 128), description="units of the layers; gru: of the cell first; naive, lag, arx: unused"
    )
    variance_units: int = Field(64, gt=0, description="displacement: width of the layers of the variance")
    members: int = Field(1, ge=1, le=64, description="displacement: networks that are averaged")
    dt_s: float = Field(0.1, gt=0, le=1.0, description="step of the samples, longest sub-step of a run")
    edges_s: tuple[float, ...] = Field(
        (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        description="ages between which commands are averaged",
    )
    inputs: tuple[Input, ...] = Field(("commands",), description="displacement: what the network reads")
    signal_edges_s: tuple[float, ...] = Field((0.0,), description="the same of measured signals, from 0")
    gyro_bias_sigma: float = Field(0.0, ge=0, description="error of the known bias, drawn in training")
    velocity_sigma: tuple[float, float] = Field((0.02, 0.05), description="noise of the velocity among the inputs")
    velocity_decay_s: float = Field(0.3, gt=0, description="decay time of a measured velocity")
    hold_s: float = Field(1.5, gt=0, description="longest time that a command is held")

    @model_validator(mode="after")
    def _may_be_an_ensemble(self) -> NetworkConfig:
        if self.kind != "displacement" and self.members > 1:
            raise ValueError(
                f"a {self.kind} model has one network, got members: {self.members}; take a displacement model"
            )
        return self


class OptimizationConfig(Section):
    """Multi-step loss, Adam, early stopping."""

    seed: int = Field(0, description="of first weights, batches, noise")
    horizon_s: float = Field(2.0, gt=0, description="rollouts in the loss")
    batch: int = Field(128, gt=0, description="rollouts a step")
    iterations: int = Field(1000, gt=0, description="steps, at most")
    validate_every: int = Field(100, gt=0, description="iterations between two validations")
    validation_s: tuple[float, ...] = Field((10.0, 30.0), description="windows whose mean drift is validated")
    patience: int = Field(6, gt=0, description="validations without improvement")
    learning_rate: float = Field(3e-3, gt=0, description="of Adam")
    position_sigma_m: float = Field(0.02, gt=0, description="unit of position errors")
    yaw_sigma_rad: float = Field(0.05, gt=0, description="unit of yaw errors")
    variance_horizon_s: float = Field(1.0, gt=0, description="rollouts whose likelihood sets the variance")
    variance_piece_s: float = Field(
        0.2,
        gt=0,
        description="pieces of them that count as much",
    )
    nll_beta: float = Field(
        0.0, ge=0, le=1, description="β of the β-NLL; 0: likelihood; 1: equal weight of all windows"
    )
    variance_iterations: int = Field(1500, ge=0, description="steps for the variance")


class CalibrationConfig(Section):
    """Scaling of the covariances on the held-out recording."""

    cross: bool = Field(
        False,
        description="also on each training recording, by a model that left it out",
    )
    horizons_s: tuple[float, ...] = Field((5.0, 10.0), description="windows whose likelihood is maximized")
    short_s: tuple[float, ...] = Field((0.2, 1.0), description="windows that separate lasting from passing errors")
    memory_s: tuple[float, ...] = Field((0.2, 0.5, 1.0, 2.0), description="time constants tried for lasting errors")
    window_s: float = Field(5.0, gt=0, description="windows of the covariances with the wheels")


class AdaptationConfig(Section):
    """How far a model moves towards another robot of its kind."""

    scale_sigma: float = Field(0.02, gt=0, description="spread of the gains of robots of a kind")
    yaw_per_m_sigma: float = Field(0.02, gt=0, description="spread of their pull to one side")
    window_s: float = Field(10.0, gt=0, description="windows whose errors are compared")

    after_training_s: float | None = Field(
        None,
        gt=0,
        description="after training, fit gains and pull to such windows; for a smoothed truth",
    )

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Prior sigmas of the gain of v, the gain of ω and the pull."""
        return self.scale_sigma, self.scale_sigma, self.yaw_per_m_sigma


class SpeedLimits(Section):
    """Largest commands of the robot."""

    v_mps: float = Field(gt=0, description="forward")
    omega_radps: float = Field(gt=0, description="to either side")
    reverse_mps: float = Field(0.0, ge=0, description="backward")


class TrainConfig(Section):
    """One training run, or one per recording left out."""

    robot: str = Field(description="name, for the model's card")
    recordings: dict[str, Path] = Field(description="bags by name")
    truth: dict[str, Path] = Field(
        {},
        description="folders of `fgloc smooth` by name, in place of the bags' truth",
    )
    leave_one_out: bool = Field(False, description="a model per recording left out, and one from all")
    split: Split | None = None
    limits: SpeedLimits | None = Field(None, description="of the robot; null: unknown, and nothing is missed")
    data: DataConfig = DataConfig()
    network: NetworkConfig = NetworkConfig()
    optimization: OptimizationConfig = OptimizationConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    adaptation: AdaptationConfig = AdaptationConfig()

    @model_validator(mode="after")
    def _one_split(self) -> TrainConfig:
        if self.leave_one_out == (self.split is not None):
            raise ValueError(
                "give either leave_one_out: true or a split by recording, such as split: {train: [a, b], validation: "
                "[c], test: [d]}; `fgloc train --init BAG... --out FILE` writes one"
            )
        if unknown := set(self.truth) - set(self.recordings):
            raise ValueError(f"truth is given for {sorted(unknown)}, recordings are {sorted(self.recordings)}")
        if self.leave_one_out and len(self.recordings) < 3:
            raise ValueError(f"leave_one_out needs at least 3 recordings, got {sorted(self.recordings)}")
        if self.split is not None:
            used = {*self.split.train, *self.split.validation, *self.split.test}
            if unknown := used - set(self.recordings):
                raise ValueError(f"the split names {sorted(unknown)}, recordings are {sorted(self.recordings)}")
            if set(self.split.train) & {*self.split.validation, *self.split.test}:
                raise ValueError("a recording that trains can neither validate nor test")
            if not (self.split.train and self.split.validation):
                raise ValueError("the split needs recordings to train and to validate on")
        return self


def load_train_config(path: Path) -> TrainConfig:
    """Read a training configuration.

    Raises:
        ConfigError: it cannot be read, or a key or value is wrong.
    """
    return Settings(
        path, "give a training configuration; fgloc train --init BAG... --out train.yaml writes one"
    ).validated(TrainConfig)
