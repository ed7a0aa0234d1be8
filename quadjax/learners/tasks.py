"""A curriculum over variants of a task: those whose pass rate changes are drawn more often.

The learning progress of a variant is the difference between its pass rate over a short and over a
long time (Kanitscheider et al., 2021, arXiv 2106.14876). A variant that is mastered, or that cannot
be learned yet, has none.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment, Variants
from quadjax.core.errors import InputError
from quadjax.learners.state import AXIS, Learner, Metrics, TrainState

SHORT, LONG = 0.02, 0.1  # fractions of a run over which pass rates are averaged
UNIFORM = 0.5  # share of the episodes whose variant is drawn uniformly
PRIOR = 10.0  # parts at which a new pass rate has the weight of the one it replaces
COMPLETED, CRASHED = "variant_completed", "variant_crashed"


@struct.dataclass
class Record:
    """What was completed in each variant, with weights that decay over updates."""

    short: jax.Array  # (2, variants): parts completed, and crashes
    long: jax.Array  # (2, variants)


def variant_metrics(
    variants: Variants | None,
    index: jax.Array | None,
    completed: jax.Array | None,
    terminated: jax.Array,
) -> Metrics:
    """Parts completed and crashes of each variant (variants,), over all devices; {} without any.

    Args:
        variants: of the environment.
        index: (time, n) the variant of each step.
        completed: (time, n) parts of the task that the step completed.
        terminated: (time, n) bool.
    """
    if variants is None or index is None or completed is None:
        return {}

    def total(numbers: jax.Array) -> jax.Array:
        own = jnp.zeros(variants.count).at[index.ravel()].add(numbers.ravel().astype(jnp.float32))
        return jax.lax.psum(own, AXIS)

    return {COMPLETED: total(completed), CRASHED: total(terminated)}


def learning_progress(record: Record) -> jax.Array:
    """The absolute change of each variant's pass rate, (variants,); 0 where nothing was counted."""

    def rate(counts: jax.Array, before: jax.Array) -> jax.Array:
        return (counts[0] + PRIOR * before) / (counts[0] + counts[1] + PRIOR)

    everywhere = jnp.sum(record.long, axis=1) + 1e-6
    slow = rate(record.long, everywhere[0] / (everywhere[0] + everywhere[1]))
    return jnp.abs(rate(record.short, slow) - slow)


def chances(record: Record) -> jax.Array:
    """The chance with which each variant is drawn, (variants,)."""
    progress = learning_progress(record)
    total, count = jnp.sum(progress), progress.shape[0]
    share = jnp.where(total > 0.0, progress / jnp.maximum(total, 1e-9), 1.0 / count)
    return UNIFORM / count + (1.0 - UNIFORM) * share


def with_learning_progress(learner: Learner, environment: Environment, updates: int) -> Learner:
    """The learner with variants drawn by learning progress.

    Args:
        learner: whose metrics contain those of ``variant_metrics``.
        environment: of the learner; without variants the learner is returned as it is.
        updates: of the run.

    Raises:
        InputError: in an update, the learner or the environment does not report what is completed.
    """
    variants = environment.variants
    if variants is None:
        return learner
    kept = tuple(1.0 - 1.0 / max(1.0, part * updates) for part in (SHORT, LONG))

    def init(hyper: object, params: object, key: jax.Array) -> TrainState:
        none = jnp.zeros((2, variants.count))
        state = learner.init(hyper, params, key)
        return dataclasses.replace(state, record=Record(none, jnp.copy(none)))

    def update(hyper: object, params: object, state: TrainState) -> tuple[TrainState, Metrics]:
        own = variants.weighted(params, chances(state.record))
        following, metrics = learner.update(hyper, own, state)
        if COMPLETED not in metrics:
            raise InputError(
                "Environment.variants needs Environment.completed, and a learner with the metrics "
                "of quadjax.learners.tasks.variant_metrics"
            )
        counts = jnp.stack([metrics.pop(COMPLETED), metrics.pop(CRASHED)])
        before = state.record
        record = Record(kept[0] * before.short + counts, kept[1] * before.long + counts)
        progress = jnp.mean(learning_progress(record))
        return dataclasses.replace(following, record=record), metrics | {
            "learning_progress": progress
        }

    return dataclasses.replace(learner, init=init, update=update)
