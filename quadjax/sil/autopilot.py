"""The autopilots of software in the loop: one interface, and exported C behind it."""

from pathlib import Path
from typing import Protocol

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.compiler import Failed, Skipped
from quadjax.export.conversion import Converted
from quadjax.export.library import Library
from quadjax.flights.flight import Signal

COUNTED = ("outside steps", "late calls", "nan calls")  # by the pilot, in a race


class Autopilot(Protocol):
    """What flies a simulated drone: called once in every control step."""

    @property
    def label(self) -> str:
        """For the table."""

    @property
    def files(self) -> str:
        """What flies, as text."""

    def begin(self) -> None:
        """A race begins with the next call."""

    def step(self, now_us: int, vehicle: np.ndarray | None) -> tuple[int, np.ndarray]:
        """The status, of ``qj_pilot_status``, and the command (4,) in the model's units.

        Args:
            now_us: time of the call since the start of the race.
            vehicle: the newest state that has arrived, a ``VEHICLE`` (); None before the first.
        """

    def counts(self) -> dict[str, int]:
        """What was wrong in this race, by name."""

    def outside(self) -> list[str]:
        """The inputs of the policy that were outside their range in this race."""

    def signals(self) -> dict[str, Signal]:
        """What it logs, by name, with a row for each call of this race."""


class ExportedC:
    """The C runtime with a policy, compiled for this machine: an ``Autopilot``."""

    def __init__(self, converted: Converted, work: Path, frequency: float) -> None:
        """Compile it in a folder and start its pilot, whose calls come at a rate, Hz.

        Raises:
            InputError: no compiler, C that does not compile, or a pilot that rejects the policy.
        """
        try:
            self._pilot = Library(converted, work).pilot(frequency)
        except (Skipped, Failed) as error:
            raise InputError(f"the C cannot be compiled: {error}") from None
        in_c = converted.in_c
        if wrong := self._pilot.wrong:
            other = f"; export with --sample-rate {frequency:g}, or fly the policy file itself"
            raise InputError(
                f"{converted.file}: with {frequency:g} calls a second the policy cannot fly: "
                f"{wrong}{other if in_c.sample_rate else ''}"
            )
        estimator = ", its own estimators" * (in_c.sample_rate is not None)
        self.label = f"exported C{estimator}" + ", sampled actions" * (in_c.noise is not None)
        self.files = f"{in_c.name}.h and qj_*.c of {converted.target.folder}/"
        self._before, self._inputs = self._pilot.counts(), in_c.network.box.layout.labels

    def begin(self) -> None:
        """A race begins with the next call."""
        self._pilot.reset()
        self._before = self._pilot.counts()

    def step(self, now_us: int, vehicle: np.ndarray | None) -> tuple[int, np.ndarray]:
        """See ``Autopilot``."""
        return self._pilot.call(now_us, vehicle)

    def counts(self) -> dict[str, int]:
        """Calls and steps of this race in which something was wrong with the state."""
        now = self._pilot.counts()
        return {name: now[name] - self._before[name] for name in COUNTED}

    def outside(self) -> list[str]:
        """The inputs that were outside their range in this race."""
        return [label for bit in self._pilot.outside() for label in self._inputs[bit : bit + 1]]

    def signals(self) -> dict[str, Signal]:
        """Nothing: its commands are those of the flight."""
        return {}
