"""Checks of a user's own functions on the first step of a race, before anything is written."""

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.race import choices_of
from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.learners.parallel import repeat
from quadjax.learners.state import Learner, TrainState
from quadjax.race.environment import RaceParams, make_environment

STARTS = 8  # random starts whose first step is computed


def check_functions(config: Config, params: RaceParams) -> None:
    """Compute the first step from random starts, where a config names functions of the user's.

    Raises:
        InputError: a reward term, a rule or an observation field that raises an error, or returns
            no scalar or a number that is not finite.
    """
    terms, choices = config.reward.terms, choices_of(config)
    if not (terms or config.rules.extra or config.observation.extra):
        return
    environment = make_environment(choices)

    def first_step(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = environment.reset(params, key)
        action = jnp.zeros(environment.action_size)
        return environment.observe(params, state), environment.step(params, state, action)[1]

    keys = jax.random.split(jax.random.key(0), STARTS)
    observed, reward = jax.jit(jax.vmap(first_step))(keys)
    label = f"reward (with terms {', '.join(terms)})" if terms else "reward"
    layout, values = choices.layout, {label: reward}
    for name in layout.names:
        values[f"observation field {name!r}"] = observed[:, layout.slice(name)]
    for label, numbers in values.items():
        if not np.all(np.isfinite(numbers)):
            raise InputError(f"{label} is not finite after a random start, expected finite numbers")


def check_learner(config: Config, learner: Learner, params: RaceParams) -> TrainState:
    """The shapes of a learner's state; two updates of a user's own learner are traced.

    Raises:
        InputError: a user's learner that raises an error, or whose functions return something else.
    """
    user, name = ":" in config.learner.algorithm, f"learner.algorithm {config.learner.algorithm}"
    try:
        shapes = jax.eval_shape(learner.init, learner.hyper, params, jax.random.key(0))
        if user and isinstance(shapes, TrainState):
            jax.eval_shape(repeat(learner, 2), learner.hyper, params, shapes)
    except InputError:
        raise
    except USER_ERRORS as error:
        if not user:
            raise
        raise InputError(f"{name}: {user_error(error)}") from error
    if not isinstance(shapes, TrainState):
        raise InputError(f"{name}: init gives {shapes!r:.60}, expected a quadjax.TrainState")
    return shapes
