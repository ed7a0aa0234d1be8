"""The observation in fixed point: a track and the scales of a vehicle's state as integers.

Every number of the state becomes an integer of 2^-30 of its own range, a power of two, wide enough
for the hall, by the same rule as a network's input; the rest is sums and products of integers.
Positions and velocities turn into the gate's frame by a cosine and a sine in Q30, a yaw is wrapped
by one multiplication, and what is scaled to [-1, 1] is ``(q - middle) factor >> shift``.
"""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import LARGEST_INPUT, FixedNetwork
from quadjax.policy.file import Policy
from quadjax.race.track import Track

ONE = LARGEST_INPUT
YAW_EXPONENT = 6  # of the state's yaw: +-64 rad, which an autopilot's may wind up to
WIND_EXPONENT = 2  # the state's velocity has four times the range of the network's input
TURN_BITS = 56  # one turn is 2^56 of (yaw * turns_per_unit)
EXTERNAL = ("moment_x", "moment_y", "moment_z", "force_z")


@dataclasses.dataclass(frozen=True)
class Rescale:
    """One number of the state to one input: ``(q - middle) factor >> shift``, rounded."""

    middle: int
    factor: int  # below 2^31
    shift: int


@dataclasses.dataclass(frozen=True)
class RaceTables:
    """Integers of the observation and of the gate logic."""

    vehicle: str
    fields: tuple[tuple[str, int], ...]  # of the state: name and how many numbers
    exponents: tuple[int, ...]  # of every number of the state
    network_exponents: tuple[int, ...]  # of every input of the network
    gate_position: np.ndarray  # (gates, 3) int32, in the state's position units
    gate_cos: np.ndarray  # (gates,) int32 Q30
    gate_sin: np.ndarray  # (gates,) int32 Q30
    gate_yaw: np.ndarray  # (gates,) int64, rad in Q30
    half_size: np.ndarray  # (gates, 2) int32 half width and height, in position units
    next_gate: np.ndarray  # (gates, 4) int32, network inputs
    scaled: tuple[Rescale | None, ...]  # rpm or thrust, then disturbances; None: always zero
    turns_per_unit: int  # 2^32 / (2 pi): turns of a yaw in Q24 are its product in Q56
    two_pi: int  # Q30
    world_box: bool  # a gate's opening is tested along the world's axes, not its own

    @property
    def gates(self) -> int:
        """How many gates."""
        return len(self.gate_yaw)

    @property
    def state_size(self) -> int:
        """How many floats the state has."""
        return len(self.exponents)


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
        InputError: a gate farther away than 2^15 m, or a next gate outside the network's box.
    """
    box = network.box
    exponent = {name: box.exponents[box.index(name)] for name in ("position", "velocity")}
    position = np.stack([np.asarray(c, np.float64) for c in track.position.components()], axis=1)
    reach = float(np.abs(position).max()) + 2.0 ** exponent["position"]
    world = max(5, math.ceil(math.log2(reach)))
    if world > 15:
        raise InputError(f"a gate lies {reach:.3g} m away, allowed: 2^15 m")
    fields, exponents, scaled = _state_fields(network, policy, world)
    yaw = np.asarray(track.yaw, np.float64)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)
    unit = ONE / 2.0**world
    return RaceTables(
        vehicle=policy.vehicle,
        fields=fields,
        exponents=exponents,
        network_exponents=box.exponents,
        gate_position=np.rint(position * unit).astype(np.int64),
        gate_cos=np.rint(np.cos(yaw) * ONE).astype(np.int64),
        gate_sin=np.rint(np.sin(yaw) * ONE).astype(np.int64),
        gate_yaw=np.rint(yaw * ONE).astype(np.int64),
        half_size=np.rint(half.astype(np.float64) * unit).astype(np.int64),
        next_gate=_next_gates(network, policy, track),
        scaled=scaled,
        turns_per_unit=round(2.0**32 / (2.0 * math.pi)),
        two_pi=round(2.0 * math.pi * ONE),
        world_box=world_box,
    )


def _next_gates(network: FixedNetwork, policy: Policy, track: Track) -> np.ndarray:
    start = network.box.index("next_position")
    next_yaw = track.next_yaw
    if policy.observation.get("wrap_next_yaw") is False:
        next_yaw = np.roll(track.yaw, -1) - np.asarray(track.yaw)
    columns = [*track.next_position.components(), next_yaw]
    values = np.stack([np.asarray(c, np.float64) for c in columns], axis=1)
    ranges = network.box.ranges[start : start + 4]
    for gate, row in enumerate(values):
        for name, value, limit in zip(network.box.names[start:], row, ranges, strict=False):
            if abs(value) > limit:
                raise InputError(
                    f"gate {gate}: {name} is {value:.4g}, declared +-{limit:g}; "
                    f"declare more with --range {name.split('[')[0]}={2 * limit:g}"
                )
    return np.trunc(values * (ONE / ranges)).astype(np.int64)


def _state_fields(
    network: FixedNetwork, policy: Policy, world: int
) -> tuple[tuple[tuple[str, int], ...], tuple[int, ...], tuple[Rescale | None, ...]]:
    box = network.box

    def of(name: str) -> int:
        return box.exponents[box.index(name)]

    attitude = of("attitude")
    parts = [
        ("position", [world] * 3),
        ("velocity", [of("velocity") + WIND_EXPONENT] * 3),
        ("euler", [attitude, attitude, YAW_EXPONENT]),
        ("rates", [of("rates")] * 3),
    ]
    low, high = policy.command_low, policy.command_high
    if policy.vehicle == "rate":
        exponent, thrust = _span(float(low[3]), float(high[3]), of("thrust"))
        parts.append(("thrust", [exponent]))
        scaled: list[Rescale | None] = [thrust]
    else:
        spans = [_span(float(a), float(b), of("rpm")) for a, b in zip(low, high, strict=True)]
        parts.append(("rpm", [exponent for exponent, _ in spans]))
        external = _external(policy, [of("moment_ext")] * 3 + [of("force_ext")])
        parts.append(("moment_ext", [exponent for exponent, _ in external[:3]]))
        parts.append(("force_ext", [external[3][0]] * 3))
        scaled = [pair[1] for pair in spans] + [pair[1] for pair in external]
    fields = tuple((name, len(exponents)) for name, exponents in parts)
    return fields, tuple(e for _, exponents in parts for e in exponents), tuple(scaled)


def _span(low: float, high: float, network: int) -> tuple[int, Rescale]:
    """[low, high] to [-1, 1]: the exponent of the state's number, and the integers."""
    reach = max(abs(0.5 * (low + high) + s * 0.5 * (high - low) * 2.0**network) for s in (-1, 1))
    exponent = math.ceil(math.log2(reach))
    unit = ONE / 2.0**exponent
    return exponent, rescale(
        0.5 * (low + high) * unit, 2.0 / (high - low) * 2.0 ** (exponent - network)
    )


def _external(policy: Policy, network: list[int]) -> list[tuple[int, Rescale | None]]:
    """Exponent and integers of each disturbance; ``None`` where the policy sees zero."""
    spans = policy.observation.get("disturbance") or {}
    blind = policy.observation.get("disturbance_input") == "none"
    result: list[tuple[int, Rescale | None]] = []
    for name, exponent in zip(EXTERNAL, network, strict=True):
        half = spans.get(name, 0.0)
        if isinstance(half, bool) or not isinstance(half, (int, float)) or not 0 <= half < 1e6:
            raise InputError(f"meta 'observation': disturbance.{name} is {half!r}, not a range")
        if blind or half == 0:
            result.append((0, None))
            continue
        state = math.ceil(math.log2(half * 2.0**exponent))
        result.append((state, rescale(0.0, 2.0 ** (state - exponent) / half)))
    return result


def rescale(middle: float, factor: float) -> Rescale:
    """Integers of ``(q - middle) factor``, the factor with 30 bits."""
    shift = 30 - math.frexp(factor)[1]
    return Rescale(round(middle), round(factor * 2.0**shift), shift)


def state_names(tables: RaceTables) -> list[str]:
    """The state's numbers in order, ``position[0]`` and so on."""
    names = []
    for name, count in tables.fields:
        names += [f"{name}[{i}]" if count > 1 else name for i in range(count)]
    return names
