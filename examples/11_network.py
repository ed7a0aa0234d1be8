"""Networks of your own: layer norm, residual connections and another activation."""

from flax import linen as nn

import quadjax


class Blocks(nn.Module):
    width: int
    outputs: int
    last_scale: float

    @nn.compact
    def __call__(self, inputs):
        x = nn.Dense(self.width)(inputs)
        for _ in range(2):
            x = x + nn.Dense(self.width)(nn.silu(nn.LayerNorm()(x)))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.last_scale))(x)


class ResidualNetworks(quadjax.ActorCritic):
    def make_network(self, outputs, last_scale):
        return Blocks(self.hidden[0], outputs, last_scale)


def main():
    own = "network.module=11_network:ResidualNetworks"
    config = quadjax.load("e2e", [own, "network.hidden=[64]"])
    run = quadjax.train(config, overwrite=True)
    print(run.policy.describe())
    print(quadjax.evaluate(run.policy, config).table())


if __name__ == "__main__":
    main()
