"""Flights of a policy in its own environment: what its declared ranges and its tests rest on."""

import dataclasses
import functools
import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.emulator_jax import fixed_point_action
from quadjax.export.fixed import FixedNetwork
from quadjax.export.ranges import InputBox
from quadjax.policy.file import Policy
from quadjax.policy.inference import act_deterministic, flying
from quadjax.race import build, environment, rules
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.laps import Laps, Trace, fly_laps
from quadjax.race.track import gate
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.rate import RateState

Carry = tuple[jax.Array, jax.Array]  # a position and the target after it
LOST_CONTROL = ("lost its attitude", "out of bounds", "not finite")  # of CRASHES
DISTURBANCES = ("moment_x", "moment_y", "moment_z", "force_z")


@dataclasses.dataclass(frozen=True)
class OwnRace:
    """The environment that a policy flies in."""

    choices: Choices
    params: RaceParams
    config: Config


@dataclasses.dataclass(frozen=True)
class Flown:
    """What was flown, one row a step of a drone that was still racing."""

    observations: np.ndarray  # (n, inputs) float32
    states: np.ndarray  # (n, state_size) float32, in the order of the emitted state
    targets: np.ndarray  # (n,) int32
    laps: Laps | None  # of all that flew; None for rows read back from a file


def own_race(
    policy: Policy, config_path: Path | None, track: str | None, residual: Path | None = None
) -> OwnRace:
    """The race of a config, or of the project's default one, as the policy was trained to see it.

    Args:
        policy: its vehicle, the scaling of its observation and the limits of its commands take the
            place of the config's.
        config_path: a training config, or ``None`` for the default.
        track: the name of a track file, or ``None`` for the config's.
        residual: a residual file that takes the place of the config's, if that names one.

    Raises:
        InputError: a file that cannot be read, a scaling that makes no sense, or limits that no
            vehicle of the policy's kind has.
    """
    words = [f"vehicle.kind={policy.vehicle}", *_limits(policy)]
    if track is not None:
        words.append(f"track.file={track}")
    spans = policy.observation.get("disturbance") or {}
    words += [f"disturbance.{name}={spans[name]}" for name in DISTURBANCES if name in spans]
    for key in ("wrap_next_yaw", "disturbance_input"):
        if key in policy.observation:
            words.append(f"episode.{key}={json.dumps(policy.observation[key])}")
    config = load_config(config_path or CONFIGS / "e2e_shac.yaml", words)
    if residual is not None and config.vehicle.residual:
        words.append(f"vehicle.residual={residual}")
        config = load_config(config_path or CONFIGS / "e2e_shac.yaml", words)
    return OwnRace(build.choices_of(config), build.build_params(config), config)


def _limits(policy: Policy) -> list[str]:
    """Words for a config: a vehicle whose commands have the policy's limits."""
    low, high = policy.command_low.tolist(), policy.command_high.tolist()
    if policy.vehicle == "motor":
        if len(set(low)) > 1 or len(set(high)) > 1:
            raise InputError(f"policy commands {low}..{high} rpm: expected the same for all motors")
        return [f"vehicle.motor.rpm_min={low[0]!r}", f"vehicle.motor.rpm_max={high[0]!r}"]
    if low[:3] != [-x for x in high[:3]]:
        raise InputError(f"policy commands rates of {low[:3]}..{high[:3]} rad/s: expected +-")
    words = [f"vehicle.rate.{axis}_max={x!r}" for axis, x in zip("pqr", high, strict=False)]
    return [*words, f"vehicle.rate.thrust_min={low[3]!r}", f"vehicle.rate.thrust_max={high[3]!r}"]


def fly(own: OwnRace, policy: Policy, runs: int, laps: int = 6, seed: int = 0) -> Flown:
    """Fly the float policy, its means, from the training's random starts, and keep what it saw.

    What is kept is of all flights but those that lost control, or of all if every one did.
    """
    result, trace = _fly_traced(own, policy, runs, laps, seed, from_hover=False)
    held = np.array([crash not in LOST_CONTROL for crash in result.crashes])
    counted = held if held.any() else ~held  # what a tumbling wreck sees does not count
    states, targets = _states(trace, policy.vehicle, own, counted, seed)
    return Flown(observe(own, states, targets), states, targets, result)


def _fly_traced(
    own: OwnRace, policy: Policy, runs: int, laps: int, seed: int, from_hover: bool
) -> tuple[Laps, Trace]:
    result, trace = fly_laps(
        own.choices,
        own.params,
        act_deterministic,
        flying(policy),
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
        # The disturbances do not change in flight; they are drawn again from their ranges.
        rng = np.random.default_rng(seed)
        span = own.params.disturbance
        half = np.array([float(getattr(span, name)) for name in DISTURBANCES])
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
    """What the environment shows of states (n, state_size) towards targets (n,): float32."""

    def one(state: jax.Array, target: jax.Array) -> jax.Array:
        zero = jnp.zeros((), jnp.int32)
        drone = drone_of(own.choices.model.name, state)
        race = RaceState(drone, target, zero, zero, None)
        return environment.observe(own.choices, own.params, race)

    return np.asarray(jax.jit(jax.vmap(one))(states, targets))


def check_box(box: InputBox, observations: np.ndarray) -> None:
    """Refuse a declared range that a flight left.

    Raises:
        InputError: what left it, how far, and which range to declare.
    """
    problems = box.outside(observations)
    if not problems:
        return
    words = []
    for problem in problems:
        group = problem.split()[0]
        size = float(np.max(np.abs(observations[:, box.columns(group)])))
        words.append(f"{group}={2.0 ** np.ceil(np.log2(size)):g}")
    raise InputError(
        f"the policy's own flights leave the declared range: {'; '.join(problems)}; "
        f"declare --range {' '.join(words)}"
    )


def fly_both(
    own: OwnRace, policy: Policy, network: FixedNetwork, runs: int, laps: int = 6, seed: int = 1
) -> tuple[Laps, Laps]:
    """The same starts flown by the float policy and by the fixed-point one."""
    key = jax.random.key(seed)
    common = {"laps": laps, "runs": runs, "from_hover": False}
    as_float, _ = fly_laps(
        own.choices, own.params, act_deterministic, flying(policy), key, **common
    )
    act = fixed_point_action(network)
    as_fixed, _ = fly_laps(own.choices, own.params, act, None, key, **common)
    return as_float, as_fixed


def fly_traced(own: OwnRace, policy: Policy, runs: int, laps: int, seed: int = 2) -> Trace:
    """Flights of the float policy from hover, step by step."""
    return _fly_traced(own, policy, runs, laps, seed, from_hover=True)[1]


def paths(trace: Trace) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions (n, 3) and the target at each, run by run."""
    flown = []
    for run in range(np.shape(trace.over)[1]):
        going = ~np.asarray(trace.over)[:, run]
        positions = np.asarray(trace.position)[going][:, :, run]
        flown.append((positions, np.asarray(trace.target)[going][:, run]))
    return flown


def wander(own: OwnRace, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A path that reaches every gate in turn, now through its opening and now beside it.

    Returns:
        Positions (steps, 3) float32, and the target (steps,) after each by the simulator's rules.
    """
    rng = np.random.default_rng(seed)
    track = own.params.track
    centre = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    ahead = np.stack([np.asarray(track.cos_yaw), np.asarray(track.sin_yaw)], axis=1)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)

    world_box = own.choices.gate_test == "world_box"

    def follow(carry: Carry, after: jax.Array) -> tuple[Carry, jax.Array]:
        before, target = carry
        ends = (Vec3.of(before), Vec3.of(after))
        passed, _ = rules.crossing(*ends, gate(track, target), jnp.zeros(()), world_box)
        following = (target + passed.astype(jnp.int32)) % len(centre)
        return (after, following), following

    follow = jax.jit(functools.partial(jax.lax.scan, follow))
    target, position = 0, np.float32(centre[-1])
    positions, targets = [], []
    while len(targets) < steps:
        aside, above = rng.uniform(-1.6, 1.6, 2) * half[target]
        way = np.array([*ahead[target], 0.0])
        goal = centre[target] + np.array([-way[1] * aside, way[0] * aside, above])
        ends = np.array([position, goal - 0.5 * way, goal + 0.5 * way])
        part = np.linspace(0.04, 1.0, 25)[:, None]
        leg = np.float32(np.concatenate([a + part * (b - a) for a, b in itertools.pairwise(ends)]))
        _, after = follow((position, jnp.int32(target)), leg)
        positions += list(leg)
        targets += after.tolist()
        target, position = targets[-1], leg[-1]
    return np.array(positions[:steps], np.float32), np.array(targets[:steps], np.int32)
