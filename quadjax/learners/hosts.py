"""Training over several processes, on one machine or many, by ``jax.distributed``.

Every process runs the same program on its share of the drones; the first one writes the files. What
is done between chunks has to be agreed on, because all processes must enter the next chunk, or the
gathering of a checkpoint, together.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding

from quadjax.core.errors import InputError


def connect(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Join the processes of a run; does nothing where no coordinator is named.

    Call it after ``quadjax.learners.devices.prepare_devices`` and before anything is computed.

    Args:
        coordinator: HOST:PORT at which the first process listens; "auto" on a cluster that JAX
            knows (Slurm, Open MPI, Kubernetes, TPU pods).
        processes: how many there are.
        process: which of them this is, from 0.

    Raises:
        InputError: numbers that do not fit, or a coordinator that does not answer.
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
    """Whether there is no other process."""
    return jax.process_count() == 1


def meet(mesh: Mesh) -> None:
    """Let all processes find each other, while they are at the same place.

    Where they first meet they wait half a minute at most, and compiling may take one of them
    longer than that.
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
    """Whether any process says so; all have to ask."""
    if alone():
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def _is_key(leaf: object) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def spread(tree: object, shardings: object) -> object:
    """A tree that every process holds whole, laid out over the devices of all.

    Args:
        tree: of arrays, the same in every process.
        shardings: a tree of them, or one for all leaves.
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


def gather(tree: object) -> object:
    """A tree on the host, whole in every process, keys as their integers; all have to call it."""

    def plain(tree: object) -> object:
        return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)

    if alone():
        return jax.device_get(plain(tree))
    mesh = next(
        (x.sharding.mesh for x in jax.tree.leaves(tree) if isinstance(x.sharding, NamedSharding)),
        Mesh(np.array(jax.devices()), ("all",)),
    )
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.device_get(jax.jit(plain, out_shardings=everywhere)(tree))


def share(tree: object) -> object:
    """The first process's tree of NumPy arrays, in every process; all have to call it."""
    if alone():
        return tree
    return jax.device_get(multihost_utils.broadcast_one_to_all(tree))
