"""Whole races from around the track's start, with constants drawn: finished, times and speeds.

The protocol of MonoRace (arXiv 2601.15222), for any track: the mean action flies from rest at the
start, with x and y within 0.5 m of it and the yaw within 45 deg.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.markdown import table
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import laps
from quadjax.race.environment import Choices, RaceParams
from quadjax.studies.robustness import drawn_races

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
    own = pilot.make_pilot(choices, params, policy, deterministic=True)
    race, _ = laps.fly_race(
        choices,
        pilot.fly,
        math.ceil(length),
        laps.step_limit(params, length),
        False,
        params,
        own,
        states,
        noise,
        laps.last_gate(params.track, gates),
        jnp.float32(math.inf if speed is None else speed),
    )
    limit = laps.time_limit(params.track, length)
    result = laps.laps_of(choices, race, float(params.rules.time_step), limit)
    assert race.speeds is not None
    first, highest, above = (
        np.asarray(getattr(race.speeds, name), np.float64)
        for name in ("first_gate", "highest", "above")
    )
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
