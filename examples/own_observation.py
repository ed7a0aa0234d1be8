"""Add a field to the observation: a function of the drone in its race."""

import quadjax
from quadjax.core.vectors import safe_norm


def speed(step):
    """Speed, m/s, in tenths."""
    return [0.1 * safe_norm(step.velocity)]


SPEED = quadjax.Field("speed", 1, "10 m/s", "world", range=4.0, value=speed)

if __name__ == "__main__":
    overrides = ["observation.extra=[own_observation:SPEED]", "name=own_observation"]
    config = quadjax.load("e2e", overrides)
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())

    policy = quadjax.Policy.load(run.folder / "policy.npz")  # the file contains the layout
    assert policy.layout.size == 25 and policy.layout.names[-1] == "speed"
