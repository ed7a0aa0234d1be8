"""Whole races from around the track's start, with constants drawn: finished, times and speeds.

The protocol of MonoRace (arXiv 2601.15222), for any track: the mean action flies from rest at the
start, with x and y within 0.5 m of it and the yaw within 45 deg.
"""

import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.markdown import table
from quadjax.core.vectors import safe_norm
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import laps
from quadjax.race.environment import Choices, RaceParams
from quadjax.studies.robustness import drawn_races

# Time until the first gate (0 before), s; highest speed, m/s; seconds above a speed: (runs,) each.
Speeds = tuple[jax.Array, jax.Array, jax.Array]
TITLES = ("constants", "finished", "median", "first to last gate", "highest speed")


@dataclasses.dataclass(frozen=True)
class RaceFlights:
    """The flights of one randomization; times and speeds are of the flights that finish.

    Attributes:
        label: of the randomization; see ``quadjax.studies.robustness.Flights``.
        runs: number of flights.
        finished: number of flights that pass all gates.
        time: median time from the start to the last gate, s; NaN if no flight finishes.
        between: median time from the first to the last gate, s.
        highest_speed: the largest of any of them, m/s.
        seconds_above: mean time of a flight above ``speed``, s.
        speed: m/s, ``fitted_speed`` of the vehicle; None: unknown.
        crashes: why flights do not finish, with their number.
    """

    label: str
    runs: int
    finished: int
    time: float
    between: float
    highest_speed: float
    seconds_above: float
    speed: float | None
    crashes: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """The numbers as JSON takes them: ``null`` where no flight finishes."""
        own = dataclasses.asdict(self)
        if self.speed is None:
            own["seconds_above"] = None
        rounded = {k: round(x, 4) for k, x in own.items() if isinstance(x, float)}
        return own | {k: x if math.isfinite(x) else None for k, x in rounded.items()}


def fly_races(
    policy: Policy,
    config: Config,
    runs: int = 1000,
    laps: int | None = None,
    gates: int | None = None,
    seed: int = 0,
    name: str = "policy",
) -> list[RaceFlights]:
    """Fly whole races with the mean action, by the exact rules, without disturbances.

    Args:
        policy: the policy.
        config: of the race.
        runs: number of flights of each randomization.
        laps: of a race; ``evaluate.laps`` of the config if neither is given.
        gates: of a race, in place of laps; ``evaluate.gates`` of the config if neither is given.
        seed: of starts and constants.
        name: of the policy, for messages.

    Returns:
        Flights for errors of ±0, 10, 20 and 30% of every constant, for each population of the
        vehicle model, and for the config's own randomization, if it has another one.

    Raises:
        InputError: the policy does not fit the race, or ``gates`` of a course.
    """
    if laps is None and gates is None:
        laps, gates = config.evaluate.laps, config.evaluate.gates
    speed = config.vehicle.fitted_speed
    return [
        _fly(label, choices, params, policy, runs, laps or 1, gates, speed, seed)
        for label, choices, params in drawn_races(policy, config, name)
    ]


def _fly(
    label: str,
    choices: Choices,
    params: RaceParams,
    policy: Policy,
    runs: int,
    count: int,
    gates: int | None,
    speed: float | None,
    seed: int,
) -> RaceFlights:
    length = laps.race_length(params.track, count, gates)
    key, noise = jax.random.split(jax.random.key(seed))
    begin = jax.jit(laps.starting_states, static_argnums=(0, 3, 4, 5))
    states = begin(choices, params, key, runs, True, True)
    actor_params = pilot.make_pilot(choices, params, policy, deterministic=True)
    steps, last = laps.step_limit(params, length), laps.last_gate(params.track, gates)
    drones, above_limit = (laps.begin(states, math.ceil(length)), noise), speed or math.inf
    race, speeds = fly_with_speeds(
        choices, pilot.fly, steps, last, params, actor_params, drones, above_limit
    )
    limit = laps.time_limit(params.track, length)
    result = laps.laps_of(choices, race, float(params.rules.time_step), limit)
    first, highest, above = (np.asarray(x, np.float64) for x in speeds)
    done = np.isfinite(result.totals)
    return RaceFlights(
        label,
        runs,
        result.finished,
        _median(result.totals[done]),
        _median((result.totals - first)[done]),
        float(highest[done].max()) if done.any() else math.nan,
        float(above[done].mean()) if done.any() else math.nan,
        speed,
        dict(Counter(reason for reason in result.crashes if reason)),
    )


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def fly_with_speeds(
    choices: Choices,
    actor: laps.Actor,
    steps: int,
    last: int | None,
    params: RaceParams,
    policy: object,
    drones: laps.Carry,
    limit: float,
) -> tuple[laps.LapState, Speeds]:
    """Fly given drones for at most ``steps`` steps, with the time above a speed ``limit``, m/s."""
    one, dt = laps.stepper(choices, actor, params, policy, last), params.rules.time_step

    def going_on(carry: tuple[jax.Array, laps.Carry, Speeds]) -> jax.Array:
        return (carry[0] < steps) & ~jnp.all(carry[1][0].over)

    def step(carry: tuple[jax.Array, laps.Carry, Speeds]) -> tuple:
        count, (before, key), (first, highest, above) = carry
        (race, key), _ = one((before, key))
        passed = (first == 0.0) & (race.state.gates_passed > 0)
        now = safe_norm(race.state.drone.velocity)
        clock = jnp.asarray(race.state.step, jnp.result_type(dt)) * dt
        first = jnp.where(passed, clock, first)
        fast = (now > limit) & ~before.over
        return count + 1, (race, key), (first, jnp.maximum(highest, now), above + dt * fast)

    none = jnp.zeros(drones[0].over.shape)
    _, (race, _), speeds = jax.lax.while_loop(going_on, step, (0, drones, (none, none, none)))
    return race, speeds


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else math.nan


def race_table(flights: Sequence[RaceFlights]) -> str:
    """A Markdown table with a row for each randomization."""
    speed = flights[0].speed
    above = () if speed is None else (f"above {speed:g} m/s",)
    rows = [(*TITLES, *above, "not finished")]
    rows += [(*_cells(own), *_crashes(own)) for own in flights]
    return table(rows)


def _cells(own: RaceFlights) -> tuple[str, ...]:
    share = f"{100 * own.finished / own.runs:.3g}%"
    speeds = () if own.speed is None else (_number(own.seconds_above, "s", 2),)
    times = _number(own.time, "s", 2), _number(own.between, "s", 2)
    return own.label, share, *times, _number(own.highest_speed, "m/s", 1), *speeds


def _number(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if math.isfinite(value) else "-"


def _crashes(own: RaceFlights) -> tuple[str]:
    most = sorted(own.crashes.items(), key=lambda item: -item[1])
    return (", ".join(f"{count} {reason}" for reason, count in most),)
