"""The pilot of the C in NumPy: its commands at each call by an autopilot's glue."""

import numpy as np

from quadjax.export import emulator
from quadjax.export.estimator_emulator import Battery, Filters
from quadjax.export.integers import quantize, round_shift
from quadjax.export.noise import advanced, sample
from quadjax.export.words import FixedPolicy

MEASURED = ("gyro", "specific_force", "rpm", "body_velocity")  # by the estimators


class PilotEmulator:
    """A policy with its estimators and its clock of steps; one step is a whole number of calls.

    Attributes:
        command: (4,) float32, the command in effect.
    """

    def __init__(self, policy: FixedPolicy, calls: int) -> None:
        """Start before the first call; ``calls``: number of calls per step of the policy."""
        self._policy, self._calls, self._number = policy, calls, 0
        self._filters: Filters | None = None
        self._battery: Battery | None = None
        self._estimated: dict[str, np.ndarray] = {}
        self._counter = 0  # of the noise
        self.reset()

    def reset(self) -> None:
        """The next call starts a race; the estimators continue."""
        network = self._policy.network
        middle = (network.command_low + network.command_high) * 0.5**network.fraction_bits
        self.command: np.ndarray = (0.5 * middle).astype(np.float32)
        self._target, self._before = 0, None
        self._number = 0

    def call(self, vehicle: np.ndarray) -> np.ndarray:
        """The command (4,) float32 at a state, a record of ``build.VEHICLE``."""
        others = vehicle["others_command"]
        self._estimate(vehicle, others if self._before is None else self.command)
        if self._number % self._calls == 0:
            self._step(vehicle)
        self._number += 1
        return self.command

    def _estimate(self, vehicle: np.ndarray, command: np.ndarray) -> None:
        policy = self._policy
        if policy.estimator is not None:
            measured = np.concatenate([vehicle[name] for name in MEASURED])[None]
            self._filters = self._filters or Filters(policy.estimator, measured)
            estimate = self._filters.update(measured)[0]
            self._estimated |= {"moment_ext": estimate[:3], "force_ext": estimate[3:]}
        if policy.battery is not None:
            sample = np.concatenate([vehicle["rpm"], command])[None]
            if self._battery is None:
                self._battery = Battery(policy.battery, sample)
            else:
                self._battery.update(sample)
            self._estimated["highest_rpm"] = self._battery.rpm

    def _step(self, vehicle: np.ndarray) -> None:
        race, network = self._policy.race, self._policy.network
        values = {name: vehicle[name] for name in vehicle.dtype.names or ()}
        values |= {"last_command": self.command} | self._estimated
        parts = [np.atleast_1d(values[name]) for name in race.fields]
        now = quantize(vehicle["position"][None], race.exponents[:3])
        target = np.array([self._target])
        if self._before is not None:
            event = emulator.gate_event(race, self._before, now, target)[0]
            self._target = (self._target + int(event == emulator.PASSED)) % race.gates
        self._before = now
        state = np.concatenate(parts).astype(np.float32)
        q = emulator.observe(race, state[None], np.array([self._target]))[0]
        bits = network.fraction_bits
        command = emulator.forward_rows(network, q)[0, :4].astype(np.int64)
        if noise := self._policy.noise:
            command = sample(network, noise, q, self._counter)[0].astype(np.int64)
            self._counter = advanced(self._counter, 1, len(command))
        if network.model.commands[0].name == "rpm":  # whole rpm
            command, bits = round_shift(command, bits), 0
        self.command = command.astype(np.float32) * np.float32(0.5**bits)
