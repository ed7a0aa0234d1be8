"""What a training shows, and the score by which it chooses the best policy."""

import io
import types

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from quadjax.config.assembly import make_params
from quadjax.config.loading import load_config
from quadjax.learners.loop import ChunkResult
from quadjax.race.laps import OUT_OF_TIME, Laps
from quadjax.race.rules import TERMINATIONS
from quadjax.training import progress, score
from quadjax.training.checkpoint import RunState
from quadjax.training.progress import ProgressBar, describe
from quadjax.training.score import CHANGES, no_lap
from tests.race.support import BLANK
from tests.surface.short import short_config

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
    with ProgressBar(20_000_000, name, "6 laps", console) as display:
        display.show(row)
        display.note(note)
    return stream.getvalue()


def test_bar_percentage_time_and_laps_fit_in_80_columns():
    for name in ("e2e", "a_name_of_forty_letters_that_goes_on_and_on"):
        for laps in (15.8, 123.45, float("inf")):
            text = printed(name, ROW | {"lap_total": laps, "best_lap_total": laps})
            line = [line for line in text.splitlines() if "%" in line][-1]
            assert "62%" in line and ":" in line and "265 k/s" in line
            assert "━" in line and "…" not in line.replace(name[:15] + "…", "")
            assert ("reward 0.123  crashes 40%" if laps > 1000 else f"6 laps {laps:.2f} s") in line
    assert describe(ROW | {"finished": 0.8}, "6 laps").endswith(
        "  80% finish, score 15.80, best 15.70"
    )
    no_lap = ROW | {"lap_total": float("inf")}
    assert describe(no_lap | {"finished": 0.0}, "19 gates").endswith(
        "  0% finish, score -, best 15.70"
    )


def test_a_compilation_shows_its_seconds(monkeypatch, capsys):
    """On a terminal all of them, elsewhere in a line every ten seconds."""
    for terminal in (True, False):
        now, stream = [100.0], io.StringIO()
        monkeypatch.setattr(progress.time, "monotonic", lambda now=now: now[0])
        console = Console(file=stream, force_terminal=terminal, width=80, color_system=None)
        with ProgressBar(1000, "run", "1 lap", console) as display:
            for seconds in (0, 9, 11, 20, 21.4):
                now[0] = 100.0 + seconds
                display.compiling()
        assert ("compiling, 21 s" in stream.getvalue()) == terminal
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["run: compiling", "run: compiling, 11 s", "run: compiling, 21 s"]


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


@pytest.mark.parametrize(("kind", "count"), [("mean", 1), ("sampled", 16)])
def test_the_flights_of_a_score(kind, count, monkeypatch):
    """Of the mean action, or with the noise of training, as ``run.score`` says."""
    calls = []

    def fly(environment, params, act, policy, key, laps, runs, gates):
        calls.append((act, runs))
        return Laps(np.full((runs, 1), 2.0), ("",) * runs, np.full(runs, 2.0), 8.0), None

    monkeypatch.setattr(score, "fly_laps", fly)
    monkeypatch.setattr(score, "network_policy", lambda config, params: params)
    config = short_config("e2e", f"run.score={kind}")
    assert score.make_flights(config, params=None)(np.zeros(1)).score == 2.0
    expected = {"mean": score.act_deterministic, "sampled": score.act_sampled}
    assert calls == [(expected[kind], count)]


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "total"), [(1e3, 0.05), (0.01, 10.01)])
def test_a_score_of_rewards(limit, total, monkeypatch):
    """Of episodes of five steps, or of one step, which ends in a crash."""
    monkeypatch.setattr(score, "act_deterministic", lambda policy, observation, noise: jnp.zeros(4))
    monkeypatch.setattr(score, "network_policy", lambda config, params: params)
    rewards = ["reward.time=1", "reward.progress=0", "start.velocity=0", "start.position=0"]
    config = load_config(BLANK, ["run.score=reward", "training_limits.episode_steps=5", *rewards])
    params = make_params(config)
    params = params.replace(rules=params.rules.replace(position_limit=np.float32(limit)))
    laps = score.make_flights(config, params)(np.zeros(1))
    assert laps.score == pytest.approx(total) and len(laps.crashes) == 128


def test_the_best_policy_is_the_latest_of_equal_scores():
    found, kept = RunState(state=None, best="none"), []
    for chunk, total in enumerate([np.inf, 15.0, 14.0, 14.0, 16.0, np.inf]):
        state = types.SimpleNamespace(evaluated=str(chunk))
        found = found.after(ChunkResult(state, 100 * (chunk + 1), {}, 1.0), total, 1.0)
        kept.append((found.best, found.best_score, found.best_steps))
    assert kept[:3] == [("0", np.inf, 100), ("1", 15.0, 200), ("2", 14.0, 300)]
    assert kept[3:] == [("3", 14.0, 400)] * 3
