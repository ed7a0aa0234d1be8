"""Add a rule: a function of the step that ends the episode as a collision does."""

import jax
import jax.numpy as jnp

import quadjax


def ceiling(step):
    """Whether the drone is above 2.5 m (z points down)."""
    return step.position.z < -2.5


def steps_of_a_climb(config):
    """Steps until the rule ends the episode of a drone at full thrust, of 60."""
    environment, params = quadjax.make_race(config)

    def step(state, _):
        state, _, terminated, _ = environment.step(params, state, jnp.ones(4))
        return state, terminated

    start = environment.reset(params, jax.random.key(0))
    terminated = jax.lax.scan(step, start, None, 60)[1]
    return int(jnp.argmax(terminated)) if terminated.any() else 60


if __name__ == "__main__":
    config = quadjax.load("e2e_shac", ["rules.extra=[own_rule:ceiling]", "name=own_rule"])
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())
    assert steps_of_a_climb(config) < steps_of_a_climb(quadjax.load("e2e_shac"))
