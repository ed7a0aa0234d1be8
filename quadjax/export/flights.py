"""Flights of a policy in its own environment: what its declared ranges and its tests rest on."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np

from quadjax.config import REPOSITORY_CONFIGS, load_config
from quadjax.errors import InputError
from quadjax.evaluate.laps import Laps, Trace, fly_laps
from quadjax.export.emulator_jax import fixed_point_action
from quadjax.export.fixed import FixedNetwork
from quadjax.export.ranges import InputBox
from quadjax.policies import act_deterministic, flying
from quadjax.policy_file import Policy
from quadjax.race import build, environment, rules
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.track import gate
from quadjax.schema import Config
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.rate import RateState
from quadjax.vehicle.vector import Rotors, Vec3

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
        policy: its vehicle and the scaling of its observation take the place of the config's.
        config_path: a training config, or ``None`` for the default.
        track: the name of a track file, or ``None`` for the config's.
        residual: a residual file that takes the place of the config's, if that names one.

    Raises:
        InputError: a file that cannot be read, or a scaling that makes no sense.
    """
    words = [f"vehicle.kind={policy.vehicle}"]
    if track is not None:
        words.append(f"track.file={track}")
    spans = policy.observation.get("disturbance") or {}
    words += [f"disturbance.{name}={spans[name]}" for name in DISTURBANCES if name in spans]
    for key in ("wrap_next_yaw", "disturbance_input"):
        if key in policy.observation:
            words.append(f"episode.{key}={json.dumps(policy.observation[key])}")
    config = load_config(config_path or REPOSITORY_CONFIGS / "e2e.yaml", words)
    if residual is not None and config.vehicle.residual:
        words.append(f"vehicle.residual={residual}")
        config = load_config(config_path or REPOSITORY_CONFIGS / "e2e.yaml", words)
    params = build.build_params(config)
    own = OwnRace(build.choices_of(config), params, config)
    _check_commands(policy, own)
    return own


def _check_commands(policy: Policy, own: OwnRace) -> None:
    module = environment.motor if policy.vehicle == "motor" else environment.rate
    low, high = module.command_range(own.params.vehicle.constants)
    flown = [np.array([float(x) for x in jax.tree.leaves(end)]) for end in (low, high)]
    for name, mine, theirs in zip(
        ("command_low", "command_high"),
        (policy.command_low, policy.command_high),
        flown,
        strict=True,
    ):
        if not np.allclose(mine, theirs, rtol=1e-5, atol=1e-5):
            raise InputError(
                f"policy {name} {mine.tolist()} is not that of the vehicle "
                f"{own.config.vehicle.file}, {theirs.tolist()}; give its config with --config"
            )


def fly(own: OwnRace, policy: Policy, runs: int, laps: int = 6, seed: int = 0) -> Flown:
    """Fly the float policy, its means, from the training's random starts, and keep what it saw.

    What is kept is of the flights that finished, or of all if none did.
    """
    result, trace = fly_laps(
        own.choices,
        own.params,
        act_deterministic,
        flying(policy),
        jax.random.key(seed),
        laps=laps,
        runs=runs,
        from_hover=False,
        trace=True,
    )
    assert trace is not None
    finished = np.array([not crash for crash in result.crashes])
    counted = finished if finished.any() else ~finished  # what a tumbling wreck sees does not count
    states, targets = _states(trace, policy.vehicle, own, counted, seed)
    return Flown(observe(own, states, targets), states, targets, result)


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
        zero = jax.numpy.zeros((), jax.numpy.int32)
        drone = drone_of(own.choices.kind, state)
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


def fly_traced(
    own: OwnRace, policy: Policy, runs: int, laps: int, seed: int = 2
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Flights of the float policy: positions (n, 3) and the target at each, run by run."""
    _, trace = fly_laps(
        own.choices,
        own.params,
        act_deterministic,
        flying(policy),
        jax.random.key(seed),
        laps=laps,
        runs=runs,
        from_hover=True,
        trace=True,
    )
    assert trace is not None
    flown = []
    for run in range(runs):
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

    def crossed(before: jax.Array, after: jax.Array, target: jax.Array) -> jax.Array:
        ends = (Vec3.of(before), Vec3.of(after))
        return rules.crossing(*ends, gate(track, target), jax.numpy.zeros(()), False)[0]

    crossed = jax.jit(crossed)
    target, position = 0, np.float32(centre[-1])
    positions, targets = [], []
    while len(positions) < steps:
        aside, above = rng.uniform(-1.6, 1.6, 2) * half[target]
        way = np.array([*ahead[target], 0.0])
        goal = centre[target] + np.array([-way[1] * aside, way[0] * aside, above])
        for end in (goal - 0.5 * way, goal + 0.5 * way):
            start = position
            for part in np.linspace(0.04, 1.0, 25):
                after = np.float32(start + part * (end - start))
                target = (target + int(crossed(position, after, target))) % len(centre)
                position = after
                positions.append(position)
                targets.append(target)
    return np.array(positions[:steps], np.float32), np.array(targets[:steps], np.int32)
