"""What is unknown of the real drone, and how likely a simulated one makes its flights.

See ``benchmarks.calibrate``. The real flights are those of Table I of Ferede et al. (arXiv
2311.16948); ``SHOWN`` is read off a figure of one flight in their notebooks.
"""

from typing import NamedTuple

import numpy as np

from quadjax.evaluation.published import FLOWN_E2E, FLOWN_INDI


class Prior(NamedTuple):
    """Range of an unknown number, uniform in it or in its logarithm, and its value as none."""

    low: float
    high: float
    off: float
    log: bool = False

    def value(self, share: np.ndarray) -> np.ndarray:
        """The number at shares of the prior, 0 to 1."""
        if self.log:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share

    @property
    def off_share(self) -> float:
        """The share of the prior at the value as none."""
        if self.log:
            return float(np.log(self.off / self.low) / np.log(self.high / self.low))
        return (self.off - self.low) / (self.high - self.low)


PRIORS = {
    # 1: the residual, which was fitted to 16 flights of this drone on other days.
    "effects.airframe_force": Prior(0.0, 2.0, 0.0),
    "effects.airframe_moment": Prior(0.0, 2.0, 0.0),
    # The INDI loop was tuned for motors of 18.5 ms, the model of the E2E policy has 60 ms.
    "motors.tau": Prior(0.015, 0.06, 0.06, log=True),
    "motors.lag": Prior(0.0, 0.012, 0.0),  # s, of the motor controllers
    "motors.slowing": Prior(0.7, 2.0, 1.0, log=True),  # controllers drive more than they brake
    "motors.shortfall": Prior(0.0, 0.06, 0.0),  # of 11,050 rpm at most 210
    "delay.command": Prior(0.0, 0.010, 0.0),  # s, up to five control steps
    "effects.inflow": Prior(0.0, 1.5, 0.0),  # 1: curves of measured propellers
    "effects.flapping": Prior(0.0, 1.5, 0.0),
    "battery.rpm_full": Prior(11800.0, 14500.0, 14500.0),  # rpm; 11,050 were observed under load
    "effects.gusts": Prior(0.0, 1.5, 0.0),  # the drone's own wake in a closed hall
    "mass": Prior(0.378, 0.400, 0.389),  # kg; the weight of the model's drone +-3%
}
REAL = {"E2E": FLOWN_E2E, "INDI": FLOWN_INDI}
# Flights that finished: those of Table I and, of E2E, the 16 flights of 18.7 s on average to which
# the residual was fitted. INDI has as many here: no crash of it is reported.
COMPLETE = 21
LAPS = [f"{name} lap {lap}" for name in REAL for lap in range(1, 7)]  # means, s
SPREADS = [f"{name} spread" for name in REAL]  # logarithm of the deviation of a lap, s
FINISHED = [f"{name} finished" for name in REAL]  # logit of the share that finishes
WIDTHS = [f"{name} half width" for name in REAL]  # of the path, m
SHOWN = {  # of one E2E flight: value and standard deviation
    "highest speed": (11050.0, 150.0),  # rpm
    "deviation": (1000.0, 300.0),  # rpm, 95% of its magnitude, from the first-order model
    "frequency": (8.0, 2.0),  # Hz, of that deviation
}
WIDER = (0.3, 0.15)  # m, half widths of the real paths, than of simulated flights
NUMBERS = [*LAPS, *SPREADS, *FINISHED, *WIDTHS, *SHOWN]
MODEL_ERROR = 0.03  # s, of a mean lap: what no setting of the plant is trusted to represent


def log_likelihood(
    numbers: np.ndarray, simulated: np.ndarray, error: np.ndarray | float = 0.0
) -> np.ndarray:
    """Log-likelihood (drones,) of the real flights, up to a constant.

    Normal in each mean lap, with ``MODEL_ERROR``, in the deviations of the flights from their mean,
    and in what is shown; binomial in what finishes.

    Args:
        numbers: (drones, numbers) of simulated drones.
        simulated: (2,) half widths of the simulated paths of both policies, m.
        error: (drones, numbers) standard deviations of an emulator's numbers. Of what finishes its
            lower end counts.
    """
    found = dict(zip(NUMBERS, numbers.T, strict=True))
    errors = dict(zip(NUMBERS, np.broadcast_to(error, numbers.shape).T, strict=True))

    def normal(difference: np.ndarray, *deviations: np.ndarray | float) -> np.ndarray:
        variance = sum(np.square(x) for x in deviations)
        return -0.5 * (np.square(difference) / variance + np.log(variance))

    total = np.zeros(len(numbers))
    for (name, real), width in zip(REAL.items(), simulated, strict=True):
        spread, mean = np.exp(found[f"{name} spread"]), real.mean(axis=0)
        for lap, value in enumerate(mean):
            key = f"{name} lap {lap + 1}"
            of_mean = spread / np.sqrt(len(real))
            total += normal(found[key] - value, MODEL_ERROR, of_mean, errors[key])
        between = np.square(real - mean).sum()
        freedom = real.size - mean.size
        total -= 0.5 * between / spread**2 + freedom * np.log(spread)
        key = f"{name} finished"
        total -= COMPLETE * np.log1p(np.exp(errors[key] - found[key]))
        key = f"{name} half width"
        total += normal(found[key] - width - WIDER[0], WIDER[1], errors[key])
    for key, (value, deviation_of) in SHOWN.items():
        total += normal(found[key] - value, deviation_of, errors[key])
    return total
