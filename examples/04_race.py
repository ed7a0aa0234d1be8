"""Add a reward term, a rule and an observed field to the race: functions of one step."""

import jax
import jax.numpy as jnp

import quadjax


def level(step):
    """Reward term: squared roll angle, times the duration of the step."""
    return step.time_step * step.euler.x**2


def ceiling(step):
    """Rule: the episode ends above 2.5 m, as by a collision (z points down)."""
    return step.position.z < -2.5


def speed(step):
    """Observed field: speed, in tens of m/s."""
    return [0.1 * quadjax.safe_norm(step.velocity)]


SPEED = quadjax.Field("speed", 1, "10 m/s", "world", range=4.0, value=speed)
CHANGES = [  # modules are imported from the current folder, or from that of the script
    "reward.terms={04_race:level: -0.5}",
    "rules.extra=[04_race:ceiling]",
    "observation.extra=[04_race:SPEED]",
]


def main():
    config = quadjax.load("e2e", ["name=changed_race", *CHANGES])
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())
    print("observed:", ", ".join(quadjax.Policy.load(run.folder / "policy.npz").layout.names))
    for name, race in (("changed", config), ("published", quadjax.load("e2e"))):
        environment, params = quadjax.make_race(race)
        state = environment.reset(params, jax.random.key(0))
        _, reward, _, _ = environment.step(params, state, jnp.zeros(4))
        print(f"{name} race: reward of the first step {reward:.4f}")


if __name__ == "__main__":
    main()
