"""The rate-and-thrust model (INDI) of a drone from flights with its inner loop.

Time constants are those of ``quadjax.fitting.lag``: body rates that follow their commands, and the
specific thrust, ``-f_z`` of the accelerometer, that follows its own. Drag is fitted to the
accelerometer's other two axes, as the constants of the other models. The commands' limits are
choices, not properties of the drone: those of the base vehicle are kept.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadjax.fitting.axes import fit_axes
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import fit_lag, followed
from quadjax.fitting.prepare import prepare
from quadjax.fitting.regression import Estimate
from quadjax.vehicle.rate import RateConstants

LEAST_RATE, LEAST_THRUST = 0.05, 0.2  # rad/s and m/s^2, of the commands' change
LEAST_EXPLAINED = 0.2  # R^2 of a lag that is used


def fit_rate_model(
    logs: Sequence[FlightLog], rows: Sequence[np.ndarray], base: RateConstants, cutoff: float
) -> list[Estimate]:
    """Fit the model over the flights that have commanded rates and thrust; empty without any.

    Args:
        logs: the flights.
        rows: of each, (n,) bool.
        base: constants of the base vehicle.
        cutoff: of the low-pass of the drag's samples, Hz.
    """
    usable = [
        (log, used)
        for log, used in zip(logs, rows, strict=True)
        if log.rate_command is not None and log.thrust_command is not None and used.any()
    ]
    if not usable:
        return []
    rates = [followed(log, used, log.rates, log.rate_command) for log, used in usable]
    thrusts = [
        followed(log, used, -log.specific_force[:, 2:], log.thrust_command[:, None])
        for log, used in usable
    ]
    lags = [
        fit_lag(rates, float(base.tau_rate), "tau_rate", "body rates", LEAST_RATE, LEAST_EXPLAINED),
        fit_lag(
            thrusts, float(base.tau_thrust), "tau_thrust", "thrust", LEAST_THRUST, LEAST_EXPLAINED
        ),
    ]
    flights, used_rows = zip(*usable, strict=True)
    drags = fit_axes(prepare(flights, base, cutoff, used_rows), base)
    return [replace(estimate, group="rate") for estimate in (*lags, *drags)]
