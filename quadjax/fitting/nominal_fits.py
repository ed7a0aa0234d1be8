"""The constants of a model, fitted without some folds of the flights."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from quadjax.fitting.axes import fit_axes, nominal_error, with_common, with_estimates
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.motor_map import fit_motors, with_simulated_speeds
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants
from quadjax.fitting.prepare import Samples, prepare
from quadjax.fitting.regression import Estimate
from quadjax.fitting.split import ALL, LeftOut, Split
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.racing import RacingConstants


class NominalFits(ABC):
    """Fits of one model; each is computed once.

    Attributes:
        config: of the fit.
        logs: the flights.
        rows: of each, (n,) bool, that are in flight.
        split: of these rows.
        base: constants of the base vehicle.
    """

    base: Constants

    def __init__(
        self,
        config: FitConfig,
        logs: Sequence[FlightLog],
        rows: Sequence[np.ndarray],
        split: Split,
    ) -> None:
        self.config, self.logs, self.rows, self.split = config, logs, rows, split
        self._fits: dict[LeftOut, tuple[Samples, list[Estimate]]] = {}

    @abstractmethod
    def _fit(self, left_out: LeftOut) -> tuple[Samples, list[Estimate]]:
        """Every row as it is without some folds, and the constants fitted without them."""

    @abstractmethod
    def constants(self, left_out: LeftOut) -> Constants:
        """The model without some folds."""

    def samples(self, left_out: LeftOut = ALL) -> Samples:
        """Every row; nothing in them is computed from the folds left out."""
        return self._of(left_out)[0]

    def estimates(self, left_out: LeftOut = ALL) -> list[Estimate]:
        """The constants that are fitted without some folds, with their errors."""
        return self._of(left_out)[1]

    def masks(self, left_out: LeftOut = ALL) -> list[np.ndarray]:
        """The rows (n,) bool of each flight that are in flight and not left out."""
        ends = np.cumsum([int(rows.sum()) for rows in self.rows])[:-1]
        masks = [rows.copy() for rows in self.rows]
        parts = np.split(self.split.learned(left_out), ends)
        for mask, learned in zip(masks, parts, strict=True):
            mask[mask] = learned
        return masks

    def harmful(self, left_out: LeftOut = ALL) -> dict[str, str]:
        """A line for each axis on which the base vehicle's constants are kept."""
        return {}

    def _of(self, left_out: LeftOut) -> tuple[Samples, list[Estimate]]:
        if left_out not in self._fits:
            self._fits[left_out] = self._fit(left_out)
        return self._fits[left_out]

    def _axes(self, samples: Samples, left_out: LeftOut, base: Constants) -> list[Estimate]:
        estimates = fit_axes(samples[self.split.learned(left_out)], base)
        return [fit for fit in estimates if fit.group in self.config.nominal.axes]


class MotorFits(NominalFits):
    """Fits of the model ``motor``, with the base vehicle's constants on axes where they are better.

    Whether they are is decided on the folds that are not left out, each by a fit without it, too.
    """

    base: MotorConstants

    def __init__(
        self,
        config: FitConfig,
        logs: Sequence[FlightLog],
        rows: Sequence[np.ndarray],
        split: Split,
        base: MotorConstants,
    ) -> None:
        super().__init__(config, logs, rows, split)
        self.base = base
        self._samples = prepare(logs, base, config.prepare.cutoff, rows)

    def _fit(self, left_out: LeftOut) -> tuple[Samples, list[Estimate]]:
        return self._samples, self._axes(self._samples, left_out, self.base)

    def _fitted(self, left_out: LeftOut) -> MotorConstants:
        if not self.config.nominal.fit:
            return self.base
        return with_estimates(self.base, self.estimates(left_out))

    def harmful(self, left_out: LeftOut = ALL) -> dict[str, str]:
        """A line for each axis on which the base vehicle's constants are kept."""
        lines: dict[str, str] = {}
        folds = [k for k in range(self.split.folds) if k not in left_out]
        if len(folds) < 2 or not self.config.nominal.fit:
            return lines
        for fold in folds:
            part = self._samples[self.split.fold == fold]
            fitted, kept = (
                np.sqrt((nominal_error(part, constants) ** 2).mean(axis=0))
                for constants in (self._fitted(left_out | {fold}), self.base)
            )
            changes = fitted / np.maximum(kept, 1e-300) - 1.0
            for axis, change in zip(AXES, changes, strict=True):
                if change > self.config.residual.max_harm:
                    lines[axis] = (
                        f"{axis}: the base vehicle's constants are kept: those fitted without "
                        f"{self.split.names[fold]} have a {100.0 * change:.0f}% larger error on it"
                    )
        return lines

    def constants(self, left_out: LeftOut = ALL) -> MotorConstants:
        """The constants fitted without some folds."""
        of_axis = EQUATIONS[MotorConstants].constants
        names = [name for axis in self.harmful(left_out) for name in of_axis[axis]]
        kept = {name: getattr(self.base, name) for name in names}
        return self._fitted(left_out).replace(**kept)


class RacingFits(NominalFits):
    """Fits of the model ``racing``: motors first, whose speeds are used where logs have none."""

    base: RacingConstants

    def __init__(
        self,
        config: FitConfig,
        logs: Sequence[FlightLog],
        rows: Sequence[np.ndarray],
        split: Split,
        base: RacingConstants,
    ) -> None:
        super().__init__(config, logs, rows, split)
        self.base = base
        self._measured: Samples | None = None

    def _fit(self, left_out: LeftOut) -> tuple[Samples, list[Estimate]]:
        cutoff = self.config.prepare.cutoff
        motors = fit_motors(self.logs, self.masks(left_out), self.base, cutoff)
        samples = self._measured
        if samples is None:
            logs = [with_simulated_speeds(log, motors.values) for log in self.logs]
            samples = prepare(logs, self.base, cutoff, self.rows)
        if all(log.speeds_measured for log in self.logs):
            self._measured = samples
        common = with_common(samples[self.split.learned(left_out)], self.base)
        return samples, [*self._axes(samples, left_out, common), motors]

    def constants(self, left_out: LeftOut = ALL) -> RacingConstants:
        """The constants fitted without some folds."""
        return with_estimates(self.base, self.estimates(left_out))
