"""Mean and sampled flights of a policy, from hover and from random starts."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quadjax.core.markdown import table
from quadjax.evaluation.evaluation import Evaluation
from quadjax.evaluation.tables import Row
from quadjax.race.laps import Laps

STARTS = {"hover": 1, "random": 2}  # with the seed of noise, disturbances and starts
TITLES = ("policy", "noise", "mean", "sampled", "ratio", "mean, random", "sampled, random")


@dataclasses.dataclass(frozen=True)
class Protocols:
    """Flights of one policy: of the mean action, and sampled with the noise of training.

    Attributes:
        label: of the policy.
        noise: standard deviation of the policy's noise, mean over the actions, which are -1 to 1.
        mean: flights of the mean action by start, "hover" and "random".
        sampled: flights with noise by start.
        published: the published flight of the same race and protocol, sampled from hover, if any.
    """

    label: str
    noise: float
    mean: dict[str, Laps]
    sampled: dict[str, Laps]
    published: Row | None = None

    @property
    def ratio(self) -> float:
        """Sampled time from hover over that of the mean action."""
        return mean_total(self.sampled["hover"]) / mean_total(self.mean["hover"])

    def to_json(self) -> dict[str, Any]:
        """Mean time of all laps in s (null where none finishes), and counts of flights."""
        both = {"mean": self.mean, "sampled": self.sampled}
        flights = {
            how: {start: numbers(laps) for start, laps in by_start.items()}
            for how, by_start in both.items()
        }
        return {"policy": self.label, "noise": round(self.noise, 4), **flights}


def fly_protocols(
    fly: Callable[..., Evaluation], label: str, log_std: np.ndarray, published: Row | None = None
) -> Protocols:
    """Evaluate mean and sampled flights from both starts.

    Args:
        fly: ``evaluate`` with policy, race and number of runs; takes the other options.
        label: of the policy.
        log_std: of the policy.
        published: see ``Protocols``.
    """

    def flights(deterministic: bool) -> dict[str, Laps]:
        return {
            start: fly(deterministic=deterministic, start=start, seed=seed).laps
            for start, seed in STARTS.items()
        }

    noise = float(np.exp(np.asarray(log_std, np.float64)).mean())
    return Protocols(label, noise, flights(True), flights(False), published)


def mean_total(laps: Laps) -> float:
    """Mean time of all laps over the flights that finish, s; NaN if none does."""
    done = laps.totals[np.isfinite(laps.totals)]
    return float(done.mean()) if done.size else float("nan")


def numbers(laps: Laps) -> dict[str, float | int | None]:
    """Mean time of all laps in s (None where no flight finishes), and counts of flights."""
    time = mean_total(laps)
    seconds = round(time, 3) if np.isfinite(time) else None
    return {"time": seconds, "finished": laps.finished, "runs": len(laps.crashes)}


def protocol_table(results: Sequence[Protocols]) -> str:
    """A Markdown table, one line per policy; published flights are below those of their race."""
    rows: list[Sequence[str]] = [TITLES]
    for own, following in zip(results, [*results[1:], None], strict=True):
        rows.append(_row(own))
        row = own.published
        if row and (following is None or following.published != row):
            rows.append((f"published {row.label}", "", "", f"{row.total:.2f}", "", "", ""))
    return f"{table(rows)}\n\n{note(results[0].mean['hover'])}"


def _row(own: Protocols) -> tuple[str, ...]:
    return (
        own.label,
        f"{own.noise:.2f}",
        cell(own.mean["hover"]),
        cell(own.sampled["hover"]),
        f"{own.ratio:.3f}" if np.isfinite(own.ratio) else "-",
        cell(own.mean["random"]),
        cell(own.sampled["random"]),
    )


def note(laps: Laps) -> str:
    """The note below a table of flights, for the number of flights in ``laps``."""
    runs = len(laps.crashes)
    return f"Seconds for all laps, mean of the flights that finish; in brackets, of {runs} flights."


def cell(laps: Laps) -> str:
    """Mean time of all laps, and in brackets the number of flights that finish."""
    time = mean_total(laps)
    return f"{time:.2f} ({laps.finished})" if np.isfinite(time) else f"- ({laps.finished})"
