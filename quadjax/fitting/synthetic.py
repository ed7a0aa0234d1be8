"""Residual networks made up at random, as large as those found on real drones.

For training with a residual before there is a flight log, and for tests: smooth, and the same for
the same seed. As a command::

    python -m quadjax.fitting.synthetic --seed 0 --out residual.npz
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from quadjax.cli.arguments import Parser, check_writable, count, parse, seed
from quadjax.core.errors import InputError, command_line
from quadjax.vehicle.residual import Layers, Residual
from quadjax.vehicle.residual_file import write_residual

# The flight envelope of the Bebop 1 over which the outputs have the asked-for spread.
RPM_RANGE = (3000.0, 11000.0)
VELOCITY = 8.0  # m/s, either way
RATE = 6.0  # rad/s, either way
SAMPLES = 20_000


def make_residual(
    seed: int,
    thrust_std: float = 1.0,
    moment_std: float | tuple[float, float, float] = 0.015,
    width: int = 32,
) -> Residual:
    """A random residual of a given size.

    Args:
        seed: decides everything.
        thrust_std: standard deviation of the body-z specific force over the envelope, m/s^2.
        moment_std: standard deviation of the moments over the envelope, N m; one
            number for all three axes or one for each.
        width: hidden units of each network.

    Returns:
        The residual; the mean of each output over the envelope is zero.

    Raises:
        InputError: a spread that is negative or not finite, or a width below one.
    """
    moments = np.broadcast_to(np.asarray(moment_std, np.float64), 3)
    for name, value in (("thrust_std", thrust_std), *(("moment_std", m) for m in moments)):
        if not (np.isfinite(value) and value >= 0.0):
            raise InputError(f"{name} is {value}, expected a finite number that is not negative")
    if width < 1:
        raise InputError(f"width is {width}, expected at least 1")
    random = np.random.default_rng(seed)
    spans = np.array([1.0] * 4 + [VELOCITY] * 3 + [RATE] * 3)
    return Residual(
        thrust=_random_network(random, spans[:7], width, np.array([thrust_std])),
        moment=_random_network(random, spans, width, moments),
        rpm_min=jnp.float32(RPM_RANGE[0]),
        rpm_max=jnp.float32(RPM_RANGE[1]),
        thrust_sign=jnp.float32(1.0),
    )


def _random_network(
    random: np.random.Generator, spans: np.ndarray, width: int, spread: np.ndarray
) -> Layers:
    """A one-hidden-layer network on inputs within +-spans, its outputs scaled to ``spread``."""
    kernel = random.normal(size=(len(spans), width)) / np.sqrt(len(spans))
    bias = random.uniform(-1.0, 1.0, size=width)
    inputs = random.uniform(-1.0, 1.0, size=(SAMPLES, len(spans)))
    hidden = np.maximum(inputs @ kernel + bias, 0.0)
    last = random.normal(size=(width, len(spread)))
    raw = hidden @ last
    last = last * spread / np.maximum(raw.std(axis=0), 1e-12)
    layers = ((kernel / spans[:, None], bias), (last, -(hidden @ last).mean(axis=0)))
    return tuple((jnp.asarray(k, jnp.float32), jnp.asarray(b, jnp.float32)) for k, b in layers)


def main() -> None:
    """Write a made-up residual file."""
    parser = Parser(description=main.__doc__)
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--thrust-std", type=float, default=1.0, help="m/s^2")
    parser.add_argument("--moment-std", type=float, default=0.015, help="N m")
    parser.add_argument("--width", type=count, default=32, help="hidden units")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, .npz")
    words = parse(parser)
    check_writable(words.out, (".npz",))
    residual = make_residual(words.seed, words.thrust_std, words.moment_std, words.width)
    source = {
        "synthetic": True,
        "seed": words.seed,
        "thrust_std": words.thrust_std,
        "moment_std": words.moment_std,
    }
    write_residual(words.out, residual, source)
    print(f"wrote {words.out}")


if __name__ == "__main__":
    command_line(main)()
