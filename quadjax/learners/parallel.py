"""Training over several devices: environments split, parameters shared.

An update is a function of whole arrays. Compiled over a mesh of devices, each device computes its
part of the environments, and the compiler inserts the sums over all of them. Random numbers do not
depend on the number of devices (``jax_threefry_partitionable``, JAX's default), so that a run is
the same on any number, up to rounding. On a CPU there is a device of one thread for each core.
"""

import contextlib
import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import psutil
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from quadjax.core.errors import InputError
from quadjax.learners.state import Metrics, TrainState

if TYPE_CHECKING:
    from quadjax.learners.schedules import Training

AXIS = "environments"  # name of the mesh axis over which the environments are split
SHARED = PartitionSpec()
Chunk = Callable[[TrainState], tuple[TrainState, Metrics]]
Tree = TypeVar("Tree")


def core_count() -> int:
    """The number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def prepare_devices(wanted: str | int) -> None:
    """Split the CPU into the number of devices that a run may use: auto, all, or a number.

    Call it before JAX computes anything; later it has no effect. There are as many as cores at
    most: ``choose_devices`` refuses a larger number.
    """
    count = min(int(wanted) if str(wanted).isdigit() else core_count(), core_count())
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)


def choose_devices(wanted: str | int, num_envs: int) -> int:
    """The number of devices to train on.

    ``wanted`` is ``run.devices``: auto (the largest number that divides the number of environments
    in the learner's state, which may be 0), all, or a number.

    Raises:
        InputError: more devices than there are, or a number that does not divide the environments.
    """
    available = jax.local_device_count()
    if wanted == "auto":
        counts = range(1, min(available, num_envs) + 1)
        return max((count for count in counts if num_envs % count == 0), default=1)
    count = available if wanted == "all" else int(wanted)
    if jax.default_backend() == "cpu":
        available = min(available, core_count())
    if count > available:
        raise InputError(f"run.devices is {wanted}, allowed: at most {available} (devices)")
    if num_envs % count:
        raise InputError(
            f"run.devices is {wanted} ({count}), allowed: a divisor of the {num_envs} environments "
            "(learner.num_envs)"
        )
    return count


def make_mesh(count: int) -> Mesh:
    """A mesh of the first ``count`` devices."""
    return Mesh(np.array(jax.devices()[:count]), (AXIS,))


def choose_mesh(wanted: str | int, state: TrainState) -> Mesh:
    """The mesh of ``choose_devices`` for the state of a learner, or for its shapes.

    Raises:
        InputError: as ``choose_devices``, or the devices have too little memory for the state.
    """
    env_states = jax.tree.leaves(state.env_states)
    num_envs = int(env_states[0].shape[-1]) if env_states else 0
    mesh = make_mesh(choose_devices(wanted, num_envs))
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
    check_memory(size / mesh.size, mesh)
    return mesh


def split_last(tree: Any) -> Any:
    """A tree of partition specs: every leaf is split along its last axis."""
    return jax.tree.map(lambda leaf: PartitionSpec(*(None,) * (leaf.ndim - 1), AXIS), tree)


def _shardings(state: TrainState, mesh: Mesh) -> TrainState:
    """How each leaf is laid out: environments are split by their last axis, all else is shared."""
    shared = jax.tree.map(lambda _: SHARED, state)
    specs = shared.replace(env_states=split_last(state.env_states))
    return jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs)


def place(state: TrainState, mesh: Mesh) -> TrainState:
    """The state laid out over the mesh.

    Weakly typed leaves become strongly typed, as those that the compiled chunk returns.
    """

    def strong(leaf: jax.Array) -> jax.Array:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf if is_key else leaf.astype(leaf.dtype)

    return jax.device_put(jax.tree.map(strong, state), _shardings(state, mesh))


def placed_shapes(shapes: TrainState, mesh: Mesh) -> TrainState:
    """Shapes of a state, with its shardings over the mesh."""
    return jax.tree.map(
        lambda leaf, where: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where),
        shapes,
        _shardings(shapes, mesh),
    )


def constrain(tree: Tree, *spec: str | None) -> Tree:
    """Traced arrays, laid out over the mesh that a program is compiled for, if it is for one.

    ``spec`` is the mesh axis by which each of the first array axes is split; none: shared.
    """
    if AXIS not in jax.sharding.get_abstract_mesh().axis_names:
        return tree
    return jax.lax.with_sharding_constraint(tree, PartitionSpec(*spec))


def sum_over_devices(
    function: Callable[..., tuple[Any, Any]], in_specs: Any, out_specs: Any
) -> Callable[..., tuple[Any, Any]]:
    """A function that adds up its first result over the devices once, at its end.

    The compiler alone adds up a gradient through a rollout at every time step. The function's
    arguments are split over the devices as ``in_specs`` say, its second result as ``out_specs``.
    """
    if AXIS not in jax.sharding.get_abstract_mesh().axis_names:
        return function

    def on_device(*arguments: Any) -> tuple[Any, Any]:
        sums, rest = function(*arguments)
        return jax.lax.psum(sums, AXIS), rest

    return jax.shard_map(
        on_device, in_specs=in_specs, out_specs=(SHARED, out_specs), check_vma=False
    )


def compile_options() -> dict[str, bool]:
    """XLA's options: one thread per CPU device. More slow down matrix products this small."""
    return {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else {}


def repeat(training: "Training", state: TrainState, count: int) -> tuple[TrainState, Metrics]:
    """The state after a number of updates, and the metrics of each, (count,)."""
    return jax.lax.scan(lambda carry, _: training.update(carry), state, None, count)


def compile_chunk(training: "Training", mesh: Mesh, updates: int, state: TrainState) -> Chunk:
    """Compile ``updates`` updates as one program that reuses the old state's memory.

    It is compiled ahead of time, for a state or its shapes: one of another shape is an error, not
    another compilation.

    Returns:
        A function of the placed state, to the next state and the metrics of every update, each
        (updates,).

    Raises:
        InputError: the program needs more memory than a device has.
    """
    shared, split = NamedSharding(mesh, SHARED), _shardings(state, mesh)
    jitted = jax.jit(
        repeat,
        static_argnums=2,
        in_shardings=(shared, split),
        out_shardings=(split, shared),
        donate_argnums=1,
        compiler_options=compile_options(),
    )
    training = jax.device_put(training, shared)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    with jax.set_mesh(mesh):
        program = jitted.lower(training, shapes, updates).compile()
    if (memory := program.memory_analysis()) is not None:  # not available on every backend
        results = memory.output_size_in_bytes - memory.alias_size_in_bytes
        needed = memory.argument_size_in_bytes + memory.temp_size_in_bytes + results
        check_memory(needed, mesh)
    return functools.partial(program, training)


def check_memory(needed: float, mesh: Mesh) -> None:
    """Raise an ``InputError`` where a device of the mesh has less memory than ``needed`` bytes."""
    stats = mesh.devices.flat[0].memory_stats() or {}
    available = stats.get("bytes_limit", psutil.virtual_memory().total / mesh.size)
    if needed > available:
        raise InputError(
            f"training needs about {needed / 2**30:.3g} GiB of memory on each device, which has "
            f"{available / 2**30:.3g} GiB: fewer environments (learner.num_envs), shorter rollouts "
            "or smaller networks"
        )
