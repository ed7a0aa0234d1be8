"""Checks of a user's own functions on the first step of a race, before anything is written."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.imports import user_numbers
from quadjax.learners.parallel import repeat
from quadjax.learners.state import Learner, TrainState
from quadjax.race import environment
from quadjax.race.environment import Choices, RaceParams
from quadjax.race.step import Step
from quadjax.race.track import gate

STARTS = 8  # random starts whose first step is computed


def check_functions(choices: Choices, params: RaceParams, extra: int) -> None:
    """Compute reward terms, rules and observation fields on the first step from random starts.

    Args:
        choices: of the race.
        params: its numbers.
        extra: the number of fields at the end of the observation that are the user's own.

    Raises:
        InputError: one that raises an error, or returns no scalar or a number that is not finite.
    """
    if not (choices.terms or choices.rules or extra):
        return
    plain = dataclasses.replace(choices, terms=())
    fields = choices.layout.fields[len(choices.layout.fields) - extra :]

    def first_step(key: jax.Array) -> dict[str, list[jax.Array]]:
        state = environment.reset(choices, params, key)
        before = Step(choices.model, params, state, gate(params.track, state.target))
        values = {f"observation field {field.name!r}": field.numbers(before) for field in fields}
        action = jnp.zeros(choices.model.action_size)
        following, _, outcome = environment.transition(plain, params, state, action)
        step = dataclasses.replace(before, after=following.drone, outcome=outcome, action=action)
        terms = ((f"reward term {name}", term) for name, term in choices.terms)
        return values | {label: user_numbers(label, term, step) for label, term in terms}

    values = jax.jit(jax.vmap(first_step))(jax.random.split(jax.random.key(0), STARTS))
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
