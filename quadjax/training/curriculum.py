"""What of the race changes while a policy trains, around a learner that knows nothing of it."""

import dataclasses

import jax
import jax.numpy as jnp

from quadjax.config.schema import Config
from quadjax.learners.state import Learner, Metrics, TrainState
from quadjax.race.environment import RaceParams
from quadjax.race.track import into_bend
from quadjax.vehicle.residual import scale_residual

Span = tuple[float, float]  # environment steps: nothing before the first, all from the second on


@dataclasses.dataclass(frozen=True)
class Curriculum:
    """What grows in, and when; the price of pitch fades while the yaw of a start grows."""

    residual: Span = (0.0, 0.0)  # of the vehicle
    yaw: Span = (0.0, 0.0)  # by which a start may be turned away from the inside of the bend
    edge: Span = (0.0, 0.0)  # the price of a gate's edge

    def at(self, params: RaceParams, steps: jax.Array) -> RaceParams:
        """The race after so many environment steps ()."""
        if self.yaw[1]:
            share = ramp(steps, self.yaw)
            half_width = share * params.start.yaw
            begin = params.start.replace(yaw=half_width, facing=into_bend(params.track))
            reward = params.reward.replace(nose_up=(1.0 - share) * params.early_nose_up)
            params = params.replace(start=begin, reward=reward)
        if self.edge[1]:
            price = ramp(steps, self.edge) * params.reward.edge
            params = params.replace(reward=params.reward.replace(edge=price))
        if getattr(params.vehicle, "residual", None) is None or not self.residual[1]:
            return params
        return with_residual_share(params, ramp(steps, self.residual))


def curriculum_of(config: Config) -> Curriculum:
    """The curriculum of a config's ramps."""
    train = config.train
    return Curriculum(
        residual=tuple(train.residual_ramp),
        yaw=tuple(train.yaw_ramp),
        edge=tuple(train.edge_ramp),
    )


def ramp(steps: jax.Array, span: Span) -> jax.Array:
    """0 up to the span's first step, 1 from its last on, and linear between them."""
    begin, end = span
    rising = (steps - begin) / max(end - begin, 1.0)
    return jnp.where(steps >= end, 1.0, jnp.clip(rising, 0.0, 1.0))


def with_residual_share(params: RaceParams, share: jax.Array) -> RaceParams:
    """The race with a share () of its residual, in the drone and in what is believed on board."""

    def lessen(vehicle: object) -> object:
        return vehicle.replace(residual=scale_residual(vehicle.residual, share))

    estimator = params.estimator
    if estimator is not None:
        estimator = estimator.replace(vehicle=lessen(estimator.vehicle))
    return params.replace(vehicle=lessen(params.vehicle), estimator=estimator)


def follow(learner: Learner[RaceParams], curriculum: Curriculum) -> Learner[RaceParams]:
    """The learner on a race that changes from update to update as a curriculum says.

    The curriculum is static: another one is another program.
    """

    def init(hyper: object, params: RaceParams, key: jax.Array) -> TrainState:
        return learner.init(hyper, curriculum.at(params, jnp.zeros(())), key)

    def update(hyper: object, params: RaceParams, state: TrainState) -> tuple[TrainState, Metrics]:
        steps = state.update.astype(jnp.float32) * learner.steps_per_update
        return learner.update(hyper, curriculum.at(params, steps), state)

    return dataclasses.replace(learner, init=init, update=update)
