"""What a policy commands in the states of a flight log, in floats and in fixed point."""

from dataclasses import dataclass

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.fixed import convert
from quadjax.export.flights import observe
from quadjax.export.proof import prove
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import LAST_COMMAND, state_sizes
from quadjax.policy.file import Policy
from quadjax.policy.inference import mean_action, policy_params
from quadjax.policy.pilot import command_ranges
from quadjax.race.layout import split_name
from quadjax.studies.replay.logged import (
    DISTURBANCES,
    Logged,
    Signals,
    commands_of,
    disturbances_of,
    states_of,
)

AT_LIMIT = 1e-3  # of a command's range
RATE_ERROR = 0.05  # of a log's sample rate, of a policy that observes a history


@dataclass(frozen=True)
class Replayed:
    """Commands at every sample of a log: n samples, k commands."""

    names: tuple[str, ...]  # (k,)
    units: tuple[str, ...]
    logged: np.ndarray | None  # (n, k); None without commands in the log
    source: str  # what ``logged`` is
    policy: np.ndarray  # (n, k) float
    fixed: np.ndarray | None  # (n, k) fixed point; None for a policy that cannot be converted
    reason: str  # why ``fixed`` is None
    inside: np.ndarray  # (n,) bool: every input is within its declared range
    clipped: dict[str, float]  # fraction of the samples outside the declared range, by input
    low: np.ndarray  # (k,) lowest command
    high: np.ndarray
    disturbance: str  # the external moment and force that the policy observes; "" for none


def replay_commands(flight: Logged, targets: np.ndarray, own: OwnRace, policy: Policy) -> Replayed:
    """Commands of a policy in the logged states.

    Its commands do not act on the flight. External moments and forces that it observes are those
    of the onboard estimator, with the model of its race, in the log.

    Args:
        flight: the log.
        targets: (n,) index of the gate ahead.
        own: the policy's race, with the track that was flown.
        policy: the policy.

    Raises:
        InputError: a log without a signal that the policy observes.
    """
    model = own.choices.model
    measured, source = commands_of(flight, model), "logged commands"
    actuators = flight.actuators.get(model.actuators.name)
    same = tuple((s.size, s.unit) for s in model.commands) == (model.actuators[1:],)
    if measured is None and same:
        measured, source = actuators, f"logged {model.actuators.name} (no commands in the log)"
    observations, disturbance = _observations(flight, targets, own, measured)
    low, high = (np.asarray(end, np.float64) for end in (policy.command_low, policy.command_high))
    action = np.clip(np.asarray(jax.jit(mean_action)(policy_params(policy), observations)), -1, 1)
    commands = low + 0.5 * (high - low) * (action.astype(np.float64) + 1.0)
    fixed, reason, clipped, inside = None, "", {}, np.ones(len(action), bool)
    try:
        network = convert(policy)
        prove(network, policy)
    except InputError as error:
        reason = str(error)
    else:
        fixed = emulator.commands(network, observations)
        beyond = np.abs(observations) > 2.0 ** np.array(network.box.exponents)
        inside = ~beyond.any(axis=1)
        share = dict(zip(policy.layout.labels, beyond.mean(axis=0), strict=True))
        clipped = {name: float(value) for name, value in share.items() if value > 0.0}
    signals = [signal for signal in model.commands for _ in range(signal.size)]
    places = [i + 1 for signal in model.commands for i in range(signal.size)]
    names = tuple(
        f"{signal.name}_{place}" if signal.size > 1 else signal.name
        for signal, place in zip(signals, places, strict=True)
    )
    units = tuple(signal.unit for signal in signals)
    return Replayed(
        *(names, units, measured, source, commands, fixed, reason, inside, clipped, low, high),
        disturbance,
    )


def _observations(
    flight: Logged, targets: np.ndarray, own: OwnRace, commands: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """Observations (n, inputs) float32, in the scaling of training, and their disturbances."""
    _check_rate(flight, own)
    sizes, last = state_sizes(own.choices.layout, own.choices.model), None
    if LAST_COMMAND in sizes and commands is not None:
        low, high = command_ranges(own.choices, own.params)
        last = np.concatenate([[0.5 * (low + high)], commands[:-1]])
    disturbances, source = _disturbances(flight, own)
    states = states_of(flight, own.choices.model, sizes, last, disturbances)
    return observe(own, states, targets.astype(np.int32)), source


def _disturbances(flight: Logged, own: OwnRace) -> tuple[Signals, str]:
    """The external moment and force that a policy observes, and where they are from."""
    layout = own.choices.layout
    observed = [name for name in layout.names if split_name(name)[0] in DISTURBANCES]
    if not observed:
        return {}, ""
    if layout[observed[0]].source == "none":
        return {}, "zero, as in the training of the policy"
    signals = disturbances_of(flight, own.choices.model, own.params.vehicle)
    if not signals:
        return {}, "taken as zero, as the model has no estimator"
    speeds = "" if flight.speeds_measured else " with simulated rotor speeds"
    return signals, f"estimated from the log{speeds}"


def _check_rate(flight: Logged, own: OwnRace) -> None:
    """Check that a history, which counts steps, has the log's samples as its steps."""
    apart = flight.step / own.time_step - 1.0
    if own.choices.layout.depth and abs(apart) > RATE_ERROR:
        raise InputError(
            f"{flight.path}: {1.0 / flight.step:.4g} samples/s; the policy observes a history, "
            f"which needs a log of {1.0 / own.time_step:.4g} samples/s"
        )


def differences(replayed: Replayed) -> list[dict[str, float | str | None]]:
    """For each command: means, RMS difference, correlation, share at a limit, error of fixed point.

    The last is the largest error where no input is clipped; it is None where there is none.
    """
    rows = []
    for i, (name, unit) in enumerate(zip(replayed.names, replayed.units, strict=True)):
        own = replayed.policy[:, i]
        span = replayed.high[i] - replayed.low[i]
        edge = np.minimum(own - replayed.low[i], replayed.high[i] - own) < AT_LIMIT * span
        row: dict[str, float | str | None] = {
            "command": name,
            "unit": unit,
            "policy_mean": float(own.mean()),
            "at_limit": float(edge.mean()),
            **dict.fromkeys(("logged_mean", "rms_difference", "correlation", "fixed_error")),
        }
        if replayed.logged is not None:
            given = replayed.logged[:, i]
            row |= {
                "logged_mean": float(given.mean()),
                "rms_difference": float(np.sqrt(((own - given) ** 2).mean())),
            }
            if own.std() > 0.0 and given.std() > 0.0:
                row["correlation"] = float(np.corrcoef(own, given)[0, 1])
        if replayed.fixed is not None:
            error = np.abs(replayed.fixed[:, i] - own)[replayed.inside]
            row["fixed_error"] = float(error.max()) if error.size else None
        rows.append(row)
    return rows
