"""Required and available memory of a training run."""

import contextlib
import math
from pathlib import Path

import jax
import psutil
from jax.sharding import Mesh

from quadjax.core.errors import InputError


def memory_bytes(devices: int = 1) -> float:
    """Memory of one device: that of a GPU, or an equal part of the machine's for a CPU device."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return float(stats["bytes_limit"])
    limits = [float(psutil.virtual_memory().total)]
    with contextlib.suppress(OSError, ValueError):  # "max", or a system without control groups
        limits.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(limits) / devices


def check_memory(needed: float, mesh: Mesh) -> None:
    """Raise an ``InputError`` where a device of the mesh has less memory than ``needed`` bytes."""
    have = memory_bytes(len(mesh.local_devices))
    if needed > have:
        raise InputError(
            f"training needs about {needed / 2**30:.3g} GiB of memory on each device, which has "
            f"{have / 2**30:.3g} GiB: fewer environments (learner.num_envs), shorter rollouts or "
            "smaller networks"
        )


def tree_bytes(shapes: object) -> int:
    """Memory of a pytree of arrays or shapes."""
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(shapes))


def program_bytes(program: jax.stages.Compiled) -> int:
    """Memory of a compiled program on each device: arguments, results and temporaries."""
    found = program.memory_analysis()
    if found is None:  # not available on this backend
        return 0
    return (
        found.argument_size_in_bytes
        + found.output_size_in_bytes
        + found.temp_size_in_bytes
        - found.alias_size_in_bytes
    )
