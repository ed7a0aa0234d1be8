"""Another learner on the race: evolution strategies, which need no gradient and no critic."""

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

import quadjax


class Evolution(quadjax.Learner):
    num_envs: int = 256  # each flies with a perturbed copy of the network
    horizon: int = 60
    noise: float = 0.05
    learning_rate: float = 0.01
    steps_per_update = property(lambda self: self.num_envs * self.horizon)

    def init(self, task, key):
        w = task.network.init(key, jnp.zeros(task.environments.observation_size))["params"]
        return quadjax.TrainState(w, optax.adam(1.0).init(w), None, (), key, jnp.int32(0))

    def update(self, task, state):
        def step(carry, _):  # of all environments, each until it crashes
            states, alive = carry
            seen = task.environments.observe(task.env_params, states)
            action = jax.vmap(lambda w, x: task.network.apply({"params": w}, x)[0])(weights, seen)
            states, reward, ended, _ = task.environments.step(task.env_params, states, action)
            return (states, alive & ~ended), jnp.where(alive, reward, 0.0)

        key, noise_key, run_key = jax.random.split(state.key, 3)
        flat, unflatten = ravel_pytree(state.params)
        draws = jax.random.normal(noise_key, (self.num_envs, flat.size))
        weights = jax.vmap(unflatten)(flat + self.noise * draws)
        starts = task.environments.reset(task.env_params, jax.random.split(run_key, self.num_envs))
        alive = jnp.ones(self.num_envs, bool)
        reward = jax.lax.scan(step, (starts, alive), None, self.horizon)[1].mean(axis=0)
        score = (reward - reward.mean()) / (reward.std() + 1e-8)
        slope = unflatten(-(score @ draws) / self.num_envs)
        change, optimizer = optax.adam(self.learning_rate).update(slope, state.optimizer)
        w = optax.apply_updates(state.params, change)
        return state.next_state((), key, params=w, optimizer=optimizer), {"reward": reward.mean()}


def main():
    environment, params = quadjax.make_race(quadjax.load("e2e"))
    reward = Evolution().train(environment, params, steps=1_000_000).metrics["reward"]
    print(f"mean reward {reward[:5].mean():.3f} at first, {reward[-5:].mean():.3f} at the end")


if __name__ == "__main__":
    main()
