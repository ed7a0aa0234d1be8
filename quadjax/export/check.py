"""Checks of a policy that was read: what the C checks on board, the proofs and the self-tests."""

import dataclasses

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.battery import prove_battery
from quadjax.export.cases import Cases, answered
from quadjax.export.disturbances import EstimatorTables, prove_terms
from quadjax.export.integers import INPUT_BITS, ONE, WORD
from quadjax.export.network import FixedLayer
from quadjax.export.noise import NoiseTables
from quadjax.export.proof import prove_layers
from quadjax.export.race_tables import (
    FIELDS,
    QUATERNION_EXPONENT,
    VECTORS,
    YAW_EXPONENT,
    Input,
    RaceTables,
)
from quadjax.export.words import COMMANDS, LARGEST_EXPONENT, LARGEST_SHIFT, FixedPolicy

LARGEST_YAW, LARGEST_RANGE = 2**36, 96


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise InputError(f"{what} is not allowed")


def check(policy: FixedPolicy) -> None:
    """What ``runtime/qj_check.c`` checks, in its order."""
    network, race = policy.network, policy.race
    _require(1 <= network.output_shift <= WORD, f"an output shift of {network.output_shift}")
    _require(0 <= network.fraction_bits <= 30, f"{network.fraction_bits} fraction bits")
    _require(race.time_step > 0, "its time step")
    ends = (network.command_low, network.command_high)
    _require(bool(np.all(ends[0] <= ends[1]) and np.all(ends[0] > -(2**31))), "a command range")
    for name, exponents in race.fields.items():
        _require(len(exponents) == FIELDS[name][0], f"the size of {name}")
    _require("position" in race.fields, "a state without a position")
    _require(max(map(abs, race.exponents)) <= LARGEST_EXPONENT, "a range of the state")
    place = 0
    for part in race.inputs:
        _require(part.index == place, f"the place of {part.name}")
        _require(_is_input(race, part), f"the input {part.name}")
        place += len(part.numbers)
    gates = race.track
    units = (*(gates[name] for name in ("position", "axes", "cosine", "sine")), race.next_gate)
    _require(all(np.all(np.abs(x) <= ONE) for x in units), "a gate")
    _require(bool(np.all(np.abs(gates["yaw"]) <= LARGEST_YAW)), "the yaw of a gate")
    sizes = np.minimum(gates["half_width"], gates["half_height"])
    _require(bool(np.all(sizes >= 0) and np.all(gates["round"] >> 1 == 0)), "the size of a gate")
    if policy.estimator is not None:
        _check_estimator(policy.estimator)
    if policy.battery is not None:
        prove_battery(policy.battery)
    if policy.noise is not None:
        NoiseTables.of(policy.noise.factors, policy.noise.on_clamped)
    _prove(network.layers, network.inputs, COMMANDS)


def _is_input(race: RaceTables, part: Input) -> bool:
    exponent, numbers, kind = race.box.exponent[part.name], part.numbers, part.kind
    middle, factor, shift = (numbers[name] for name in ("middle", "factor", "shift"))
    fine = abs(exponent) <= LARGEST_EXPONENT
    fine &= bool(np.all(numbers["source"] >= 0))
    if kind == "scaled":
        fine &= bool(np.all((shift >= 1) & (shift <= LARGEST_SHIFT)))
        fine &= bool(np.all(np.minimum(middle, factor) > -(2**31)))
    else:
        fine &= bool(np.all((middle == 0) & (factor == 0) & (shift == 1)))
    if kind == "gate":
        return fine and int(part.sources.max()) < race.next_gate.shape[1]
    if kind in VECTORS:
        first, size = race.starts.get(VECTORS[kind], -1), 6 if kind == "rotation" else 3
        expected = first + np.arange(size) * (kind != "rotation")
        fine &= np.array_equal(numbers["source"], expected)
    exponents = [race.exponents[i] for i in part.sources]
    if kind in ("position", "velocity"):
        within = 1 <= INPUT_BITS - exponents[0] + exponent <= LARGEST_SHIFT
        fine &= len(set(exponents)) == 1 and within
    if kind == "attitude":
        fine &= exponents == [exponent, exponent, YAW_EXPONENT]
    if kind == "rotation":
        fine &= set(exponents) == {QUATERNION_EXPONENT}
        fine &= 1 - INPUT_BITS <= exponent <= LARGEST_SHIFT - INPUT_BITS
    if kind == "copy":
        fine &= set(exponents) == {exponent}
    return fine


def _check_estimator(tables: EstimatorTables) -> None:
    largest = max(map(abs, (*tables.exponents, *tables.channel_exponents)))
    _require(largest <= LARGEST_RANGE and tables.period_ns > 0, "a range of its estimator")
    prove_terms(tables)
    if (residual := tables.residual) is None:
        return
    fine = 1 <= residual.rpm.shift <= LARGEST_SHIFT and abs(residual.rpm.middle) <= ONE
    fine &= all(1 <= shift <= INPUT_BITS for shift in residual.shifts)
    _require(fine, "a scale of its residual")
    _prove(residual.thrust, 7, 1)
    _prove(residual.moment, 10, 3)


def _prove(layers: tuple[FixedLayer, ...], inputs: int, outputs: int) -> None:
    prove_layers(layers, inputs)
    _require(len(layers[-1].bias) == outputs, f"{len(layers[-1].bias)} outputs")


def passes(policy: FixedPolicy) -> bool:
    """Whether the emulators give the integers of the self-tests."""
    cases = policy.cases
    inputs = cases.inputs.view(np.int32)
    floats = (cases.states.view("<f4"), cases.measurements.view("<f4"), cases.samples.view("<f4"))
    states, measurements, samples = floats
    targets = cases.targets[:, 0].astype(np.int64)
    right = answered(policy, inputs, states, targets, measurements, samples)
    noise = policy.noise
    if noise is not None and noise != NoiseTables.of(noise.factors, noise.on_clamped):
        return False
    fields = (field.name for field in dataclasses.fields(Cases))
    return all(np.array_equal(getattr(right, name), getattr(cases, name)) for name in fields)
