"""Train your own vehicle model: the rate-level drone with quadratic drag."""

import dataclasses

import jax
from flax import struct

import quadjax
from quadjax.core.vectors import safe_norm
from quadjax.vehicle import rate
from quadjax.vehicle.constants import RateConstants


@struct.dataclass
class Constants(RateConstants):
    """The constants of the rate-level model, and one more."""

    d_2: jax.Array  # quadratic drag, 1/m


def derivative(params, state, command, *call):
    """Time derivative of the state."""
    slope = rate.derivative(params, state, command, *call)
    drag = state.velocity * (params.constants.d_2 * safe_norm(state.velocity))
    return slope.replace(velocity=slope.velocity - drag)


MODEL = dataclasses.replace(
    rate.MODEL, name="quadratic_drag", constants=Constants, derivative=derivative
)

if __name__ == "__main__":
    overrides = ["vehicle.model=own_vehicle:MODEL", "vehicle=own_vehicle.yaml", "name=own_vehicle"]
    config = quadjax.load("indi", overrides)
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())
    assert run.policy.vehicle == "quadratic_drag"
    assert config.vehicle.constants["d_2"] == 0.02
