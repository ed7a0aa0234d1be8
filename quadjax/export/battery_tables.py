"""The estimator of the highest propeller speed in fixed point.

The method is that of ``quadjax.vehicle.battery.update``, with the factors k, lead and gain of
``limit_estimator``. Of each motor with the measured speed w and the command u, with h the estimate
of the highest speed and all past values on the right::

    expected' = expected + k (min(u, h) - expected)
    limited'  = limited + k ([u >= h] - limited)
    error     = speed + lead (w - speed) - expected'
    speed'    = speed + k (w - speed)

and ``h' = h + gain sum(error limited')``, held to 0.75 to 1 of the highest command. Speeds and
commands become integers of 2^-30 of their range. The memory is kept in fine units of 2^-40 of it,
``limited`` in 2^-40. The same integers decide ``u >= h`` here and in the C.
"""

import dataclasses
import math

import jax.numpy as jnp

from quadjax.core.errors import InputError
from quadjax.export.estimator_tables import speed_exponent
from quadjax.export.integers import INPUT_BITS, enable_x64
from quadjax.vehicle.battery import LOWEST, limit_estimator
from quadjax.vehicle.motor import MotorConstants

FINE_BITS = 40  # the range of the speeds is 2^40 fine units
MOTORS = 4
SPLIT = 16  # a long product is made of an upper part and 16 lower bits
ROOM = 62  # every sum and every product stays below 2^62


@dataclasses.dataclass(frozen=True)
class Factor:
    """The real number ``value / 2**shift``."""

    value: int  # 2^29 to 2^30
    shift: int

    @property
    def wrong(self) -> float:
        """The largest rounding error of the number."""
        return 2.0 ** -(self.shift + 1)

    @property
    def rounding(self) -> float:
        """The largest rounding error of a product with it, in its last bit."""
        return 0.5 + 2.0 ** (SPLIT - self.shift)


LIMITED = Factor(1 << INPUT_BITS, INPUT_BITS)  # the largest of ``limited``, Q30


@dataclasses.dataclass(frozen=True)
class BatteryTables:
    """Integers of the estimator."""

    sample_rate: float  # Hz
    exponent: int  # of the range of the speeds and commands, rpm
    low_pass: Factor  # k
    lead: Factor
    gain: Factor
    lowest: int  # fine units, of the estimate
    highest: int  # fine units, of the estimate: the highest command
    first: int  # fine units, the estimate after a reset

    @property
    def unit(self) -> float:
        """One fine unit, rpm."""
        return 2.0 ** (self.exponent - FINE_BITS)

    @property
    def exponents(self) -> tuple[int, ...]:
        """Of the ranges of four speeds and four commands."""
        return (self.exponent,) * (2 * MOTORS)


def make_battery(
    constants: MotorConstants, first_rpm: float, sample_rate: float = 512.0
) -> BatteryTables:
    """The integers of the estimator of one vehicle.

    Args:
        constants: the highest command and the time constant of the motors.
        first_rpm: the estimate after a reset, rpm.
        sample_rate: Hz.

    Raises:
        InputError: motors so slow that there is no room for the proof.
    """
    top, lag = float(constants.rpm_max), float(constants.tau)
    with enable_x64(True):
        exact = limit_estimator(top, jnp.float64(lag), sample_rate)
    exponent = speed_exponent(top)
    unit = 2.0 ** (exponent - FINE_BITS)
    lowest, highest = round(LOWEST * top / unit), round(top / unit)
    tables = BatteryTables(
        sample_rate=sample_rate,
        exponent=exponent,
        low_pass=_factor(float(exact.low_pass)),
        lead=_factor(float(exact.lead)),
        gain=_factor(float(exact.gain)),
        lowest=lowest,
        highest=highest,
        first=min(max(round(first_rpm / unit), lowest), highest),
    )
    prove_battery(tables)
    return tables


def _factor(number: float) -> Factor:
    shift = 30 - math.frexp(number)[1]
    return Factor(round(number * 2.0**shift), shift)


def prove_battery(tables: BatteryTables) -> None:
    """Prove that no measurement and no command can overflow the estimator.

    ``k`` is at most one, so that a low-pass stays between its past and its input, whatever is
    rounded: speeds and expected speeds stay within their range, ``limited`` in [0, 1]. The estimate
    is held to its limits. The sums and products of one sample follow from that.

    Raises:
        InputError: a sum or product that may reach 2^62.
    """
    k = tables.low_pass
    full, error = 1 << FINE_BITS, _largest_error(tables)
    _check_numbers(tables)
    total = MOTORS * (error + 1)
    step = (total * tables.gain.value >> tables.gain.shift) + 1
    products = (
        *((2 * full, k), (2 * full, tables.lead)),
        *((error, LIMITED), (total, tables.gain)),
    )
    largest = max([((x >> SPLIT) + 1) * (f.value + 1) for x, f in products] + [total + step + full])
    if largest >= 1 << ROOM or k.value > 1 << k.shift:
        raise InputError(
            "estimator of the highest rpm: its sums may reach "
            f"2^{math.log2(largest):.1f}, allowed: below 2^{ROOM}; the motors are too slow"
        )


def _check_numbers(tables: BatteryTables) -> None:
    """What the C checks on board.

    Raises:
        InputError: a number that is not allowed.
    """

    def fits(value: int, factor: int) -> bool:
        size = abs(factor)
        bits = ((value >> SPLIT) + 1).bit_length() + (size + 1).bit_length()
        return bits <= ROOM and 16 + size.bit_length() <= ROOM

    full = 1 << FINE_BITS
    factors = (tables.low_pass, tables.lead, tables.gain)
    fine = all(0 <= f.value <= 1 << 30 and 17 <= f.shift <= 60 for f in factors)
    fine = fine and tables.low_pass.value <= 1 << tables.low_pass.shift
    fine = fine and 0 <= tables.lowest <= tables.first <= tables.highest <= full
    fine = fine and abs(tables.exponent) <= 30 and tables.sample_rate > 0.0
    if fine:
        lead = (2 * full >> SPLIT) * tables.lead.value >> (tables.lead.shift - SPLIT)
        error = 2 * full + 2 + lead + 1
        fine = fits(error, 1 << 30) and fits(4 * (error + 1), tables.gain.value)
    if not fine:
        raise InputError(
            "estimator of the highest rpm: its sums may reach 2^62, allowed: below 2^62; "
            "the motors are too slow"
        )


def _largest_error(tables: BatteryTables) -> int:
    """The largest difference of a speed, with its lead, to the expected one, in fine units."""
    full = 1 << FINE_BITS
    return 2 * full + (2 * full * tables.lead.value >> tables.lead.shift) + 2


def update_error(tables: BatteryTables) -> float:
    """The largest error of the estimate in one sample, rpm, against real arithmetic.

    From any one memory that the estimator can have and any integers of speeds and commands: what
    is rounded in one sample, and the rounding of the factors.
    """
    full, k, lead = float(1 << FINE_BITS), tables.low_pass, tables.lead
    error = float(_largest_error(tables))
    moved = k.rounding + 2.0 * full * k.wrong  # of a low-pass
    wrong = moved + lead.rounding + 2.0 * full * lead.wrong
    weight = moved / full + 2.0**-INPUT_BITS  # of ``limited``, cut to Q30
    product = wrong + error * weight + wrong * weight + LIMITED.rounding
    gain = tables.gain.value / 2.0**tables.gain.shift + tables.gain.wrong
    total = MOTORS * (gain * product + error * tables.gain.wrong) + tables.gain.rounding
    return 1.001 * total * tables.unit
