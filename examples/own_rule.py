"""Add a rule: a function of the step that ends the episode as a collision does."""

import jax
import jax.numpy as jnp

import quadjax


def ceiling(step):
    """Whether the drone is above 2.5 m (z points down)."""
    return step.position.z < -2.5


def ends_at_3_m(config):
    """Whether a step of a drone at 3 m ends the episode."""
    environment, params = quadjax.make_race(config)
    state = environment.reset(params, jax.random.key(0))
    position = state.drone.position.replace(z=jnp.float32(-3.0))
    state = state.replace(drone=state.drone.replace(position=position))
    _, _, terminated, _ = environment.step(params, state, jnp.zeros(4))
    return bool(terminated)


if __name__ == "__main__":
    config = quadjax.load("e2e", ["rules.extra=[own_rule:ceiling]", "name=own_rule"])
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())
    assert ends_at_3_m(config) and not ends_at_3_m(quadjax.load("e2e"))
