"""Simulated flights of a policy in its own race: data for its tests, and checks of them."""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.actor import fixed_point_fly
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import LAST_COMMAND, drone_of, example_state, state_sizes
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import command_ranges
from quadjax.race import environment, rules
from quadjax.race.environment import Estimate, RaceState
from quadjax.race.laps import Actor, Laps, Trace, fly_laps
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.race.step import Past
from quadjax.race.track import gate
from quadjax.vehicle.battery import Battery, BatteryState, battery_at_start
from quadjax.vehicle.protocol import State

Carry = tuple[jax.Array, jax.Array]  # a position and the target after it
LOST_CONTROL = (  # of TERMINATIONS
    "lost its attitude",
    "out of bounds",
    "above the body rate limit",
    "above the training limit of the yaw rate",
    "not finite",
)
RUNS, LAPS, SEED = 32, 6, 0
FINISHED = 0.9  # fraction of the flights that must finish
KEPT_ROWS = 20_000  # rows of the simulated flights that are kept for the verification


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """Simulated flights, one row per step of a drone that is still racing."""

    observations: np.ndarray  # (n, inputs) float32
    states: np.ndarray  # (n, state_size) float32, in the order of the emitted state
    targets: np.ndarray  # (n,) int32
    laps: Laps | None = None  # of all flights; None for rows read back from a file
    steps: int = 0  # of all flights
    longest: np.ndarray | None = None  # rows of one flight, where a history is observed

    def thinned(self) -> "Rollouts":
        """At most ``KEPT_ROWS`` rows, evenly spread; with a history those of one flight."""
        count = len(self.states)
        rows = np.linspace(0, count - 1, min(KEPT_ROWS, count)).astype(int)
        rows = rows if self.longest is None else self.longest[:KEPT_ROWS]
        return Rollouts(
            self.observations[rows], self.states[rows], self.targets[rows], self.laps, self.steps
        )


def simulate(own: OwnRace, runs: int = RUNS, laps: int = LAPS, seed: int = SEED) -> Rollouts:
    """Simulate the float policy's mean actions from the random starts of training.

    The rows are those of all flights but the ones that lost control, or of all if every one did.
    """
    result, trace = _fly(own, pilot.fly, runs, laps, seed, trace=True)
    assert trace is not None
    held = np.array([crash not in LOST_CONTROL for crash in result.crashes])
    counted = held if held.any() else ~held
    states, targets = _states(trace, own, counted, seed)
    shown, longest = (states, targets), None
    going = ~np.asarray(trace.over) & counted
    if depth := own.choices.layout.depth:
        earlier, longest = _earlier(going, depth)
        shown = (*shown, earlier)
    return Rollouts(observe(own, *shown), states, targets, result, len(states), longest)


def _earlier(going: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of earlier states of rows that are ``going`` (time, runs), and rows of one flight.

    Returns:
        The rows (n, depth) of the states of 1, 2 .. steps before, and those of the longest flight.
    """
    rows = np.cumsum(going.ravel()).reshape(going.shape) - 1
    times = np.arange(len(going))[:, None] - 1 - np.arange(depth)
    earlier = np.moveaxis(rows[np.maximum(times, 0)], 1, -1)  # (time, runs, depth)
    run = int(going.sum(axis=0).argmax())
    return earlier[going], rows[going[:, run], run]


def _fly(
    own: OwnRace, actor: Actor, runs: int, laps: int, seed: int, **options: bool
) -> tuple[Laps, Trace | None]:
    options = {"from_hover": False} | options
    key = jax.random.key(seed)
    return fly_laps(own.choices, own.params, actor, own.pilot, key, laps, runs, **options)


def _sizes(own: OwnRace) -> dict[str, int]:
    return state_sizes(own.choices.layout, own.choices.model)


def _quaternions(euler: jax.Array) -> np.ndarray:
    """Quaternions (time, 4, runs) of Euler angles (time, 3, runs), rad."""
    q = quaternion.of_euler(Vec3(*np.moveaxis(np.asarray(euler, np.float32), 1, 0)))
    return np.stack([np.asarray(x) for x in jax.tree.leaves(q)], axis=1)


def _states(
    trace: Trace, own: OwnRace, counted: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (n, state_size) and targets (n,) of every step of the runs that are counted."""
    going = ~np.asarray(trace.over) & counted
    sizes = _sizes(own)
    attitude = [trace.euler] if "euler" in sizes else []
    attitude += [_quaternions(trace.euler)] if "quaternion" in sizes else []
    parts = [trace.position, trace.velocity, *attitude, trace.rates, trace.actuators]
    rows = [np.moveaxis(np.asarray(part), 1, -1)[going] for part in parts]
    if own.choices.model.disturbed:
        # Disturbances are constant in a flight; they are drawn again from their ranges.
        rng = np.random.default_rng(seed)
        span = own.params.disturbance
        half = np.array(
            [float(getattr(span, name)) for names in DISTURBANCES.values() for name in names]
        )
        drawn = rng.uniform(-half, half, (len(counted), 4))[np.nonzero(going)[1]]
        rows += [drawn[:, :3], np.zeros((len(drawn), 2)), drawn[:, 3:]]
    if HIGHEST_RPM in sizes:
        assert trace.highest_rpm is not None
        rows.append(np.asarray(trace.highest_rpm)[going][:, None])
    if LAST_COMMAND in sizes:
        low, high = command_ranges(own.choices, own.params)
        first = np.broadcast_to(0.5 * (low + high)[:, None], trace.command.shape[1:])
        before = np.concatenate([first[None], np.asarray(trace.command)[:-1]])
        rows.append(np.moveaxis(before, 1, -1)[going])
    return np.concatenate(rows, axis=1).astype(np.float32), np.asarray(trace.target)[going]


def observe(
    own: OwnRace, states: np.ndarray, targets: np.ndarray, earlier: np.ndarray | None = None
) -> np.ndarray:
    """Observations (n, inputs) float32 of states (n, state_size) towards targets (n,).

    They are in the scaling that the policy was trained with. Where a history is observed,
    ``earlier`` has the rows (n, depth) of the states of 1, 2 .. steps before; by default the states
    are those of one flight from its start on.
    """
    depth = own.choices.layout.depth
    if earlier is None:
        earlier = np.maximum(np.arange(len(states))[:, None] - 1 - np.arange(depth), 0)
    example, sizes = example_state(own.choices, own.params), list(_sizes(own).items())
    last = sizes[-1][1] if sizes[-1][0] == LAST_COMMAND else 0
    low, high = command_ranges(own.choices, own.params)
    before = itertools.takewhile(lambda part: part[0] != HIGHEST_RPM, sizes)
    limit = sum(size for _, size in before) if HIGHEST_RPM in dict(sizes) else None

    def known(state: jax.Array) -> Past:
        drone = drone_of(own.choices.layout, own.choices.model, example, state)
        given = state[len(state) - last :]
        action = tuple(
            (2.0 * given[i] - low[i] - high[i]) / (high[i] - low[i]) for i in range(last)
        )
        return Past(drone, action or None)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
    def shown(state: jax.Array, target: jax.Array, rows: jax.Array, all_: jax.Array) -> jax.Array:
        zero, now = jnp.zeros((), jnp.int32), known(state)
        past = jax.vmap(known)(all_[rows]) if depth else None
        estimate = _estimate(own, now.drone)
        race = RaceState(now.drone, target, zero, zero, None, estimate, now.action, past=past)
        if own.params.battery is not None and limit is not None:
            race = race.replace(battery=_battery(own.params.battery, state[limit]))
        return pilot.see(own.pilot, environment.observe(own.choices, own.params, race))

    return np.asarray(shown(states, targets, earlier, states))


def observe_float64(own: OwnRace, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """As ``observe``, with states and parameters in float64: the rounding of float32 differs."""

    def exact(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else leaf

    with jax.enable_x64(True):
        params, of_pilot = jax.tree.map(exact, (own.params, own.pilot))
        same = dataclasses.replace(own, params=params, pilot=of_pilot)
        return observe(same, states.astype(np.float64), targets)


def _battery(params: Battery, highest: jax.Array) -> BatteryState:
    """A battery of which the estimate of the highest speed is a number of the state, rpm."""
    state = battery_at_start(params, Rotors.same(jnp.zeros(())), None)
    return state.replace(estimate=state.estimate.replace(highest=highest))


def _estimate(own: OwnRace, drone: State) -> Estimate | None:
    """The disturbances of the state as the onboard estimate; None for a race without estimator."""
    model = own.choices.model
    if own.params.estimator is None or not model.disturbed:
        return None
    return Estimate(None, *drone.disturbance)


def check_finished(laps: Laps | None, own: OwnRace, who: str) -> str:
    """Check that at least the fraction ``FINISHED`` of a policy's flights finish.

    Returns:
        The number of flights that finish, as text for a report.

    Raises:
        InputError: too few flights finish.
    """
    assert laps is not None
    said = f"{laps.finished} of {len(laps.crashes)} flights finish {laps.lap_times.shape[1]} laps"
    if laps.finished < FINISHED * len(laps.crashes):
        where = f"track {own.track} ({own.origin})"
        raise InputError(
            f"{who}: {said} of {where}, expected {FINISHED:.0%}; allow_unfinished=True accepts it"
        )
    return said


def fly_float_and_fixed(
    own: OwnRace, policy: Policy, ranges: dict[str, float], runs: int, laps: int = 6, seed: int = 1
) -> tuple[Laps, Laps]:
    """Laps of the float policy and of the fixed-point one, from the same starts."""
    actors = (pilot.fly, fixed_point_fly(policy, ranges))
    as_float, as_fixed = (_fly(own, actor, runs, laps, seed)[0] for actor in actors)
    return as_float, as_fixed


def fly_traced(own: OwnRace, runs: int, laps: int, seed: int = 2) -> Trace:
    """Flights of the float policy from hover, step by step."""
    _, trace = _fly(own, pilot.fly, runs, laps, seed, from_hover=True, trace=True)
    assert trace is not None
    return trace


def paths(trace: Trace) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions (n, 3) and the target at each, run by run."""
    found = []
    for run in range(np.shape(trace.over)[1]):
        going = ~np.asarray(trace.over)[:, run]
        positions = np.asarray(trace.position)[going][:, :, run]
        found.append((positions, np.asarray(trace.target)[going][:, run]))
    return found


def wander(own: OwnRace, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A path to every gate in turn, partly through the openings and partly outside them.

    Returns:
        Positions (steps, 3) float32, and the target (steps,) after each by the simulator's rules.
    """
    rng = np.random.default_rng(seed)
    track = own.params.track
    centers = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    ahead = np.stack([np.asarray(track.cos_yaw), np.asarray(track.sin_yaw)], axis=1)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)

    test = "world_box" if own.params.rules.gate_test == "world_box" else "square"

    def follow(carry: Carry, after: jax.Array) -> tuple[Carry, jax.Array]:
        before, target = carry
        ends = (Vec3.of(before), Vec3.of(after))
        passed, _ = rules.crossing(*ends, gate(track, target), jnp.zeros(()), test)
        following = (target + passed.astype(jnp.int32)) % len(centers)
        return (after, following), following

    follow = jax.jit(functools.partial(jax.lax.scan, follow))
    target, position = 0, np.float32(centers[-1])
    positions, targets = [], []
    while len(targets) < steps:
        aside, above = rng.uniform(-1.6, 1.6, 2) * half[target]
        way = np.array([*ahead[target], 0.0])
        goal = centers[target] + np.array([-way[1] * aside, way[0] * aside, above])
        ends = np.array([position, goal - 0.5 * way, goal + 0.5 * way])
        part = np.linspace(0.04, 1.0, 25)[:, None]
        leg = np.float32(np.concatenate([a + part * (b - a) for a, b in itertools.pairwise(ends)]))
        _, after = follow((position, jnp.int32(target)), leg)
        positions += list(leg)
        targets += after.tolist()
        target, position = targets[-1], leg[-1]
    return np.array(positions[:steps], np.float32), np.array(targets[:steps], np.int32)
