"""Several runs of one shape as one program: a ``vmap`` over seeds and float hyperparameters.

Right on a GPU, which one small run does not fill; on a CPU one process for each core is faster.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from quadjax.learners.sharding import compile_options
from quadjax.learners.state import AXIS, Learner, Metrics, TrainState

RUNS = "runs"  # name of the mesh axis over which runs are split
RunsChunk = Callable[[TrainState], tuple[TrainState, Metrics]]


def stack(trees: Sequence[object]) -> object:
    """Trees of one structure as one, batched along a new first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def make_mesh(runs: int) -> Mesh:
    """As many of the local devices as divide the runs; each holds its runs' environments whole."""
    there = jax.local_devices()
    count = max(n for n in range(1, len(there) + 1) if runs % n == 0)
    return Mesh(np.array(there[:count]).reshape(count, 1), (RUNS, AXIS))


def compile_runs(
    learner: Learner,
    mesh: Mesh,
    updates: int,
    hyper: object,
    params: object,
    state: TrainState,
) -> tuple[RunsChunk, TrainState]:
    """``updates`` updates of every run as one compiled program.

    Args:
        learner: of any of the runs; its own hyperparameters are not used.
        mesh: of ``make_mesh``.
        updates: in one call.
        hyper: float hyperparameters, stacked (runs, ..).
        params: traced parameters of the environment, stacked.
        state: train states, stacked.

    Returns:
        A function of the stacked states, which takes their memory, to the next states and the
        metrics of every update, each (updates, runs); and the states, placed.
    """
    each, metric = PartitionSpec(RUNS), PartitionSpec(None, RUNS)

    def many(hyper: object, params: object, state: TrainState) -> tuple[TrainState, Metrics]:
        update = jax.vmap(learner.update)
        return jax.lax.scan(lambda carry, _: update(hyper, params, carry), state, None, updates)

    split = jax.shard_map(
        many, mesh=mesh, in_specs=(each, each, each), out_specs=(each, metric), check_vma=False
    )
    placed = NamedSharding(mesh, each)
    hyper, params, state = jax.device_put((hyper, params, state), placed)
    jitted = jax.jit(split, donate_argnums=2, compiler_options=compile_options())
    program = jitted.lower(hyper, params, state).compile()
    return lambda state: program(hyper, params, state), state
