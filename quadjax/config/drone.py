"""Checks of the drone of a config: its constants, and that it can fly."""

from collections.abc import Callable, Mapping

from quadjax.config.schema import Config
from quadjax.core.errors import close_match
from quadjax.core.sections import BadValue, refuse
from quadjax.vehicle.constants import Sign, declarations
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import base_model

MAX_THRUST_TO_WEIGHT = 1000.0
INERTIA_TOLERANCE = 1.1  # of the triangle inequality, as moments of inertia are measured
SIGNS: dict[Sign, tuple[Callable[[float], bool], str]] = {  # of constants, and what is allowed
    "positive": (lambda value: value > 0, "a positive number"),
    "nonnegative": (lambda value: value >= 0, "at least 0"),
    "direction": (lambda value: abs(value) == 1, "1 (counter-clockwise seen from above) or -1"),
    "any": (lambda value: True, ""),
}
Values = Mapping[str, float]


def check_drone(config: Config) -> None:
    """Check the constants, that the drone can hover, and that its actuators' integration is stable.

    Raises:
        InputError: a constant, a factor of the mismatch, or a population with which it cannot.
    """
    model, constants = base_model(config.vehicle.model), config.vehicle.constants
    factors, step = config.vehicle.mismatch, config.rules.time_step
    sections = {"randomization.constants": config.randomization.constants}
    for section, names in (sections | {"vehicle.mismatch": factors}).items():
        for name in (name for name in names if name not in model.constant_names):
            hint, listed = close_match(name, model.constant_names), ", ".join(model.constant_names)
            key = f"{section}.{name}"
            raise BadValue(key, f"unknown key {key}{hint}; allowed there: {listed}")
    _check_population(config, model)
    for name, declared in declarations(model.constants).items():
        holds, allowed = SIGNS[declared.sign]
        if not holds(constants[name]):
            refuse(f"vehicle.constants.{name}", constants[name], allowed)
    inertia = {name: constants[name] for name in model.groups.get("inertia", ())}
    if len(inertia) == 3:
        name = max(inertia, key=inertia.__getitem__)
        others = sum(inertia.values()) - inertia[name]
        if inertia[name] > INERTIA_TOLERANCE * others:
            allowed = f"at most {others:g}, the sum of the other moments of inertia"
            refuse(f"vehicle.constants.{name}", inertia[name], allowed)
    simulated = {name: value * factors.get(name, 1.0) for name, value in constants.items()}
    for values, origin in ((constants, ""), (simulated, " times vehicle.mismatch")):
        _check_thrust(model, values, origin)
        _check_allocation(model, values, origin)
    for name in (name for name in model.lags if simulated[name] <= 0.5 * step):
        key = f"vehicle.constants.{name}{' times its mismatch' if name in factors else ''}"
        unstable = f"half of rules.time_step {step} s (integration is unstable below)"
        refuse(key, simulated[name], f"above {0.5 * step:g} s, {unstable}")


def _check_population(config: Config, model: VehicleModel) -> None:
    """Check that the model has the population, and that no fraction is drawn besides it."""
    population, key = config.randomization.population, "randomization.population"
    if population is None:
        return
    if population not in model.populations:
        allowed = " or ".join(["null", *model.populations])
        hint = close_match(population, list(model.populations))
        refuse(key, population, f"{allowed} with model {model.name}{hint}")
    for name, fraction in config.randomization.by_constant(model).items():
        if fraction:
            here = f"null with fractions (here {fraction:g} of {name})"
            refuse(key, population, f"{here}, or randomization.all=0")


def _check_thrust(model: VehicleModel, values: Values, origin: str) -> None:
    """Check that the commands reach from below to above the weight."""
    idle = {**values, **{high: values[low] for low, high in model.ranges}}
    lowest, highest = (model.thrust_to_weight(model.make_constants(x)) for x in (idle, values))
    limit = MAX_THRUST_TO_WEIGHT
    if lowest is not None and highest is not None and not lowest < 1 < highest <= limit:
        raise BadValue(
            "vehicle.constants",
            f"vehicle.constants{origin} give a thrust of {lowest:.3g} to {highest:.3g} times the "
            f"weight, allowed: a range around 1, up to {limit:g}, so that the drone can hover",
        )


def _check_allocation(model: VehicleModel, values: Values, origin: str) -> None:
    """Check that the rotors set thrust, roll, pitch and yaw independently of each other."""
    if reason := model.dependent_axes(model.make_constants(values)):
        key = "vehicle.constants.turning1" if "turning1" in values else "vehicle.constants"
        raise BadValue(key, f"vehicle.constants{origin}: {reason}")
