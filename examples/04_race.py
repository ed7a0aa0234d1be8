"""Add a reward term, a rule and an observed field to the race: functions of one step."""

import jax
import jax.numpy as jnp

import quadjax


def out_of_view(step):
    """Reward term: 1 minus the cosine of the angle from a forward camera's axis to the gate."""
    to_gate = step.drone.to_body(step.gate.position - step.position)
    return step.time_step * (1.0 - to_gate.x / jnp.maximum(step.distance, 0.1))


def ceiling(step):
    """Rule: the episode ends above 2.5 m, as by a collision (z points down)."""
    return step.position.z < -2.5


def speed(step):
    """Observed field: speed, in tens of m/s."""
    return [0.1 * quadjax.safe_norm(step.velocity)]


SPEED = quadjax.ObservedField("speed", 1, "10 m/s", "world", range=4.0, value=speed)
CHANGES = [  # modules are imported from the current folder, or from that of the script
    "reward.terms={04_race:out_of_view: -0.5}",
    "rules.extra=[04_race:ceiling]",
    "observation.extra=[04_race:SPEED]",
]


def main():
    config = quadjax.load("e2e", ["name=changed_race", *CHANGES])
    run = quadjax.train(config, overwrite=True)
    print(quadjax.evaluate(run.policy, config).table())
    print("observed:", ", ".join(quadjax.Policy.load(run.folder / "policy.npz").layout.names))
    for name, race in (("changed", config), ("published", quadjax.load("e2e"))):
        environment, params = quadjax.make_race(race)
        state = environment.reset(params, jax.random.key(0))
        _, reward, _, _ = environment.step(params, state, jnp.zeros(4))
        print(f"{name} race: reward of the first step {reward:.4f}")


if __name__ == "__main__":
    main()
