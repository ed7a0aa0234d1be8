"""Checks that involve several keys of a config.

Those of the race are of the first and of the last values of its schedules.
"""

import functools
import math
from collections.abc import Mapping, Sequence

from quadjax.config.schema import Config, Randomization, Schedule
from quadjax.core.errors import InputError, close_match, short
from quadjax.core.sections import BadValue, fields_at, refuse, value_at
from quadjax.race.layout import LONGEST
from quadjax.race.observations import ACTUATORS, remembered_names
from quadjax.vehicle.constants import declarations
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import model as vehicle_model

NOT_GROUPS = ("all", "constants", "population", "width", "tracks")  # keys of randomization
SMALLEST_LEG = 0.01  # m
MAX_THRUST = 1000.0  # times the weight
INERTIA_TOLERANCE = 1.1  # of the triangle inequality, as inertias are measured
Values = Mapping[str, float]


def check(config: Config) -> None:
    """Reject combinations of values that are impossible.

    Raises:
        InputError: one line that names the key, its value and what is allowed.
    """
    _check_schedules(config)
    _check_effects(config)
    _check_observation(config)
    last = at_end(config)
    for race in (at_end(config, 0), last):
        check_drone(race)
        _check_rules(race)
        _check_gates(race)
        _check_race_start(race)
    reward, inflation = last.reward, last.training_limits.gate_inflation
    if inflation > 0 and not (reward.gate_edge > 0 or reward.gate_offset > 0):
        allowed = "at most 0 without reward.gate_edge or reward.gate_offset"
        refuse("training_limits.gate_inflation", inflation, allowed)


def with_body(config: Config, radius: float) -> Config:
    """The race of a drone with a radius, m, with gates tested where the flight crosses them.

    Raises:
        InputError: a radius for which an opening is too small.
    """
    rules = config.rules.replace(body_radius=radius, gate_test="interpolated")
    config = config.replace(rules=rules)
    check(config)
    return config


def at_end(config: Config, index: int = -1) -> Config:
    """The config with the last value of every schedule; with ``index`` 0 the first."""
    for key, schedule in config.schedules.items():
        if schedule.linear[index] != "value":
            config = config.at(key, schedule.linear[index])
    return config


def _check_schedules(config: Config) -> None:
    """Check that schedules are of numbers, with allowed values, and within the run."""
    for key, schedule in config.schedules.items():
        try:
            value = value_at(config, key, missing=None)
        except InputError as error:
            learner = f" with learner.algorithm={config.learner.algorithm}"
            where = f"schedules{learner if key.startswith('learner.') else ''}"
            raise BadValue(f"schedules.{key}", f"{where}: {error}") from None
        if not isinstance(value, float):
            refuse(f"schedules.{key}", value, "the key of a number")
        _check_times(f"schedules.{key}", config.run.steps, schedule)
        for number in schedule.linear:
            if number != "value":
                try:
                    config.at(key, number)
                except InputError as error:
                    raise BadValue(f"schedules.{key}.linear", f"schedules.{key}: {error}") from None


def _check_times(key: str, steps: int, schedule: Schedule) -> None:
    """Check that a schedule begins before it ends, and ends within the run."""
    if schedule.by == "pass_rate" and max(schedule.start, schedule.until) > 1:
        refuse(key, short(schedule.model_dump(by_alias=True)), "levels up to 1")
    for name, time in (("from", schedule.start), ("until", schedule.until)):
        if time > 1 and time > steps:
            allowed = f"at most run.steps {steps}, or a fraction of the run up to 1"
            refuse(f"{key}.{name}", f"{time:g} steps", allowed)
    begin, *_, end = schedule.knots(steps, steps)
    if begin > end:
        refuse(f"{key}.from", schedule.start, f"before until {schedule.until:g}")


def _check_observation(config: Config) -> None:
    """Check that observed constants are drawn, and which fields have a history."""
    observed, model = config.observation, vehicle_model(config.vehicle.model)
    random = any(config.randomization.by_constant(model).values())
    for key in ("constants", "critic_constants"):
        if getattr(observed, key) and not (random or config.randomization.population):
            allowed = "false where randomization draws none (randomization.all=0.2 draws them)"
            refuse(f"observation.{key}", True, allowed)
    if observed.constants and observed.critic_constants:
        refuse("observation.critic_constants", True, "false with observation.constants")
    past = observed.history
    if past is None:
        return
    fields = remembered_names(model, observed.attitude)
    names = [model.actuators.name if name == ACTUATORS else name for name in past.fields]
    if not names or len(set(names)) < len(names) or set(past.fields) - set(fields):
        listed = f"one or more of {', '.join(fields)}, each once"
        refuse("observation.history.fields", past.fields, listed)
    if past.steps * past.every > LONGEST:
        allowed = f"at most {LONGEST // past.every} with every {past.every}"
        refuse("observation.history.steps", past.steps, allowed)


def _check_effects(config: Config) -> None:
    """Check that each key has an effect, and that the model has what the config asks for."""
    model = vehicle_model(config.vehicle.model)
    groups = [name for name in Randomization.model_fields if name not in NOT_GROUPS]
    for group in (group for group in model.groups if group not in groups):
        allowed = f"a model whose groups are among {', '.join(groups)}; it has {group!r}"
        refuse("vehicle.model", config.vehicle.model, allowed)
    if config.observation.disturbance == "estimated" and not model.can_be_disturbed:
        allowed = f"ground_truth or none with vehicle.model={config.vehicle.model}"
        refuse("observation.disturbance", "estimated", allowed)
    for reason, keys in _without_effect(config, model).items():
        for key in keys:
            *location, name = key.split(".")
            if key in config.schedules:
                reason = f"has no effect {reason}; write schedules.{key}=null"
                raise BadValue(f"schedules.{key}", f"schedules: {key} {reason}")
            value = getattr(functools.reduce(getattr, location, config), name)
            default = fields_at(Config, location)[name].default
            if value != default:
                refuse(key, value, f"{'null' if default is None else short(default)} {reason}")


def _without_effect(config: Config, model: VehicleModel) -> dict[str, list[str]]:
    """Keys of which only the default is allowed, by the reason."""
    has = {"battery": model.has_battery, "vehicle.residual": model.has_residual}
    has |= {f"disturbance.{key}": model.can_be_disturbed for key in vars(config.disturbance)}
    with_model = [key for key, used in has.items() if not used]
    keys = {f"with vehicle.model={config.vehicle.model}": with_model}
    if config.vehicle.residual is None:
        keys["without vehicle.residual"] = ["vehicle.residual_gain"]
    if config.rules.speed_limit is None:
        keys["without rules.speed_limit"] = ["reward.overspeed", "reward.overspeed_margin"]
    return keys


def check_drone(config: Config) -> None:
    """Check that the drone can hover, and that the integration of its actuators is stable.

    Raises:
        InputError: a constant, a factor of the mismatch, or a population with which it cannot.
    """
    model, constants = vehicle_model(config.vehicle.model), config.vehicle.constants
    factors = config.vehicle.mismatch
    sections = {"randomization.constants": config.randomization.constants}
    for section, names in (sections | {"vehicle.mismatch": factors}).items():
        for name in (name for name in names if name not in model.constant_names):
            hint, listed = close_match(name, model.constant_names), ", ".join(model.constant_names)
            key = f"{section}.{name}"
            raise BadValue(key, f"unknown key {key}{hint}; allowed there: {listed}")
    _check_population(config, model)
    _check_signs(model, constants)
    simulated = {name: value * factors.get(name, 1.0) for name, value in constants.items()}
    _check_thrust(model, constants, "")
    _check_thrust(model, simulated, " times vehicle.mismatch")
    step = config.rules.time_step
    for name in model.lags:
        if simulated[name] <= 0.5 * step:
            key = f"vehicle.constants.{name}{' times its mismatch' if name in factors else ''}"
            unstable = f"half of rules.time_step {step} s (integration is unstable below)"
            refuse(key, simulated[name], f"above {0.5 * step:g} s, {unstable}")


def _check_population(config: Config, model: VehicleModel) -> None:
    """Check that the model has the population, and that no fraction is drawn besides it."""
    population = config.randomization.population
    if population is None:
        return
    if population not in model.populations:
        allowed = " or ".join(["null", *model.populations])
        hint = close_match(population, list(model.populations))
        refuse("randomization.population", population, f"{allowed} with model {model.name}{hint}")
    for name, fraction in config.randomization.by_constant(model).items():
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
            allowed = f"at most {others:g}, the sum of the other moments of inertia"
            refuse(f"vehicle.constants.{name}", largest, allowed)


def _check_thrust(model: VehicleModel, values: Values, origin: str) -> None:
    """Check that the commands reach from below to above the weight."""
    idle = {**values, **{high: values[low] for low, high in model.ranges}}
    lowest, highest = (model.thrust_to_weight(model.make_constants(x)) for x in (idle, values))
    if lowest is None or highest is None:
        return
    if not lowest < 1 < highest <= MAX_THRUST:
        raise BadValue(
            "vehicle.constants",
            f"vehicle.constants{origin} give a thrust of {lowest:.3g} to {highest:.3g} times the "
            f"weight, allowed: a range around 1, up to {MAX_THRUST:g}, so that the drone can hover",
        )


def _check_rules(config: Config) -> None:
    """Check ranges, and that random tracks have the rules and starts of any track."""
    rules, start = config.rules, config.start
    if start.thrust[0] > start.thrust[1]:
        refuse("start.thrust", start.thrust, "[lowest, highest]")
    if any(low >= high for low, high in rules.bounds or ()):
        refuse("rules.bounds", rules.bounds, "[lowest, highest] for each of x, y and z")
    if config.randomization.tracks is None:
        return
    if start.heading == "inside_turn":
        refuse("start.heading", start.heading, "north with randomization.tracks")
    of_one_track = {"rules.bounds": rules.bounds, "run.start_states": config.run.start_states}
    for key, value in of_one_track.items():
        if value is not None:
            refuse(key, value, "null with randomization.tracks")


def _within(config: Config, position: Sequence[float], ground: bool = False) -> bool:
    """Whether a position is above ground (or on it) and within the rules' limits."""
    limit, box = config.rules.position_limit, config.rules.bounds
    x, y, z = position
    inside = limit is None or max(abs(x), abs(y)) < limit
    z = min(z, -1e-6) if ground else z
    if box is not None:
        inside &= all(low < p < high for p, (low, high) in zip((x, y, z), box, strict=True))
    return inside and (z < 0)


def _check_gates(config: Config) -> None:
    """Check that gates are apart, can be reached, and that the drone fits through them."""
    inflation, radius = config.training_limits.gate_inflation, config.rules.body_radius
    gates, smallest = config.track.gates, 2 * (radius - min(inflation, 0.0))
    for index, gate in enumerate(gates):
        key = f"track.gates[{index}]"
        if min(gate.size) <= max(config.vehicle.width, smallest):
            allowed = f"above vehicle.width {config.vehicle.width:g} and above {smallest:g}"
            limits = "training_limits.gate_inflation and rules.body_radius"
            refuse(f"{key}.size", gate.size, f"{allowed}, of {limits}")
        if gate.shape == "circle" and gate.size[0] != gate.size[1]:
            refuse(f"{key}.size", gate.size, "[diameter, diameter] of a circle")
        upright = gate.shape == "rectangle" and gate.pitch_deg == gate.roll_deg == 0
        if config.rules.gate_test == "world_box" and not upright:
            refuse("rules.gate_test", "world_box", f"square, because {key} is tilted or round")
        if not _within(config, gate.position):
            allowed = "z below 0 (above ground), within rules.bounds and rules.position_limit"
            refuse(f"{key}.position", gate.position, allowed)
        before = gates[index - 1].position
        if (index or config.track.closed) and math.dist(before, gate.position) < SMALLEST_LEG:
            allowed = "another place than the gate before it" + " (itself)" * (len(gates) == 1)
            refuse(f"{key}.position", gate.position, allowed)


def _check_race_start(config: Config) -> None:
    """Check the start of timed laps, and that a course has one lap and a start.

    The start is in the air, or on the ground with ``rules.ground_speed``, and within the bounds.
    """
    start = config.track.start
    if not config.track.closed:
        if config.evaluate.laps != 1:
            refuse("evaluate.laps", config.evaluate.laps, "1 with track.closed false")
        if config.evaluate.gates is not None:
            refuse("evaluate.gates", config.evaluate.gates, "null with track.closed false")
        if start is None:
            refuse("track.start", None, "{position, yaw_deg} with track.closed false")
    if start is None:
        return
    on_ground = start.position[2] == 0 and config.rules.ground_speed is not None
    if not _within(config, start.position, on_ground):
        allowed = "above ground (on it with rules.ground_speed) and within the rules' limits"
        refuse("track.start.position", start.position, allowed)
