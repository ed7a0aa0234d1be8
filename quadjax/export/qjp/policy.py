"""What a ``.qjp`` file contains, and its bytes.

The file is a sequence of little-endian 32-bit words, as ``templates/qjp/qjp_layout.h`` names them:
header, certificates, state, observation, track, tables, self-tests, and a SHA-256 of all of it.
"""

import dataclasses
import hashlib

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import ONE, WORD, words_of
from quadjax.export.proof import prove_layer
from quadjax.export.qjp.words import Writer
from quadjax.export.race_tables import (
    ATTITUDE,
    COPY,
    GATE,
    POSITION,
    ROTATION,
    SCALED,
    VELOCITY,
    Input,
    RaceTables,
)
from quadjax.export.scaling import Rescale
from quadjax.export.selftest import (
    TURN,
    network_test,
    padded_layers,
    race_test,
)

MAGIC, VERSION, OUTPUTS = 0x00504A51, 1, 4
HASH_BYTES, NAME_BYTES, VEHICLE_BYTES, FIELD_BYTES = 32, 32, 16, 24
HEADER_WORDS = 50
SIZE_AT = 2  # the word of the header that is the size of the file
KINDS = (POSITION, VELOCITY, ATTITUDE, ROTATION, COPY, SCALED, GATE)  # numbered from 1 on
STATE_FIELDS = (  # numbered from 1 on
    *("position", "velocity", "euler", "quaternion", "rates", "rotor_speed"),
    *("moment_ext", "force_ext", "last_command", "rpm", "thrust"),
)
COMMAND_KINDS = {"rpm": 1, "motor_command": 2}  # by the name of the commands
OTHER_COMMANDS = 3
PLACES = (0, 1, 2, 3)  # of our rotors: front-left, front-right, rear-right, rear-left
LARGEST_SHIFT = 60
NO_RESCALE = Rescale(0, 0, 1)  # of an input that is always zero


@dataclasses.dataclass(frozen=True)
class NetworkCases:
    """Inferences of the self-test."""

    inputs: np.ndarray  # (n, inputs) int32
    commands: np.ndarray  # (n, outputs) int32
    traces: np.ndarray  # (n,) uint32, digest of every accumulator


@dataclasses.dataclass(frozen=True)
class RaceCases:
    """States of the self-test, and the inputs that follow from them."""

    states: np.ndarray  # (n, state_size) uint32, the bits
    targets: np.ndarray  # (n,)
    inputs: np.ndarray  # (n, inputs) int32
    status: np.ndarray  # (n, 3) uint32: clipped, nan, outside


@dataclasses.dataclass(frozen=True)
class QjpPolicy:
    """What a ``.qjp`` file contains."""

    name: str  # prefix of the C symbols of the export
    network: FixedNetwork  # of a file: without the real values of its units
    race: RaceTables
    policy_hash: str  # SHA-256 of the policy file
    time_step: float  # s
    network_test: NetworkCases
    race_test: RaceCases


@dataclasses.dataclass(frozen=True)
class Certificate:
    """What is proven of a layer, and its size."""

    rows: int
    columns: int
    largest_sum: int  # |bias| + sum |w| max|x|, the largest of all rows
    largest_output: int  # of a hidden layer; 0 for the output layer


def make_qjp(
    name: str,
    network: FixedNetwork,
    race: RaceTables,
    policy_hash: str,
    time_step: float,
    observations: np.ndarray | None,
    states: np.ndarray,
    targets: np.ndarray,
) -> QjpPolicy:
    """A policy and its self-tests.

    Args:
        name: prefix of the C symbols of the export.
        network: proven integers.
        race: observation and track.
        policy_hash: SHA-256 of the policy file, hexadecimal.
        time_step: of the policy, s.
        observations: (n, inputs) simulated observations for the self-tests, if there are any.
        states: (n, state_size) simulated states for the self-tests.
        targets: (n,) the target gate of each.

    Raises:
        InputError: a policy that the format cannot represent.
    """
    _check(name, network, race)
    made = network_test(network, padded_layers(network), observations)
    tests = NetworkCases(made.inputs, made.commands, made.traces)
    own = race_test(race, states, targets)
    seen = RaceCases(own.states, own.targets, own.inputs, own.status)
    return QjpPolicy(name, network, race, policy_hash, time_step, tests, seen)


def qjp_bytes(policy: QjpPolicy) -> bytes:
    """A policy as the bytes of a ``.qjp`` file.

    Raises:
        InputError: a layer of which the range proof fails, or a number beyond 32 bits.
    """
    words, tests, seen = Writer(), policy.network_test, policy.race_test
    _write_header(words, policy)
    for own in certify(policy.network):
        words.put(own.rows, own.columns, words_of(_signed(own.largest_sum)), own.largest_output)
    _write_race(words, policy.race)
    for layer in padded_layers(policy.network):
        words.put(layer.weights, words_of(layer.bias))
    for test in zip(tests.inputs, tests.commands, tests.traces, strict=True):
        words.put(*test)
    for case in zip(seen.states, seen.targets, seen.inputs, seen.status, strict=True):
        words.put(*case)
    body = words.data(SIZE_AT, HASH_BYTES)
    return body + hashlib.sha256(body).digest()


def table_start(words: np.ndarray) -> int:
    """The place of the first weight in the words of a file, int32."""
    inputs, layers, state, fields, parts, gates, constants = words[[3, 5, 6, 7, 8, 9, 10]].tolist()
    sizes = (5 * layers, 3 * fields, state, 10 * parts, 4 * inputs, (19 + constants) * gates)
    return HEADER_WORDS + sum(sizes)


def certify(network: FixedNetwork) -> list[Certificate]:
    """The certificate of each layer.

    Raises:
        InputError: a layer of which the range proof fails.
    """
    high = np.array([ONE] * network.inputs, object)
    low, found = -high, []
    for index, layer in enumerate(network.layers):
        hidden = index < len(network.hidden)
        rows = prove_layer(index, layer, low, high, hidden)
        low = np.array([max(0, row.low >> WORD) for row in rows], object)
        high = np.array([max(0, row.high >> WORD) for row in rows], object)
        padding = 2 ** (WORD - 1) if hidden and len(rows) % TURN else 0
        largest = max(padding, *(row.magnitude for row in rows))
        count, columns = layer.weights.shape
        found.append(Certificate(count, columns, largest, int(high.max()) if hidden else 0))
    return found


def _signed(value: int) -> np.ndarray:
    return np.array([value], np.uint64).view(np.int64)


def _check(name: str, network: FixedNetwork, race: RaceTables) -> None:
    """Raise an ``InputError`` for what the format cannot represent."""
    if race.history:
        raise InputError("the policy has observation.history, which a .qjp file cannot have")
    unknown = [field.name for field in race.fields if field.name not in STATE_FIELDS]
    unknown += [part.name for part in race.inputs if part.kind not in KINDS]
    if unknown:
        allowed = ", ".join(STATE_FIELDS)
        raise InputError(f"a .qjp file has no {unknown[0]!r}; its state has: {allowed}")
    texts = {part.name: FIELD_BYTES for part in race.inputs} | {name: NAME_BYTES}
    long = [(text, size) for text, size in texts.items() if len(text) >= size]
    if long:
        text, size = long[0]
        raise InputError(f"name {text}: allowed in a .qjp file: up to {size - 1} letters")
    shifts = [r.shift for part in race.inputs for r in part.rescales if r is not None]
    if network.outputs != OUTPUTS or not all(1 <= shift <= LARGEST_SHIFT for shift in shifts):
        raise InputError(
            f"a .qjp file has {OUTPUTS} commands, and scales of 2^-1 to 2^-{LARGEST_SHIFT}"
        )


def _write_header(words: Writer, policy: QjpPolicy) -> None:
    network, race = policy.network, policy.race
    kind = COMMAND_KINDS.get(network.model.commands[0].name, OTHER_COMMANDS)
    words.put(MAGIC, VERSION, 0, network.inputs, network.outputs, len(network.layers))
    words.put(race.state_size, len(race.fields), len(race.inputs), race.gates)
    words.put(race.next_gate.shape[1], int(race.world_box), kind, network.output_shift)
    words.put(network.fraction_bits, round(policy.time_step * 1e9))
    words.put(len(policy.network_test.inputs), len(policy.race_test.states))
    words.put(np.frombuffer(bytes.fromhex(policy.policy_hash), "<u4"))
    words.text(policy.name, NAME_BYTES)
    words.text(network.model.name, VEHICLE_BYTES)
    words.put(PLACES, network.command_low, network.command_high)


def _write_race(words: Writer, race: RaceTables) -> None:
    """State, observation and track."""
    for field in race.fields:
        words.put(1 + STATE_FIELDS.index(field.name), field.start, len(field.exponents))
    words.put(race.exponents)
    for part in race.inputs:
        size = race.box.layout[part.name].size
        words.put(1 + KINDS.index(part.kind), part.index, size, race.box.exponent[part.name])
        words.text(part.name, FIELD_BYTES)
    for part in race.inputs:
        for source, own in _numbers(part, race.box.layout[part.name].size):
            words.put(source, own.middle, own.factor, own.shift)
    for gate in range(race.gates):
        words.put(race.gate_position[gate], _axes(race, gate))
        words.put(race.gate_cos[gate], race.gate_sin[gate], race.half_size[gate])
        words.put(0 if race.circle is None else int(race.circle[gate]))
        words.put(words_of(race.gate_yaw[gate : gate + 1]))
        words.put(race.next_gate[gate])


def _axes(race: RaceTables, gate: int) -> np.ndarray:
    """Directions through a gate, to its right and down, (3, 3) Q30 in the world."""
    if race.axes is not None:
        return race.axes[gate]
    cosine, sine = race.gate_cos[gate], race.gate_sin[gate]
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, ONE]], np.int64)


def _numbers(part: Input, size: int) -> list[tuple[int, Rescale]]:
    """Source and scale of each input of a field; of a rotation, the first number of its source."""
    sources = part.sources if part.kind != ROTATION else part.sources[:1] * size
    rescales = [own or NO_RESCALE for own in part.rescales] or [NO_RESCALE] * size
    return list(zip(sources, rescales, strict=True))
