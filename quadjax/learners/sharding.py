"""Compiled chunks of updates, data-parallel over devices: environments split, parameters shared."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from quadjax.learners.memory import check_memory, program_bytes, tree_bytes
from quadjax.learners.state import AXIS, Learner, Metrics, TrainState

Chunk = Callable[[object, TrainState], tuple[TrainState, Metrics]]


def make_mesh(count: int) -> Mesh:
    """A mesh of the first ``count`` devices."""
    return Mesh(np.array(jax.devices()[:count]), (AXIS,))


def device_count(shards: int, wanted: int) -> int:
    """The most devices, up to ``wanted``, among which the shards divide evenly; 0 if none do."""
    counts = range(1, max(wanted, 1) + 1)
    return max((count for count in counts if shards % count == 0), default=0)


def specs_of(state: TrainState) -> TrainState:
    """How each leaf is split: environments and keys by their last axis; others are replicated."""

    def split(leaf: jax.Array) -> PartitionSpec:
        return PartitionSpec(*(None,) * (leaf.ndim - 1), AXIS)

    shared = jax.tree.map(lambda _: PartitionSpec(), state)
    return shared.replace(
        environment=jax.tree.map(split, state.environment),
        keys=PartitionSpec(AXIS),
    )


def _strong(leaf: jax.Array) -> jax.Array:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return leaf.astype(leaf.dtype)


def _shardings(state: TrainState, mesh: Mesh) -> TrainState:
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        specs_of(state),
        is_leaf=lambda x: isinstance(x, PartitionSpec),
    )


def place(state: TrainState, mesh: Mesh) -> TrainState:
    """The state laid out over the mesh.

    Weakly typed leaves become strongly typed, as those that the compiled chunk returns.
    """
    return jax.device_put(jax.tree.map(_strong, state), _shardings(state, mesh))


def abstract(state: TrainState, mesh: Mesh) -> TrainState:
    """Shapes, types and shardings of a placed state, of one from ``jax.eval_shape``."""
    return jax.tree.map(
        lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
        state,
        _shardings(state, mesh),
    )


def compile_options() -> dict[str, bool]:
    """XLA's compiler options: one thread per CPU device.

    XLA's own threads slow down matrix products this small; a device for each core is faster.
    """
    return {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else {}


def compile_chunk(
    learner: Learner, mesh: Mesh, updates: int, params: object, state: TrainState
) -> Chunk:
    """Compile ``updates`` updates as one program that reuses the old state's memory.

    It is compiled ahead of time: a state of another shape is an error, not another compilation.

    Args:
        learner: the algorithm.
        mesh: the devices.
        updates: in one call.
        params: traced parameters of the environment.
        state: a placed state, or its ``abstract`` one.

    Raises:
        InputError: the program needs more memory than a device has.

    Returns:
        A function of the environment's parameters and the state, to the next state and the
        metrics of every update, each (updates,).
    """
    check_memory(tree_bytes(state) / mesh.size, mesh)
    everywhere = NamedSharding(mesh, PartitionSpec())
    hyper, params = jax.device_put((learner.hyper, params), everywhere)
    split = _split_updates(learner, mesh, updates, state)
    jitted = jax.jit(split, donate_argnums=2, compiler_options=compile_options())
    program = jitted.lower(hyper, params, state).compile()
    check_memory(program_bytes(program), mesh)

    def chunk(params: object, state: TrainState) -> tuple[TrainState, Metrics]:
        return program(hyper, jax.device_put(params, everywhere), state)

    return chunk


def check_update(learner: Learner, mesh: Mesh, params: object, state: TrainState) -> None:
    """Trace two updates; nothing is compiled. Arguments as of ``compile_chunk``."""
    jax.eval_shape(_split_updates(learner, mesh, 2, state), learner.hyper, params, state)


def _split_updates(
    learner: Learner, mesh: Mesh, updates: int, state: TrainState
) -> Callable[[object, object, TrainState], tuple[TrainState, Metrics]]:
    """A number of updates, with the environments split over the devices."""
    specs, shared = specs_of(state), PartitionSpec()

    def many(hyper: object, params: object, state: TrainState) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda carry, _: learner.update(hyper, params, carry), state, None, updates
        )

    return jax.shard_map(
        many,
        mesh=mesh,
        in_specs=(shared, shared, specs),
        out_specs=(specs, shared),
        check_vma=False,
    )
