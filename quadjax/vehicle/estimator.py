"""Onboard estimate of the external moment and force: measured minus modeled.

Every signal goes through the same causal second-order Butterworth low-pass ``H`` (Ferede et al.,
arXiv 2311.16948: 8 Hz; ``quadjax.core.filters``), so that all of them share its delay::

    M_ext = H [ (I Omega)' + Omega x I Omega - M(rpm, rpm', v, Omega) ]
    F_ext = H [ accelerometer - F(rpm, v) ]

``M`` and ``F`` include the residual networks where the vehicle has them. ``H`` is linear, so the
difference is formed first and filtered once: six filtered channels. The angular momentum and, for
the yaw moment of rotor acceleration, the propeller speeds are differentiated by the filter.

A simulation in explicit Euler steps is not a sampled continuous flight: there the derivative at one
sample is the difference to the *next* one, half a sample later than the bilinear transform takes
it. ``explicit_euler`` delays the moment by the same half sample, with the forward coefficients
``k [0, 2, 2]``: then the estimate is exactly that filter of the true external moment.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.filters import advance, butterworth, settled
from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Measurement, VehicleModel, VehicleParams

DEFAULT_CUTOFF_HZ = 8.0


class EstimatorParams(struct.PyTreeNode):
    """The model that is subtracted and the coefficients of the filter; all but it traced."""

    vehicle: VehicleParams
    feedback: jax.Array  # (2,)
    low_pass: jax.Array  # (3,) forward coefficients, for the force
    low_pass_moment: jax.Array  # (3,) the same, or k [0, 2, 2] in an explicit Euler simulation
    derivative: jax.Array  # (3,) forward coefficients of the derivative, 1/s
    model: VehicleModel = struct.field(pytree_node=False)


class EstimatorState(struct.PyTreeNode):
    """Two numbers of memory for each of the six channels."""

    moment_1: Vec3  # N m
    moment_2: Vec3  # N m
    force_1: Vec3  # m/s^2
    force_2: Vec3  # m/s^2


def estimator_params(
    model: VehicleModel,
    vehicle: VehicleParams,
    sample_rate: Scalar,
    cutoff: Scalar = DEFAULT_CUTOFF_HZ,
    explicit_euler: bool = False,
) -> EstimatorParams:
    """The estimator of one vehicle at a fixed sample rate, Hz; both rates may be traced.

    ``vehicle`` is the model that is subtracted, ``cutoff`` the -3 dB frequency of the low-pass, Hz.
    With ``explicit_euler`` the samples are the steps of an explicit Euler simulation.

    Raises:
        InputError: a cutoff that is not between zero and half the sample rate (where both are
            plain numbers).
    """
    assert model.can_be_disturbed, model.name
    filtered = butterworth(sample_rate, cutoff)
    low_pass, k = filtered.forward, filtered.forward[0]
    late = jnp.stack([jnp.zeros_like(k), 2.0 * k, 2.0 * k]) if explicit_euler else low_pass
    return EstimatorParams(
        vehicle, filtered.feedback, low_pass, late, filtered.derivative, model=model
    )


def init(params: EstimatorParams, measurement: Measurement) -> EstimatorState:
    """The state before the first sample: no disturbance, rates and propeller speeds constant.

    Without this start, the initial rotation of a drone would appear as an external moment.
    Pass the same measurement to the first ``update``.
    """
    momentum, _, force = params.model.balance(params.vehicle, measurement)
    zero = jax.tree.map(jnp.zeros_like, force)
    return EstimatorState(*settled(momentum, params.derivative), zero, zero)


def update(
    params: EstimatorParams, state: EstimatorState, measurement: Measurement
) -> tuple[EstimatorState, Vec3, Vec3]:
    """One sample of the estimator, of one drone.

    Returns:
        The new state, the external moment, N m, and the external specific force, m/s^2, both in
        the body frame and with the delay of the filter (about ``sqrt(2) / (2 pi f_c)``: 28 ms
        at 8 Hz).
    """
    momentum, moment, force = params.model.balance(params.vehicle, measurement)
    moment_ext, moments = advance(
        params.feedback,
        [(moment, params.low_pass_moment), (momentum, params.derivative)],
        (state.moment_1, state.moment_2),
    )
    force_ext, forces = advance(
        params.feedback, [(force, params.low_pass)], (state.force_1, state.force_2)
    )
    return EstimatorState(*moments, *forces), moment_ext, force_ext
