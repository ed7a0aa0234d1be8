"""What a policy commands in the states of a flight log, in floats and in fixed point."""

import dataclasses

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.fixed import convert
from quadjax.export.flights import observe
from quadjax.export.proof import prove
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import LAST_COMMAND, state_sizes
from quadjax.flights.flight import Flight
from quadjax.policy.file import Policy
from quadjax.policy.inference import mean_action, policy_params
from quadjax.policy.pilot import command_ranges
from quadjax.race.layout import split_name
from quadjax.replay.states import DISTURBANCES, disturbances_of, states_of, step_of

AT_LIMIT = 1e-3  # of a command's range
RATE_ERROR = 0.05  # of a log's sample rate, of a policy that observes a history


@dataclasses.dataclass(frozen=True)
class Commands:
    """Commands at n samples of a log: of the log, of the policy in floats and in fixed point.

    Attributes:
        names: of the k commands.
        units: of them.
        logged: (n, k); None without commands in the log.
        source: what ``logged`` is.
        policy: (n, k).
        fixed: (n, k); None for a policy that cannot be converted.
        reason: why ``fixed`` is None.
        inside: (n,) whether every input is within its declared range.
        clipped: fraction of the samples outside the declared range, by input.
        low: (k,) lowest command.
        high: (k,) highest command.
        disturbance: what the observed external moment and force are; "" for none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    logged: np.ndarray | None
    source: str
    policy: np.ndarray
    fixed: np.ndarray | None
    reason: str
    inside: np.ndarray
    clipped: dict[str, float]
    low: np.ndarray
    high: np.ndarray
    disturbance: str


def policy_commands(flight: Flight, race: OwnRace, policy: Policy) -> Commands:
    """Commands of a policy in the logged states.

    External moments and forces that it observes are those of the onboard estimator, with the model
    of its race, in the log.

    Args:
        flight: of ``vehicle_flight``, with its passages.
        race: the policy's race, with the track that was flown.
        policy: the policy.

    Raises:
        InputError: a log without a signal that the policy observes.
    """
    model, logged, source = race.choices.model, None, "logged commands"
    same = tuple((s.size, s.unit) for s in model.commands) == (model.actuators[1:],)
    if "command" in flight.signals:
        logged = flight["command"]
    elif same and "actuators" in flight.signals:
        logged = flight["actuators"]
        source = f"logged {model.actuators.name} (no commands in the log)"
    observations, disturbance = _observations(flight, race, logged)
    low, high = (np.asarray(end, np.float64) for end in (policy.command_low, policy.command_high))
    action = np.clip(np.asarray(jax.jit(mean_action)(policy_params(policy), observations)), -1, 1)
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
    columns = [
        (f"{signal.name}_{i + 1}" if signal.size > 1 else signal.name, signal.unit)
        for signal in model.commands
        for i in range(signal.size)
    ]
    names, units = zip(*columns, strict=True)
    commands = low + 0.5 * (high - low) * (action.astype(np.float64) + 1.0)
    return Commands(
        *(names, units, logged, source, commands, fixed, reason, inside, clipped, low, high),
        disturbance,
    )


def _observations(
    flight: Flight, race: OwnRace, commands: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """Observations (n, inputs) float32, in the scaling of training, and their disturbances.

    Raises:
        InputError: a policy that observes a history, and a log of another sample rate.
    """
    layout, model, step = race.choices.layout, race.choices.model, step_of(flight)
    if layout.depth and abs(step / race.time_step - 1.0) > RATE_ERROR:
        raise InputError(
            f"{flight.source['path']}: {1.0 / step:.4g} samples/s; the policy observes a history, "
            f"which needs a log of {1.0 / race.time_step:.4g} samples/s"
        )
    sizes, more = state_sizes(layout, model), {}
    if LAST_COMMAND in sizes and commands is not None:
        low, high = command_ranges(race.choices, race.params)
        more[LAST_COMMAND] = np.concatenate([[0.5 * (low + high)], commands[:-1]])
    observed = [name for name in layout.names if split_name(name)[0] in DISTURBANCES]
    source = ""
    if observed and layout[observed[0]].source == "none":
        source = "zero, as in the training of the policy"
    elif observed:
        estimates = disturbances_of(flight, model, race.params.vehicle)
        more |= estimates
        source = "taken as zero, as the model has no estimator"
        if estimates:
            simulated = "" if flight.source["measured"] else " with simulated rotor speeds"
            source = f"estimated from the log{simulated}"
    states = states_of(flight, model, sizes, more)
    return observe(race, states, flight.target.astype(np.int32)), source


def differences(commands: Commands) -> list[dict[str, float | str | None]]:
    """For each command: means, RMS difference, correlation, share at a limit, error of fixed point.

    The last is the largest error where no input is clipped; it is None where there is none.
    """
    rows = []
    for i, (name, unit) in enumerate(zip(commands.names, commands.units, strict=True)):
        values, low, high = commands.policy[:, i], commands.low[i], commands.high[i]
        edge = np.minimum(values - low, high - values) < AT_LIMIT * (high - low)
        row: dict[str, float | str | None] = {
            "command": name,
            "unit": unit,
            "policy_mean": float(values.mean()),
            "at_limit": float(edge.mean()),
            **dict.fromkeys(("logged_mean", "rms_difference", "correlation", "fixed_error")),
        }
        if commands.logged is not None:
            logged = commands.logged[:, i]
            row["logged_mean"] = float(logged.mean())
            row["rms_difference"] = float(np.sqrt(((values - logged) ** 2).mean()))
            if values.std() > 0.0 and logged.std() > 0.0:
                row["correlation"] = float(np.corrcoef(values, logged)[0, 1])
        if commands.fixed is not None:
            error = np.abs(commands.fixed[:, i] - values)[commands.inside]
            row["fixed_error"] = float(error.max()) if error.size else None
        rows.append(row)
    return rows
