"""Flights of drones whose constants differ from the nominal ones: crashes and lap times.

The protocol of Ferede et al., "One Net to Rule Them All" (arXiv 2504.21586), for any track: each
flight begins 1 m before a random gate, with any yaw, and lasts 12 s.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.race import race_of, vehicle_model_of
from quadjax.config.schema import Config, Disturbance, Randomization
from quadjax.core.markdown import table
from quadjax.core.vectors import Vec3
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.episode import draw_start, start_gate, with_memory
from quadjax.race.track import gate
from quadjax.vehicle.protocol import Motion

SPREADS = (0.0, 0.1, 0.2, 0.3)
DISTANCE = 1.0  # m before the gate
VELOCITY, ROLL_PITCH, RATES = 0.5, math.pi / 9, 0.1  # half-widths: m/s, rad, rad/s
MOST_LAPS = 64  # that one flight is counted for


@dataclasses.dataclass(frozen=True)
class Flights:
    """The flights of one randomization.

    Attributes:
        label: ``±10%``, the name of a population of the vehicle model, or ``own`` for the
            randomization of the config.
        runs: number of flights.
        crashed: number of flights that crashed.
        without_lap: number of flights that neither crash nor complete a lap.
        lap: median of all laps but the first of each flight, s; NaN if there is none.
    """

    label: str
    runs: int
    crashed: int
    without_lap: int
    lap: float

    def to_json(self) -> dict[str, Any]:
        """The numbers as JSON takes them: ``null`` where no lap was completed."""
        lap = round(self.lap, 4) if math.isfinite(self.lap) else None
        return dataclasses.asdict(self) | {"lap": lap}


def fly_spreads(
    policy: Policy,
    config: Config,
    runs: int = 1000,
    seconds: float = 12.0,
    seed: int = 0,
    name: str = "policy",
    spreads: Sequence[float] = SPREADS,
) -> list[Flights]:
    """Fly the mean action with constants drawn from each spread, without disturbances.

    Args:
        policy: the policy.
        config: of the race. Where it draws constants, its own distribution is the last one.
        runs: number of flights of each spread.
        seconds: of a flight.
        seed: of starts and constants.
        name: of the policy, for messages.
        spreads: largest relative errors of every constant (of each rotor) except gravity.

    Raises:
        InputError: the policy does not fit the race.
    """
    return [
        _fly(label, choices, params, policy, runs, seconds, seed)
        for label, choices, params in drawn_races(policy, config, name, spreads)
    ]


def drawn_races(
    policy: Policy, config: Config, name: str, spreads: Sequence[float] = SPREADS
) -> Iterator[tuple[str, Choices, RaceParams]]:
    """The race by the exact rules with constants drawn from each spread and each population.

    Args:
        policy: that is flown.
        config: of the race. Where it draws constants, its own distribution is the last one.
        name: of the policy, for messages.
        spreads: largest relative errors of every constant (of each rotor) except gravity.
    """
    own = config.randomization
    races = {f"±{100 * part:g}%": Randomization(all=part) for part in spreads}
    model = vehicle_model_of(config)
    races |= {each: Randomization(population=each) for each in model.populations}
    races |= {"own": own} if own.drawn and own.replace(tracks=None) not in races.values() else {}
    for label, randomization in races.items():
        race = config.replace(randomization=randomization, disturbance=Disturbance(), schedules={})
        choices, params = pilot.fit_race(*race_of(race), policy, name)
        choices = dataclasses.replace(choices, randomize=True)
        yield label, choices, environment.exact_rules(choices.model, params)


def _fly(
    label: str,
    choices: Choices,
    params: RaceParams,
    policy: Policy,
    runs: int,
    seconds: float,
    seed: int,
) -> Flights:
    key, noise = jax.random.split(jax.random.key(seed))
    states = jax.jit(_starts, static_argnums=(0, 3))(choices, params, key, runs)
    own = pilot.make_pilot(choices, params, policy, deterministic=True)
    steps = round(seconds / float(params.rules.time_step))
    race, _ = laps.fly_race(choices, pilot.fly, MOST_LAPS, steps, False, params, own, states, noise)
    ends = np.asarray(race.lap_end, np.float64)
    times = np.diff(np.where(ends > 0, ends, np.nan), axis=0)
    flown = times[np.isfinite(times)]
    crashed = np.asarray(race.crash) != 0
    without_lap = ~crashed & ~(ends > 0).any(axis=0)
    lap = float(np.median(flown)) if flown.size else math.nan
    return Flights(label, runs, int(crashed.sum()), int(without_lap.sum()), lap)


def _starts(choices: Choices, params: RaceParams, key: jax.Array, runs: int) -> RaceState:
    """Starts before the gates, batched along the last axis."""
    one = functools.partial(start_before_gate, choices, params)
    return jax.vmap(one, out_axes=-1)(jax.random.split(key, runs))


def start_before_gate(choices: Choices, params: RaceParams, key: jax.Array) -> RaceState:
    """A start ``DISTANCE`` before a gate, on the line through it; constants are drawn."""
    first, second = jax.random.split(key)
    state, model = environment.reset(choices, params, first), choices.model
    drawn = draw_start(model, second)
    target = start_gate(params.track, drawn.gate)
    g = gate(params.track, target)
    behind = Vec3(g.cos_yaw, g.sin_yaw, jnp.zeros_like(g.yaw)) * DISTANCE
    motion = Motion(
        position=g.position - behind,
        velocity=Vec3.of(drawn.velocity) * VELOCITY,
        euler=Vec3.of(drawn.euler) * Vec3(ROLL_PITCH, ROLL_PITCH, math.pi),
        rates=Vec3.of(drawn.rates) * RATES,
    )
    drone = model.start(state.constants, motion, drawn.actuators, params.start.thrust)
    zero = jnp.zeros((), jnp.int32)
    fresh = state.replace(drone=drone, target=target, step=zero, gates_passed=zero)
    return with_memory(choices, params, fresh)


def spread_table(flights: Sequence[Flights], name: str) -> str:
    """A Markdown table with a column for each randomization: crashes and median lap.

    A cell also has the flights that neither crash nor complete a lap, if there are any.
    """
    titles = ["policy", *(each.label for each in flights)]
    return table([titles, [name, *(_cell(each) for each in flights)]])


def _cell(own: Flights) -> str:
    share = f"{100 * own.crashed / own.runs:.3g}%"
    if own.without_lap:
        share += f" and {100 * own.without_lap / own.runs:.3g}% without a lap"
    return f"{share} / {own.lap:.3f} s" if math.isfinite(own.lap) else f"{share} / -"
