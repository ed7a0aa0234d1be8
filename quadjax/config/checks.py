"""Checks that involve several keys of a config.

Those of the race are of the first and of the last values of its schedules. One field is checked
where it is declared, code where it is imported (``core.imports``), files where they are read.
"""

import functools
import math
from collections.abc import Sequence

from quadjax.config.drone import check_drone
from quadjax.config.scales import SHORTEST_LEG_M
from quadjax.config.schema import Config, Schedule
from quadjax.core.errors import InputError, close_match, prefixed, short
from quadjax.core.section_keys import fields_at, value_at
from quadjax.core.sections import BadValue, Needs, refuse
from quadjax.core.yaml_files import flatten
from quadjax.learners.schedules import Curriculum
from quadjax.race.draws import Randomization
from quadjax.race.random_track import MAX_COORDINATE_M
from quadjax.race.track import check_lap
from quadjax.race.types import describe_dependents
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import base_model

MAX_EULER_PITCH_DEG = 89.0  # largest pitch of a start with Euler angles
NEEDS = {  # keys that have an effect only with another one, which their fields name
    f"{section}.{key}": item.key
    for section in Config.model_fields
    for key, field in fields_at(Config, [section]).items()
    for item in field.metadata
    if isinstance(item, Needs)
}
GROUPS = [x for x, f in Randomization.model_fields.items() if f.default == 0.0 and x != "all"]
GROUP_KEYS = [f"randomization.{group}" for group in GROUPS]
CURRICULUM = [f"curriculum.{name}" for name in Curriculum.model_fields]


def check(config: Config) -> None:
    """Reject combinations of values that are impossible.

    Raises:
        InputError: one line that names the key, its value and what is allowed.
    """
    for key, schedule in config.schedules.items():
        _check_schedule(config, key, schedule)
    if config.network.module and config.network.normalize:
        refuse("network.normalize", True, "false with network.module")
    step, delay = config.rules.time_step, config.vehicle.delay
    if delay is not None and delay[1] > step:
        refuse("vehicle.delay", list(delay), f"at most rules.time_step, {step:g} s")
    _check_effects(config)
    _check_observation(config)
    last = with_scheduled_values(config)
    for race in (with_scheduled_values(config, 0), last):
        check_drone(race)
        _check_track(race)
        for index in range(len(race.track.gates)):
            _check_gate(race, index)
    if config.run.score != "reward":
        check_lap(config.track)
    reward, inflation = last.reward, last.training_limits.gate_inflation
    if inflation > 0 and not (reward.gate_edge > 0 or reward.gate_offset > 0):
        allowed = "at most 0 without reward.gate_edge or reward.gate_offset"
        refuse("training_limits.gate_inflation", inflation, allowed)


def with_body(config: Config, radius: float) -> Config:
    """The race of a drone with a radius, m, with gates tested where the flight crosses them.

    Raises:
        InputError: a radius for which an opening is too small.
    """
    with prefixed(f"a body radius of {radius:g} m"):
        rules = config.rules.replace(body_radius=radius or None, gate_test="interpolated")
        config = config.replace(rules=rules)
        check(config)
    return config


def with_scheduled_values(config: Config, index: int = -1) -> Config:
    """The config with the last value of every schedule; with ``index`` 0 the first."""
    for key, schedule in config.schedules.items():
        if schedule.linear[index] != "value":
            config = config.at(key, schedule.linear[index])
    return config


def _similar_keys(config: Config, key: str) -> str:
    """``"; did you mean X?"`` for up to three numbers of the config like a key, or nothing.

    They are of the key's section, or else those of its name in any section, or else of any key.
    """
    tree = flatten(config.model_dump(exclude={"schedules"}))
    keys = [name for name, value in tree.items() if isinstance(value, float)]
    section, _, name = key.rpartition(".")
    if siblings := [x.rpartition(".")[2] for x in keys if x.rpartition(".")[0] == section]:
        return close_match(name, siblings, 3)
    if namesakes := [x for x in keys if x.endswith(f".{key}")]:
        return close_match(namesakes[0], namesakes, 3)
    return close_match(key, keys, 3)


def _check_schedule(config: Config, key: str, schedule: Schedule) -> None:
    """Check that a schedule is of a number, with allowed values, and within the run."""
    name, steps = f"schedules.{key}", config.run.steps
    try:
        value = value_at(config, key)
    except InputError:
        learner = f" with learner.algorithm={config.learner.algorithm}"
        where = learner if key.startswith("learner.") else ""
        raise BadValue(name, f"{name}: no such number{where}{_similar_keys(config, key)}") from None
    try:
        for index, number in enumerate(schedule.linear if isinstance(value, float) else ()):
            where = f"{name}.linear[{index}]"
            if number != "value":
                config.at(key, number)
    except InputError as error:
        raise BadValue(name, f"{where}: {error}") from None
    if value is None:
        allowed = f"a key that the config sets to a number{_similar_keys(config, key)}"
        raise BadValue(name, f"{name}: {key} is null, allowed: {allowed}")
    if not isinstance(value, float):
        raise BadValue(
            name,
            f"{name}: {key} cannot be scheduled, allowed: a key whose value is a number with "
            "decimals, such as reward.gate",
        )
    if key in GROUP_KEYS and "randomization.all" not in config.schedules:
        if max(value if x == "value" else x for x in schedule.linear) <= config.randomization.all:
            refuse(f"{name}.linear", list(schedule.linear), "values above randomization.all")
    random_tracks, battery = config.randomization.tracks is not None, config.battery is not None
    if needs := describe_dependents(key, random_tracks=random_tracks, battery=battery):
        raise BadValue(name, f"{name}: {key} cannot be scheduled: {needs} computed from it")
    for end, time in (("from", schedule.start), ("until", schedule.until)):
        if time > 1 and schedule.by == "pass_rate":
            refuse(f"{name}.{end}", time, "a level up to 1 with by: pass_rate")
        if time > 1 and time > steps:
            allowed = f"at most run.steps {steps}, or a fraction of the run up to 1"
            refuse(f"{name}.{end}", f"{time:g} steps", allowed)
    begin, *_, last = schedule.knots(steps, steps)
    if begin > last:
        refuse(f"{name}.from", schedule.start, f"before until {schedule.until:g}")


def _check_observation(config: Config) -> None:
    """Check that observed constants are drawn."""
    draws = config.randomization
    random = draws.population or any(draws.by_constant(base_model(config.vehicle.model)).values())
    if config.observation.critic_constants and not random:
        allowed = "false where randomization draws none (randomization.all=0.2 draws them)"
        refuse("observation.critic_constants", True, allowed)


def _check_effects(config: Config) -> None:
    """Check that each key has an effect, and that the model has what the config asks for."""
    name, model = config.vehicle.model, base_model(config.vehicle.model)
    if config.observation.disturbance == "estimated" and not model.can_be_disturbed:
        allowed = f"ground_truth or none with vehicle.model={name}"
        refuse("observation.disturbance", "estimated", allowed)
    for key, needed in NEEDS.items():
        if not _value(config, needed) and needed not in config.schedules:
            _check_is_default(config, key, f"without {needed}")
    of_disturbance = [f"disturbance.{key}" for key in vars(config.disturbance)]
    others = [f"randomization.{group}" for group in GROUPS if group not in model.groups]
    scheduled = [x for x in config.schedules if x.startswith("randomization.")]
    drawn = config.randomization.drawn or scheduled not in ([], ["randomization.width"])
    by_level = any(schedule.by == "pass_rate" for schedule in config.schedules.values())
    own_start = type(model).start_actuators is not VehicleModel.start_actuators
    for used, reason, keys in (
        (model.has_battery, f"with vehicle.model={name}", ["battery"]),
        (model.has_residual, f"with vehicle.model={name}", ["vehicle.residual"]),
        (model.can_be_disturbed, f"with vehicle.model={name}", of_disturbance),
        (not others, f"with vehicle.model={name}", others),
        (own_start, f"with vehicle.model={name}", ["start.thrust"]),
        (drawn, "where randomization draws no constants", ["randomization.width"]),
        (by_level, "without a schedule with by: pass_rate", CURRICULUM),
    ):
        for key in () if used else keys:
            _check_is_default(config, key, reason)


def _value(config: Config, key: str) -> object:
    """A value, or a section, of a config by its dotted key."""
    return functools.reduce(getattr, key.split("."), config)


def _check_is_default(config: Config, key: str, reason: str) -> None:
    """Refuse another value than the default of a key without effect."""
    if key in config.schedules:
        reason = f"has no effect {reason}; write schedules.{key}=null"
        raise BadValue(f"schedules.{key}", f"schedules: {key} {reason}")
    *location, name = key.split(".")
    value, default = _value(config, key), fields_at(Config, location)[name].default
    if value != default:
        refuse(key, value, f"{short(default)} {reason}")


def _check_track(config: Config) -> None:
    """Check the rules and starts of random tracks, and the start of timed laps.

    A course has one lap and a start. The start is in the air, or on the ground with
    ``rules.ground_speed``, and within the bounds.
    """
    rules, start, track, laps = config.rules, config.start, config.track, config.evaluate
    if start.roll_pitch_deg > MAX_EULER_PITCH_DEG and not config.vehicle.quaternion:
        allowed = f"at most {MAX_EULER_PITCH_DEG:g} without vehicle.quaternion"
        refuse("start.roll_pitch_deg", start.roll_pitch_deg, allowed)
    for index, (low, high) in enumerate(rules.bounds or ()):
        if low >= high:
            refuse(f"rules.bounds[{index}]", [low, high], "[lowest, highest], which differ")
    if config.randomization.tracks is not None:
        if start.heading == "inside_turn":
            refuse("start.heading", start.heading, "north with randomization.tracks")
        if rules.bounds is not None:
            refuse("rules.bounds", rules.bounds, "null with randomization.tracks")
    if not track.closed:
        if laps.laps != 1:
            refuse("evaluate.laps", laps.laps, "1 with track.closed false")
        if laps.gates is not None:
            refuse("evaluate.gates", laps.gates, "null with track.closed false")
        if track.start is None:
            refuse("track.start", None, "{position, yaw_deg} with track.closed false")
    if track.start is not None:
        on_ground = track.start.position[2] == 0 and rules.ground_speed is not None
        _check_place(config, "track.start.position", track.start.position, on_ground)


def _check_place(config: Config, key: str, place: Sequence[float], ground: bool = False) -> None:
    """Check that a position is above ground (or on it) and within the rules' limits."""
    limit, (x, y, z) = config.rules.position_limit, place
    z, far = min(z, -1e-6) if ground else z, max(abs(x), abs(y))
    if z >= 0:
        refuse(key, place, "z below 0 (above ground; 0 at a start with rules.ground_speed)")
    if limit is not None and far >= limit:
        room = f"{1.5 * far:g}" if 1.5 * far <= MAX_COORDINATE_M else "null"
        remedy = f"a track file may set rules: {{position_limit: {room}}}"
        refuse(key, place, f"|x| and |y| below rules.position_limit, {limit:g} m; {remedy}")
    for axis, p, (low, high) in zip("xyz", (x, y, z), config.rules.bounds or (), strict=False):
        if not low < p < high:
            refuse(key, place, f"{axis} within rules.bounds, {low:g} to {high:g} m")


def _check_gate(config: Config, index: int) -> None:
    """Check that a gate is apart from others, can be reached, and that the drone fits through."""
    inflation, radius = config.training_limits.gate_inflation, config.rules.body_radius
    gates, gate, key = config.track.gates, config.track.gates[index], f"track.gates[{index}]"
    half, narrower = 0.5 * min(gate.size), max(-inflation, 0.0)
    of_gate = f"of {key}.size {short(gate.size)}"
    if radius and radius + narrower >= half:
        taken = f" less training_limits.gate_inflation {inflation:g}" if narrower else ""
        refuse("rules.body_radius", radius, f"below {half - narrower:g}, half {of_gate}{taken}")
    if narrower >= half:
        refuse("training_limits.gate_inflation", inflation, f"above {-half:g}, half {of_gate}")
    if 2.0 * half <= (width := config.vehicle.width):
        drone = f"vehicle.width of {config.vehicle.name}"
        refuse(f"{key}.size", gate.size, f"sides above {width:g} m, {drone}")
    if gate.shape == "circle" and gate.size[0] != gate.size[1]:
        refuse(f"{key}.size", gate.size, "[diameter, diameter] of a circle")
    upright = gate.shape == "rectangle" and gate.pitch_deg == gate.roll_deg == 0
    if config.rules.gate_test == "world_box" and not upright:
        refuse("rules.gate_test", "world_box", f"square, because {key} is tilted or round")
    _check_place(config, f"{key}.position", gate.position)
    before = gates[index - 1].position
    follows = index > 0 or (config.track.closed and len(gates) > 1)
    if follows and math.dist(before, gate.position) < SHORTEST_LEG_M:
        refuse(f"{key}.position", gate.position, "another place than the gate before it")
