"""Another learner on the race: gradient ascent through the simulator, without a critic."""

import jax
import jax.numpy as jnp
import optax

import quadjax


class GradientAscent(quadjax.LearnerSection):
    num_envs: int = 64
    horizon: int = 40
    learning_rate: float = 3e-3

    def make(self, environment, network, num_updates):
        adam = optax.adam(self.learning_rate)

        def init(hyper, params, key):
            w = network.init(key, jnp.zeros(environment.observation_size))["params"]
            return quadjax.TrainState(w, adam.init(w), None, (), key, jnp.int32(0))

        def loss(w, params, key):  # of one environment, until it crashes
            def step(carry, _):
                state, alive = carry
                seen = environment.observe(params, state)
                action = network.apply({"params": w}, seen, method="mean")
                state, reward, terminated, _ = environment.step(params, state, action)
                return (state, alive & ~terminated), jnp.where(alive, -reward, 0.0)

            start = (environment.reset(params, key), jnp.array(True))
            return jax.lax.scan(step, start, None, self.horizon)[1].mean()

        def update(hyper, params, old):
            keys = jax.random.split(old.key, 1 + self.num_envs)
            differentiate = jax.vmap(jax.value_and_grad(loss), in_axes=(None, None, 0))
            losses, gradients = differentiate(old.params, params, keys[1:])
            gradient = jax.tree.map(lambda g: jnp.nan_to_num(g).mean(axis=0), gradients)
            change, optimizer = adam.update(gradient, old.optimizer)
            w = optax.apply_updates(old.params, change)
            new = quadjax.TrainState(w, optimizer, None, (), keys[0], old.update + 1)
            return new, {"reward": -losses.mean()}

        return quadjax.Learner(init, update, {}, self.num_envs * self.horizon)


def main():
    environment, params = quadjax.make_race(quadjax.load("e2e"))
    result = GradientAscent().train(environment, params, steps=200_000)
    reward = result.metrics["reward"]
    print(f"mean reward {reward[:5].mean():.3f} at first, {reward[-5:].mean():.3f} at the end")


if __name__ == "__main__":
    main()
