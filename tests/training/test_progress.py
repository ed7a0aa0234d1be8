"""What a training shows: on one line of 80 columns, with advice where no lap is completed."""

import io

from rich.console import Console

from quadjax.race.laps import OUT_OF_TIME
from quadjax.race.rules import TERMINATIONS
from quadjax.training.progress import TrainingProgress, describe
from quadjax.training.score import CHANGES, no_lap

ROW = {
    "steps": 12_300_000,
    "seconds": 45.0,
    "steps_per_second": 265_000.0,
    "reward": 0.1234,
    "crash_rate": 0.4,
    "lap_total": 15.8,
    "best_lap_total": 15.7,
}


def printed(name, row, note=""):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=80, color_system=None)
    with TrainingProgress(20_000_000, name, console) as progress:
        progress.show(row)
        progress.note(note)
    return stream.getvalue()


def test_bar_percentage_time_and_laps_fit_in_80_columns():
    for name in ("e2e", "a_name_of_forty_letters_that_goes_on_and_on"):
        for laps in (15.8, 123.45, float("inf")):
            text = printed(name, ROW | {"lap_total": laps, "best_lap_total": laps})
            line = [line for line in text.splitlines() if "%" in line][-1]
            assert "62%" in line and ":" in line and "265 k/s" in line
            assert "━" in line and "…" not in line.replace(name[:15] + "…", "")
            assert ("reward 0.123  crashes 40%" if laps > 1000 else f"laps {laps:.2f} s") in line
    assert "laps - s, best 15.70" in describe(ROW | {"lap_total": float("inf")})


def test_without_a_lap_it_says_what_ended_the_flights_and_what_to_change():
    causes, changes = no_lap(["hit a gate", "out of bounds", "hit a gate", ""], 1e8).split("\n", 1)
    assert causes.endswith("hit a gate (2 of 3), out of bounds (1 of 3)")
    changes = " ".join(changes.split())
    assert "reward.gate_edge" in changes and "When a policy does not learn" in changes
    assert causes in printed("run", ROW, causes)
    assert set(CHANGES) == {*TERMINATIONS, OUT_OF_TIME}  # every reason has its advice
    assert no_lap(["", ""], 1e8) == ""
    every = [no_lap([reason] * 9, steps) for reason in CHANGES for steps in (1e5, 1e8)]
    assert max(len(line) for text in every for line in text.splitlines()) < 80
    assert "20,000 steps are few" in no_lap(["hit a gate"], 20_000)
