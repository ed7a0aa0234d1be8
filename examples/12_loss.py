"""PPO with another loss: that of the value is clipped, as that of the policy."""

import jax.numpy as jnp

import quadjax


class ClippedPPO(quadjax.PPO):
    value_clip: float = 0.2

    def loss(self, params, network, batch):
        total, metrics = super().loss(params, network, batch)
        old = batch.target - batch.advantage
        value = network.apply({"params": params}, batch.observation, method="value")
        near = old + jnp.clip(value - old, -self.value_clip, self.value_clip)
        error = jnp.maximum((value - batch.target) ** 2, (near - batch.target) ** 2).mean()
        total += self.value_coefficient * (error - metrics["value_loss"])
        return total, metrics | {"value_loss": error}


def main():
    environment, params = quadjax.make_race(quadjax.load("e2e"))
    learner = ClippedPPO(num_envs=256, rollout_length=32)
    reward = learner.train(environment, params, steps=300_000).metrics["reward"]
    print(f"mean reward {reward[:5].mean():.3f} at first, {reward[-5:].mean():.3f} at the end")


if __name__ == "__main__":
    main()
