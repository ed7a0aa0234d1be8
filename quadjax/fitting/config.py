"""Config of a fit, ``configs/fit/*.yaml``: logs, drone, method and output."""

import dataclasses
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator

from quadjax.core.errors import InputError, close_match
from quadjax.core.sections import (
    MAX_SEED,
    RISING,
    Field,
    FolderName,
    NonNegative,
    Positive,
    Section,
    load_section,
    model_validator,
)
from quadjax.core.yaml_files import Tree, parse_overrides
from quadjax.fitting.formats import ALLOWED, FORMATS, QUANTITIES
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.vehicle_file import VehicleFile

Columns = Annotated[tuple[str, ...], Field(max_length=100)]
MotorCommand = Annotated[float, Field(ge=-1e6, le=1e6)]


def _as_list(value: object) -> object:
    """A single text as a list of one."""
    return (value,) if isinstance(value, str) else value


class UnitsConfig(Section):
    """Units of a log's columns, converted to SI and rpm; null is the format's."""

    time: Literal["s", "ms", "us"] | None = Field(None, description="unit of time stamps")
    rpm: Literal["rpm", "krpm", "rad/s", "Hz", "erpm", "erpm/100"] | Positive | None = Field(
        None,
        description="unit of propeller speeds and their commands, or the rpm of 1; erpm: electrical"
        " speed, with pole_pairs",
    )
    gyro: Literal["rad/s", "deg/s"] | None = Field(None, description="unit of body rates")
    acceleration: Literal["m/s^2", "g", "mg"] | None = Field(
        None, description="unit of specific force and its bias"
    )
    velocity: Literal["m/s", "cm/s", "mm/s"] | None = Field(
        None, description="unit of body and world velocity"
    )
    length: Literal["m", "cm", "mm"] | None = Field(None, description="unit of the position")
    angle: Literal["rad", "deg"] | None = Field(None, description="unit of Euler angles")


class LogsConfig(Section):
    """Flight logs and their columns."""

    files: Annotated[tuple[str, ...], BeforeValidator(_as_list)] = Field(
        (), max_length=1000, description="paths or glob patterns, one flight each; one or a list"
    )
    format: str = Field(
        "plain",
        max_length=200,
        description="plain, paparazzi, blackbox, tii, ulog or a LogFormat (module:OBJECT)",
    )
    columns: dict[str, Columns] = Field(
        {}, max_length=100, description="columns by quantity, overriding"
    )
    units: UnitsConfig = UnitsConfig()
    body_frame: Literal["FRD", "FLU", "auto"] | None = Field(
        None, description="axes of body-frame columns; auto: by the thrust; null: the format's"
    )
    world_frame: Literal["NED", "ENU", "auto"] | None = Field(
        None, description="axes of world-frame columns; auto: by gravity; null: the format's"
    )
    motor_range: Annotated[tuple[MotorCommand, MotorCommand], RISING] | None = Field(
        None, description="motor commands that are 0 and 1; null: the log's or the format's"
    )
    pole_pairs: int | None = Field(
        None,
        ge=1,
        le=100,
        description="of a motor, half its magnets, for speeds in erpm; null: the log's",
    )
    max_gap: Positive = Field(
        0.05, description="s, longest allowed gap between samples, not fitted"
    )
    min_seconds: float = Field(2.0, ge=0.5, le=3600, description="s, shortest allowed flight")
    max_scale_error: float = Field(
        0.25, gt=0.0, le=1e6, description="largest allowed error of a column's scale"
    )
    max_delay: float = Field(
        0.05, gt=0.0, le=1e6, description="s, largest allowed between columns; searched up to 0.6 s"
    )
    max_angle: float = Field(
        15.0, gt=0.0, le=180.0, description="deg, largest allowed between axes of two quantities"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.format not in FORMATS and ":" not in self.format:
            raise ValueError(f"logs.format is {self.format!r}, allowed: {ALLOWED}")
        for quantity, names in self.columns.items():
            if quantity not in QUANTITIES:
                key = f"logs.columns.{quantity}{close_match(quantity, list(QUANTITIES))}"
                raise ValueError(f"unknown key {key}; allowed: {list(QUANTITIES)}")
            width = QUANTITIES[quantity].width
            if names and len(names) != width:
                raise ValueError(
                    f"logs.columns.{quantity} has {len(names)} columns, allowed: {width}"
                )
        return self


class BodyConfig(Section):
    """Properties of the drone that logs do not contain."""

    name: str = Field("fitted drone", description="name in the vehicle file that is written")
    mass: Positive | None = Field(None, description="kg; null leaves it out of the vehicle file")
    inertia: tuple[Positive, Positive, Positive] | Literal["base"] | None = Field(
        None, description="kg m^2: xx, yy, zz; base takes the base vehicle's; required"
    )
    rpm_range: Annotated[tuple[Positive, Positive], RISING] | None = Field(
        None, description="lowest, highest rpm; null takes the logs'"
    )


class NominalConfig(Section):
    """The nominal model."""

    fit: bool = Field(True, description="false keeps the base vehicle's constants")
    axes: tuple[Literal["ax", "ay", "az", "Mx", "My", "Mz"], ...] = Field(
        ("ax", "ay", "az", "Mx", "My", "Mz"),
        max_length=6,
        description="axes whose constants are fitted",
    )


class SplitConfig(Section):
    """Held-out data: whole flights, or a part of each flight's time."""

    by: Literal["auto", "flight", "time"] = Field(
        "auto", description="auto is flight for two or more flights"
    )
    test_flights: tuple[str, ...] = Field(
        (), max_length=1000, description="not fitted and used for no choice, only predicted"
    )
    test_fraction: float = Field(
        0.3, gt=0.0, lt=0.9, description="by time: the last part of each flight, not fitted"
    )
    folds: int = Field(5, ge=2, le=1000, description="largest number of groups or blocks")


class ResidualConfig(Section):
    """Training of the residual networks."""

    fit: bool = Field(True, description="false writes a vehicle without a residual")
    epochs: int = Field(150, ge=1, le=10**5, description="maximum number of passes over the data")
    batch_size: int = Field(512, ge=1, le=10**6, description="rows of a minibatch")
    learning_rate: Positive = Field(3e-3, description="of Adam")
    weight_decay: NonNegative = Field(2e-3, description="L2 penalty on the kernels")
    input_noise: NonNegative = Field(
        0.07, description="noise on the inputs, in units of each input's standard deviation"
    )
    mirror: bool = Field(
        True, description="train on mirror images too: the drone is symmetric about its x-z plane"
    )
    select: bool = Field(
        True,
        description="held-out folds choose epochs and scale; false: all epochs and scale 1",
    )
    max_harm: NonNegative = Field(
        0.1, description="largest relative increase of any held-out fold's error"
    )


class FitConfig(Section):
    """One fit."""

    name: FolderName = Field("fit", description="folder of results")
    vehicle: str = Field("bebop1.yaml", description="base vehicle, a file in configs/vehicles")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="of everything random in the fit")
    figures: bool = Field(True, description="draw figures")
    logs: LogsConfig = LogsConfig()
    body: BodyConfig = BodyConfig()
    nominal: NominalConfig = NominalConfig()
    split: SplitConfig = SplitConfig()
    residual: ResidualConfig = ResidualConfig()


def load_fit_config(
    path: Path | str, overrides: Sequence[str] = (), allow_code: bool = False
) -> FitConfig:
    """The config of a YAML file, or of a name in ``configs/fit``, and ``key=value`` overrides.

    Args:
        path: of the file, or a name.
        overrides: with dotted keys.
        allow_code: accept a file whose ``logs.format`` is ``module:OBJECT``; overrides always may.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value or an unreadable file.
    """
    config = load_section(FitConfig, path, "fit", overrides)
    reader = config.logs.format
    if ":" in reader and not allow_code and reader != _format_of(parse_overrides(overrides)):
        raise InputError(
            f"{path}: logs.format is {reader!r:.80}; code that a config of flight logs names is "
            "imported only with --allow-code"
        )
    return config


def _format_of(overrides: Tree) -> object:
    """``logs.format`` of a command line's overrides; None if it is not among them."""
    logs = overrides.get("logs")
    return logs.get("format") if isinstance(logs, dict) else None


def with_body(base: VehicleFile, body: BodyConfig, model: str = "motor") -> VehicleFile:
    """The base vehicle with the config's name, mass, inertia and rpm range.

    Mass and width of the base vehicle are those of a drone with its inertia.

    Raises:
        InputError: no inertia for the model ``motor``.
    """
    values = dict(values_of(base.constants(model)))
    same = model == "racing" or body.inertia == "base"
    if body.rpm_range is not None:
        names, unit = ("rpm_min", "rpm_max"), 1.0
        if model == "racing":
            names, unit = ("w_min", "w_max"), RPM_PER_RAD_S
        values |= {name: rpm / unit for name, rpm in zip(names, body.rpm_range, strict=True)}
    if not same:
        if body.inertia is None:
            raise InputError(
                "body.inertia is null; logs do not determine it, and all moments are proportional "
                f"to it: set [xx, yy, zz] in kg m^2, or base for that of {base.name}"
            )
        values |= dict(zip(("i_xx", "i_yy", "i_zz"), map(float, body.inertia), strict=True))
    mass = base.mass if same and body.mass is None else body.mass
    width = base.width if same else None
    drone = dataclasses.replace(base, name=body.name, mass=mass, width=width)
    return drone.with_constants(model, values)


def check_keys(config: FitConfig, model: str, split_by: str) -> None:
    """Reject keys without effect, with a split by "flight" or "time".

    Raises:
        InputError: naming the key, its value, the reason and what is allowed.
    """
    reasons: dict[str, str] = {}
    training = [f"residual.{name}" for name in ResidualConfig.model_fields if name != "fit"]
    if split_by == "flight":
        reasons["split.test_fraction"] = "whole flights are held out"
    if not config.nominal.fit:
        reasons["nominal.axes"] = "nominal.fit=false fits no constant"
    if not config.residual.fit:
        reason = "residual.fit=false trains no network"
        other = {"residual.max_harm", "residual.mirror"}  # of the constants, and of the drone
        reasons |= dict.fromkeys([key for key in training if key not in other], reason)
        reasons["seed"] = "without a residual nothing is random"
    if model == "racing":
        of_model = "on a vehicle of the model racing: "
        reasons |= dict.fromkeys(training, f"{of_model}it has no residual")
        reasons["seed"] = f"{of_model}nothing in its fit is random"
        reasons["nominal.fit"] = f"{of_model}without its constants nothing would be fitted"
        reasons["body.inertia"] = f"{of_model}its constants are per inertia"
        if split_by == "time":
            reasons["split.folds"] = f"{of_model}no choice is validated on blocks of time"
    for key, reason in reasons.items():
        value, usual = (attrgetter(key)(section) for section in (config, FitConfig()))
        if value != usual:
            raise InputError(
                f"{key} is {value!r}, which has no effect: {reason}; allowed: {usual!r}"
            )
