"""Fitting the residual networks: tasks, training, choice, teaching.

With folds ``0 .. K-1``, one network is trained without each fold (to choose on it) and one on all
of them (to use). To judge the whole procedure, choices included, on a flight that had no say in it,
everything is done again without that flight: training without every *pair* of folds serves both
members of the pair. So for four flights eleven trainings per candidate and seed cover the fit and
its leave-one-flight-out test, and all of them run as one compiled program.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.choose import Choice, Score, choose, refuse_all, score_fold
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.prepare import Samples, thin
from quadjax.fitting.problem import (
    NETWORKS,
    Network,
    Task,
    file_inputs,
    make_task,
    nominal_error,
    nominal_without,
)
from quadjax.fitting.split import Split
from quadjax.fitting.teach import Teacher, teach
from quadjax.fitting.train import Params, train_tasks
from quadjax.vehicle.constants import MotorConstants
from quadjax.vehicle.residual import Layers, Residual

LeftOut = frozenset[int]
Part = tuple[list[Choice], Layers, np.ndarray]  # one network: choices, file layers, grades
ALL: LeftOut = frozenset()


@dataclass(frozen=True)
class ResidualFit:
    """One complete fit, without some folds."""

    constants: MotorConstants  # nominal model of the same rows
    residual: Residual
    choices: dict[str, Choice]  # by axis
    taught: dict[str, float]  # by axis: share of the ensemble's variance that the file keeps


def fit_residuals(
    samples: Samples,
    split: Split,
    base: MotorConstants,
    config: ResidualConfig,
    seed: int,
    leave_one_out: bool,
    fit_constants: bool = True,
    report: Callable[[str], None] = lambda line: None,
) -> dict[LeftOut, ResidualFit]:
    """Fit both networks on all folds and, if asked, once more without each fold.

    Args:
        samples: every row, at the logs' rate.
        split: its folds.
        base: for the inertia, the rpm range and what the nominal model keeps.
        config: the training.
        seed: decides everything random.
        leave_one_out: also fit without each fold, all choices included.
        fit_constants: fit the nominal model as well, to the same rows each time.
        report: told what is being done.

    Returns:
        The fit on everything under ``frozenset()``, those without fold k under ``frozenset({k})``.
    """
    check_residual_config(config)
    every = max(1, int(round(samples.sample_rate / config.sample_rate)))
    thinned, fold = thin(samples, config.sample_rate), split.fold[::every]
    outer = [ALL] + [frozenset({k}) for k in range(split.folds) if leave_one_out]
    left_outs = _left_outs(split.folds, outer)
    constants = {s: nominal_without(samples, split.fold, s, base, fit_constants) for s in left_outs}

    def fit_network(network: Network) -> list[Part]:
        report(f"training the {network.name} network, {len(left_outs)} times {config.seeds} seeds")
        bench = _Bench(network, thinned, fold, base, constants, config, seed)
        teachers = [bench.teacher(s, split.folds) for s in outer]
        report(f"teaching the {network.name} network that the file will hold")
        return _taught(teachers, config, seed)

    # Networks this small leave all but one core idle; the two have nothing to do with each other.
    with ThreadPoolExecutor(max_workers=2) as pool:
        thrust, moment = pool.map(fit_network, NETWORKS.values())
    return {s: _assemble(constants[s], base, thrust[i], moment[i]) for i, s in enumerate(outer)}


def check_residual_config(config: ResidualConfig) -> None:
    """Raise an ``InputError`` for an impossible value of the ``residual`` section."""
    whole = ("hidden_thrust", "hidden_moment", "seeds", "epochs", "batch", "teach_epochs")
    limits = {name: (1.0, np.inf) for name in whole}
    limits |= {"learning_rate": (1e-6, 1.0), "average": (0.0, 0.99999), "decay": (0.0, np.inf)}
    limits |= {"noise": (0.0, 10.0), "sample_rate": (1.0, np.inf), "caution": (0.0, np.inf)}
    limits |= {"min_gain": (0.0, 1.0), "margin": (0.0, 10.0)}
    for name, (low, high) in limits.items():
        if not low <= getattr(config, name) <= high:
            raise InputError(
                f"residual.{name} is {getattr(config, name)}, allowed: {low:g} to {high:g}"
            )
    if config.mirror not in ("auto", "on", "off"):
        raise InputError(f"residual.mirror is {config.mirror!r}, allowed: ['auto', 'on', 'off']")


def zero_residual(base: MotorConstants) -> Residual:
    """A residual that adds nothing."""
    zeros = {
        network.name: (
            (np.zeros((network.inputs, 1)), np.zeros(1)),
            (np.zeros((1, len(network.axes))), np.zeros(len(network.axes))),
        )
        for network in NETWORKS.values()
    }
    return _residual(base, zeros["thrust"], zeros["moment"])


def _left_outs(folds: int, outer: list[LeftOut]) -> list[LeftOut]:
    """Every set of folds that some training does without."""
    sets = [ALL] + [frozenset({k}) for k in range(folds)]
    if len(outer) > 1 and folds > 2:
        sets += [frozenset(pair) for pair in combinations(range(folds), 2)]
    return sets


class _Bench:
    """All trainings of one network, and what they are good for."""

    def __init__(
        self,
        network: Network,
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
        self.longest = int(np.bincount(fold[fold >= 0]).max())

    def params(self, key: tuple[LeftOut, bool]) -> Params:
        """Weights of one task, every leaf (seed, epoch, ..)."""
        index = list(self.tasks).index(key)
        return jax.tree.map(lambda leaf: leaf[index], self.history)

    def score(self, left_out: LeftOut, mirror: bool, held_out: int) -> Score:
        """How one task's ensemble does on a fold that it was trained without."""
        task, rows = self.tasks[left_out, mirror], self.fold == held_out
        inputs = file_inputs(self.network, self.samples.motion[rows], self.rpm_range)
        errors = nominal_error(self.samples[rows], self.constants[left_out])
        return score_fold(
            self.params((left_out, mirror)),
            (inputs - task.centre) / task.scale,
            errors[:, self.network.columns] / task.error_scale,
            self.longest,
        )

    def teacher(self, left_out: LeftOut, folds: int) -> Teacher:
        """Choose on the folds that are left, and gather the ensemble that was chosen."""
        inner = [k for k in range(folds) if k not in left_out]
        if len(inner) > 1:
            candidates = {
                mirror: [self.score(left_out | {k}, mirror, k) for k in inner]
                for mirror in self.mirrors
            }
            choices = choose(self.network.axes, candidates, self.config)
        else:
            choices = refuse_all(self.network.axes, "no second flight is left to validate on")
        keys = [
            (left_out, choice.mirror or len(self.mirrors) == 1 and self.mirrors[0])
            for choice in choices
        ]
        params = [
            jax.tree.map(lambda leaf, e=choice.epoch: leaf[:, e], self.params(key))
            for key, choice in zip(keys, choices, strict=True)
        ]
        return Teacher(self.network, choices, [self.tasks[key] for key in keys], params)


def _taught(teachers: list[Teacher], config: ResidualConfig, seed: int) -> list[Part]:
    taught = teach(teachers, config, seed)
    return [
        (teacher.choices, layers, grade)
        for teacher, (layers, grade) in zip(teachers, taught, strict=True)
    ]


def _assemble(
    constants: MotorConstants, base: MotorConstants, thrust: Part, moment: Part
) -> ResidualFit:
    choices, taught = {}, {}
    for chosen, _, grade in (thrust, moment):
        for choice, share in zip(chosen, grade, strict=True):
            choices[choice.axis], taught[choice.axis] = choice, float(share)
    return ResidualFit(constants, _residual(base, thrust[1], moment[1]), choices, taught)


def _residual(base: MotorConstants, thrust: Layers, moment: Layers) -> Residual:
    return Residual(
        thrust=thrust,
        moment=moment,
        rpm_min=np.float32(base.rpm_min),
        rpm_max=np.float32(base.rpm_max),
        thrust_sign=np.float32(1.0),
    )
