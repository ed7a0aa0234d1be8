"""What simulated flights tell of drones that were not simulated: quadratic regression.

Each of the ``NUMBERS`` of a drone is a quadratic polynomial of its shares of the priors, fitted to
the simulated drones of the last rounds, crashes included, and to those most like the real one. Its
error grows with the distance to them (the leverage of a regression).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.calibration_likelihood import PRIORS, log_likelihood
from quadjax.core.files import read_npz

LAST, BEST, RIDGE = 640, 300, 1e-3  # simulated drones of a fit; weight of small coefficients
CHAINS, TOO_FAR = 256, -1e6
FORMAT = "quadjax-calibration/1"


class Emulator(NamedTuple):
    """Coefficients (features, numbers) and errors (numbers,), and what a likelihood needs."""

    coefficients: np.ndarray
    error: np.ndarray
    inverse: np.ndarray  # (features, features) of the regression's normal equations
    simulated: np.ndarray  # (2,) half widths of simulated paths, m

    def log_likelihood(self, shares: np.ndarray) -> np.ndarray:
        """Of drones (n, keys) of the priors; outside of them there is none."""
        inside = ((shares >= 0.0) & (shares <= 1.0)).all(axis=1)
        x = features(shares)
        leverage = ((x @ self.inverse) * x).sum(axis=1)
        numbers, error = x @ self.coefficients, self.error * np.sqrt(1.0 + leverage)[:, None]
        return np.where(inside, log_likelihood(numbers, self.simulated, error), TOO_FAR)


def features(shares: np.ndarray) -> np.ndarray:
    """A constant, the centered shares (n, keys) and their products."""
    x = 2.0 * shares - 1.0
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], axis=1)


def fitted(shares: np.ndarray, numbers: np.ndarray, simulated: np.ndarray) -> Emulator:
    """The emulator of simulated drones: shares (n, keys), numbers (n, numbers), NaN for none."""
    log = np.nan_to_num(log_likelihood(numbers, simulated), nan=-np.inf)
    near = np.union1d(np.argsort(-log)[:BEST], np.arange(len(log))[-LAST:])
    x, coefficients, error = features(shares[near]), [], []
    for values in numbers[near].T:
        known = np.isfinite(values)
        a, y = x[known], values[known]
        middle = y.mean()
        inverse = np.linalg.inv(a.T @ a + RIDGE * len(a) * np.eye(a.shape[1]))
        solution = inverse @ (a.T @ (y - middle))
        # Each residual as of a fit without its drone.
        leverage = ((a @ inverse) * a).sum(axis=1)
        error.append(np.sqrt(np.mean(((y - middle - a @ solution) / (1.0 - leverage)) ** 2)))
        solution[0] += middle
        coefficients.append(solution)
    inverse = np.linalg.inv(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]))
    return Emulator(np.stack(coefficients, axis=1), np.array(error), inverse, simulated)


def sampled(
    emulator: Emulator,
    first: np.ndarray,
    random: np.random.Generator,
    *,
    temper: float = 1.0,
    fixed: tuple[int, float] | None = None,
    steps: int = 3000,
) -> np.ndarray:
    """Drones (n, keys) of the posterior, with the likelihood to the power ``temper``.

    Differential evolution Markov chains (ter Braak, Statistics and Computing 16, 2006) from the
    drones ``first``. ``fixed`` is the index of a key and the share at which it stays.
    """
    now, free = first.copy(), np.ones(first.shape[1], bool)
    if fixed is not None:
        now[:, fixed[0]], free[fixed[0]] = fixed[1], False
    log, count = temper * emulator.log_likelihood(now), len(first)
    for step in range(steps):
        a, b = (random.permutation(count) for _ in range(2))
        scale = 1.0 if step % 10 == 0 else 2.38 / np.sqrt(2.0 * free.sum())
        moved = now + free * (scale * (now[a] - now[b]) + 0.01 * random.standard_normal(now.shape))
        tried = temper * emulator.log_likelihood(moved)
        taken = np.log(random.random(count)) < tried - log
        now[taken], log[taken] = moved[taken], tried[taken]
    return now


def stored(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares and numbers of the drones of ``benchmarks.calibrate``, and ``Emulator.simulated``."""
    names = ("shares", "numbers", "simulated")
    arrays, _ = read_npz(file, FORMAT, names)
    shares, numbers, simulated = (np.float64(arrays[name]) for name in names)
    return shares, numbers, simulated


def posterior(file: Path, seed: int = 0, fixed: tuple[int, float] | None = None) -> np.ndarray:
    """Drones (chains, keys) of the posterior, by the flights of ``benchmarks.calibrate``."""
    random, emulator = np.random.default_rng(seed), fitted(*stored(file))
    chains = random.random((CHAINS, len(PRIORS)))
    for temper in (0.01, 0.1, 1.0):
        chains = sampled(emulator, chains, random, temper=temper, fixed=fixed)
    return chains
