"""Add a reward term: a function of the step, with its weight in the config."""

import jax
import jax.numpy as jnp

import quadjax
from quadjax.core.vectors import safe_norm


def fast(step):
    """Speed above 8 m/s, times the duration of the step."""
    return step.time_step * jnp.maximum(safe_norm(step.velocity) - 8.0, 0.0)


def level(step):
    """Squared roll angle, times the duration of the step."""
    return step.time_step * step.euler.x**2


if __name__ == "__main__":
    terms = "reward.terms={own_reward_term:fast: -1.0, own_reward_term:level: -0.5}"
    config = quadjax.load("e2e", [terms, "name=own_reward_term"])
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())

    rewards = []
    for each in (config, quadjax.load("e2e")):
        environment, params = quadjax.make_race(each)
        state = environment.reset(params, jax.random.key(0))
        rewards.append(environment.step(params, state, jnp.zeros(4))[1])
    assert rewards[0] < rewards[1], "the drone starts with some roll"
