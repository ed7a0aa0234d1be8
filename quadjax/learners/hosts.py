"""Training in several processes, on one machine or many, by ``jax.distributed``.

Every process runs the same program on its part of the environments; the first one writes the files.
All processes must enter the next chunk, or gather a checkpoint, together: what happens between
chunks is decided by all of them.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding

from quadjax.core.errors import InputError


def connect(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join the processes of a run; does nothing if no coordinator is named.

    Call it after ``quadjax.learners.devices.prepare_devices`` and before JAX computes anything.

    Args:
        coordinator: HOST:PORT at which the first process listens; "auto" on a cluster that JAX
            detects (Slurm, Open MPI, Kubernetes, TPU pods).
        processes: number of processes.
        process: index of this process, from 0.

    Raises:
        InputError: an impossible number, or a coordinator that does not answer.
    """
    if coordinator is None:
        if processes is not None or process is not None:
            raise InputError("--processes and --process need --coordinator HOST:PORT")
        return
    auto = coordinator == "auto"
    if not auto:
        _check(coordinator, processes, process)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(None if auto else coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"--coordinator {coordinator}: {reason}") from error


def _check(coordinator: str, processes: int | None, process: int | None) -> None:
    host, colon, port = coordinator.rpartition(":")
    if not (host and colon and port.isdigit() and 0 < int(port) < 65536):
        raise InputError(f"--coordinator is {coordinator!r}, expected HOST:PORT or auto")
    if processes is None or process is None:
        raise InputError("--coordinator HOST:PORT needs --processes N and --process I")
    if not 0 <= process < processes:
        raise InputError(f"--process is {process}, allowed: 0 to {processes - 1}")


def is_first() -> bool:
    """Whether this process writes the files."""
    return jax.process_index() == 0


def alone() -> bool:
    """Whether this is the only process."""
    return jax.process_count() == 1


def meet(mesh: Mesh) -> None:
    """Connect all processes; all have to call it.

    A first collective operation waits at most half a minute for the others. Called before
    compilation, which can take one process longer than that.
    """
    if alone():
        return
    agree(False)
    axis = mesh.axis_names[0]
    count = jax.shard_map(
        lambda x: jax.lax.psum(x, axis),
        mesh=mesh,
        in_specs=PartitionSpec(axis),
        out_specs=PartitionSpec(),
    )
    ones = spread(np.ones(mesh.size, np.float32), NamedSharding(mesh, PartitionSpec(axis)))
    jax.block_until_ready(jax.jit(count)(ones))


def agree(flag: bool) -> bool:
    """Whether the flag is true in any process; all have to call it."""
    if alone():
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def spread(tree: Any, shardings: Any) -> Any:
    """A tree that every process holds completely, laid out over the devices of all.

    Args:
        tree: arrays, the same in every process.
        shardings: a tree of shardings, or one for all leaves.
    """
    if alone():
        return jax.device_put(tree, shardings)
    if isinstance(shardings, Sharding):
        shardings = jax.tree.map(lambda _: shardings, tree)
    return jax.tree.map(_spread_leaf, tree, shardings)


def _spread_leaf(leaf: jax.Array, sharding: NamedSharding) -> jax.Array:
    if not _is_key(leaf):
        host = np.asarray(leaf)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])
    host = np.asarray(jax.random.key_data(leaf))
    whole = NamedSharding(sharding.mesh, PartitionSpec(*sharding.spec, None))
    numbers = jax.make_array_from_callback(host.shape, whole, lambda index: host[index])
    return jax.jit(jax.random.wrap_key_data, out_shardings=sharding)(numbers)


def gather(tree: Any) -> Any:
    """A tree on the host, complete in every process; keys as integers. All have to call it."""

    def plain(tree: Any) -> Any:
        return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)

    if alone():
        return jax.device_get(plain(tree))
    mesh = next(
        (x.sharding.mesh for x in jax.tree.leaves(tree) if isinstance(x.sharding, NamedSharding)),
        Mesh(np.array(jax.devices()), ("all",)),
    )
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.device_get(jax.jit(plain, out_shardings=everywhere)(tree))


def broadcast(tree: Any) -> Any:
    """The first process's tree of NumPy arrays, in every process; all have to call it."""
    if alone():
        return tree
    return jax.device_get(multihost_utils.broadcast_one_to_all(tree))
