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

import jax
import jax.numpy as jnp

from quadjax.core.errors import InputError
from quadjax.export.disturbances import product_fits, speed_exponent
from quadjax.export.integers import SPLIT, Rescale
from quadjax.vehicle.battery import LOWEST, limit_estimator
from quadjax.vehicle.motor import MotorConstants

FINE_BITS = 40  # the range of the speeds is 2^40 fine units
MOTORS = 4


@dataclasses.dataclass(frozen=True)
class BatteryTables:
    """Integers of the estimator, in the order of its words."""

    period_ns: int  # of a sample
    exponent: int  # of the range of the speeds and commands, rpm
    low_pass: int  # k, of fine units as ``integers.multiply_shift``
    low_pass_shift: int
    lead: int
    lead_shift: int
    gain: int
    gain_shift: int
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
    with jax.enable_x64(True):
        exact = limit_estimator(top, jnp.float64(lag), sample_rate)
    exponent = speed_exponent(top)
    unit = 2.0 ** (exponent - FINE_BITS)
    lowest, highest = round(LOWEST * top / unit), round(top / unit)
    factors: dict[str, int] = {}
    for name in ("low_pass", "lead", "gain"):
        rescale = Rescale.of(0.0, float(getattr(exact, name)))
        factors |= {name: rescale.factor, f"{name}_shift": rescale.shift}
    tables = BatteryTables(
        period_ns=round(1e9 / sample_rate),
        exponent=exponent,
        lowest=lowest,
        highest=highest,
        first=min(max(round(first_rpm / unit), lowest), highest),
        **factors,
    )
    prove_battery(tables)
    return tables


def prove_battery(tables: BatteryTables) -> None:
    """Prove that no measurement and no command can overflow the estimator.

    ``k`` is at most one, so that a low-pass stays between its past and its input, whatever is
    rounded: speeds and expected speeds stay within their range, ``limited`` in [0, 1]. The estimate
    is held to its limits. The sums and products of one sample follow from that, by bits as the C
    proves it on board.

    Raises:
        InputError: a number that is not allowed, or a sum or product that may reach 2^62.
    """
    full, t = 1 << FINE_BITS, tables
    fine = all(0 <= factor <= 1 << 30 for factor in (t.low_pass, t.lead, t.gain))
    fine = fine and all(17 <= x <= 60 for x in (t.low_pass_shift, t.lead_shift, t.gain_shift))
    fine = fine and t.low_pass <= 1 << t.low_pass_shift
    fine = fine and 0 <= t.lowest <= t.first <= t.highest <= full
    fine = fine and abs(t.exponent) <= 30 and t.period_ns > 0
    if fine:
        lead = (2 * full >> SPLIT) * t.lead >> (t.lead_shift - SPLIT)
        error = 2 * full + 2 + lead + 1
        fine = product_fits(error, 1 << 30)
        fine = fine and product_fits(MOTORS * (error + 1), t.gain)
    if not fine:
        raise InputError(
            "estimator of the highest rpm: its sums may reach 2^62, allowed: below 2^62; "
            "the motors are too slow"
        )
