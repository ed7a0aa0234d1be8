"""Checks of a user's own functions on the first step of a race, before anything is written."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.imports import user_numbers
from quadjax.learners import sharding as parallel
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
        target = gate(params.track, state.target)
        seen = Step(choices.model, params, state, target)
        values = {f"observation field {field.name!r}": field.numbers(seen) for field in fields}
        action = jnp.zeros(choices.model.action_size)
        following, _, outcome = environment.transition(plain, params, state, action)
        step = dataclasses.replace(seen, after=following.drone, outcome=outcome, action=action)
        for name, term in choices.terms:
            label = f"reward term {name}"
            values[label] = user_numbers(label, term, step)
        return values

    values = jax.jit(jax.vmap(first_step))(jax.random.split(jax.random.key(0), STARTS))
    for label, numbers in values.items():
        if not np.all(np.isfinite(numbers)):
            raise InputError(f"{label} is not finite after a random start, expected finite numbers")


def check_learner(config: Config, learner: Learner, params: RaceParams) -> TrainState:
    """The shapes of a learner's state; a user's own learner is checked.

    Raises:
        InputError: a learner that raises an error, or whose functions return something else.
    """
    own, name = ":" in config.learner.algorithm, f"learner.algorithm {config.learner.algorithm}"

    def init() -> TrainState:
        return jax.eval_shape(learner.init, learner.hyper, params, jax.random.key(0))

    if not own:
        return init()
    try:
        shapes, part = init(), "init"
        if isinstance(shapes, TrainState):
            part = "update"
            parallel.check_update(learner, params, shapes)
    except InputError:
        raise
    except USER_ERRORS as error:
        raise InputError(f"{name}: {user_error(error)}") from error
    if part == "init":
        raise InputError(f"{name}: init gives {shapes!r:.60}, expected a quadjax.TrainState")
    return shapes
