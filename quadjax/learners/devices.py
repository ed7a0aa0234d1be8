"""The number of devices that a run uses: on a CPU, one for each core."""

import os

import jax

from quadjax.core.errors import InputError
from quadjax.learners.sharding import device_count


def core_count() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def prepare_devices(wanted: str | int) -> None:
    """Split the CPU into the number of devices that a run may use.

    Call it before JAX computes anything; later it has no effect.

    Args:
        wanted: ``run.devices``: auto, all, or a number.
    """
    count = int(wanted) if str(wanted).isdigit() else core_count()
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        return


def choose_devices(wanted: str | int, shards: int) -> int:
    """The number of devices to train on.

    Two devices of one core each train faster than one of two cores: XLA's own threads slow down
    matrix products this small.

    Args:
        wanted: ``run.devices``: auto (the most that divide the shards), all, or a number.
        shards: number of equal parts of the environments.

    Raises:
        InputError: more devices than there are, or a number that does not divide the shards.
    """
    available = jax.local_device_count()
    if wanted == "auto":
        return device_count(shards, available)
    count = available if wanted == "all" else int(wanted)
    if count > available:
        raise InputError(f"run.devices is {wanted}, allowed: at most {available} (devices)")
    if count > core_count() and jax.default_backend() == "cpu":
        raise InputError(f"run.devices is {wanted}, allowed: at most {core_count()} (cores)")
    if shards % count:
        raise InputError(
            f"run.devices is {wanted} ({count}), allowed: a divisor of the {shards} shards of "
            "learner.num_envs (at most run.shards)"
        )
    return count
