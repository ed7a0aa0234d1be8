"""What a config names of the user's, checked: a residual, functions and a learner."""

import functools

import jax
import jax.numpy as jnp

from quadjax.config.assembly import make_environment
from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.learners.parallel import repeat
from quadjax.learners.schedules import Training
from quadjax.learners.state import TrainState
from quadjax.race.types import RaceParams
from quadjax.vehicle.residual import adds_nothing


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
    environment = make_environment(config)
    state = jax.eval_shape(environment.reset, params, jax.random.key(0))
    jax.eval_shape(environment.observe, params, state)
    jax.eval_shape(environment.step, params, state, jnp.zeros(environment.action_size))


def check_learner(config: Config, training: Training) -> TrainState:
    """The shapes of a learner's state; two updates of a user's own code are traced.

    Raises:
        InputError: a user's learner or network that raises an error, or returns something else.
    """
    algorithm, module = config.learner.algorithm, config.network.module
    name = f"network.module {module}" if module else f"learner.algorithm {algorithm}"
    user = module is not None or ":" in algorithm
    try:
        shapes = jax.eval_shape(Training.init, training, jax.random.key(0))
        if user and isinstance(shapes, TrainState):
            jax.eval_shape(functools.partial(repeat, count=2), training, shapes)
    except InputError:
        raise
    except USER_ERRORS as error:
        if not user:
            raise
        raise InputError(f"{name}: {user_error(error)}") from error
    if not isinstance(shapes, TrainState):
        raise InputError(f"{name}: init gives {shapes!r:.60}, expected a quadjax.TrainState")
    return shapes
