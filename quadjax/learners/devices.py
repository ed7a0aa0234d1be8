"""How many devices a run uses: on a CPU, one for each core."""

import os

import jax

from quadjax.core.errors import InputError
from quadjax.learners.sharding import device_count


def core_count() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def prepare_devices(wanted: str | int) -> None:
    """Give the CPU as many devices as the run may want; call it before anything is computed.

    Does nothing where JAX's backend is up already, as in a notebook's second run.

    Args:
        wanted: ``run.devices``: auto, all, or a number.
    """
    count = int(wanted) if str(wanted).isdigit() else core_count()
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        return


def choose_devices(wanted: str | int, lanes: int) -> int:
    """How many devices of each process to train on.

    Two devices of one core each train faster than one of two cores: XLA's own threads get in each
    other's way in matrices this small.

    Args:
        wanted: ``run.devices``: auto (as many as divide the work), all, or a number.
        lanes: into how many shares the drones divide.

    Raises:
        InputError: a number of devices that is not there or does not divide the drones.
    """
    there, processes = jax.local_device_count(), jax.process_count()
    if lanes % processes:
        raise InputError(
            f"--processes is {processes}, expected a divisor of the {lanes} shares into which "
            "learner.num_envs divides; run.shards says how many there may be"
        )
    lanes //= processes
    if wanted == "auto":
        return device_count(lanes, there)
    count = there if wanted == "all" else int(wanted)
    if count > there:
        raise InputError(f"run.devices is {wanted}, but this process has {there}")
    if count > core_count() and jax.default_backend() == "cpu":
        raise InputError(f"run.devices is {wanted}, allowed: at most {core_count()} (cores)")
    if lanes % count:
        raise InputError(
            f"run.devices is {wanted} ({count}), expected a divisor of the {lanes} shares into "
            "which learner.num_envs divides"
        )
    return count
