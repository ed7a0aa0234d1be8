"""The schema of ``configs/fit/*.yaml``: what to read, how to fit, what to write."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class UnitsConfig:
    """Units of a log's columns; they are converted to SI and rpm on reading."""

    time: str = "s"  # s, ms, us
    rpm: str = "rpm"  # rpm, krpm, rad/s
    gyro: str = "rad/s"  # rad/s, deg/s
    acceleration: str = "m/s^2"  # m/s^2, g
    velocity: str = "m/s"  # m/s, cm/s
    angle: str = "rad"  # rad, deg


@dataclass(frozen=True)
class LogsConfig:
    """Which flight logs, and what their columns are called."""

    files: list[str] = field(default_factory=list)  # paths or glob patterns, one flight each
    format: str = "plain"  # plain, paparazzi: column names to start from
    columns: dict[str, list[str]] = field(default_factory=dict)  # quantity: columns, overriding
    units: UnitsConfig = field(default_factory=UnitsConfig)
    body_frame: str = "FRD"  # FRD, FLU
    world_frame: str = "NED"  # NED, ENU
    max_gap: float = 0.05  # s without a sample that is refused
    min_seconds: float = 2.0  # a shorter flight is refused


@dataclass(frozen=True)
class BodyConfig:
    """What the logs cannot tell about the drone."""

    name: str = "fitted drone"
    mass: float | None = None  # kg; the base vehicle's where missing
    inertia: list[float] | None = None  # kg m^2, (xx, yy, zz); the base vehicle's where missing
    rpm_range: list[float] | None = None  # lowest, highest rpm; the logs' where missing


@dataclass(frozen=True)
class PrepareConfig:
    """From a log to model inputs and targets."""

    cutoff: float = 16.0  # Hz, zero-phase second-order Butterworth
    airborne_fraction: float = 0.5  # of the flight's median rpm, below which it is on the ground
    airborne_pause: float = 1.0  # s below it within a flight that count as a landing


@dataclass(frozen=True)
class NominalConfig:
    """The nominal model."""

    fit: bool = True  # false: keep the base vehicle's constants and fit only what they leave


@dataclass(frozen=True)
class SplitConfig:
    """What is held out: whole flights, or a part of each flight's time."""

    by: str = "auto"  # flight, time, auto (flight where there are two or more)
    test_flights: list[str] = field(default_factory=list)  # never used for any choice
    test_fraction: float = 0.3  # by time: the last part of each flight
    folds: int = 5  # at most so many groups of flights; by time, so many blocks at most
    leave_one_out: bool = True  # the whole procedure again for each flight left out


@dataclass(frozen=True)
class ResidualConfig:
    """Training of the residual networks."""

    fit: bool = True
    hidden_thrust: int = 32
    hidden_moment: int = 32
    seeds: int = 5
    epochs: int = 60
    batch: int = 128
    learning_rate: float = 3e-3
    average: float = 0.99  # decay of the average of the weights that is kept
    decay: float = 1e-3  # L2 on the last layer: towards no residual
    noise: float = 0.1  # on the mirrored candidate's inputs, in their standard deviations
    mirror: str = "auto"  # auto, on, off: also learn from each flight's mirror image
    sample_rate: float = 50.0  # Hz, to which the filtered signals are thinned
    caution: float = 1.0  # weight of the worst held-out flight's harm in choosing the shrinkage
    min_gain: float = 0.01  # a smaller relative gain on held-out flights is refused
    teach_epochs: int = 120  # of the exported network on the ensemble
    margin: float = 0.5  # how far beyond the logs the exported network is taught to stay level


@dataclass(frozen=True)
class FitConfig:
    """One fit."""

    name: str = "fit"
    runs: str = "runs"  # the results go to runs/NAME
    vehicle: str = "bebop1.yaml"  # in configs/vehicles; base: rate model, and what is not fitted
    seed: int = 0
    figures: bool = True
    logs: LogsConfig = field(default_factory=LogsConfig)
    body: BodyConfig = field(default_factory=BodyConfig)
    prepare: PrepareConfig = field(default_factory=PrepareConfig)
    nominal: NominalConfig = field(default_factory=NominalConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    residual: ResidualConfig = field(default_factory=ResidualConfig)
