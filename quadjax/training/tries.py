"""The start of a run as the best of several short trainings (``run.tries``)."""

import dataclasses
from collections.abc import Callable

import jax

from quadjax.learners.loop import Hooks, Position, Row
from quadjax.learners.state import TrainState


def best_try(
    begin: Callable[[int], TrainState],
    train: Callable[[Position, Hooks], Position],
    hooks: Hooks,
    number: int,
    show: Callable[[str, Row], None],
) -> Position:
    """Train several times for a short time; the one with the highest reward goes on.

    The rows of metrics of that one are reported, the others are dropped. An interrupted run starts
    its tries again when it is resumed, and gets the same ones.

    Args:
        begin: the first state of the try of an index.
        train: a try, from a position.
        hooks: of the run.
        number: of tries.
        show: called after every chunk with the name of the try and the row.

    Returns:
        The position of the best try; without any training if the run is to stop.
    """
    best: tuple[Position, list[Row]] | None = None
    for index in range(number):
        rows: list[Row] = []

        def report(row: Row, rows: list[Row] = rows, name: str = f"try {index + 1}") -> None:
            rows.append(row)
            show(name, row)

        own = dataclasses.replace(hooks, report=report, save=lambda _: None)
        position = train(fresh(begin(index)), own)
        if hooks.agree(hooks.stop()):
            return fresh(begin(0))
        if best is None or _reward(rows[-1]) > _reward(best[1][-1]):
            best = position, rows
    assert best is not None, number
    for row in best[1]:
        hooks.report(row)
    return best[0]


def fresh(state: TrainState) -> Position:
    """The position of a run before its first update."""
    return Position(state=state, best=jax.device_get(state.evaluated))


def _reward(row: Row) -> float:
    """What the tries are compared by; the score for a learner that reports no reward."""
    return row["reward"] if "reward" in row else -row["score"]
