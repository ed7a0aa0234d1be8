"""What values a config may hold: every impossible one is refused before anything compiles."""

import dataclasses
import math

from quadjax.config.schema import Config, RandomiseConfig
from quadjax.core.errors import InputError
from quadjax.vehicle.constants import MotorConstants, RateConstants, constant_names

CHOICES: dict[str, tuple[str, ...]] = {
    "algorithm": ("ppo", "shac"),
    "vehicle.kind": ("motor", "rate"),
    "vehicle.integrator": ("euler", "rk4"),
    "episode.gate_test": ("square", "world_box"),
    "episode.disturbance_input": ("true", "estimated", "none"),
    "network.activation": ("relu", "tanh"),
}
MOST_LAPS, MOST_RUNS = 1000, 100_000  # of a race: what is flown at once must fit in memory
# Lowest and highest value, and whether each bound itself is allowed.
_UNIT = (0.0, 1.0)
CLOSED: dict[str, tuple[float, float]] = {
    "episode.max_steps": (1, 10**6),
    "episode.dt": (1e-4, 0.1),
    "train.steps": (1, 10**12),
    "train.drones": (1, 10**7),
    "seed": (0, 2**31 - 1),
    "evaluate.laps": (1, MOST_LAPS),
    "evaluate.runs": (1, MOST_RUNS),
    "ppo.gae_lambda": _UNIT,
    "shac.td_lambda": _UNIT,
    "shac.state_gradient_decay": _UNIT,
    "shac.critic_target_rate": _UNIT,
    "shac.mean_rate": (1e-4, 1.0),
    "start.roll_pitch_deg": (0.0, 89.0),
    "start.yaw_deg": (0.0, 180.0),
    "episode.pitch_limit_deg": (1.0, 89.0),
    "episode.roll_limit_deg": (1.0, 180.0),
    **{f"randomise.{f.name}": (0.0, 0.9) for f in dataclasses.fields(RandomiseConfig)},
}
HALF_OPEN_DISCOUNT = ("ppo.discount", "shac.discount")  # [0, 1)
AT_LEAST_ONE = (
    "ppo.steps_per_update",
    "ppo.batches",
    "ppo.epochs",
    "shac.horizon",
    "shac.critic_passes",
    "shac.critic_batches",
    "train.evaluate_every",
)
POSITIVE = (
    "vehicle.mass",
    "episode.position_limit",
    "episode.rate_limit",
    "episode.yaw_rate_limit",
    "ppo.learning_rate",
    "ppo.adam_epsilon",
    "ppo.clip",
    "ppo.gradient_norm",
    "ppo.kl_limit",
    "ppo.reward_scale",
    "shac.learning_rate",
    "shac.gradient_norm",
    "shac.critic_learning_rate",
    "shac.critic_gradient_norm",
    "shac.state_gradient_clip",
    "shac.std",
    "shac.final_std",
    "shac.reward_scale",
)
NOT_NEGATIVE = (
    "reward.onward",
    "reward.edge",
    "reward.edge_margin",
    "start.position",
    "start.velocity",
    "start.rates",
    "disturbance.moment_x",
    "disturbance.moment_y",
    "disturbance.moment_z",
    "disturbance.force_z",
    "ppo.shuffle_block",
    "ppo.warm_up",
    "shac.warm_up",
    "ppo.final_learning_rate",
    "ppo.value_coefficient",
    "ppo.entropy_coefficient",
    "shac.final_learning_rate",
    "train.checkpoint_seconds",
    "train.nose_up_price",
)


def value_at(config: object, key: str) -> object:
    """The value at a dotted key."""
    for part in key.split("."):
        config = getattr(config, part)
    return config


def check(config: Config) -> None:
    """Raise an ``InputError`` that names the key, the value and what is allowed."""
    _check_finite(config, "")
    for key, allowed in CHOICES.items():
        _require(config, key, value_at(config, key) in allowed, f"one of {', '.join(allowed)}")
    for key, (low, high) in CLOSED.items():
        _require(config, key, low <= value_at(config, key) <= high, f"{low} to {high}")
    for key in HALF_OPEN_DISCOUNT:
        _require(config, key, 0 <= value_at(config, key) < 1, "at least 0 and less than 1")
    last = config.shac.final_discount
    fine = last is None or 0 <= last < 1
    _require(config, "shac.final_discount", fine, "at least 0 and less than 1, or null")
    for key in AT_LEAST_ONE:
        _require(config, key, value_at(config, key) >= 1, "at least 1")
    for key in POSITIVE:
        _require(config, key, value_at(config, key) > 0, "a positive number")
    for key in NOT_NEGATIVE:
        _require(config, key, value_at(config, key) >= 0, "not negative")
    _check_name(config)
    _check_lists(config)
    _check_wide_gates(config)
    _check_ramps(config)
    _check_sizes(config)
    _check_constants(config)
    _check_used(config)


def _require(config: Config, key: str, fine: bool, allowed: str) -> None:
    if not fine:
        raise InputError(f"{key} is {value_at(config, key)!r}, allowed: {allowed}")


def _check_finite(node: object, prefix: str) -> None:
    for item in dataclasses.fields(node):
        value, key = getattr(node, item.name), f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            _check_finite(value, f"{key}.")
        values = value if isinstance(value, (list, tuple)) else [value]
        if any(isinstance(x, float) and not math.isfinite(x) for x in values):
            raise InputError(f"{key} is {value!r}, allowed: finite numbers")


def _check_name(config: Config) -> None:
    fine = bool(config.name) and all(c.isalnum() or c in "._-" for c in config.name)
    _require(config, "name", fine and not config.name.startswith("."), "letters, digits, . _ -")
    devices = config.train.devices
    fine = devices in ("auto", "all") or (devices.isdigit() and int(devices) >= 1)
    _require(config, "train.devices", fine, "auto, all, or a number from 1")
    shares = config.train.shares
    fine = shares >= 1 and shares & (shares - 1) == 0
    _require(config, "train.shares", fine, "a power of two")


def _check_lists(config: Config) -> None:
    widths = config.network.hidden
    _require(config, "network.hidden", bool(widths) and min(widths) >= 1, "widths of at least 1")
    low_high = config.start.thrust
    fine = len(low_high) == 2 and 0 <= low_high[0] <= low_high[1]
    _require(config, "start.thrust", fine, "[lowest, highest], not negative")
    steady = config.disturbance.steady_moment
    fine = len(steady) == 3 and all(math.isfinite(x) for x in steady)
    _require(config, "disturbance.steady_moment", fine, "three finite numbers, N m")
    if not config.track.gates:
        raise InputError(f"track.gates is empty in {config.track.file}, expected one gate or more")
    for index, gate in enumerate(config.track.gates):
        for name, count in (("position", 3), ("size", 2)):
            value = getattr(gate, name)
            if len(value) != count or not all(math.isfinite(x) for x in value):
                raise InputError(
                    f"track.gates[{index}].{name} is {value}, expected {count} finite numbers"
                )
        if not math.isfinite(gate.yaw_deg):
            raise InputError(
                f"track.gates[{index}].yaw_deg is {gate.yaw_deg}, expected a finite number"
            )
        if min(gate.size) <= 2 * config.episode.gate_margin:
            raise InputError(
                f"track.gates[{index}].size is {gate.size}, expected more than twice the "
                f"episode.gate_margin {config.episode.gate_margin}"
            )


def _check_wide_gates(config: Config) -> None:
    """What flies on beyond a gate's edge pays for it, by a price that has a slope there."""
    margin, reward = config.episode.gate_margin, config.reward
    priced = margin >= 0 or reward.edge > 0 or reward.gate_offset > 0
    beyond = "at least 0 where neither reward.edge nor reward.gate_offset prices what is beyond"
    _require(config, "episode.gate_margin", priced, beyond)
    if reward.edge == 0:
        return
    lowest = reward.edge_margin - 1.0  # farther out the price stays the same
    _require(config, "episode.gate_margin", margin >= lowest, f"at least {lowest:g}")
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    _require(config, "reward.edge_margin", reward.edge_margin < half, f"less than {half:g}")


def _check_ramps(config: Config) -> None:
    """Ramps rise, and a residual is there in full before the run ends."""
    for key in ("train.residual_ramp", "train.yaw_ramp", "train.edge_ramp"):
        ramp = value_at(config, key)
        fine = len(ramp) == 2 and 0 <= ramp[0] <= ramp[1]
        _require(config, key, fine, "[first, last] step, not negative")
    within = config.vehicle.residual is None or config.train.residual_ramp[1] <= config.train.steps
    _require(config, "train.residual_ramp", within, f"up to train.steps {config.train.steps}")
    turned = not config.train.yaw_ramp[1] or config.start.yaw_deg == 180.0
    _require(config, "train.yaw_ramp", turned, f"[0, 0] for start.yaw_deg {config.start.yaw_deg}")


def _check_sizes(config: Config) -> None:
    ppo, shac, drones = config.ppo, config.shac, config.train.drones
    if config.algorithm == "ppo":
        block = ppo.shuffle_block or ppo.steps_per_update
        if ppo.steps_per_update % block:
            raise InputError(
                f"ppo.shuffle_block is {block}, expected a divisor of ppo.steps_per_update "
                f"{ppo.steps_per_update}"
            )
        blocks = drones * (ppo.steps_per_update // block)
        if blocks % ppo.batches:
            raise InputError(
                f"ppo.batches is {ppo.batches}, expected a divisor of the {blocks} blocks of "
                f"an update (train.drones {drones} x {ppo.steps_per_update // block})"
            )
    elif drones % shac.critic_batches:
        raise InputError(
            f"shac.critic_batches is {shac.critic_batches}, expected a divisor of train.drones "
            f"{drones}"
        )


def _check_constants(config: Config) -> None:
    """Every constant of both models is there, is a finite number and makes sense."""
    positive = {"g", "i_xx", "i_yy", "i_zz", "k_w", "tau", "tau_rate", "tau_thrust"}
    positive |= {"p_max", "q_max", "r_max"}
    for section, kind in (("motor", MotorConstants), ("rate", RateConstants)):
        values, names = getattr(config.vehicle, section), constant_names(kind)
        for name in [*values, *names]:
            key = f"vehicle.{section}.{name}"
            if name not in names:
                raise InputError(f"unknown key {key}; allowed there: {', '.join(names)}")
            if name not in values:
                raise InputError(f"{key} is missing from {config.vehicle.file}")
            if not math.isfinite(values[name]):
                raise InputError(f"{key} is {values[name]}, expected a finite number")
            if name in positive and values[name] <= 0:
                raise InputError(f"{key} is {values[name]}, expected a positive number")
    _check_actual(config)
    spread = config.randomise.limits
    for section, values, low, high in (
        ("motor", config.vehicle.motor, "rpm_min", "rpm_max"),
        ("rate", config.vehicle.rate, "thrust_min", "thrust_max"),
    ):
        if not 0 <= values[low] * (1 + spread) < values[high] * (1 - spread):
            drawn = f", however randomise.limits {spread} draws them" if spread else ""
            raise InputError(
                f"vehicle.{section}.{low} is {values[low]}, expected at least 0 and less than "
                f"{high} {values[high]}{drawn}"
            )


def _check_actual(config: Config) -> None:
    """The flown drone's factors name constants of its model and are positive."""
    names = constant_names(MotorConstants if config.vehicle.kind == "motor" else RateConstants)
    for name, factor in config.vehicle.actual.items():
        key = f"vehicle.actual.{name}"
        if name not in names:
            raise InputError(f"unknown key {key}; allowed there: {', '.join(names)}")
        if not (math.isfinite(factor) and factor > 0):
            raise InputError(f"{key} is {factor}, expected a positive factor")


# Keys that say something of one kind of vehicle only, with the value that says nothing. The drawn
# disturbances are not among them: a preset of both kinds may carry them, and one shows no others.
MOTOR_ONLY = {
    "vehicle.residual": None,
    "disturbance.steady_moment": [0.0, 0.0, 0.0],
    "randomise.inertia": 0.0,
    "randomise.thrust": 0.0,
    "randomise.moment": 0.0,
    "randomise.velocity_moment": 0.0,
    "randomise.yaw": 0.0,
}


def _check_used(config: Config) -> None:
    """Refuse what would change nothing: a person who set it expects that it does."""
    if config.vehicle.kind != "rate":
        return
    for key, nothing in MOTOR_ONLY.items():
        _require(config, key, value_at(config, key) == nothing, f"{nothing} for vehicle.kind=rate")
    source = config.episode.disturbance_input
    fine = source != "estimated"
    _require(config, "episode.disturbance_input", fine, "true, none for vehicle.kind=rate")
