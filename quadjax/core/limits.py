"""Upper limits of laps, gates, runs and seeds, and a check of integers."""

from numbers import Integral

from quadjax.core.errors import InputError

MAX_LAPS, MAX_GATES, MAX_RUNS = (
    1000,
    10_000,
    100_000,
)  # of one evaluation, which is simulated all at once
MAX_SEED = 2**31 - 1


def check_integer(name: str, value: object, least: int, most: int) -> None:
    """Raise an ``InputError`` that names the argument unless it is an integer in the range."""
    if (
        isinstance(value, bool)
        or not isinstance(value, Integral)
        or not least <= int(value) <= most
    ):
        raise InputError(f"{name} is {value!r}, allowed: an integer, {least} to {most}")
