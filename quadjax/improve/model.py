"""A drone's model, refitted from flight logs and accepted only if it predicts other flights better.

Nothing here knows the stand-in plant: a refit receives log files and the present model.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.fitting.axes import nominal_error
from quadjax.fitting.config import FitConfig
from quadjax.fitting.fit import Fit, Report
from quadjax.fitting.fit import fit as fit_drone
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import BatteryFit, fit_battery
from quadjax.fitting.nominal import AXES, UNITS, residual_output
from quadjax.fitting.report import write_results
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import read_residual

SPEEDS = "rpm"
LEAST_GAIN = 0.01  # least decrease of the mean error for a model to be accepted
MOST_HARM = 0.1  # largest increase of one quantity's error


@dataclasses.dataclass(frozen=True)
class Model:
    """Constants, residual and battery of a drone.

    Attributes:
        constants: of the motor-level model.
        residual: file of the networks; None for none.
        battery: the fitted limit; None for no limit.
    """

    constants: dict[str, float]
    residual: str | None = None
    battery: BatteryFit | None = None

    @classmethod
    def of(cls, config: Config) -> Self:
        """The model that a race trains with, without its battery, which no flight has shown."""
        names = constant_names(MotorConstants)
        constants = {name: float(config.vehicle.constants[name]) for name in names}
        return cls(constants, config.vehicle.residual)

    @property
    def motor(self) -> MotorConstants:
        """The constants as floats."""
        values: dict[str, Any] = {**self.constants}
        return MotorConstants(**values)

    @property
    def hover(self) -> float:
        """Propeller speed of a hover, rpm."""
        return float(np.sqrt(self.constants["g"] / (4.0 * self.constants["k_w"])))

    def race(self, config: Config) -> Config:
        """The race with this model; the policy's observation stays the same."""
        vehicle, observed = config.vehicle, config.observation
        gain = {} if self.residual is None else {"residual_gain": 1.0}
        new = {"constants": {**vehicle.constants, **self.constants}, "residual": self.residual}
        battery = self.limits(config)
        if battery is None:
            battery = config.battery
        elif config.battery is None:
            observed = observed.replace(highest_rpm="none")
        return config.replace(
            vehicle=vehicle.replace(**new, **gain), battery=battery, observation=observed
        )

    def limits(self, config: Config) -> BatteryConfig | None:
        """The battery in a race; None where the flights show none."""
        if self.battery is None:
            return None
        return self.battery.section(config.battery or BatteryConfig())

    def to_json(self) -> dict[str, Any]:
        """The model for a JSON file."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        """The model of ``to_json``."""
        battery = values["battery"] and BatteryFit(**values["battery"])
        return cls(values["constants"], values["residual"], battery)


@dataclasses.dataclass(frozen=True)
class Refit:
    """A refitted model against the present one.

    Attributes:
        model: the refitted one.
        before: root mean square errors of the present model on the held-out flights, by quantity;
            without the propeller speeds where the logs have no commanded ones.
        after: those of models that are fitted without the flight that they predict.
        refused: why the model is not accepted; "" if it is.
        seconds: of computing.
    """

    model: Model
    before: dict[str, float]
    after: dict[str, float]
    refused: str
    seconds: float

    @property
    def change(self) -> float:
        """Relative change of the error, the geometric mean over the quantities."""
        return mean_change(self.before, self.after)

    def save(self, path: Path) -> None:
        """Write a JSON file."""
        write_json(path, dataclasses.asdict(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the JSON file."""
        values = read_json(path)
        own = Model.from_json(values["model"])
        rest = (values[name] for name in ("before", "after", "refused", "seconds"))
        return cls(own, *rest)


def check_speeds(logs: Sequence[FlightLog], present: Model, scale_error: float) -> None:
    """Refuse logs of another drone: with speeds beyond the range that the policy commands.

    Raises:
        InputError: naming the log, its speeds and the range.
    """
    low, high = present.constants["rpm_min"], present.constants["rpm_max"]
    for log in logs:
        fastest = float(np.percentile(log.rpm, 99.0))
        if fastest > high * (1.0 + scale_error):
            raise InputError(
                f"{log.path}: speeds of up to {fastest:.5g} rpm; the config's vehicle commands "
                f"{low:g} to {high:g} (is it this drone? are logs.units.rpm right?)"
            )


def refit(
    files: Sequence[Path],
    recent: Sequence[Path],
    fit: FitConfig,
    present: Model,
    folder: Path,
    report: Report = lambda line: None,
    battery: BatteryConfig | None = None,
) -> Refit:
    """Fit a model to logs, and compare its predictions with those of the present model.

    The comparison is on the flights ``recent``, which the present model has not seen. Each is
    predicted by a fit without it; of a single flight the last part is held out.

    Args:
        files: logs of one drone.
        recent: those of ``files`` to compare on.
        fit: config of the fit; its files are not used, and its range of speeds is that of the
            present model, which the policy commands.
        present: the model in use.
        folder: for the vehicle file, the residual and the report of the fit.
        report: called with the progress.
        battery: of the race, whose drain is assumed where flights are too short to show it.

    Raises:
        InputError: bad logs, or a fit of impossible constants, in one line.
    """
    started = time.monotonic()
    ends = (present.constants["rpm_min"], present.constants["rpm_max"])
    config = fit.replace(
        logs=fit.logs.replace(files=tuple(str(file) for file in files)),
        body=fit.body.replace(rpm_range=ends),
    )
    base = battery or BatteryConfig()
    result = fit_drone(config, Path(), report, base)
    write_results(result, folder)
    model = _model_of(result, present, folder)
    names = {file.stem for file in recent}
    before, after = _errors(result, present, names)
    speeds = _speed_errors(result.logs, model, present, names, base)
    if speeds is not None:
        before[SPEEDS], after[SPEEDS] = speeds
    seconds = round(time.monotonic() - started, 1)
    return Refit(model, before, after, refusal(before, after), seconds)


def _model_of(result: Fit, present: Model, folder: Path) -> Model:
    """The fitted model."""
    motor = result.vehicle.motor
    constants = {name: float(getattr(motor, name)) for name in constant_names(MotorConstants)}
    return Model(constants, str(folder / "residual.npz"), result.battery or present.battery)


def _errors(
    result: Fit, present: Model, names: set[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Errors of the present model and of the fit on the held-out rows of some flights."""
    flights = [index for index, log in enumerate(result.logs) if log.name in names]
    residual = None if present.residual is None else read_residual(present.residual)
    before, after = [], []
    for part in result.held_out:
        rows = np.isin(result.samples.flight[part.rows], flights)
        own = result.samples[part.rows[rows]]
        error = nominal_error(own, present.motor)
        if residual is not None:
            error[:, 2:] -= residual_output(residual, own.motion)
        before.append(error)
        after.append((part.measured - part.full)[rows])
    pairs = (np.sqrt((np.concatenate(errors) ** 2).mean(axis=0)) for errors in (before, after))
    old, new = (dict(zip(AXES, map(float, rmse), strict=True)) for rmse in pairs)
    return old, new


def _speed_errors(
    logs: Sequence[FlightLog],
    model: Model,
    present: Model,
    names: set[str],
    base: BatteryConfig,
) -> tuple[float, float] | None:
    """Errors of the propeller speeds from commands, of the present model and of fits without.

    Loads are relative to the hover of each model. None where no flight can be compared: without
    commanded speeds, or without a second flight.
    """
    known = [log for log in logs if log.rpm_command is not None]
    old = present.battery or BatteryFit(present.constants["tau"], 0.0, 0.0)
    before, after = [], []
    for log in known:
        others = [other for other in known if other is not log]
        own = fit_battery(others, model.hover, base) if log.name in names else None
        if own is not None:
            before.append(old.error(log, present.hover, present.constants["rpm_max"]))
            after.append(own.error(log, model.hover, model.constants["rpm_max"]))
    if not before:
        return None
    return float(np.sqrt(np.mean(np.square(before)))), float(np.sqrt(np.mean(np.square(after))))


def mean_change(before: dict[str, float], after: dict[str, float]) -> float:
    """Relative change of the errors, the geometric mean over the quantities that are known."""
    ratios = np.array([after[name] / max(before[name], 1e-300) for name in before])
    return float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-300)))) - 1.0)


def refusal(before: dict[str, float], after: dict[str, float]) -> str:
    """Why a model with the errors ``after`` on held-out flights is rejected; "" if it is not."""
    change = mean_change(before, after)
    if not change <= -LEAST_GAIN:
        than = f"{100.0 * abs(change):.1f}% {'smaller' if change < 0 else 'larger'} than"
        return (
            f"its error on held-out flights is {than} that of the present model, allowed: at least "
            f"{100.0 * LEAST_GAIN:g}% smaller"
        )
    for name, error in after.items():
        harm = error / max(before[name], 1e-300) - 1.0
        if harm > MOST_HARM:
            return f"its error of {name} on held-out flights is {100.0 * harm:.0f}% larger"
    return ""


def error_lines(found: Refit) -> list[str]:
    """Held-out errors before and after as text."""
    units = UNITS | {SPEEDS: "rpm"}
    lines = [f"{'held out':10}{'present':>12}{'refitted':>12}{'change':>9}"]
    for name in found.before:
        old, new = found.before[name], found.after[name]
        change = 100.0 * (new / max(old, 1e-300) - 1.0)
        lines.append(f"{name:10}{old:12.4g}{new:12.4g}{change:+8.1f}%  {units[name]}")
    return lines


def constant_lines(present: Model, found: Model) -> list[str]:
    """Constants and battery before and after as text."""
    lines = [f"{'constant':10}{'present':>12}{'refitted':>12}{'change':>9}"]
    for name, new in found.constants.items():
        old = present.constants[name]
        if new != old:
            lines.append(f"{name:10}{old:12.5g}{new:12.5g}{100.0 * (new / old - 1.0):+8.1f}%")
    if found.battery is None:
        return [*lines, "battery: not fitted, as no log has commanded propeller speeds"]
    if not found.battery.converged:
        lines.append("warning: the fit of the battery stopped before it converged")
    if not found.battery.first:
        return [*lines, "battery: no limit of the propeller speeds found"]
    top = list(found.battery.first.values())
    return [
        *lines,
        f"battery: highest speed {min(top):.0f} to {max(top):.0f} rpm without load at the start, "
        f"{found.battery.sag:.0f} rpm less at the load of hover, {found.battery.drain:.1f} rpm "
        "less per second of hover",
    ]
