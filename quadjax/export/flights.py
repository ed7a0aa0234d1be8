"""Simulated flights of a policy in its own race: data for its tests, and checks of them."""

import dataclasses
import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.actor import fixed_point_action
from quadjax.export.fixed import FixedNetwork
from quadjax.export.race_source import OwnRace
from quadjax.export.ranges import InputBox
from quadjax.policy.file import Policy
from quadjax.policy.inference import act_deterministic, policy_params
from quadjax.race import environment, rules
from quadjax.race.environment import RaceState
from quadjax.race.laps import Laps, Trace, fly_laps
from quadjax.race.layout import DISTURBANCES
from quadjax.race.track import gate
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.rate import RateState

Carry = tuple[jax.Array, jax.Array]  # a position and the target after it
LOST_CONTROL = ("lost its attitude", "out of bounds", "not finite")  # of CRASHES
RUNS, LAPS = 32, 6
FINISHED = 0.9  # fraction of the flights that must finish


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """Simulated flights, one row per step of a drone that is still racing."""

    observations: np.ndarray  # (n, inputs) float32
    states: np.ndarray  # (n, state_size) float32, in the order of the emitted state
    targets: np.ndarray  # (n,) int32
    laps: Laps | None = None  # of all flights; None for rows read back from a file
    steps: int = 0  # of all flights


def simulate(
    own: OwnRace, policy: Policy, runs: int = RUNS, laps: int = LAPS, seed: int = 0
) -> Rollouts:
    """Simulate the float policy's mean actions from the random starts of training.

    The rows are those of all flights but the ones that lost control, or of all if every one did.
    """
    result, trace = _traced(own, policy, runs, laps, seed, from_hover=False)
    held = np.array([crash not in LOST_CONTROL for crash in result.crashes])
    counted = held if held.any() else ~held
    states, targets = _states(trace, policy.vehicle, own, counted, seed)
    return Rollouts(observe(own, states, targets), states, targets, result, len(states))


def _traced(
    own: OwnRace, policy: Policy, runs: int, laps: int, seed: int, from_hover: bool
) -> tuple[Laps, Trace]:
    result, trace = fly_laps(
        own.choices,
        own.params,
        act_deterministic,
        policy_params(policy),
        jax.random.key(seed),
        laps=laps,
        runs=runs,
        from_hover=from_hover,
        trace=True,
    )
    assert trace is not None
    return result, trace


def _states(
    trace: Trace, vehicle: str, own: OwnRace, counted: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (n, state_size) and targets (n,) of every step of the runs that are counted."""
    going = ~np.asarray(trace.over) & counted
    parts = [trace.position, trace.velocity, trace.euler, trace.rates, trace.actuators]
    rows = [np.moveaxis(np.asarray(part), 1, -1)[going] for part in parts]
    if vehicle == "motor":
        # Disturbances are constant in a flight; they are drawn again from their ranges.
        rng = np.random.default_rng(seed)
        span = own.params.disturbance
        half = np.array(
            [float(getattr(span, name)) for names in DISTURBANCES.values() for name in names]
        )
        drawn = rng.uniform(-half, half, (len(counted), 4))[np.nonzero(going)[1]]
        rows += [drawn[:, :3], np.zeros((len(drawn), 2)), drawn[:, 3:]]
    return np.concatenate(rows, axis=1).astype(np.float32), np.asarray(trace.target)[going]


def drone_of(vehicle: str, state: jax.Array) -> MotorState | RateState:
    """A state (state_size,), in the order of the emitted one, as the simulator has it."""
    pose = [Vec3.of(state[start : start + 3]) for start in (0, 3, 6, 9)]
    if vehicle == "rate":
        return RateState(*pose, state[12])
    return MotorState(*pose, Rotors.of(state[12:16]), Vec3.of(state[16:19]), Vec3.of(state[19:22]))


def observe(own: OwnRace, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Observations (n, inputs) float32 of states (n, state_size) towards targets (n,)."""

    def one(state: jax.Array, target: jax.Array) -> jax.Array:
        zero = jnp.zeros((), jnp.int32)
        drone = drone_of(own.choices.model.name, state)
        race = RaceState(drone, target, zero, zero, None)
        return environment.observe(own.choices, own.params, race)

    return np.asarray(jax.jit(jax.vmap(one))(states, targets))


def check_box(box: InputBox, observations: np.ndarray) -> None:
    """Raise an ``InputError`` if observations leave a declared range, with the range to declare."""
    problems = box.outside(observations)
    if not problems:
        return
    options = []
    for problem in problems:
        group = problem.split()[0]
        size = float(np.max(np.abs(observations[:, box.columns(group)])))
        options.append(f"--range {group}={2.0 ** np.ceil(np.log2(size)):g}")
    raise InputError(
        f"the policy's own flights leave the declared range: {'; '.join(problems)}; "
        f"declare {' '.join(options)}"
    )


def check_finished(laps: Laps, own: OwnRace, who: str) -> None:
    """Raise an ``InputError`` unless ``FINISHED`` of a policy's flights finish."""
    runs, wanted = len(laps.crashes), laps.lap_times.shape[1]
    if laps.finished < FINISHED * runs:
        where = own.config.track.name or Path(own.config.track.file).stem
        raise InputError(
            f"{who}: {laps.finished} of {runs} flights finish {wanted} laps of track {where} "
            f"({own.origin} config), expected {FINISHED:.0%}; give the config that it was trained "
            "with by --config, or --allow-unfinished"
        )


def fly_float_and_fixed(
    own: OwnRace, policy: Policy, network: FixedNetwork, runs: int, laps: int = 6, seed: int = 1
) -> tuple[Laps, Laps]:
    """Laps of the float policy and of the fixed-point one, from the same starts."""
    key = jax.random.key(seed)
    common = {"laps": laps, "runs": runs, "from_hover": False}
    as_float, _ = fly_laps(
        own.choices, own.params, act_deterministic, policy_params(policy), key, **common
    )
    act = fixed_point_action(network)
    as_fixed, _ = fly_laps(own.choices, own.params, act, None, key, **common)
    return as_float, as_fixed


def fly_traced(own: OwnRace, policy: Policy, runs: int, laps: int, seed: int = 2) -> Trace:
    """Flights of the float policy from hover, step by step."""
    return _traced(own, policy, runs, laps, seed, from_hover=True)[1]


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

    world_box = own.choices.gate_test == "world_box"

    def follow(carry: Carry, after: jax.Array) -> tuple[Carry, jax.Array]:
        before, target = carry
        ends = (Vec3.of(before), Vec3.of(after))
        passed, _ = rules.crossing(*ends, gate(track, target), jnp.zeros(()), world_box)
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
