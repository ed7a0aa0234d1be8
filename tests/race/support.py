"""A race made of defaults and overrides, and one compiled step of it for rows of drones.

What is compiled takes any number of rows: they are padded to a multiple of ``ROWS``, so that tests
share programs. Results are NumPy arrays, on which further arithmetic compiles nothing.
"""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from quadjax.config.assembly import make_environment, make_params
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.race import episode
from quadjax.race.environment import Race
from quadjax.race.laps import LapState, begin, count_laps
from quadjax.race.track import Track, TrackSection, make_track
from quadjax.race.types import Outcome, RaceParams, RaceState
from tests import reference as ref
from tests.convert import state_of
from tests.promotion import QUICK

BLANK = Path(__file__).parent.parent / "blank.yaml"
ROWS = 64
COURSE = ("track.closed=false", "track.start={position: [-3, -1.5, -1.5]}", "evaluate.laps=1")


def make_config(*overrides: str) -> Config:
    return load_config(BLANK, overrides)


def make_race(*overrides: str) -> tuple[Race, RaceParams]:
    config = make_config(*overrides)
    with jax.enable_x64(False):  # the same programs whatever the test's precision
        return make_environment(config), make_params(config)


def track_of(
    gates: np.ndarray,
    yaw: np.ndarray,
    size: Sequence = (1.0, 1.0),
    tilt: Sequence = (0.0, 0.0),
    shape: str = "rectangle",
    closed: bool = True,
) -> Track:
    """A track of centers, m, and angles, rad; sizes and tilts of all gates, or of each."""
    columns = [np.broadcast_to(x, (len(gates), 2)).tolist() for x in (size, np.degrees(tilt))]
    sections = [
        {"position": place, "yaw_deg": angle, "size": sides, "shape": shape}
        | {"roll_deg": roll, "pitch_deg": pitch}
        for place, angle, sides, (roll, pitch) in zip(
            np.asarray(gates, np.float64).tolist(), np.degrees(yaw).tolist(), *columns, strict=True
        )
    ]
    with jax.enable_x64(False):
        return make_track(TrackSection(gates=sections, closed=closed))


def race_state(kind: str, rows: np.ndarray, target: object = 0, clock: object = 0) -> RaceState:
    """States of rows of drones on their way to ``target``."""
    count = len(rows)
    return RaceState(
        drone=state_of(kind, np.asarray(rows, np.float32)),
        target=np.broadcast_to(target, count).astype(np.int32),
        clock=np.broadcast_to(clock, count).astype(np.int32),
        gates_passed=np.zeros(count, np.int32),
        constants=None,
    )


def by_rows(function: Callable, shared: int = 1, **options: object) -> Callable:
    """``function`` compiled for rows of its arguments after the first ``shared``, padded."""

    @functools.partial(jax.jit, compiler_options=QUICK, **options)
    def compiled(*arguments: object, **named: object) -> object:
        axes = [None] * shared + [0] * (len(arguments) - shared)
        return jax.vmap(functools.partial(function, **named), in_axes=axes)(*arguments)

    def call(*arguments: object, **named: object) -> object:
        count = len(jax.tree.leaves(arguments[shared:])[0])

        def padded(leaf: object) -> np.ndarray:
            leaf = np.asarray(leaf)
            return np.pad(leaf, [(0, -count % ROWS)] + [(0, 0)] * (leaf.ndim - 1), mode="edge")

        rows = jax.tree.map(padded, arguments[shared:])
        results = compiled(*arguments[:shared], *rows, **named)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], results)

    call.compiled = compiled
    return call


@functools.cache
def compiled_transition(environment: Race) -> Callable:
    return by_rows(environment.transition)


@functools.cache
def compiled_observe(environment: Race) -> Callable:
    return by_rows(environment.observation)


@functools.cache
def compiled_reset(environment: Race) -> Callable:
    """States of the keys of one key, ``count`` of them."""
    reset = jax.vmap(functools.partial(episode.reset, environment), in_axes=(None, 0))

    @functools.partial(jax.jit, static_argnames="count", compiler_options=QUICK)
    def compiled(params: RaceParams, key: jax.Array, count: int) -> RaceState:
        return reset(params, jax.random.split(key, count))

    return lambda *arguments: jax.tree.map(np.asarray, compiled(*arguments))


def first_score(
    rows: np.ndarray, target: object, following: RaceState, outcome: Outcome
) -> LapState:
    """The race of one lap of four gates, of rows of motor-level drones, after its first step."""
    one = jax.jit(
        lambda before, *after: count_laps(begin(before, 1), *after, np.float32(0.01), 4),
        compiler_options=QUICK,
    )
    return jax.tree.map(np.asarray, one(race_state("motor", rows, target), following, outcome))


def hover_state(race: tuple[Race, RaceParams]) -> RaceState:
    """The start of timed laps."""
    start = functools.partial(episode.hover_start, race[0])
    return jax.tree.map(np.asarray, jax.jit(start, compiler_options=QUICK)(race[1]))


def level(positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Rows of level motor-level drones with hovering propellers."""
    positions, velocities = np.broadcast_arrays(np.atleast_2d(positions), velocities)
    rows = np.zeros((len(positions), 22))
    rows[:, ref.P], rows[:, ref.V], rows[:, ref.RPM] = positions, velocities, 7497.0
    return rows


# A race with every rule that has a number, one program for all: each test names the numbers that
# it is about.
NUMBERS = {
    "rules.gate_frame": 0.4,
    "rules.gate_depth": 0.2,
    "rules.bounds": [[-9, 9], [-9, 9], [-9, 0]],
    "rules.body_radius": 1e-4,
    "rules.body_rate_limit": [1000, 1000, 1000],
    "rules.speed_limit": 500,
    "reward.overspeed": 5,
    "reward.overspeed_margin": 0.25,
    "start.velocity": 0.5,
    "start.body_rates": 0.1,
}


def ruled(**changed):
    """A race with every rule; an override's first dot is ``__``."""
    numbers = NUMBERS | {key.replace("__", "."): value for key, value in changed.items()}
    return make_race(*(f"{key}={value}" for key, value in numbers.items()))


HOVER = (7497.0 - 7000.0) / 4000.0


def step(race, rows, target=0, clock=0, action=HOVER, kind="motor"):
    """One step of rows of drones; with Euler a position moves by exactly dt times velocity."""
    environment, params = race
    actions = np.broadcast_to(np.asarray(action, np.float32), (len(rows), 4))
    state = race_state(kind, rows, target, clock)
    return compiled_transition(environment)(params, state, actions)


def through(gate: int, forward: float, right: float = 0.0, down: float = 0.0) -> np.ndarray:
    """A world position in a gate's own frame of the square track."""
    yaw = ref.GATE_YAW[gate]
    ahead, side = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    return ref.GATES[gate] + forward * ahead + right * side + [0, 0, down]


def normal(gate: int) -> np.ndarray:
    """The unit vector of the way through a gate of the square track."""
    return np.array([np.cos(ref.GATE_YAW[gate]), np.sin(ref.GATE_YAW[gate]), 0])
