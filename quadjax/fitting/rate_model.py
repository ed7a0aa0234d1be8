"""The rate-and-thrust model (INDI) of a drone from flights with its inner loop.

Time constants are those of ``quadjax.fitting.lag``: body rates that follow their commands, and the
specific thrust, ``-f_z`` of the accelerometer, that follows its own. Drag is least squares of the
accelerometer's other two axes on the body velocity, ``f_x = -d_x v_x``. The commands' limits are
choices, not properties of the drone: those of the base vehicle are kept.
"""

from dataclasses import dataclass

import numpy as np

from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import LagFit, fit_lag, followed
from quadjax.fitting.least_squares import half_seconds, r_squared
from quadjax.fitting.nominal import AXES
from quadjax.fitting.prepare import Samples

LEAST_RATE, LEAST_THRUST = 0.05, 0.2  # rad/s and m/s^2, of the commands' change
LEAST_EXPLAINED = 0.2  # R^2 of a lag that is used


@dataclass(frozen=True)
class RateFit:
    """Fitted constants of the rate-and-thrust model, by name."""

    values: dict[str, float]
    standard_errors: dict[str, float]
    r_squared: dict[str, float]
    warnings: tuple[str, ...]


def fit_rate_model(
    logs: list[FlightLog],
    flying: list[np.ndarray],
    training: list[int],
    samples: Samples,
    base: dict[str, float],
) -> RateFit | None:
    """Fit the model over the flights that have commanded rates and thrust; None without any.

    Args:
        logs: the flights.
        flying: rows of each in flight, (n,) bool.
        training: indices of the flights that are used.
        samples: prepared rows of the flights, in the same order.
        base: the base vehicle's constants.
    """
    usable = [
        index
        for index in training
        if logs[index].rate_command is not None and logs[index].thrust_command is not None
    ]
    if not usable:
        return None
    lags = {
        "tau_rate": _rate_lag(logs, flying, usable, base["tau_rate"]),
        "tau_thrust": _thrust_lag(logs, flying, usable, base["tau_thrust"]),
    }
    values, errors, explained = {}, {}, {}
    rows = np.isin(samples.flight, usable)
    for name, axis in (("d_x", "ax"), ("d_y", "ay")):
        values[name], errors[name], explained[name] = _drag(samples[rows], axis)
    warnings = []
    for name, lag in lags.items():
        explains = lag.r_squared > LEAST_EXPLAINED and np.isfinite(lag.standard_error)
        values[name] = lag.tau if explains else base[name]
        errors[name], explained[name] = lag.standard_error, lag.r_squared
        if explains or not np.isfinite(lag.standard_error):
            warnings += [lag.warning] if lag.warning else []
        else:
            warnings.append(
                f"{name}: a lag explains {max(lag.r_squared, 0.0):.0%} of the signal in the logs; "
                f"the base vehicle's {base[name]:g} s is kept"
            )
    for name in ("d_x", "d_y"):
        if not values[name] > 2.0 * errors[name]:
            warnings.append(
                f"{name}: {values[name]:.3g} +- {errors[name]:.2g} 1/s is not above zero; the base "
                f"vehicle's {base[name]:g} is kept"
            )
            values[name] = base[name]
    return RateFit(values, errors, explained, tuple(warnings))


def _rate_lag(
    logs: list[FlightLog], flying: list[np.ndarray], usable: list[int], base: float
) -> LagFit:
    parts = [followed(logs[i], flying[i], logs[i].rates, logs[i].rate_command) for i in usable]
    return fit_lag(parts, base, "tau_rate", "body rates", LEAST_RATE)


def _thrust_lag(
    logs: list[FlightLog], flying: list[np.ndarray], usable: list[int], base: float
) -> LagFit:
    parts = [
        followed(
            logs[i], flying[i], -logs[i].specific_force[:, 2:], logs[i].thrust_command[:, None]
        )
        for i in usable
    ]
    return fit_lag(parts, base, "tau_thrust", "thrust", LEAST_THRUST)


def _drag(samples: Samples, axis: str) -> tuple[float, float, float]:
    """Drag constant, 1/s, its cluster-robust standard error, and R^2 about the mean force."""
    column = AXES.index(axis)
    v, f = samples.motion.body_velocity[:, column], samples.measured[:, column]
    square = float(v @ v)
    drag = -float(v @ f) / square
    scores = np.bincount(half_seconds(samples), (f + drag * v) * v)
    error = float(np.sqrt((scores**2).sum())) / square
    return drag, error, float(r_squared(f, -drag * v))
