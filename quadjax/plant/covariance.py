"""Covariance of the navigation filter's fifteen errors, in 3 x 3 blocks.

Errors, in this order: position (m, world), velocity (m/s, world), attitude (rad, world: the
rotation vector that turns the estimated attitude into the true one, on the left), gyro bias
(rad/s, body) and accelerometer bias (m/s^2, body). The true value is the estimated one plus the
error, for the attitude ``q_true = exp(error) * q``.

Only the 120 entries of the upper triangle are stored, so the matrix is symmetric by construction.
The transition is mostly zeros and ones: a prediction takes 20 products of blocks, not 250.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.materialize import Caller, call_directly
from quadjax.core.matrix import (
    Mat3,
    Sym3,
    apply,
    inverse,
    skew,
    skew_times,
    times,
    times_skew,
    times_transposed,
    transpose,
)
from quadjax.core.vectors import Vec3, dot

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, FORCE_BIAS = range(5)
_PAIRS = tuple((i, j) for i in range(5) for j in range(i + 1, 5))


@struct.dataclass
class Covariance:
    """A 15 x 15 matrix as five diagonal blocks and the ten above them."""

    diagonal: tuple[Sym3, ...]
    upper: tuple[Mat3, ...]  # in the order of rows, then columns

    def block(self, row: int, column: int) -> Mat3:
        """The block of two of the five errors."""
        if row == column:
            return self.diagonal[row].full()
        if row > column:
            return transpose(self.block(column, row))
        return self.upper[_PAIRS.index((row, column))]

    def array(self) -> jax.Array:
        """The matrix (15, 15)."""
        return jnp.concatenate(
            [
                jnp.concatenate([self.block(i, j).array() for j in range(5)], axis=1)
                for i in range(5)
            ]
        )


@struct.dataclass
class Growth:
    """Variances added by one step of sensor noise."""

    velocity: jax.Array  # (m/s)^2
    attitude: jax.Array  # rad^2
    gyro_bias: jax.Array  # (rad/s)^2
    force_bias: jax.Array  # (m/s^2)^2


@struct.dataclass
class Transition:
    """Transition of the errors over one step; all other entries are zero or one.

    With ``S = [turn]x``: position += step velocity + step/2 (velocity's change),
    velocity += -S attitude - R force bias, attitude += -R gyro bias.
    """

    step: jax.Array  # s
    turn: Vec3  # specific force in the world frame times step, m/s
    rotation: Mat3  # body to world, times step, s


def diagonal_covariance(standard_deviations: tuple[jax.Array, ...]) -> Covariance:
    """Independent, isotropic errors of five standard deviations."""
    zero = jnp.zeros_like(standard_deviations[0])
    empty = Mat3(*(Vec3(zero, zero, zero) for _ in range(3)))
    blocks = tuple(Sym3.isotropic(value * value) for value in standard_deviations)
    return Covariance(blocks, tuple(empty for _ in _PAIRS))


def predict(
    covariance: Covariance, transition: Transition, growth: Growth, call: Caller = call_directly
) -> Covariance:
    """``F P F^T + Q`` by blocks.

    Args:
        covariance: before the step.
        transition: ``F``.
        growth: ``Q``; the velocity's noise also moves the position by half a step of it.
        call: calls a function; see ``quadjax.core.materialize``.
    """
    half = call(_rows, covariance, transition)
    return call(_columns, covariance, half, transition, growth)


@struct.dataclass
class _Half:
    """The needed blocks of ``F P``: rows of position, velocity and attitude."""

    position: tuple[Mat3, ...]  # all five columns
    velocity: tuple[Mat3, ...]  # all but position
    attitude: tuple[Mat3, ...]  # all but position and velocity


def _rows(p: Covariance, f: Transition) -> _Half:
    change = [
        (skew_times(f.turn, p.block(ATTITUDE, j)) + times(f.rotation, p.block(FORCE_BIAS, j)))
        * -1.0
        for j in range(5)
    ]
    position = tuple(
        p.block(POSITION, j) + p.block(VELOCITY, j) * f.step + change[j] * (0.5 * f.step)
        for j in range(5)
    )
    velocity = tuple(p.block(VELOCITY, j) + change[j] for j in range(1, 5))
    attitude = tuple(
        p.block(ATTITUDE, j) - times(f.rotation, p.block(GYRO_BIAS, j)) for j in range(2, 5)
    )
    return _Half(position, velocity, attitude)


def _columns(p: Covariance, half: _Half, f: Transition, q: Growth) -> Covariance:
    def turned(row: tuple[Mat3, ...]) -> Mat3:  # the attitude column, from the last three of a row
        return row[-3] - times_transposed(row[-2], f.rotation)

    def moved(row: tuple[Mat3, ...]) -> Mat3:  # the change of the velocity column
        return times_skew(row[-3], f.turn) - times_transposed(row[-1], f.rotation)

    of_position, of_velocity = moved(half.position), moved(half.velocity)
    position = half.position[0] + half.position[1] * f.step + of_position * (0.5 * f.step)
    noise = 0.5 * f.step * q.velocity
    position_velocity = half.position[1] + of_position
    diagonal = (
        Sym3.of(position).plus(0.5 * f.step * noise),
        Sym3.of(half.velocity[0] + of_velocity).plus(q.velocity),
        Sym3.of(turned(half.attitude)).plus(q.attitude),
        p.diagonal[GYRO_BIAS].plus(q.gyro_bias),
        p.diagonal[FORCE_BIAS].plus(q.force_bias),
    )
    upper = (
        position_velocity + Sym3.isotropic(noise).full(),
        turned(half.position),
        *half.position[3:],
        turned(half.velocity),
        *half.velocity[2:],
        *half.attitude[1:],
        p.block(GYRO_BIAS, FORCE_BIAS),
    )
    return Covariance(diagonal, upper)


def correct(
    covariance: Covariance, error: int, innovation: Vec3, variance: jax.Array, weight: jax.Array
) -> tuple[tuple[Vec3, ...], Covariance]:
    """Correct with a direct measurement of one of the five errors.

    ``K = P H^T S^-1``, ``P <- P - K H P`` on the upper triangle, ``S = H P H^T + variance``.

    Args:
        covariance: before the measurement.
        error: which of the five is measured, on all three axes.
        innovation: measured less expected.
        variance: () of the measurement's noise, on each axis.
        weight: () 1 to use it, 0 to change nothing.

    Returns:
        The corrections of the five errors, and the covariance afterwards.
    """
    certainty = inverse(covariance.diagonal[error].plus(variance)).full() * weight
    columns = [covariance.block(i, error) for i in range(5)]
    gains = [times(column, certainty) for column in columns]
    corrections = tuple(apply(gain, innovation) for gain in gains)
    taken = {(i, j): times_transposed(gains[i], columns[j]) for i in range(5) for j in range(i, 5)}
    diagonal = tuple(Sym3.of(covariance.block(i, i) - taken[i, i]) for i in range(5))
    upper = tuple(block - taken[pair] for block, pair in zip(covariance.upper, _PAIRS, strict=True))
    return corrections, Covariance(diagonal, upper)


def variances_ahead(
    p: Covariance, ahead: Transition, moved: Vec3, growth: Growth
) -> tuple[Vec3, Vec3, Sym3]:
    """Variances of position and velocity, and the attitude block, some time ahead.

    One transition over the whole time, from the preintegrated measurements (Forster et al.,
    "On-manifold preintegration for real-time visual-inertial odometry", arXiv 1512.02363,
    section VI).

    Args:
        p: present covariance.
        ahead: ``step`` the time, ``turn`` the velocity's change by specific force, m/s.
        moved: the position's change by specific force, m.
        growth: variances added over the time.

    Returns:
        Variances (m^2), (m/s)^2 on each axis, and the attitude's covariance, rad^2.
    """
    time, rotation = ahead.step, ahead.rotation
    one = jnp.ones_like(time)
    position = _diagonal(
        p,
        ((POSITION, one), (VELOCITY, time)),
        ((ATTITUDE, skew(moved) * -1.0), (FORCE_BIAS, rotation * (-0.5 * time))),
    )
    velocity = _diagonal(
        p, ((VELOCITY, one),), ((ATTITUDE, skew(ahead.turn) * -1.0), (FORCE_BIAS, rotation * -1.0))
    )
    turned = times(rotation, p.block(GYRO_BIAS, ATTITUDE))
    bias = times_transposed(times(rotation, p.block(GYRO_BIAS, GYRO_BIAS)), rotation)
    attitude = p.block(ATTITUDE, ATTITUDE) - turned - transpose(turned) + bias
    drift = time * time * growth.velocity / 3.0
    return (
        position + Vec3(drift, drift, drift),
        velocity + Vec3(growth.velocity, growth.velocity, growth.velocity),
        Sym3.of(attitude).plus(growth.attitude),
    )


def _diagonal(
    p: Covariance,
    direct: tuple[tuple[int, jax.Array], ...],
    levers: tuple[tuple[int, Mat3], ...],
) -> Vec3:
    """Diagonal of ``C P C^T``; ``C`` sums errors times a number and errors times a matrix."""
    result = []
    for axis in range(3):
        total = sum(a * b * p.block(i, j).rows()[axis][axis] for i, a in direct for j, b in direct)
        for j, lever in levers:
            row = lever.rows()[axis]
            for i, a in direct:
                total = total + 2.0 * a * dot(p.block(i, j).rows()[axis], row)
            for i, other in levers:
                total = total + dot(other.rows()[axis], apply(p.block(i, j), row))
        result.append(total)
    return Vec3(*result)
