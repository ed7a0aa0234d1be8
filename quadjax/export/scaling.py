"""Scaling of the state to [-1, 1] in fixed point: ``(q - middle) factor >> shift``."""

import dataclasses
import math

from quadjax.core.errors import InputError
from quadjax.export.integers import ONE
from quadjax.export.ranges import InputBox
from quadjax.policy.file import Policy
from quadjax.race.layout import Field
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM, NONE
from quadjax.vehicle.battery import LOWEST

LARGEST_SPAN = 1e6


@dataclasses.dataclass(frozen=True)
class Rescale:
    """One number of the state to one input: ``(q - middle) factor >> shift``, rounded."""

    middle: int
    factor: int  # below 2^31
    shift: int


Spans = list[tuple[int, Rescale | None]]  # of each number: exponent of the state's, and integers


def spans_of(policy: Policy, box: InputBox, name: str) -> Spans:
    """Exponent and integers of each number of a scaled field."""
    field, exponent = policy.layout[name], box.exponent[name]
    if name in DISTURBANCES:
        return [
            _external(field, exponent, high) for _, high in field.span or ((0, 0),) * field.size
        ]
    commands = tuple(zip(policy.command_low.tolist(), policy.command_high.tolist(), strict=True))
    if name == HIGHEST_RPM:
        commands = ((LOWEST * commands[0][1], commands[0][1]),)
    spans = field.span or commands[-field.size :]
    for low, high in spans:
        if low == high:
            allowed = "allowed: a width above zero"
            raise InputError(f"the policy's layout: {name} has a span of {[low, high]}, {allowed}")
    return [_span(low, high, exponent) for low, high in spans]


def _span(low: float, high: float, network: int) -> tuple[int, Rescale]:
    """[low, high] to [-1, 1]: the exponent of the state's number, and the integers."""
    reach = max(abs(0.5 * (low + high) + s * 0.5 * (high - low) * 2.0**network) for s in (-1, 1))
    exponent = math.ceil(math.log2(reach))
    unit = ONE / 2.0**exponent
    return exponent, rescale(
        0.5 * (low + high) * unit, 2.0 / (high - low) * 2.0 ** (exponent - network)
    )


def _external(field: Field, network: int, half: float) -> tuple[int, Rescale | None]:
    """A disturbance of half-width ``half``; ``None`` where the policy sees zero."""
    if not 0 <= half < LARGEST_SPAN:
        raise InputError(
            f"the policy's layout: {field.name} has a span of {half:g}, allowed: 0..1e6"
        )
    if field.source == NONE or half == 0:
        return 0, None
    exponent = math.ceil(math.log2(half * 2.0**network))
    return exponent, rescale(0.0, 2.0 ** (exponent - network) / half)


def rescale(middle: float, factor: float) -> Rescale:
    """Integers of ``(q - middle) factor``, the factor with 30 bits."""
    shift = 30 - math.frexp(factor)[1]
    return Rescale(round(middle), round(factor * 2.0**shift), shift)
