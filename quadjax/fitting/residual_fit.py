"""Fit of the residual networks: tasks, training, selection, distillation.

With folds ``0 .. K-1``, one network is trained without each fold, to validate on it, and one on all
of them, to use. To evaluate the whole procedure, selection included, on a flight that it has not
seen, everything is repeated without that flight: a training without a *pair* of folds serves both
members of the pair. For four flights, eleven trainings per candidate and seed cover the fit and its
leave-one-flight-out test; all run as one compiled program.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import jax
import numpy as np

from quadjax.core.mlp import Layers
from quadjax.fitting.config import NominalConfig, ResidualConfig
from quadjax.fitting.distill import Ensemble, distill
from quadjax.fitting.nominal import file_inputs
from quadjax.fitting.prepare import Samples, thin
from quadjax.fitting.selection import FoldMoments, Selection, reject_all, score_fold, select
from quadjax.fitting.split import Split
from quadjax.fitting.tasks import (
    NETWORKS,
    ResidualNetwork,
    Task,
    make_task,
    nominal_error,
    nominal_without,
)
from quadjax.fitting.train import padded, train_tasks
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

LeftOut = frozenset[int]
# Of one network: the selection of each axis, the layers, and the R^2 (axes,) of the distillation.
Part = tuple[list[Selection], Layers, np.ndarray]
ALL: LeftOut = frozenset()


@dataclass(frozen=True)
class ResidualFit:
    """One complete fit, without some folds."""

    constants: MotorConstants  # nominal model of the same rows
    residual: Residual
    choices: dict[str, Selection]  # by axis
    distilled: dict[str, float]  # by axis: R^2 of the file's network to the ensemble


def fit_residuals(
    samples: Samples,
    split: Split,
    base: MotorConstants,
    config: ResidualConfig,
    seed: int,
    leave_one_out: bool,
    constants_without: Callable[[LeftOut], MotorConstants] | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> dict[LeftOut, ResidualFit]:
    """Fit both networks on all folds and, if wanted, once more without each fold.

    Args:
        samples: every row, at the logs' rate.
        split: its folds.
        base: with inertia, rpm range and constants that are not fitted.
        config: of the training.
        seed: of everything random.
        leave_one_out: repeat the fit, selection included, without each fold.
        constants_without: nominal model of the rows without some folds; None fits every axis.
        report: called with the progress.

    Returns:
        The fit on everything under ``frozenset()``, those without fold k under ``frozenset({k})``.
    """
    every = max(1, int(round(samples.sample_rate / config.sample_rate)))
    thinned, fold = thin(samples, config.sample_rate), split.fold[::every]
    outer = outer_sets(split, leave_one_out)
    left_outs = [ALL] + [frozenset({k}) for k in range(split.folds)]
    if len(outer) > 1 and split.folds > 2:
        left_outs += [frozenset(pair) for pair in combinations(range(split.folds), 2)]
    constants = {
        s: constants_without(s)
        if constants_without
        else nominal_without(samples, split.fold, s, base, NominalConfig())
        for s in left_outs
    }

    def fit_network(network: ResidualNetwork) -> list[Part]:
        report(f"training the {network.name} network, {len(left_outs)} times {config.seeds} seeds")
        trained = _Trained(network, thinned, fold, base, constants, config, seed)
        ensembles = [trained.select(s, split.folds) for s in outer]
        report(f"distilling the {network.name} network")
        distilled = distill(ensembles, config, seed)
        return [(e.choices, *parts) for e, parts in zip(ensembles, distilled, strict=True)]

    # Networks this small use one core; the two are independent.
    with ThreadPoolExecutor(max_workers=2) as pool:
        thrust, moment = pool.map(fit_network, NETWORKS.values())
    return {s: _assemble(constants[s], base, thrust[i], moment[i]) for i, s in enumerate(outer)}


def outer_sets(split: Split, leave_one_out: bool) -> list[LeftOut]:
    """Folds left out of each complete fit."""
    return [ALL] + [frozenset({fold}) for fold in range(split.folds) if leave_one_out]


def zero_residual(base: MotorConstants) -> Residual:
    """A residual with output zero."""
    thrust, moment = (
        (
            (np.zeros((network.inputs, 1)), np.zeros(1)),
            (np.zeros((1, len(network.axes))), np.zeros(len(network.axes))),
        )
        for network in NETWORKS.values()
    )
    return _residual(base, thrust, moment)


class _Trained:
    """All trainings of one network."""

    def __init__(
        self,
        network: ResidualNetwork,
        samples: Samples,
        fold: np.ndarray,
        base: MotorConstants,
        constants: dict[LeftOut, MotorConstants],
        config: ResidualConfig,
        seed: int,
    ) -> None:
        self.network, self.samples, self.fold, self.config = network, samples, fold, config
        self.constants = constants
        self.rpm_range = (float(base.rpm_min), float(base.rpm_max))
        self.mirrors = {"auto": (True, False), "on": (True,), "off": (False,)}[config.mirror]
        self.tasks: dict[tuple[LeftOut, bool], Task] = {
            (s, mirror): make_task(network, samples, fold, s, mirror, constants[s], self.rpm_range)
            for mirror in self.mirrors
            for s in constants
        }
        self.history = train_tasks(network, list(self.tasks.values()), config, seed)
        self.longest = padded(int(np.bincount(fold[fold >= 0]).max()))

    def layers(self, key: tuple[LeftOut, bool]) -> Layers:
        """Layers of one task, every leaf (seed, epoch, ..)."""
        index = list(self.tasks).index(key)
        return jax.tree.map(lambda leaf: leaf[index], self.history)

    def score(self, left_out: LeftOut, mirror: bool, held_out: int) -> FoldMoments:
        """Scores of one task's ensemble on a fold that it was trained without."""
        task, rows = self.tasks[left_out, mirror], self.fold == held_out
        inputs = file_inputs(self.samples.motion[rows], self.rpm_range)
        errors = nominal_error(self.samples[rows], self.constants[left_out])
        return score_fold(
            self.layers((left_out, mirror)),
            (inputs[:, : self.network.inputs] - task.center) / task.scale,
            errors[:, self.network.columns] / task.error_scale,
            self.longest,
        )

    def select(self, left_out: LeftOut, folds: int) -> Ensemble:
        """The ensemble that is best on the remaining folds."""
        inner = [k for k in range(folds) if k not in left_out]
        if len(inner) > 1:
            candidates = {
                mirror: [self.score(left_out | {k}, mirror, k) for k in inner]
                for mirror in self.mirrors
            }
            choices = select(self.network.axes, candidates, self.config)
        else:
            choices = reject_all(self.network.axes, "no second flight to validate on")
        keys = [
            (left_out, choice.mirror if choice.mirror in self.mirrors else self.mirrors[0])
            for choice in choices
        ]
        layers = [
            jax.tree.map(lambda leaf, e=choice.epoch: leaf[:, e], self.layers(key))
            for key, choice in zip(keys, choices, strict=True)
        ]
        return Ensemble(self.network, choices, [self.tasks[key] for key in keys], layers)


def _assemble(
    constants: MotorConstants, base: MotorConstants, thrust: Part, moment: Part
) -> ResidualFit:
    choices, distilled = {}, {}
    for selected, _, grade in (thrust, moment):
        for choice, r2 in zip(selected, grade, strict=True):
            choices[choice.axis], distilled[choice.axis] = choice, float(r2)
    return ResidualFit(constants, _residual(base, thrust[1], moment[1]), choices, distilled)


def _residual(base: MotorConstants, thrust: Layers, moment: Layers) -> Residual:
    return Residual(
        thrust=thrust,
        moment=moment,
        rpm_min=np.float32(base.rpm_min),
        rpm_max=np.float32(base.rpm_max),
        thrust_sign=np.float32(1.0),
    )
