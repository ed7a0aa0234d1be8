"""Train another vehicle model: the rate-level drone with quadratic drag."""

from pathlib import Path

import jax

import quadjax


class Constants(quadjax.RateConstants):
    """The constants of the rate-level model, and one more."""

    d_2: jax.Array = quadjax.constant("1/m", "drag", "nonnegative")  # quadratic drag


class QuadraticDrag(quadjax.RateModel):
    """The rate-level model with quadratic drag."""

    name, constants = "quadratic_drag", Constants

    def force_moment(self, params, body):
        """Specific force and moment, body."""
        force, moment = super().force_moment(params, body)
        drag = body.velocity * (params.constants.d_2 * quadjax.safe_norm(body.velocity))
        return force - drag, moment


MODEL = QuadraticDrag()


def main():
    drone = Path(__file__).with_suffix(".yaml")
    model = ["vehicle.model=05_vehicle_model:MODEL", f"vehicle={drone}"]
    config = quadjax.load("indi", [*model, "name=quadratic_drag"])
    run = quadjax.train(config, overwrite=True)
    print(run.policy.vehicle, config.vehicle.constants)
    print(quadjax.evaluate(run.policy, config).table())


if __name__ == "__main__":
    main()
