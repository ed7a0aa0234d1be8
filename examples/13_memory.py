"""A reward term and an observed field with a memory: the integral of the offset from the gate."""

import jax.numpy as jnp

import quadjax


class OffsetIntegral(quadjax.Memory):
    """Leaky integral of the distance to the left or right of the gate's axis, m s."""

    name = "offset_integral"

    def begin(self, model, params, state):
        return jnp.zeros(())

    def advance(self, value, step):
        away, gate = step.position - step.gate.position, step.gate
        offset = gate.cos_yaw * away.y - gate.sin_yaw * away.x
        return (1.0 - step.time_step) * value + step.time_step * offset


def steady_offset(step):
    """Reward term: minus the integral before the step; ``advance`` gives that after it."""
    return -step.time_step * jnp.abs(step.memories["offset_integral"])


def observed(step):
    return [step.memories["offset_integral"]]


steady_offset.memory = memory = OffsetIntegral()
INTEGRAL = quadjax.ObservedField("offset_integral", 1, "m s", "gate", value=observed, memory=memory)


def main():
    changes = ["reward.terms={13_memory:steady_offset: 1.0}"]
    changes += ["observation.extra=[13_memory:INTEGRAL]", "name=memory"]
    run = quadjax.train(quadjax.load("e2e", changes), overwrite=True)
    print(quadjax.evaluate(run.policy, run.config).table())


if __name__ == "__main__":
    main()
