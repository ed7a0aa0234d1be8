"""Train your own vehicle model: the rate-level drone with quadratic drag."""

import jax

import quadjax
from quadjax.core.vectors import safe_norm
from quadjax.vehicle.constants import constant
from quadjax.vehicle.rate import Rate, RateConstants


class Constants(RateConstants):
    """The constants of the rate-level model, and one more."""

    d_2: jax.Array = constant("1/m", "drag", "nonnegative")  # quadratic drag


class QuadraticDrag(Rate):
    """The rate-level model with quadratic drag."""

    name, constants = "quadratic_drag", Constants

    def force_moment(self, params, body):
        """Specific force and moment, body."""
        force, moment = super().force_moment(params, body)
        drag = body.velocity * (params.constants.d_2 * safe_norm(body.velocity))
        return force - drag, moment


MODEL = QuadraticDrag()

if __name__ == "__main__":
    overrides = ["vehicle.model=own_vehicle:MODEL", "vehicle=own_vehicle.yaml", "name=own_vehicle"]
    config = quadjax.load("indi", overrides)
    run = quadjax.train(config)
    print(quadjax.evaluate(run.policy, config).table())
    assert run.policy.vehicle == "quadratic_drag"
    assert config.vehicle.constants["d_2"] == 0.02
