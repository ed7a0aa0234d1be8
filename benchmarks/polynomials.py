"""Polynomials of a drone's motion, for ``benchmarks.cyberzoo_airframe``."""

import itertools

import numpy as np

from quadjax.plant.config import VARIABLES

LEAST, MOST = 0.008, 12  # share of the variance that a term explains; terms of a polynomial
SIGNS = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [-1, 1, -1, 1]])
ODD = {"roll", "yaw", "vy", "p", "r"}  # variables that change their sign in a mirror


def variables_of(states: np.ndarray) -> np.ndarray:
    """The ``VARIABLES`` (n, 11) of states (n, 10)."""
    rpm, velocity, rates = states[:, :4] / 1.0e4, states[:, 4:7], states[:, 7:]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return np.column_stack([rpm.mean(axis=1), rpm @ SIGNS.T / 4.0, speed, velocity, rates])


def limits_of(values: np.ndarray) -> np.ndarray:
    """Ends (2, 11) of the variables in flight; alike to both sides where the drone is."""
    ends = np.quantile(values, [0.002, 0.998], axis=0)
    for i, name in enumerate(VARIABLES):
        if name in ODD:
            ends[:, i] = np.abs(ends[:, i]).max() * np.array([-1.0, 1.0])
    ends[0, VARIABLES.index("v")] = 0.0
    ends[:, VARIABLES.index("vx")] = -5.0, 5.0
    return ends


def polynomial(values: np.ndarray, target: np.ndarray, is_odd: bool) -> tuple[dict, float]:
    """Coefficients by term, and the share of the variance of ``target`` (n,) that they explain."""
    pairs = itertools.combinations_with_replacement(range(len(VARIABLES)), 2)
    terms = [(), *((i,) for i in range(len(VARIABLES))), *pairs]
    features = {t: values[:, list(t)].prod(axis=1) for t in terms}
    parity = {t: sum(VARIABLES[i] in ODD for i in t) % 2 for t in terms}
    chosen, left = [()], [t for t in terms if t and parity[t] == is_odd]

    def fit(names: list) -> tuple[np.ndarray, float]:
        columns = np.stack([features[t] for t in names], axis=1)
        solution = np.linalg.lstsq(columns, target, rcond=None)[0]
        return solution, float(1.0 - np.mean((columns @ solution - target) ** 2) / target.var())

    solution, share = fit(chosen)
    while len(chosen) < MOST:
        (_, better), term = max(((fit([*chosen, t]), t) for t in left), key=lambda x: x[0][1])
        if better - share < LEAST:
            break
        chosen, left, share = [*chosen, term], [t for t in left if t != term], better
        solution, _ = fit(chosen)
    names = ("*".join(VARIABLES[i] for i in t) or "1" for t in chosen)
    return dict(zip(names, solution, strict=True)), share
