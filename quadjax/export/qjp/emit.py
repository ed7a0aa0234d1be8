"""The C that loads and runs a ``.qjp`` file: the same for every policy."""

import functools
import math

import numpy as np

from quadjax.export.race_tables import QUATERNION_EXPONENT, TURNS_PER_UNIT, TWO_PI, YAW_EXPONENT
from quadjax.export.render import render

FOLDER = "qjp"
LOADER = ("qjp.h", "qjp_layout.h", "qjp_load.c", "qjp_check.c", "qjp_run.c", "qjp_sha256.c")


def emit_loader() -> dict[str, str]:
    """The loader's files, by path."""
    return {f"{FOLDER}/{file}": qjp_source(file) for file in LOADER}


@functools.cache
def qjp_source(file: str) -> str:
    """A file of ``templates/qjp`` as C."""
    values = {
        "name": "qjp",
        "NAME": "QJP",
        "turns_per_unit": TURNS_PER_UNIT,
        "two_pi": TWO_PI,
        "yaw_exponent": YAW_EXPONENT,
        "quaternion_exponent": QUATERNION_EXPONENT,
        "sha256_rounds": np.array([_fraction(prime, 3) for prime in _primes(64)]),
        "sha256_start": np.array([_fraction(prime, 2) for prime in _primes(8)]),
    }
    return render(f"qjp/{file}", values)


def _primes(count: int) -> list[int]:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % prime for prime in found):
            found.append(number)
        number += 1
    return found


def _fraction(prime: int, root: int) -> int:
    """The first 32 bits of the fraction of a prime's square or cube root."""
    scaled = prime << (32 * root)
    if root == 2:
        return math.isqrt(scaled) & 0xFFFFFFFF
    low, high = 0, 1 << 40
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if middle**3 <= scaled else (low, middle)
    return low & 0xFFFFFFFF
