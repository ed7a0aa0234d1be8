"""The number of devices that a run uses: on a CPU, one for each core."""

import os

import jax

from quadjax.core.errors import InputError


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


def choose_devices(wanted: str | int, num_envs: int) -> int:
    """The number of devices to train on.

    Two devices of one core each train faster than one of two cores: XLA's own threads slow down
    matrix products this small.

    Args:
        wanted: ``run.devices``: auto (the most that divide the environments), all, or a number.
        num_envs: number of environments in the learner's state; 0 if it holds none.

    Raises:
        InputError: more devices than there are, or a number that does not divide the environments.
    """
    available = jax.local_device_count()
    if wanted == "auto":
        counts = range(1, min(available, num_envs) + 1)
        return max((count for count in counts if num_envs % count == 0), default=1)
    count = available if wanted == "all" else int(wanted)
    if count > available:
        raise InputError(f"run.devices is {wanted}, allowed: at most {available} (devices)")
    if count > core_count() and jax.default_backend() == "cpu":
        raise InputError(f"run.devices is {wanted}, allowed: at most {core_count()} (cores)")
    if num_envs % count:
        raise InputError(
            f"run.devices is {wanted} ({count}), allowed: a divisor of the {num_envs} environments "
            "(learner.num_envs)"
        )
    return count
