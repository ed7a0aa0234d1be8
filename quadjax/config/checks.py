"""Checks that involve several keys of a config, once of its values and once of its last ones."""

import math
from collections.abc import Sequence

from quadjax.config.drone_checks import check_drone
from quadjax.config.schema import Config, Randomization, Schedule
from quadjax.core.errors import InputError, short
from quadjax.core.sections import BadValue, refuse, value_at
from quadjax.race.layout import LONGEST
from quadjax.race.observations import ACTUATORS, remembered_names
from quadjax.vehicle.registry import model as vehicle_model

NOT_GROUPS = ("all", "constants", "population", "width", "tracks")  # keys of randomization
SMALLEST_LEG = 0.01  # m


def check(config: Config) -> None:
    """Reject combinations of values that are impossible.

    Raises:
        InputError: one line that names the key, its value and what is allowed.
    """
    _check_run(config)
    _check_schedules(config)
    _check_effects(config)
    _check_observation(config)
    last = at_end(config)
    for race in (_with_scheduled(config, 0), last):
        check_drone(race)
        _check_gates(race)
        _check_random_tracks(race)
        _check_race_start(race)
        _check_start(race)
    _check_gate_penalty(last)


def with_body(config: Config, radius: float) -> Config:
    """The race of a drone with a radius, m, with gates tested where the flight crosses them.

    Raises:
        InputError: a radius for which an opening is too small.
    """
    rules = config.rules.replace(body_radius=radius, gate_test="interpolated")
    config = config.replace(rules=rules)
    check(config)
    return config


def at_end(config: Config) -> Config:
    """The config with the last value of every schedule."""
    return _with_scheduled(config, -1)


def _with_scheduled(config: Config, index: int) -> Config:
    for key, schedule in config.schedules.items():
        if schedule.linear[index] != "value":
            config = config.at(key, schedule.linear[index])
    return config


def _check_run(config: Config) -> None:
    low, high = config.start.thrust
    if low > high:
        refuse("start.thrust", config.start.thrust, "[lowest, highest]")
    for low, high in config.rules.bounds or ():
        if low >= high:
            refuse("rules.bounds", config.rules.bounds, "[lowest, highest] for each of x, y and z")


def _check_schedules(config: Config) -> None:
    """Check that schedules are of numbers, with allowed values, and within the run."""
    for key, schedule in config.schedules.items():
        try:
            value = value_at(config, key, missing=None)
        except InputError as error:
            raise BadValue(f"schedules.{key}", f"schedules: {error}") from None
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
    """Check that the model has what the config asks for."""
    model, vehicle = vehicle_model(config.vehicle.model), config.vehicle
    with_model = f"with vehicle.model={vehicle.model}"
    for group in model.groups:
        if group not in Randomization.model_fields or group in NOT_GROUPS:
            allowed = [name for name in Randomization.model_fields if name not in NOT_GROUPS]
            raise BadValue(
                "vehicle.model",
                f"vehicle.model is {vehicle.model}: its groups name {group!r}, allowed: the keys "
                f"of randomization: {', '.join(allowed)}",
            )
    if config.battery is not None and not model.has_battery:
        refuse("battery.charge", list(config.battery.charge), f"no battery (null) {with_model}")
    if vehicle.residual is not None and not model.has_residual:
        refuse("vehicle.residual", vehicle.residual, f"null {with_model}")
    if vehicle.residual is None and "vehicle.residual_gain" in config.schedules:
        raise BadValue(
            "schedules.vehicle.residual_gain",
            "schedules: vehicle.residual_gain has no effect without vehicle.residual; write "
            "schedules.vehicle.residual_gain=null",
        )
    if vehicle.residual is None and vehicle.residual_gain != 1.0:
        refuse("vehicle.residual_gain", vehicle.residual_gain, "1.0 without vehicle.residual")
    for key, value in config.disturbance.model_dump().items():
        if not model.can_be_disturbed and value != type(config.disturbance)().model_dump()[key]:
            refuse(f"disturbance.{key}", value, f"0 {with_model}")
    if config.observation.disturbance == "estimated" and not model.can_be_disturbed:
        refuse("observation.disturbance", "estimated", f"ground_truth or none {with_model}")
    for key in ("overspeed", "overspeed_margin"):
        value, default = getattr(config.reward, key), type(config.reward).model_fields[key].default
        if config.rules.speed_limit is None and value != default:
            refuse(f"reward.{key}", value, f"{default} without rules.speed_limit")


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


def _check_random_tracks(config: Config) -> None:
    """Check that the random tracks of training fit the starts and the rules."""
    tracks, frame = config.randomization.tracks, config.rules.gate_frame
    if tracks is None:
        return
    if frame > tracks.frame:
        refuse("rules.gate_frame", frame, f"at most {tracks.frame:g}, randomization.tracks.frame")
    if config.start.position >= tracks.height[0]:
        lowest = f"below {tracks.height[0]:g}, the lowest gate of randomization.tracks"
        refuse("start.position", config.start.position, lowest)
    if config.start.heading == "inside_turn":
        refuse("start.heading", config.start.heading, "north with randomization.tracks")
    for key, value in (
        ("rules.bounds", config.rules.bounds),
        ("run.start_states", config.run.start_states),
    ):
        if value is not None:
            refuse(key, value, "null with randomization.tracks")


def _check_race_start(config: Config) -> None:
    """Check that timed laps start in the air and within the bounds."""
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


def _check_start(config: Config) -> None:
    """Check that starts are within the limits."""
    start, training, gates = config.start, config.training_limits, config.track.gates
    limit, rates = config.rules.position_limit, min(config.rules.largest_body_rates)
    pitch = training.largest_pitch_deg(vehicle_model(config.vehicle.model))
    for index in range(len(gates)) if start.gate == "random" else [len(gates) - 1]:
        x, y, z = gates[index].position
        room = -z if limit is None else min(-z, limit - abs(x), limit - abs(y))
        if start.position >= room:
            places = f"between track.gates[{index}] and the ground or rules.position_limit"
            refuse("start.position", start.position, f"below {room:g}, the room {places}")
    for key, value, name, limit in (
        ("roll_pitch_deg", start.roll_pitch_deg, "training_limits.pitch_deg", pitch),
        ("roll_pitch_deg", start.roll_pitch_deg, "training_limits.roll_deg", training.roll_deg),
        ("body_rates", start.body_rates, "rules.body_rate_limit", rates),
        ("body_rates", start.body_rates, "training_limits.yaw_rate", training.yaw_rate),
    ):
        if limit is not None and value >= limit:
            refuse(f"start.{key}", value, f"below {name} {limit:g}")


def _check_gate_penalty(config: Config) -> None:
    """Check that widened gates have a penalty, which depends on the distance to the edge."""
    reward, inflation = config.reward, config.training_limits.gate_inflation
    if inflation > 0 and not (reward.gate_edge > 0 or reward.gate_offset > 0):
        allowed = "at most 0 without reward.gate_edge or reward.gate_offset"
        refuse("training_limits.gate_inflation", inflation, allowed)
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    half -= config.rules.body_radius
    if reward.gate_edge > 0 and reward.gate_edge_margin >= half:
        refuse("reward.gate_edge_margin", reward.gate_edge_margin, f"below {half:g}")
