"""Checks of a drone, as configured and with its mismatch."""

from collections.abc import Mapping, Sequence

from quadjax.config.schema import Config
from quadjax.core.errors import close_match
from quadjax.core.sections import BadValue, refuse
from quadjax.vehicle.constants import declarations
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import model as vehicle_model

MAX_THRUST = 1000.0  # times the weight
INERTIA_TOLERANCE = 1.1  # of the triangle inequality, as inertias are measured
Values = Mapping[str, float]


def check_drone(config: Config) -> None:
    """Check that the drone can hover, and that the integration of its actuators is stable.

    Raises:
        InputError: a constant, a factor of the mismatch, or a population with which it cannot.
    """
    model, constants = vehicle_model(config.vehicle.model), config.vehicle.constants
    factors, spread = config.vehicle.mismatch, config.randomization.by_constant(model)
    for name in config.randomization.constants:
        _check_name(f"randomization.constants.{name}", name, model.constant_names)
    for name in factors:
        _check_name(f"vehicle.mismatch.{name}", name, model.constant_names)
    _check_population(config, model, spread)
    _check_signs(model, constants)
    simulated = {name: value * factors.get(name, 1.0) for name, value in constants.items()}
    _check_ranges(model, simulated, spread)
    for values in (constants, simulated):
        _check_thrust(model, values, "" if values is constants else " times vehicle.mismatch")
    step = config.rules.time_step
    for name in model.lags:
        if simulated[name] <= 0.5 * step:
            key = f"vehicle.constants.{name}{' times its mismatch' if name in factors else ''}"
            unstable = f"half of rules.time_step {step} s (integration is unstable below)"
            refuse(key, simulated[name], f"above {0.5 * step:g} s, {unstable}")


def _check_name(key: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        allowed = f"allowed there: {', '.join(names)}"
        raise BadValue(key, f"unknown key {key}{close_match(name, names)}; {allowed}")


def _check_population(config: Config, model: VehicleModel, spread: Values) -> None:
    """Check that the model has the population, and that no fraction is drawn besides it."""
    population = config.randomization.population
    if population is None:
        return
    if population not in model.populations:
        allowed = " or ".join(["null", *model.populations])
        hint = close_match(population, list(model.populations))
        refuse("randomization.population", population, f"{allowed} with model {model.name}{hint}")
    for name, fraction in spread.items():
        if fraction:
            here = f"null with fractions (here {fraction:g} of {name})"
            refuse("randomization.population", population, f"{here}, or randomization.all=0")


def _check_signs(model: VehicleModel, constants: Values) -> None:
    """Check the signs of the constants, and the triangle inequality of moments of inertia."""
    for name, declared in declarations(model.constants).items():
        if declared.sign == "positive" and constants[name] <= 0:
            refuse(f"vehicle.constants.{name}", constants[name], "a positive number")
        if declared.sign == "nonnegative" and constants[name] < 0:
            refuse(f"vehicle.constants.{name}", constants[name], "at least 0")
    inertia = {name: constants[name] for name in model.groups.get("inertia", ())}
    if len(inertia) == 3:
        name, largest = max(inertia.items(), key=lambda item: item[1])
        others = sum(inertia.values()) - largest
        if largest > INERTIA_TOLERANCE * others:
            refuse(
                f"vehicle.constants.{name}",
                largest,
                f"at most {others:g}, the sum of the other moments of inertia, as of every body",
            )


def _check_ranges(model: VehicleModel, values: Values, spread: Values) -> None:
    for low, high in model.ranges:
        if not 0 <= values[low] * (1 + spread[low]) < values[high] * (1 - spread[high]):
            drawn = f", also as randomization.limits {spread[low]} draws them"
            refuse(
                f"vehicle.constants.{low}",
                values[low],
                f"at least 0 and below {high} {values[high]}{drawn if spread[low] else ''}",
            )


def _check_thrust(model: VehicleModel, values: Values, origin: str) -> None:
    """Check that the commands reach from below to above the weight."""
    idle = {**values, **{high: values[low] for low, high in model.ranges}}
    least, most = (model.thrust_to_weight(model.make_constants(x)) for x in (idle, values))
    if least is None or most is None:
        return
    if not least < 1 < most <= MAX_THRUST:
        raise BadValue(
            "vehicle.constants",
            f"vehicle.constants{origin} give a thrust of {least:.3g} to {most:.3g} times the "
            f"weight, allowed: a range around 1, up to {MAX_THRUST:g}, so that the drone can hover",
        )
