"""The navigation filter's estimate of the present state, with standard deviations."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.frames import attitude
from quadjax.core.matrix import Sym3, apply
from quadjax.core.vectors import Vec3
from quadjax.plant import covariance as cov
from quadjax.plant.covariance import Transition
from quadjax.plant.ekf import EkfState, InertialSample, MotionEstimate, advance, caller
from quadjax.plant.ekf_params import EkfParams


@struct.dataclass
class NavigationState:
    """Seven vectors: an estimate, its standard deviations or its errors, in the same units."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # rad/s, body
    specific_force: Vec3  # m/s^2, body
    gyro_bias: Vec3  # rad/s, body
    accelerometer_bias: Vec3  # m/s^2, body


@struct.dataclass
class NavigationEstimate:
    """Estimate of the present and its standard deviations."""

    value: NavigationState
    std: NavigationState


def estimate(params: EkfParams, state: EkfState) -> NavigationEstimate:
    """The present state of one drone: the delayed estimate predicted over the buffered samples.

    Rates and specific force are the newest sample less its bias, extrapolated by the low-pass's
    delay along the last difference. Their variance is the sum of the noise's, the bias's and the
    extrapolation error's, from the mean square of recent second differences.

    Args:
        params: of the filter.
        state: from ``ekf.init`` or ``ekf.update``.
    """
    newest, before, motion = state.newest, state.before, state.motion
    rates = newest.gyro + (newest.gyro - before.gyro) * params.gyro_lead - motion.gyro_bias
    force = newest.force + (newest.force - before.force) * params.force_lead - motion.force_bias
    present = _present(params, state, rates, force)
    value = NavigationState(
        present.position,
        present.velocity,
        quaternion.to_euler(present.attitude),
        rates,
        force,
        motion.gyro_bias,
        motion.force_bias,
    )
    return NavigationEstimate(value, _deviations(params, state, present, value.euler))


def _present(params: EkfParams, state: EkfState, rates: Vec3, force: Vec3) -> MotionEstimate:
    call, motion, last = caller(params), state.motion, state.last
    for sample in state.waiting:
        motion = call(_advanced, params.gravity, motion, last, sample)
        last = sample
    # The rest has no measurement: extrapolated rates and force.
    now = InertialSample(rates + motion.gyro_bias, force + motion.force_bias, params.late)
    return call(_advanced, params.gravity, motion, last, now)


def _advanced(
    gravity: jax.Array, motion: MotionEstimate, before: InertialSample, after: InertialSample
) -> MotionEstimate:
    return advance(gravity, motion, before, after)[0]


def _deviations(
    params: EkfParams, state: EkfState, present: MotionEstimate, euler: Vec3
) -> NavigationState:
    p, motion = state.covariance, state.motion
    time = params.late + sum(sample.step for sample in state.waiting)
    fall = params.gravity * time
    turn = present.velocity - motion.velocity
    moved = present.position - motion.position - motion.velocity * time
    ahead = Transition(
        time, turn.replace(z=turn.z - fall), quaternion.matrix(present.attitude) * time
    )
    moved = moved.replace(z=moved.z - 0.5 * fall * time)
    position, velocity, turned = cov.variances_ahead(p, ahead, moved, params.growth(time))
    gyro_bias = p.diagonal[cov.GYRO_BIAS].diagonal()
    force_bias = p.diagonal[cov.FORCE_BIAS].diagonal()
    variances = NavigationState(
        position,
        velocity,
        _euler_variances(turned, euler),
        _extrapolated(params.gyro_variance, params.gyro_lead, gyro_bias, state.roughness.gyro),
        _extrapolated(params.force_variance, params.force_lead, force_bias, state.roughness.force),
        gyro_bias,
        force_bias,
    )
    return jax.tree.map(lambda x: jnp.sqrt(jnp.maximum(x, 0.0)), variances)


def _extrapolated(noise: jax.Array, lead: jax.Array, bias: Vec3, roughness: Vec3) -> Vec3:
    """Variances of a measurement extrapolated by ``lead`` samples along its last difference.

    The error is ``lead (lead + 1) / 2`` second differences; twice that is assumed, because they
    jump with every new command.
    """
    return bias + roughness * (lead * (lead + 1.0)) ** 2 + Vec3(noise, noise, noise)


def _euler_variances(turned: Sym3, euler: Vec3) -> Vec3:
    """Variances of roll, pitch and yaw, rad^2, from the covariance of a rotation vector (world)."""
    a = attitude(euler)
    cos_pitch = jnp.maximum(a.cos_pitch, 1e-3)
    zero = jnp.zeros_like(cos_pitch)
    tangent = a.sin_pitch / cos_pitch
    rows = (
        Vec3(a.cos_yaw / cos_pitch, a.sin_yaw / cos_pitch, zero),
        Vec3(-a.sin_yaw, a.cos_yaw, zero),
        Vec3(a.cos_yaw * tangent, a.sin_yaw * tangent, zero + 1.0),
    )
    spread = (apply(turned.full(), row) for row in rows)
    return Vec3(*(r.x * s.x + r.y * s.y + r.z * s.z for r, s in zip(rows, spread, strict=True)))
