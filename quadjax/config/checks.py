"""Checks that involve several keys of a config."""

import math
from collections.abc import Callable

import jax

from quadjax.config.drone_checks import GRAVITY, LEAST_TURN, check_drone, episode_seconds, refuse
from quadjax.config.gate_checks import check_bounds, check_openings, check_random_tracks, within
from quadjax.config.schema import Config, Randomization, Schedule
from quadjax.core.errors import InputError, prefixed
from quadjax.core.sections import value_at
from quadjax.core.yaml_files import short
from quadjax.race.history import LONGEST
from quadjax.race.layout import ACTUATORS, remembered_names
from quadjax.vehicle.protocol import Constants, VehicleModel
from quadjax.vehicle.registry import model as vehicle_model

RANDOMIZED = (
    "all",
    "constants",
    "population",
    "width",
    "tracks",
)  # keys of randomization that are not groups of constants
RATE, SMALLEST_LEG = "learner.learning_rate", 0.01  # m
GATE_PENALTIES = ("reward.gate_edge", "reward.gate_offset")


def check(config: Config) -> None:
    """Reject combinations of values that are impossible or have no effect.

    Raises:
        InputError: one line that names the key, its value and what is allowed.
    """
    _check_run(config)
    _check_model(config)
    _check_schedules(config)
    _check_learner(config)
    _check_critic(config)
    _check_history(config)
    for test in TESTS:
        _check_values(config, test)
    _check_used(at_end(config))


def with_body(config: Config, radius: float) -> Config:
    """The race of a drone with a radius, m, with gates tested where the flight crosses them.

    Raises:
        InputError: a radius for which an opening is too small.
    """
    config = config.replace(
        rules=config.rules.replace(body_radius=radius, gate_test="interpolated")
    )
    check(config)
    return config


def at_end(config: Config) -> Config:
    """The config with the last value of every schedule."""
    for key, schedule in config.schedules.items():
        if schedule.linear[-1] != "value":
            config = config.at(key, schedule.linear[-1])
    return config


def _check_values(config: Config, test: Callable[[Config], None]) -> None:
    """Apply a check to the config, to every value of every schedule, and to the last values."""
    last = at_end(config)
    base = config
    try:
        test(config)
    except InputError:  # no error if the schedules never use the key's own value
        test(last)
        base = last
    for key, schedule in config.schedules.items():
        for value in schedule.linear:
            no_penalty = key in GATE_PENALTIES and value == 0  # the schedule adds the penalty
            early = schedule.by == "pass_rate"  # wide gates before the penalty has its full weight
            if value == "value" or ((no_penalty or early) and test is _check_gate_edge):
                continue
            with prefixed(f"schedules.{key}"):
                test(base.at(key, value))
    test(last)


def _check_model(config: Config) -> None:
    allowed = [name for name in Randomization.model_fields if name not in RANDOMIZED]
    for group in vehicle_model(config.vehicle.model).groups:
        if group not in allowed:
            raise InputError(
                f"vehicle.model is {config.vehicle.model}: its groups name {group!r}, allowed: "
                f"the keys of randomization: {', '.join(allowed)}"
            )


def _check_run(config: Config) -> None:
    shards = config.run.shards
    if shards & (shards - 1):
        refuse("run.shards", shards, "a power of two")
    low, high = config.start.thrust
    if low > high:
        refuse("start.thrust", config.start.thrust, "[lowest, highest]")


def _check_learner(config: Config) -> None:
    """Check that the policy is trained at all."""
    own = getattr(config.learner, "learning_rate", None)
    rates = config.schedules[RATE].linear if RATE in config.schedules else ("value",)
    if own is not None and not any(own if rate == "value" else rate for rate in rates):
        refuse(RATE, own, "above 0, as the policy learns nothing")
    warmup = getattr(config.learner, "critic_warmup", None) or 0
    sizes = (getattr(config.learner, key, 1) for key in ("num_envs", "horizon", "rollout_length"))
    updates = max(1, math.ceil(config.run.steps / math.prod(sizes)))
    if warmup > updates:
        refuse(
            "learner.critic_warmup",
            warmup,
            f"at most {updates}, the updates of run.steps {config.run.steps}",
        )


def _check_critic(config: Config) -> None:
    """Check that constants are drawn where the critic observes them."""
    own, model = config.randomization, vehicle_model(config.vehicle.model)
    drawn = own.population is not None or any(own.by_constant(model).values())
    observed = config.observation
    for key in ("constants", "critic_constants"):
        if getattr(observed, key) and not drawn:
            most = "false where randomization draws none (randomization.all=0.2 draws them)"
            refuse(f"observation.{key}", True, most)
    if observed.constants and observed.critic_constants:
        refuse("observation.critic_constants", True, "false with observation.constants")


def _check_history(config: Config) -> None:
    """Check which fields have a history, and how long it is."""
    past = config.observation.history
    if past is None:
        return
    model = vehicle_model(config.vehicle.model)
    allowed = remembered_names(model, config.observation.attitude)
    names = list(past.fields)
    meant = {model.actuators.name if name == ACTUATORS else name for name in names}
    if not names or len(meant) < len(names) or set(names) - set(allowed):
        listed = f"one or more of {', '.join(allowed)}, each once"
        refuse("observation.history.fields", names, listed)
    if past.steps * past.every > LONGEST:
        most = LONGEST // past.every
        refuse("observation.history.steps", past.steps, f"at most {most} with every {past.every}")


def _check_schedules(config: Config) -> None:
    for key, schedule in config.schedules.items():
        own = _value_at(config, key)
        if not isinstance(own, float) or isinstance(own, bool):
            raise InputError(f"schedules: {key} is {short(own)}, allowed: the key of a number")
        _check_times(config, key, schedule)
        default = _value_at(_defaults(config), key)
        if "value" not in schedule.linear and own not in (default, *schedule.linear):
            refuse(
                key,
                own,
                f"a value of its schedule {short(schedule.linear)}, as it would have no effect; "
                f"write schedules.{key}.linear, with value for the key's own",
            )
        for value in schedule.linear:
            if value != "value":
                with prefixed(f"schedules.{key}"):
                    config.at(key, value)


def _defaults(config: Config) -> Config:
    return Config.model_construct(track=config.track, learner=type(config.learner)())


def _value_at(config: Config, key: str) -> object:
    """The value at a schedule's key; None for a factor that a mapping does not list."""
    with prefixed("schedules"):
        return value_at(config, key, missing=None)


def _check_times(config: Config, key: str, schedule: Schedule) -> None:
    """Check that a schedule begins before it ends, and ends within the run."""
    steps = config.run.steps
    if schedule.by == "pass_rate" and max(schedule.start, schedule.until) > 1:
        refuse(f"schedules.{key}", short(schedule.model_dump(by_alias=True)), "levels up to 1")
    for name, time in (("from", schedule.start), ("until", schedule.until)):
        if time > 1 and time > steps:
            refuse(
                f"schedules.{key}.{name}",
                f"{time:g} steps",
                f"at most run.steps {steps}; write a fraction of the run ({name}: "
                f"{0.5 if name == 'until' else 0.25}) or fewer steps",
            )
    begin, *_, end = schedule.knots(steps, steps)
    if begin > end:
        refuse(f"schedules.{key}.from", schedule.start, f"before until {schedule.until:g}")


def _check_gates(config: Config) -> None:
    """Check that gates can be reached and passed."""
    limit, inflation = config.rules.position_limit, config.training_limits.gate_inflation
    width = config.vehicle.width
    for index, gate in enumerate(config.track.gates):
        key = f"track.gates[{index}]"
        if min(gate.size) <= width:
            refuse(f"{key}.size", gate.size, f"above vehicle.width {width:g}")
        upright = gate.shape == "rectangle" and gate.pitch_deg == gate.roll_deg == 0
        if config.rules.gate_test == "world_box" and not upright:
            refuse("rules.gate_test", "world_box", f"square, because {key} is tilted or round")
        if gate.shape == "circle" and gate.size[0] != gate.size[1]:
            refuse(f"{key}.size", gate.size, "[diameter, diameter] of a circle")
        x, y, z = gate.position
        if limit is not None and max(abs(x), abs(y)) >= limit:
            refuse(
                f"{key}.position", gate.position, f"|x| and |y| below rules.position_limit {limit}"
            )
        if z >= 0:
            refuse(f"{key}.position", gate.position, "z below 0 (above ground)")
        if not within(config, gate.position):
            refuse(f"{key}.position", gate.position, f"within rules.bounds {config.rules.bounds}")
        radius = config.rules.body_radius
        least = 2 * (radius - min(inflation, 0.0))
        if min(gate.size) <= least:
            allowed = f"above {least:g} with training_limits.gate_inflation {inflation}"
            body = f" and rules.body_radius {radius}" if radius else ""
            refuse(f"{key}.size", gate.size, allowed + body)


def _check_race_start(config: Config) -> None:
    """Check that timed laps start in the air and within the bounds."""
    start, limit = config.track.start, config.rules.position_limit
    if not config.track.closed and config.evaluate.laps != 1:
        refuse("evaluate.laps", config.evaluate.laps, "1 with track.closed false")
    if not config.track.closed and config.evaluate.gates is not None:
        refuse("evaluate.gates", config.evaluate.gates, "null with track.closed false")
    if start is None:
        if not config.track.closed:
            refuse("track.start", None, "{position, yaw_deg} with track.closed false")
        return
    x, y, z = start.position
    outside = limit is not None and max(abs(x), abs(y)) >= limit
    beneath = z >= 0 if config.rules.ground_speed is None else z > 0
    if beneath or outside or not within(config, (x, y, min(z, -1e-6))):
        allowed = "above ground (on it with rules.ground_speed) and within the rules' limits"
        refuse("track.start.position", start.position, allowed)


def _check_start(config: Config) -> None:
    """Check that starts are within the limits, and that the next gate can be reached in time."""
    start, training, gates = config.start, config.training_limits, config.track.gates
    limit, rates = config.rules.position_limit, min(config.rules.largest_body_rates)
    pitch = training.largest_pitch_deg(vehicle_model(config.vehicle.model))
    speed = config.rules.speed_limit
    component = None if speed is None else speed / math.sqrt(3)
    places = range(len(gates)) if start.gate == "random" else [len(gates) - 1]
    for index in places:
        x, y, z = gates[index].position
        room = -z if limit is None else min(-z, limit - abs(x), limit - abs(y))
        if start.position >= room:
            refuse(
                "start.position",
                start.position,
                f"below {room:g}, the room between track.gates[{index}] and the ground or "
                "rules.position_limit",
            )
    for key, value, name, most in (
        ("roll_pitch_deg", start.roll_pitch_deg, "training_limits.pitch_deg", pitch),
        ("roll_pitch_deg", start.roll_pitch_deg, "training_limits.roll_deg", training.roll_deg),
        ("body_rates", start.body_rates, "rules.body_rate_limit", rates),
        ("body_rates", start.body_rates, "training_limits.yaw_rate", training.yaw_rate),
        ("velocity", start.velocity, "rules.speed_limit / sqrt(3),", component),
    ):
        if most is not None and value >= most:
            refuse(f"start.{key}", value, f"below {name} {most:g}")


def _check_motion(config: Config) -> None:
    """Check the start's velocity and thrust, and the limit of body rates, against the drone."""
    model, constants = vehicle_model(config.vehicle.model), config.vehicle.constants
    start, seconds = config.start, episode_seconds(config)
    if model.thrust_to_weight is not None:
        fastest = (model.thrust_to_weight(constants) + 1.0) * GRAVITY * seconds
        if start.velocity > fastest:
            refuse(
                "start.velocity",
                start.velocity,
                f"at most {fastest:.3g} m/s, to which the drone accelerates in an episode",
            )
    own = model.constants(**constants)
    for axis, rate in zip("xyz", _largest_rates(model, own), strict=True):
        if 0.0 < rate * seconds < LEAST_TURN:
            raise InputError(
                f"vehicle.constants give a largest commanded rate of {rate:.2g} rad/s about "
                f"{axis}, allowed: at least {LEAST_TURN / seconds:.2g} rad/s (it cannot turn below)"
            )
    if model.uses_start_thrust:
        low, high = (float(x) for x in model.actuator_range(own))
        if start.thrust[0] < low or start.thrust[1] > high:
            refuse("start.thrust", start.thrust, f"within {low:g} to {high:g} m/s², the commands")
    limits, shown = config.rules.largest_body_rates, config.rules.body_rate_limit
    for limit, commanded in zip(limits, _largest_rates(model, own), strict=True):
        if limit <= commanded:
            refuse("rules.body_rate_limit", shown, f"above {commanded:g}, the largest command")
    if max(limits) * seconds < LEAST_TURN:
        refuse(
            "rules.body_rate_limit",
            shown,
            f"at least {LEAST_TURN / seconds:.2g} rad/s (the drone cannot turn below)",
        )


def _largest_rates(model: VehicleModel, constants: Constants) -> tuple[float, ...]:
    """The largest commanded body rates (3,), rad/s; 0 of a model that commands none."""
    begin = 0
    for signal in model.commands:
        if signal.name == "body_rates":
            _, high = model.command_range(constants)
            return tuple(float(x) for x in jax.tree.leaves(high)[begin : begin + signal.size])
        begin += signal.size
    return (0.0, 0.0, 0.0)


def _check_legs(config: Config) -> None:
    """Check that following gates are apart, and within reach in the time of an episode."""
    start, training, track = config.start, config.training_limits, config.track
    gates, model = track.gates, vehicle_model(config.vehicle.model)
    first = 0 if track.closed else 1
    seconds = training.episode_steps * config.rules.time_step
    for index in range(first, len(gates)):
        here, there = gates[index - 1].position, gates[index].position
        leg = math.dist(here, there)
        if leg < SMALLEST_LEG:
            refuse(
                f"track.gates[{index}].position",
                there,
                "another place than the gate before it" + (" (itself)" * (len(gates) == 1)),
            )
        if model.thrust_to_weight is None:
            continue
        fall = 0.5 * GRAVITY * seconds**2
        thrust = model.thrust_to_weight(config.vehicle.constants)
        reach = math.sqrt(3) * (start.position + start.velocity * seconds) + thrust * fall
        # Thrust and gravity carry the drone into a ball about the point of free fall.
        if math.dist((here[0], here[1], here[2] + fall), there) > reach:
            refuse(
                "training_limits.episode_steps",
                training.episode_steps,
                f"more: in {seconds:g} s the drone can move {reach:.2g} m, and track.gates[{index}]"
                f" is {leg:.2g} m from the gate before it",
            )


def _check_gate_edge(config: Config) -> None:
    """Check that widened gates have a penalty, which depends on the distance to the edge."""
    reward, inflation = config.reward, config.training_limits.gate_inflation
    if inflation > 0 and not (reward.gate_edge > 0 or reward.gate_offset > 0):
        refuse(
            "training_limits.gate_inflation",
            inflation,
            "at most 0 without reward.gate_edge or reward.gate_offset",
        )
    if reward.gate_edge == 0:
        return
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    half -= config.rules.body_radius
    if reward.gate_edge_margin >= half:
        refuse("reward.gate_edge_margin", reward.gate_edge_margin, f"below {half:g}")


def _check_used(config: Config) -> None:
    """Reject values that have no effect."""
    model, defaults = vehicle_model(config.vehicle.model), _defaults(config)
    with_model = f"with vehicle.model={config.vehicle.model}"
    unused: dict[str, str] = {}
    if config.battery is not None and not model.has_battery:
        refuse("battery.charge", list(config.battery.charge), f"no battery (null) {with_model}")
    if config.battery is None:
        unused["observation.highest_rpm"] = "without battery"
    if not config.observation.actuators:
        unused["observation.actuator_range"] = "with observation.actuators=false"
    if config.run.start_states is None:
        unused["run.start_states_part"] = "without run.start_states"
    elif config.randomization.tracks is not None:
        refuse("run.start_states", config.run.start_states, "null with randomization.tracks")
    if not model.has_residual:
        unused["vehicle.residual"] = with_model
    if config.vehicle.residual is None:
        unused["vehicle.residual_gain"] = "without vehicle.residual"
    if model.disturbance is None:
        unused |= {
            f"disturbance.{key}": with_model for key in type(config.disturbance).model_fields
        }
        unused["observation.disturbance"] = with_model
    for group in Randomization.model_fields:
        if group not in (*RANDOMIZED, *model.groups):
            unused[f"randomization.{group}"] = with_model
    if not config.randomization.drawn and not any(
        key.startswith("randomization.") and key != "randomization.width"
        for key in config.schedules
    ):
        unused["randomization.width"] = "without randomized constants"
    if not model.uses_start_thrust:
        unused["start.thrust"] = with_model
    if config.reward.perception == 0 and "reward.perception" not in config.schedules:
        unused["reward.perception_deg"] = unused["reward.camera_deg"] = "without reward.perception"
    if config.evaluate.gates is not None:
        unused["evaluate.laps"] = "with evaluate.gates"
    if config.rules.ground_speed is None:
        unused["rules.ground_height"] = "without rules.ground_speed"
    if config.rules.speed_limit is None:
        unused |= dict.fromkeys(
            ("reward.overspeed", "reward.overspeed_margin"), "without rules.speed_limit"
        )
    if config.rules.gate_frame == 0:
        unused["rules.gate_depth"] = "without rules.gate_frame"
    if config.reward.gate_edge == 0 and "reward.gate_edge" not in config.schedules:
        unused["reward.gate_edge_margin"] = "without reward.gate_edge"
        unused["reward.gate_edge_reach"] = "without reward.gate_edge"
    for key, reason in unused.items():
        if key in config.schedules:
            raise InputError(f"schedules: {key} has no effect {reason}; write schedules.{key}=null")
        value, default = value_at(config, key), value_at(defaults, key, missing=None)
        if value != default:
            shown = "null" if default is None else short(default)
            refuse(key, value, f"{shown} {reason}, as it would have no effect")
    if config.observation.disturbance == "estimated" and model.balance is None:
        refuse("observation.disturbance", "estimated", f"ground_truth or none {with_model}")


TESTS = (
    check_drone,
    check_bounds,
    _check_gates,
    check_openings,
    check_random_tracks,
    _check_race_start,
    _check_start,
    _check_motion,
    _check_legs,
    _check_gate_edge,
)
