"""Checks of a drone: as configured, with its mismatch, and in the worst draw of randomization."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.yaml_files import close_match, short
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import model as vehicle_model

MAX_THRUST, GRAVITY = 1000.0, 9.81  # times the weight; m/s^2
INERTIA_TOLERANCE = 1.1  # of the triangle inequality, as inertias are measured
LEAST_TURN = 0.1  # rad, within an episode
AXES = ("x", "y", "z")
Values = Mapping[str, float]


class Quantity(NamedTuple):
    """A number that follows from the constants, and its open range of possible values."""

    name: str
    function: Callable[[Values], float]
    least: float
    most: float
    allowed: str


def refuse(key: str, value: object, allowed: str) -> None:
    """Raise the one-line error of a value."""
    raise InputError(f"{key} is {short(value)}, allowed: {allowed}")


def episode_seconds(config: Config) -> float:
    """The length of an episode, s; at least a second."""
    return max(1.0, config.training_limits.episode_steps * config.rules.time_step)


def check_drone(config: Config) -> None:
    """Check that the drone can hover and turn, and that its integration is stable.

    Raises:
        InputError: a constant, a factor of the mismatch, a fraction of the randomization or a
            disturbance with which it cannot.
    """
    model, constants = vehicle_model(config.vehicle.model), config.vehicle.constants
    for name in config.randomization.constants:
        _check_name(f"randomization.constants.{name}", name, model.constant_names)
    for name in config.vehicle.mismatch:
        _check_name(f"vehicle.mismatch.{name}", name, model.constant_names)
    _check_signs(model, constants)
    factors, spread = config.vehicle.mismatch, config.randomization.by_constant(model)
    population = config.randomization.population
    if population is not None and population not in model.populations:
        allowed = " or ".join(["null", *model.populations])
        hint = close_match(population, model.populations)
        refuse("randomization.population", population, f"{allowed} with model {model.name}{hint}")
    fractions = {name: part for name, part in spread.items() if part}
    if population is not None and fractions:
        name, part = next(iter(fractions.items()))
        drawn = (
            f"null with fractions (here {part:g} of {name}), or randomization.all=0 and no other"
        )
        refuse("randomization.population", population, drawn)
    simulated = {name: value * factors.get(name, 1.0) for name, value in constants.items()}
    _check_ranges(model, simulated, spread)
    _check_thrust(model, constants)
    for quantity in _quantities(config, model):
        _check_quantity(config, quantity, simulated, spread)
    if model.disturbance is not None:
        _check_disturbance(config, model, simulated, spread)


def _check_name(key: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise InputError(
            f"unknown key {key}{close_match(name, names)}; allowed there: {', '.join(names)}"
        )


def _check_signs(model: VehicleModel, constants: Values) -> None:
    """Check the signs of the constants, and the triangle inequality of moments of inertia."""
    for name in model.positive:
        if constants[name] <= 0:
            refuse(f"vehicle.constants.{name}", constants[name], "a positive number")
    for name in model.nonnegative:
        if constants[name] < 0:
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


def _check_thrust(model: VehicleModel, constants: Values) -> None:
    if model.thrust_to_weight is None:
        return
    least, most = _lowest_thrust(model)(constants), model.thrust_to_weight(constants)
    if not least < 1 < most <= MAX_THRUST:
        raise InputError(
            f"vehicle.constants give a thrust of {least:.3g} to {most:.3g} times the weight, "
            f"allowed: a range around 1, up to {MAX_THRUST:g}, so that the drone can hover"
        )


def _lowest_thrust(model: VehicleModel) -> Callable[[Values], float]:
    """The thrust at the lowest commands, times the weight."""
    return lambda v: model.thrust_to_weight({**v, **{high: v[low] for low, high in model.ranges}})


def _quantities(config: Config, model: VehicleModel) -> list[Quantity]:
    """What a drone of the model must fulfill."""
    step, seconds = config.rules.time_step, episode_seconds(config)
    found = [
        Quantity(
            f"{name} in s",
            lambda v, name=name: v[name],
            0.5 * step,
            seconds,
            f"above {0.5 * step:g} s, half of rules.time_step {step} s (integration is unstable "
            f"below), and below {seconds:g} s",
        )
        for name in model.lags
    ]
    hover = "around 1, so that the drone can hover"
    if model.thrust_to_weight is not None:
        name = "times the weight as the thrust"
        found.append(
            Quantity(f"{name} at full command", model.thrust_to_weight, 1, math.inf, hover)
        )
        found.append(Quantity(f"{name} at least", _lowest_thrust(model), -math.inf, 1, hover))
    for name in model.damping(config.vehicle.constants) if model.damping else ():
        found.append(
            Quantity(
                f"1/s as the damping by {name}",
                lambda v, name=name: model.damping(v)[name],
                -1.0,
                2.0 / step,
                f"above -1/s (the drone drives itself) and below {2.0 / step:g}/s, 2 / "
                "rules.time_step (integration is unstable above)",
            )
        )
    least, most = 4.0 * LEAST_TURN / seconds**2, 1.0 / step**2
    for index, axis in enumerate(AXES if model.angular_acceleration else ()):
        found.append(
            Quantity(
                f"rad/s² about {axis} at full command",
                lambda v, index=index: model.angular_acceleration(v)[index],
                least,
                most,
                f"above {least:.2g} rad/s² (the drone cannot turn) and below {most:g} rad/s², a "
                "turn of 1 rad in a time step",
            )
        )
    return found


def _check_quantity(config: Config, quantity: Quantity, simulated: Values, spread: Values) -> None:
    """Check a quantity of the constants, with the mismatch, and at both ends of the draws."""
    constants, factors = config.vehicle.constants, config.vehicle.mismatch
    function = quantity.function
    for origin, changed, values in (
        ("vehicle.constants", constants, constants),
        ("vehicle.mismatch", factors, simulated),
        ("randomization", spread, _extreme(function, simulated, spread, -1)),
        ("randomization", spread, _extreme(function, simulated, spread, 1)),
    ):
        value = function(values)
        if quantity.least < value < quantity.most:
            continue
        names = [x for x in values if changed.get(x) and _depends(function, values, x)]
        name = names[0]
        if origin == "randomization":
            _refuse_draw(config, quantity, simulated, spread, names, value)
        given = f"{value:.3g} {quantity.name}: " if value != changed[name] else ""
        refuse(
            f"{origin}.{name}",
            changed[name],
            f"{given and 'other values, as it gives ' + given}{quantity.allowed}",
        )


def _refuse_draw(
    config: Config,
    quantity: Quantity,
    simulated: Values,
    spread: Values,
    names: list[str],
    value: float,
) -> None:
    """Raise the error of a fraction of the randomization, with the largest one that is possible.

    Args:
        config: of the run.
        quantity: that is impossible in the worst draw.
        simulated: the constants about which is drawn.
        spread: fractions of all constants.
        names: of the drawn constants that the quantity depends on.
        value: of the quantity in that draw.
    """
    key = _random_key(config, names[0])
    drawn = [name for name in names if _random_key(config, name) == key]
    low, high = 0.0, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        part = {k: v * (middle if k in drawn else 1.0) for k, v in spread.items()}
        ends = [
            quantity.function(_extreme(quantity.function, simulated, part, sign))
            for sign in (-1, 1)
        ]
        possible = all(quantity.least < value < quantity.most for value in ends)
        low, high = (middle, high) if possible else (low, middle)
    most = math.floor(1e3 * low * spread[drawn[0]]) / 1e3
    given = f"{value:.3g} {quantity.name}: {quantity.allowed}"
    worst = f"at most {most:g}; the worst draw of {', '.join(drawn)} gives {given}"
    refuse(key, spread[drawn[0]], worst)


def _depends(function: Callable[[Values], float], values: Values, name: str) -> bool:
    return function({**values, name: 1.5 * values[name]}) != function(values)


def _extreme(
    function: Callable[[Values], float], values: Values, spread: Values, sign: int
) -> Values:
    """The draw with the lowest (sign -1) or highest value of a function, monotonic in each."""
    for name, part in spread.items():
        if part:
            ends = ({**values, name: values[name] * (1 + end * part)} for end in (-1, 1))
            values = max(ends, key=lambda v: sign * function(v))
    return values


def _random_key(config: Config, name: str) -> str:
    """The key of randomization that draws a constant."""
    section, model = config.randomization, vehicle_model(config.vehicle.model)
    if name in section.constants:
        return f"randomization.constants.{name}"
    group = next(key for key, names in model.groups.items() if name in names)
    return f"randomization.{group if getattr(section, group) >= section.all else 'all'}"


def _check_disturbance(config: Config, model: VehicleModel, values: Values, spread: Values) -> None:
    """Check that the weakest drawn drone can hold the largest disturbances."""
    section = config.disturbance
    if (ratio := model.thrust_to_weight) is not None:
        weakest = _extreme(ratio, values, spread, -1)
        room = (ratio(weakest) - 1.0) * weakest.get("g", GRAVITY)
        if section.force_z >= room:
            refuse(
                "disturbance.force_z",
                section.force_z,
                f"below {room:.3g} m/s², what the thrust has above the weight",
            )
    inertia = model.groups.get("inertia", ())
    if model.angular_acceleration is None or len(inertia) != 3:
        return
    for index, axis in enumerate(AXES):

        def moment(v: Values, index: int = index) -> float:
            return model.angular_acceleration(v)[index] * v[inertia[index]]

        room = moment(_extreme(moment, values, spread, -1))
        half, bias = section.half_widths[f"moment_{axis}"], section.moment_bias[index]
        if half + abs(bias) >= room:
            key, value = (f"moment_{axis}", half) if half else ("moment_bias", section.moment_bias)
            refuse(
                f"disturbance.{key}", value, f"below {room:.3g} N m about {axis}, the commands' own"
            )
