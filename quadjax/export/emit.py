"""The emitted C: every file from its template and the integers of a conversion."""

import dataclasses

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import battery_tables
from quadjax.export.battery_tables import BatteryTables
from quadjax.export.estimator_tables import (
    DIFFERENCE_BITS,
    FINE_BITS,
    LOW_PASS_BITS,
    MODEL_BITS,
    MONOMIALS,
    RESIDUAL_LIMIT,
    EstimatorTables,
)
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork
from quadjax.export.integers import INPUT_BITS
from quadjax.export.race_tables import TURNS_PER_UNIT, TWO_PI, YAW_EXPONENT, RaceTables
from quadjax.export.render import render
from quadjax.export.selftest import (
    battery_test,
    estimator_test,
    network_test,
    padded_layers,
    race_test,
)

MODULE_MODELS = ("motor", "rate")  # vehicle models whose commands the Paparazzi module takes
MODULE_FREQUENCY = 512  # Hz, of the Paparazzi module
STEP_ERROR = 0.05  # of a step of the policy, where an autopilot calls it several times in one
ACCELEROMETER = {"a_x": "s[3]", "a_y": "s[4]", "a_z": "s[5]"}  # monomials with no name of their own


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Where the C came from, for its headers."""

    name: str  # the prefix of every symbol
    policy_hash: str  # SHA-256 of the policy file
    lines: tuple[str, ...]  # of the comment at the top of each file
    source: str  # one line


Values = dict[str, object]


def emit_network(
    network: FixedNetwork, origin: Provenance, observations: np.ndarray | None
) -> dict[str, str]:
    """The network's header and source, by file name.

    Args:
        network: the integers.
        origin: for the comments.
        observations: (n, inputs) simulated observations for the self-test, if there are any.
    """
    layers = padded_layers(network)
    ends = (network.command_low, network.command_high)
    values = common_values(network, origin) | {
        "layers": layers,
        "test": network_test(network, layers, observations),
        "format_version": FORMAT_VERSION,
        "limits": [_limits(x / 2.0**network.fraction_bits) for x in ends],
    }
    return _files(origin, values, [".h", ".c"], "network")


def emit_race(
    tables: RaceTables,
    network: FixedNetwork,
    origin: Provenance,
    states: np.ndarray,
    targets: np.ndarray,
) -> dict[str, str]:
    """The header and source of observation and gate logic, by file name.

    Args:
        tables: the integers.
        network: of the commands.
        origin: for the comments.
        states: (n, state_size) simulated states for the self-test.
        targets: (n,) the target gate of each.
    """
    values = common_values(network, origin) | {
        "race": tables,
        "race_test": race_test(tables, states, targets),
        "state_values": [f"state->{name}" for name in tables.names],
        "yaw_exponent": YAW_EXPONENT,
        "turns_per_unit": TURNS_PER_UNIT,
        "two_pi": TWO_PI,
    }
    return _files(origin, values, [".h", ".c"], "race", "_race")


def emit_estimator(
    tables: EstimatorTables, network: FixedNetwork, origin: Provenance, residual_hash: str
) -> dict[str, str]:
    """The disturbance estimator's header and source; the hash is empty without a residual."""
    residuals = {"thrust": tables.thrust, "moment": tables.moment} if tables.thrust else {}
    hidden = [len(layer.bias) for network in residuals.values() for layer in network.hidden]
    used = np.any(tables.model != 0, axis=0) | np.any(tables.differentiated != 0, axis=0)
    values = common_values(network, origin) | {
        "estimator": tables,
        "estimator_test": estimator_test(tables),
        "terms": _terms,
        "unused": [
            name
            for name, needed in zip(MONOMIALS, used, strict=True)
            if not needed and name not in ACCELEROMETER
        ],
        "channel_units": [f"{2.0 ** (e - INPUT_BITS)!r}F" for e in tables.channel_exponents],
        "sample_rate": _float(tables.sample_rate),
        "bits": {
            "model": MODEL_BITS,
            "difference": DIFFERENCE_BITS,
            "low_pass": LOW_PASS_BITS,
            "fine": FINE_BITS,
        },
        "residuals": residuals,
        "residual_hash": residual_hash,
        "residual_widest": max([1, *hidden]),
        "residual_depth": max([0, *(len(network.hidden) for network in residuals.values())]),
        "residual_limit": RESIDUAL_LIMIT,
    }
    return _files(origin, values, [".h", ".c"], "estimator", "_estimator")


def emit_battery(
    tables: BatteryTables, network: FixedNetwork, origin: Provenance
) -> dict[str, str]:
    """The header and source of the estimator of the highest propeller speed, by file name."""
    values = common_values(network, origin) | {
        "battery": tables,
        "battery_test": battery_test(tables),
        "fine_bits": battery_tables.FINE_BITS,
        "sample_rate": _float(tables.sample_rate),
        "unit": repr(2.0 ** (tables.exponent - INPUT_BITS)),
    }
    return _files(origin, values, [".h", ".c"], "battery", "_battery")


def emit_paparazzi(
    network: FixedNetwork,
    origin: Provenance,
    race: RaceTables,
    estimator: EstimatorTables | None,
    battery: BatteryTables | None,
) -> dict[str, str]:
    """The Paparazzi module's files, by path under ``paparazzi/``; of ``MODULE_MODELS`` only."""
    if network.model.name not in MODULE_MODELS:
        return {}
    values = common_values(network, origin) | {
        "frequency": MODULE_FREQUENCY,
        "estimator": estimator,
        "battery": battery,
    }
    # A policy that observes earlier steps runs at the rate of its training, another at every call.
    values["race"] = race
    values["hold"] = 1
    if race.box.layout.counts_steps:
        values["hold"] = calls_per_step(MODULE_FREQUENCY, race.time_step)
        if not values["hold"]:
            raise InputError(
                f"--target cortex-a9: the policy observes earlier steps of {race.time_step:g} s, "
                f"allowed: whole periods of {MODULE_FREQUENCY} Hz within {STEP_ERROR:.0%}; "
                "--target cortex-m7 has no Paparazzi module"
            )
    values["known"] = [field.name for field in race.fields]
    middle = 0.5 * (network.command_low + network.command_high) / 2.0**network.fraction_bits
    values["halfway"] = [f"{x!r}f" for x in middle.tolist()]
    files = _files(origin, values, [".h", ".c"], "module", "_module")
    files |= _files(origin, values, [".xml"], "module")
    return {f"paparazzi/{file}": text for file, text in files.items()}


def calls_per_step(frequency: float, time_step: float) -> int:
    """Calls at a frequency, Hz, in a step, s; 0 where no whole number is within ``STEP_ERROR``."""
    calls = round(frequency * time_step)
    return calls if abs(calls - frequency * time_step) <= STEP_ERROR * calls else 0


def _files(
    origin: Provenance, values: Values, suffixes: list[str], template: str, part: str = ""
) -> dict[str, str]:
    return {f"{origin.name}{part}{end}": render(f"{template}{end}", values) for end in suffixes}


def names_of(network: FixedNetwork, name: str) -> Values:
    """Values of all templates: names, the network and the type of its commands."""
    return {
        "name": name,
        "NAME": name.upper(),
        "network": network,
        "rpm": network.rpm,
        "command_type": "uint16_t" if network.rpm else "float",
        "unit": network.unit,
    }


def common_values(network: FixedNetwork, origin: Provenance) -> Values:
    """Values of all emitted files."""
    return names_of(network, origin.name) | {"origin": origin}


def _float(number: float) -> str:
    """A number as the digits of a C float."""
    return repr(float(number))


def _limits(commands: np.ndarray) -> list[str]:
    """The ends of the commands' ranges; a single one where all are the same."""
    return [f"{x:g}" for x in (commands[:1] if len(set(commands)) == 1 else commands)]


def _terms(row: np.ndarray) -> list[str]:
    """The terms of a sum of monomials (monomials,) with integer factors, as C."""
    return [
        f"INT64_C({value}) * {ACCELEROMETER.get(name, name)}"
        for name, value in zip(MONOMIALS, row.tolist(), strict=True)
        if value
    ]
