"""The observation in fixed point: a track and the scales of a vehicle's state as integers.

Every number of the state becomes an integer of 2^-30 of its own range, a power of two; the rest is
sums and products of integers. Positions and velocities are rotated into the gate's frame by a
cosine and a sine in Q30, a yaw is wrapped by one multiplication, and what is scaled to [-1, 1] is
``(q - middle) factor >> shift``.
"""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import ONE
from quadjax.export.ranges import InputBox
from quadjax.policy.file import Policy
from quadjax.race.layout import NONE
from quadjax.race.track import Track

YAW_EXPONENT = 6  # of the state's yaw: +-64 rad, because an autopilot may not wrap it
WIND_EXPONENT = 2  # the state's velocity has four times the range of the network's input
TURN_BITS = 56  # one turn is 2^56 of (yaw * TURNS_PER_UNIT)
TURNS_PER_UNIT = round(2.0**32 / (2.0 * math.pi))  # turns of a yaw in Q24 are its product in Q56
TWO_PI = round(2.0 * math.pi * ONE)  # Q30
# The numbers of the state of scaled fields; of the external force only z is observed.
SOURCES = {
    "rpm": ("rpm[0]", "rpm[1]", "rpm[2]", "rpm[3]"),
    "thrust": ("thrust",),
    "moment_ext": ("moment_ext[0]", "moment_ext[1]", "moment_ext[2]"),
    "force_ext": ("force_ext[2]",),
}
LARGEST_SPAN = 1e6
FARTHEST = 15  # exponent of the largest distance of a gate


@dataclasses.dataclass(frozen=True)
class Rescale:
    """One number of the state to one input: ``(q - middle) factor >> shift``, rounded."""

    middle: int
    factor: int  # below 2^31
    shift: int


@dataclasses.dataclass(frozen=True)
class StateField:
    """Numbers of the state that belong together."""

    name: str
    note: str  # unit and frame, for the header
    exponents: tuple[int, ...]  # of each number's range

    @property
    def names(self) -> list[str]:
        """``position[0]`` and so on; the field's own name if it is a single number."""
        if len(self.exponents) == 1:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(len(self.exponents))]

    @property
    def ranges_text(self) -> str:
        """The declared ranges, for the header; a single one where all are the same."""
        shown = self.exponents[:1] if len(set(self.exponents)) == 1 else self.exponents
        return ", ".join(f"+-{2.0**e:g}" for e in shown)


@dataclasses.dataclass(frozen=True)
class Scaled:
    """An input that is a number of the state over its range."""

    number: int  # of the state
    rescale: Rescale | None  # None: the policy sees zero


@dataclasses.dataclass(frozen=True)
class RaceTables:
    """Integers of the observation and of the gate logic."""

    box: InputBox  # of the network's inputs
    fields: tuple[StateField, ...]
    scaled: dict[str, tuple[Scaled, ...]]  # by field of the observation
    gate_position: np.ndarray  # (gates, 3) int64, in the state's position units
    gate_cos: np.ndarray  # (gates,) int64 Q30
    gate_sin: np.ndarray  # (gates,) int64 Q30
    gate_yaw: np.ndarray  # (gates,) int64, rad in Q30
    half_size: np.ndarray  # (gates, 2) int64 half width and height, in position units
    next_gate: np.ndarray  # (gates, 4) int64, network inputs
    world_box: bool  # a gate's opening is tested along the world's axes, not its own

    @property
    def gates(self) -> int:
        """Number of gates."""
        return len(self.gate_yaw)

    @property
    def names(self) -> list[str]:
        """The state's numbers in order."""
        return [name for field in self.fields for name in field.names]

    @property
    def exponents(self) -> tuple[int, ...]:
        """Exponent of the range of every number of the state."""
        return tuple(e for field in self.fields for e in field.exponents)

    @property
    def state_size(self) -> int:
        """Number of floats in the state."""
        return len(self.exponents)

    def start(self, field: str) -> int:
        """Index of the first number of a field of the state."""
        return next(i for i, name in enumerate(self.names) if name.split("[")[0] == field)


def make_tables(
    network: FixedNetwork, policy: Policy, track: Track, world_box: bool = False
) -> RaceTables:
    """The integers of a policy's observation on a track.

    Args:
        network: whose box the observation is scaled to.
        policy: whose limits and scaling it has.
        track: the gates.
        world_box: test a gate's opening as the authors' code does; see ``rules.inside_world_box``.

    Raises:
        InputError: a gate that is tilted, round, or farther away than 2^15 m, or a next gate
            outside the network's box.
    """
    if track.opening is not None or track.circle is not None:
        raise InputError("the track has tilted or round gates, allowed: upright rectangles")
    box = network.box
    position = np.stack([np.asarray(c, np.float64) for c in track.position.components()], axis=1)
    reach = float(np.abs(position).max()) + box.limit("position")
    world = max(5, math.ceil(math.log2(reach)))
    if world > FARTHEST:
        raise InputError(f"a gate lies {reach:.3g} m away, allowed: 2^{FARTHEST} m")
    yaw = np.asarray(track.yaw, np.float64)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)
    unit = ONE / 2.0**world
    fields, rescales = _state_fields(box, policy, world)
    names = [name for field in fields for name in field.names]
    return RaceTables(
        box=box,
        fields=fields,
        scaled={
            field: tuple(
                Scaled(names.index(name), rescale)
                for name, rescale in zip(SOURCES[field], rescales[field], strict=True)
            )
            for field in rescales
        },
        gate_position=np.rint(position * unit).astype(np.int64),
        gate_cos=np.rint(np.cos(yaw) * ONE).astype(np.int64),
        gate_sin=np.rint(np.sin(yaw) * ONE).astype(np.int64),
        gate_yaw=np.rint(yaw * ONE).astype(np.int64),
        half_size=np.rint(half.astype(np.float64) * unit).astype(np.int64),
        next_gate=_next_gates(box, track),
        world_box=world_box,
    )


def _next_gates(box: InputBox, track: Track) -> np.ndarray:
    """The inputs that depend only on the gate: the next gate's position and yaw, (gates, 4)."""
    plain = np.roll(track.yaw, -1) - np.asarray(track.yaw)
    values = {
        "next_position": np.stack([np.asarray(c) for c in track.next_position.components()], 1),
        "next_yaw": np.asarray(track.next_yaw)[:, None],
        "next_yaw_unwrapped": plain[:, None],
    }
    columns = []
    for name in [name for name in values if name in box.groups]:
        numbers, limit = values[name].astype(np.float64), box.limit(name)
        for gate, column in np.argwhere(np.abs(numbers) > limit):
            raise InputError(
                f"gate {gate}: {name} is {numbers[gate, column]:.4g}, declared +-{limit:g}; "
                f"declare more with --range {name}={2 * limit:g}"
            )
        columns.append(np.trunc(numbers * (ONE / limit)).astype(np.int64))
    return np.concatenate(columns, axis=1)


def _state_fields(
    box: InputBox, policy: Policy, world: int
) -> tuple[tuple[StateField, ...], dict[str, list[Rescale | None]]]:
    """The fields of the state, and how each scaled field of the observation is computed."""
    attitude = box.exponent("attitude")
    fields = [
        StateField("position", "m, world", (world,) * 3),
        StateField("velocity", "m/s, world", (box.exponent("velocity") + WIND_EXPONENT,) * 3),
        StateField(
            "euler",
            "roll, pitch, yaw, rad; any yaw, wrapped here",
            (attitude, attitude, YAW_EXPONENT),
        ),
        StateField("rates", "p, q, r, rad/s, body", (box.exponent("rates"),) * 3),
    ]
    if "thrust" in policy.layout:
        [(exponent, thrust)] = _spans(policy, box, "thrust")
        note = "specific thrust along body -z, m/s^2"
        fields.append(StateField("thrust", note, (exponent,)))
        return tuple(fields), {"thrust": [thrust]}
    rpm = _spans(policy, box, "rpm")
    moment, force = (_external(policy, box, name) for name in ("moment_ext", "force_ext"))
    fields += [
        StateField(
            "rpm",
            "1 front-left, 2 front-right, 3 rear-right, 4 rear-left",
            tuple(exponent for exponent, _ in rpm),
        ),
        StateField("moment_ext", "external moment, N m, body", tuple(e for e, _ in moment)),
        StateField("force_ext", "external specific force, m/s^2, body", (force[0][0],) * 3),
    ]
    parts = {"rpm": rpm, "moment_ext": moment, "force_ext": force}
    return tuple(fields), {name: [rescale for _, rescale in part] for name, part in parts.items()}


def _spans(policy: Policy, box: InputBox, name: str) -> list[tuple[int, Rescale | None]]:
    """Exponent and integers of each actuator, over its span or that of its command."""
    size = policy.layout[name].size
    commands = zip(policy.command_low.tolist(), policy.command_high.tolist(), strict=True)
    spans = policy.layout[name].span or tuple(commands)[-size:]
    for low, high in spans:
        if low == high:
            allowed = "allowed: a width above zero"
            raise InputError(f"the policy's layout: {name} has a span of {[low, high]}, {allowed}")
    return [_span(low, high, box.exponent(name)) for low, high in spans]


def _span(low: float, high: float, network: int) -> tuple[int, Rescale | None]:
    """[low, high] to [-1, 1]: the exponent of the state's number, and the integers."""
    reach = max(abs(0.5 * (low + high) + s * 0.5 * (high - low) * 2.0**network) for s in (-1, 1))
    exponent = math.ceil(math.log2(reach))
    unit = ONE / 2.0**exponent
    return exponent, rescale(
        0.5 * (low + high) * unit, 2.0 / (high - low) * 2.0 ** (exponent - network)
    )


def _external(policy: Policy, box: InputBox, name: str) -> list[tuple[int, Rescale | None]]:
    """Exponent and integers of each disturbance; ``None`` where the policy sees zero."""
    field, exponent = policy.layout[name], box.exponent(name)
    halves = [high for _, high in field.span or ((0.0, 0.0),) * field.size]
    result: list[tuple[int, Rescale | None]] = []
    for half in halves:
        if not 0 <= half < LARGEST_SPAN:
            raise InputError(f"the policy's layout: {name} has a span of {half:g}, allowed: 0..1e6")
        if field.source == NONE or half == 0:
            result.append((0, None))
            continue
        state = math.ceil(math.log2(half * 2.0**exponent))
        result.append((state, rescale(0.0, 2.0 ** (state - exponent) / half)))
    return result


def rescale(middle: float, factor: float) -> Rescale:
    """Integers of ``(q - middle) factor``, the factor with 30 bits."""
    shift = 30 - math.frexp(factor)[1]
    return Rescale(round(middle), round(factor * 2.0**shift), shift)
