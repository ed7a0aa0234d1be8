"""What of the race changes while a policy trains, around a learner that knows nothing of it."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.learn.state import Learner, Metrics, TrainState
from quadjax.race.environment import RaceParams
from quadjax.vehicle.residual import scale_residual


@struct.dataclass
class Ramped:
    """A learner's hyperparameters, and between which steps the residual grows."""

    hyper: object
    begin: jax.Array  # () environment steps
    end: jax.Array  # ()


def ramp(steps: jax.Array, begin: jax.Array, end: jax.Array) -> jax.Array:
    """0 up to ``begin``, 1 from ``end`` on, and linear between them."""
    rising = (steps - begin) / jnp.maximum(end - begin, 1.0)
    return jnp.where(steps >= end, 1.0, jnp.clip(rising, 0.0, 1.0))


def with_residual_share(params: RaceParams, share: jax.Array) -> RaceParams:
    """The race with a share () of its residual, in the drone and in what is believed on board."""

    def lessen(vehicle: object) -> object:
        return vehicle.replace(residual=scale_residual(vehicle.residual, share))

    estimator = params.estimator
    if estimator is not None:
        estimator = estimator.replace(vehicle=lessen(estimator.vehicle))
    return params.replace(vehicle=lessen(params.vehicle), estimator=estimator)


def ramp_residual(learner: Learner[RaceParams], begin: float, end: float) -> Learner[RaceParams]:
    """The learner on a drone whose residual grows from nothing to all of it.

    Args:
        learner: on a race whose vehicle has a residual.
        begin: environment steps before which there is none.
        end: environment steps from which on there is all of it.
    """

    def update(ramped: Ramped, params: RaceParams, state: TrainState) -> tuple[TrainState, Metrics]:
        steps = state.update.astype(jnp.float32) * learner.steps_per_update
        share = ramp(steps, ramped.begin, ramped.end)
        return learner.update(ramped.hyper, with_residual_share(params, share), state)

    ramped = Ramped(learner.hyper, jnp.float32(begin), jnp.float32(end))
    return dataclasses.replace(learner, update=update, hyper=ramped)
