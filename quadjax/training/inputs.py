"""What a config names of the user's: recorded states, functions and a learner, read and checked."""

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import make_choices
from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.files import check_finite
from quadjax.core.vectors import Vec3
from quadjax.flights.files import load
from quadjax.flights.flight import MOTION, Flight
from quadjax.learners.parallel import repeat
from quadjax.learners.state import Learner, TrainState
from quadjax.race.draws import RecordedStarts
from quadjax.race.environment import make_environment
from quadjax.race.types import RaceParams
from quadjax.vehicle.protocol import Motion
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.residual import adds_nothing

NAMES = (*MOTION, "actuators")  # of the signals of a recorded state


def read_starts(config: Config, params: RaceParams) -> RecordedStarts | None:
    """The states of ``run.start_states``; None without such a file.

    Every sample of the flights in the file is a state, with the gate ahead as its target. Of a lap
    that can be repeated the last sample, which is the first, is left out. Flights that lack a
    signal of a state are left out.

    Args:
        config: of the training.
        params: of the race, without these states.

    Raises:
        InputError: a file that cannot be read, or that is of another vehicle or track.
    """
    path = config.run.start_states
    if path is None:
        return None
    name = f"run.start_states: {path}"
    arrays = states_of(name, load(path, config.track.gates))
    model, gates = base_model(config.vehicle.model), len(config.track.gates)
    size, target = arrays["actuators"].shape[1], arrays["target"]
    if size != model.actuators.size:
        raise InputError(
            f"{name} has {size} actuators, the config's vehicle has {model.actuators.size}"
        )
    if target.min() < 0 or target.max() >= gates:
        raise InputError(
            f"{name}: target is {int(target.min())} to {int(target.max())}, allowed: the track's "
            f"gates, 0 to {gates - 1}"
        )
    ends = model.actuator_range(params.vehicle.constants)
    if model.uses_start_thrust:
        ends = config.start.thrust
    low, high = (np.array(jax.tree.leaves(end), np.float64) for end in ends)
    levels = np.clip(2.0 * (arrays["actuators"] - low) / (high - low) - 1.0, -1.0, 1.0)
    return RecordedStarts(
        motion=Motion(*(Vec3.of(jnp.asarray(arrays[key], jnp.float32)) for key in MOTION)),
        actuators=jnp.asarray(levels, jnp.float32),
        target=jnp.asarray(target, jnp.int32),
        fraction=jnp.float32(config.run.start_states_part),
    )


def states_of(name: str, flights: list[Flight]) -> dict[str, np.ndarray]:
    """The states (n, k) of flights, by the names of the signals, and "target" (n,)."""
    for flight in flights:
        for key, signal in flight.signals.items():
            if key in NAMES:
                check_finite(name, key, signal.values)
    whole = [flight for flight in flights if set(NAMES) <= set(flight.signals)]
    if not whole:
        missing = [key for key in NAMES if not flights or key not in flights[0].signals]
        raise InputError(f"{name}: {missing[0]} is missing; expected {', '.join(NAMES)}")
    ends = [len(f.time) - bool(f.source.get("periodic")) for f in whole]
    arrays = {
        key: np.concatenate([f[key][:end] for f, end in zip(whole, ends, strict=True)])
        for key in NAMES
    }
    if not len(arrays["position"]):
        raise InputError(f"{name}: no state")
    angles = arrays["attitude"]
    within = np.remainder(angles + np.pi, 2.0 * np.pi) - np.pi
    arrays["attitude"] = np.where(np.abs(angles) > np.pi, within, angles)
    targets = [f.target[:end] for f, end in zip(whole, ends, strict=True)]
    return arrays | {"target": np.concatenate(targets)}


def check_residual(config: Config, params: RaceParams) -> None:
    """Check that a residual whose gain is scheduled adds something.

    Raises:
        InputError: a file of zeros, as ``quadjax fit`` writes where it rejects every output.
    """
    residual = params.vehicle.residual
    if "vehicle.residual_gain" in config.schedules and residual and adds_nothing(residual):
        problem = f"{config.vehicle.residual} adds nothing: every output is zero"
        raise InputError(f"vehicle.residual: {problem}; leave out +residual and vehicle.residual")


def check_functions(config: Config, params: RaceParams) -> None:
    """Trace a reset, an observation and a step, where a config names functions of the user's.

    Raises:
        InputError: a reward term, a rule or an observation field that raises an error, or returns
            no scalar.
    """
    if config.reward.terms or config.rules.extra or config.observation.extra:
        trace_race(config, params)


def trace_race(config: Config, params: RaceParams) -> None:
    """Trace a reset, an observation and a step of a training."""
    environment = make_environment(make_choices(config))
    state = jax.eval_shape(environment.reset, params, jax.random.key(0))
    jax.eval_shape(environment.observe, params, state)
    jax.eval_shape(environment.step, params, state, jnp.zeros(environment.action_size))


def check_learner(config: Config, learner: Learner, params: RaceParams) -> TrainState:
    """The shapes of a learner's state; two updates of a user's own code are traced.

    Raises:
        InputError: a user's learner or network that raises an error, or returns something else.
    """
    algorithm, module = config.learner.algorithm, config.network.module
    name = f"network.module {module}" if module else f"learner.algorithm {algorithm}"
    user = module is not None or ":" in algorithm
    try:
        shapes = jax.eval_shape(learner.init, learner.hyper, params, jax.random.key(0))
        if user and isinstance(shapes, TrainState):
            jax.eval_shape(repeat(learner.update, 2), learner.hyper, params, shapes)
    except InputError:
        raise
    except USER_ERRORS as error:
        if not user:
            raise
        raise InputError(f"{name}: {user_error(error)}") from error
    if not isinstance(shapes, TrainState):
        raise InputError(f"{name}: init gives {shapes!r:.60}, expected a quadjax.TrainState")
    return shapes
