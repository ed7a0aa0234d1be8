"""What a config names of the user's, checked: a residual, functions and a learner."""

import functools

import jax
import jax.numpy as jnp
import optax

from quadjax.config.assembly import make_environment
from quadjax.config.schema import Config
from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.precision import single_precision
from quadjax.learners.parallel import repeat
from quadjax.learners.schedules import Training
from quadjax.learners.shac import SHAC
from quadjax.learners.state import TrainState
from quadjax.race.memory import advance_memories
from quadjax.race.rewards import checked
from quadjax.race.rules import evaluate_rules
from quadjax.race.track import gate
from quadjax.race.types import RaceParams, RaceState, Step
from quadjax.vehicle.residual import adds_nothing

RANDOM_STEPS = 64  # at which gradients of the user's reward terms are computed


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


@single_precision
def without_gradient(config: Config, params: RaceParams) -> list[str]:
    """Warnings of the user's reward terms that SHAC cannot differentiate.

    They are those without a gradient at ``RANDOM_STEPS`` random steps, with respect to the states
    and actions of a step and of the step before it, which reach a memory.
    """
    race = make_environment(config)
    if not (race.user_terms and isinstance(config.learner, SHAC)):
        return []

    def values(motion: tuple[list, list], state: RaceState) -> dict[str, jax.Array]:
        (before, now, after), (last_action, action) = motion
        for ends, chosen in (((before, now), last_action), ((now, after), action)):
            state = state.replace(drone=ends[0])
            target = gate(params.track, state.target)
            step = Step(race.model, params, state, target, ends[1], action=chosen)
            step = step.replace(outcome=evaluate_rules(step, race.user_rules))
            state = state.replace(memories=advance_memories(race, step))
        terms = {name: checked(name, term) for name, term in race.user_terms}
        return {name: jnp.asarray(term.value(step)) for name, term in terms.items()}

    def slopes(key: jax.Array) -> dict[str, jax.Array]:
        action_key, *keys = jax.random.split(key, 4)
        states = [race.reset(params.replace(tracks=None), each) for each in keys]
        actions = list(jax.random.uniform(action_key, (2, race.action_size), minval=-1.0))
        found = jax.jacrev(values)(([state.drone for state in states], actions), states[0])
        return {name: optax.tree.norm(slope) for name, slope in found.items()}

    keys = jax.random.split(jax.random.key(0), RANDOM_STEPS)
    return [
        f"reward.terms {name}: no gradient in {RANDOM_STEPS} random steps: SHAC learns from it "
        "through the critic only, from what is observed; ppo needs no gradient"
        for name, norms in jax.jit(jax.vmap(slopes))(keys).items()
        if not jnp.any(norms)
    ]


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
