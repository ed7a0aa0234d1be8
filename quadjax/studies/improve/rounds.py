"""What the rounds of learning from flights did, as a table."""

import dataclasses
from collections.abc import Sequence

from quadjax.core.markdown import table
from quadjax.studies.improve.flights import Flown
from quadjax.studies.improve.model import Refit

COLUMNS = (
    *("round", "finished", "time of all laps, s", "flight, s", "model", "error", "computing, s"),
)


@dataclasses.dataclass(frozen=True)
class Round:
    """What a round did."""

    flown: Flown
    found: Refit | None  # None: the logs could not be fitted
    error: str  # why not
    computing: float  # s
    margin: float  # m, inside the gates' edges, of the training
    fitted: int  # logs of the round that are fitted

    @property
    def state(self) -> str:
        """What became of the model."""
        if self.found is None:
            return "none"
        return "rejected" if self.found.refused else "accepted"


def rounds_table(rounds: Sequence[Round], check: dict[str, Flown]) -> str:
    """The rounds as a Markdown table; seconds are summed over the rounds."""
    rows: list[Sequence[str]] = [COLUMNS]
    flight = computing = 0.0
    for number, done in enumerate(rounds, start=1):
        flight += sum(done.flown.seconds)
        computing += done.computing
        found = done.found
        error = "-" if found is None else f"{100.0 * found.change:+.0f}%"
        cells = (f"{flight:.0f}", done.state, error, f"{computing:.0f}")
        rows.append((str(number), _finished(done.flown), _mean(done.flown), *cells))
    for name, flown in check.items():
        rows.append((f"check, {name}", _finished(flown), _mean(flown), "", "", "", ""))
    crashes = sum(bool(crash) for done in rounds for crash in done.flown.crashes)
    notes = [f"crashes in the rounds: {crashes}"]
    for number, done in enumerate(rounds, start=1):
        out = len(done.flown.totals) - done.fitted
        notes += [f"round {number}: {out} logs left out, too short or rejected"] if out else []
        why = done.error or (done.found.refused if done.found else "")
        notes += [f"round {number}: the model is rejected: {why}"] if why else []
    return "\n".join([table(rows), "", *notes])


def _finished(flown: Flown) -> str:
    return f"{flown.finished} of {len(flown.totals)}"


def _mean(flown: Flown) -> str:
    return f"{flown.mean:.2f}" if flown.finished else "-"
