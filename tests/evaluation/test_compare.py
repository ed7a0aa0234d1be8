"""E2E against INDI: worlds and trainings, the tables, the races flown, and the command."""

import importlib
import json

import numpy as np
import pytest

import quadjax
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError, InputWarning
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.conditions import Condition
from quadjax.evaluation.result import Evaluation
from quadjax.evaluation.rows import Row
from quadjax.training.build import untrained_policy
from tests.commands import run
from tests.evaluation.support import flights

comparison = importlib.import_module("quadjax.evaluation.compare")  # not the function
evaluation = importlib.import_module("quadjax.evaluation.evaluate")
FASTER = {"motor": 0.0, "rate": 0.25}  # s of a lap: INDI is slower


def laps(*seconds):
    """Flights of six laps of these times, s; NaN for one that crashes in its fourth lap."""
    return flights(*6.0 * np.array(seconds), laps=6, before=3)


@pytest.fixture
def flown(monkeypatch):
    """Flights of 2.5 s a lap of E2E and 2.75 s of INDI in place of simulated ones, as asked for.

    On the plant they take 0.1 s more on the first drone, and 0.3 s and a crash of E2E on another.
    """
    calls = []

    def evaluate(policy, config, **how):
        calls.append((policy, config, how))
        slower = FASTER[policy.vehicle]
        simulated = laps(2.5 + slower, 2.5 + slower)
        crash = np.nan if policy.vehicle == "motor" else 4.0
        plant = laps(2.6 + slower, 2.6 + slower, 2.8 + slower, crash)
        labels = [x.label for x in how["conditions"].conditions] if how["conditions"] else ["-"]
        result = ("", simulated) if how["plant"] is None else ("", plant)
        drones = {} if how["plant"] is None else {"drones": 2, "at_limit": 0.45}
        rows = [
            Row(*result, "sampled, 4 runs" if label == "-" else label, **drones) for label in labels
        ]
        return Evaluation(tuple(rows), None, {})

    monkeypatch.setattr(comparison, "evaluate", evaluate)
    return calls


def test_both_fly_in_the_simulator_and_on_the_plant(flown):
    """INDI finishes a slow flight that E2E does not: without it the lead is 0.25 s a lap."""
    duel = quadjax.compare("e2e", "indi", plant="standin", drones=2, runs=4)
    text, lead = duel.table(), duel.lead()
    for line in (
        "E2E simulated, sampled   2.50",
        "E2E plant, sampled       2.67",
        "3/4 20.89",
        "E2E plant, sampled: run 4: hit a gate in lap 4",
        "motor commands at a limit: E2E plant 45%, INDI plant 45%",
        "score: mean of all flights; one that does not finish counts as 31.50 s to 35.57 s",
    ):
        assert line in text, text
    assert "published" not in text
    assert "simulated            +1.50" in lead and "+0.25 [+0.25, +0.25]" in lead and "3/4" in lead
    assert "95% intervals, plant: over 2 drones, flights; one training each" in lead
    assert [len(x.leads.drones) for x in duel.worlds.values()] == [1, 2]
    plant = duel.worlds["plant"]
    assert plant.laps[0].shape == (2, 1, 2, 6) and plant.leads.score.mean < 0.0 < plant.leads.pairs
    assert repr(duel).startswith("Comparison(E2E's lead over INDI: simulated +1.50")
    how = [(x["plant"] and x["plant"].name, x["drones"], x["runs"]) for *_, x in flown]
    assert how == 2 * [(None, None, 4), ("standin", 2, 4)]
    assert len(duel.plot().axes) == 3
    written = json.loads(json.dumps(duel.to_json(), allow_nan=False))
    assert written["worlds"]["plant"]["lead"]["pairs"] == 3
    assert written["worlds"]["simulated"]["E2E"]["at_limit"] is None
    (origin,) = written["provenance"]["policies"]["INDI"]
    assert origin["sha256"] and origin["race"]["name"] == "indi_seed0"


def test_trainings_of_a_contender_are_told_apart(flown):
    """Two of E2E by policy and file, one of INDI; the score counts a failed flight as 20 s."""
    pair = [quadjax.Policy.load("e2e"), PRETRAINED / "e2e.npz"]
    duel = quadjax.compare(pair, "indi", plant="standin", failed_after=20.0, names=("new", "old"))
    plant = duel.worlds["plant"]
    assert [x.shape[1] for x in plant.laps] == [2, 1] and plant.leads.of == 8
    assert plant.leads.scores == pytest.approx(
        ((15.6 + 15.6 + 16.8 + 20) / 4, (17.1 + 17.1 + 18.3 + 24) / 4)
    )
    assert "6/8" in duel.table() and "new's lead over old" in duel.lead("markdown")
    assert "over 2 drones, 2 and 1 trainings, flights" in duel.lead()
    assert len(duel.to_json()["provenance"]["policies"]["new"]) == 2


def test_conditions_have_a_line_each(flown):
    conditions = [
        Condition(label="calm"),
        Condition(label="windy", plant=("effects.gusts=2",)),
    ]
    duel = quadjax.compare("e2e", "indi", plant="standin", conditions=conditions, failed_after=30.0)
    text = " ".join(duel.table().split())
    assert "E2E finished score INDI finished score lead" in text
    assert "calm 16.00 3/4 19.50 19.12 4/4 19.12 +1.50 [+1.50, +1.50] windy" in text
    assert "counts as 30.00 s" in text and "commands at a limit" not in text
    assert [how["plant"].name for *_, how in flown] == ["standin", "standin"]
    assert "95% intervals: over 2 drones" in duel.lead() and duel.plot().axes
    quadjax.compare("e2e", "indi", conditions="plants")
    assert flown[-1][2]["plant"].name == "standin" and flown[-1][2]["drones"] is None


def test_contenders_fly_their_own_races_which_must_be_alike(tmp_path, capsys, flown):
    """INDI of a thrust of up to 18 m/s^2: in its own race, and with its constants in another."""
    own = load_config("indi", ["vehicle.constants.thrust_max=18"])
    file = tmp_path / "indi18.npz"
    untrained_policy(own).save(file)
    quadjax.compare("e2e", file, plant="standin")
    assert [race.vehicle.constants["thrust_max"] for _, race, _ in flown[2:]] == [18.0, 18.0]
    with pytest.warns(InputWarning, match="thrust_max is 18 in training, 15 here"):
        quadjax.compare("e2e", file, race="e2e")
    assert flown[-1][1].vehicle.constants == own.vehicle.constants
    untrained_policy(load_config("indi", ["track=figure8"])).save(file)
    assert run("compare", "standin", "--indi", "indi", file, "--output", tmp_path) == 2
    error = capsys.readouterr().err
    assert (
        "track is square4 in the race of" in error
        and "(race=CONFIG, --race CONFIG)" in " ".join(error.split())
    )
    change = "vehicle.constants.thrust_max=18"
    assert run("compare", "standin", change, "--output", tmp_path) == 2
    assert "(overrides change the plant, not the race)" in capsys.readouterr().err


@pytest.mark.parametrize("stops", ["fly_plants", "simulate"])
def test_a_race_of_neither_is_told_once_of_each(stops, tmp_path, capsys, monkeypatch):
    """The warnings are those of the policies, although each flies several times."""

    def stop(*_, **__):
        raise InputError("stopped")

    monkeypatch.setattr(evaluation, stops, stop)
    race = tmp_path / "race.yaml"
    race.write_text("base: e2e\nrules: {position_limit: 20}\n")
    more = ["--conditions", "rates"] if stops == "fly_plants" else []
    assert run("compare", "standin", "--race", race, *more, "--output", tmp_path) == 2
    error = capsys.readouterr().err
    assert "error: stopped" in error and error.count("trained in another race") == 2


@pytest.mark.slow
def test_the_command_flies_and_writes(tmp_path, capsys):
    pair = ["--e2e", "e2e", PRETRAINED / "e2e.npz", "--indi", "indi", "--deterministic"]
    options = ["--runs", 2, "--laps", 1, "--drones", 2]
    assert run("compare", "standin", *pair, *options, "--output", tmp_path) == 0
    text = capsys.readouterr().out
    assert "E2E plant, deterministic" in text and "2 and 1 trainings" in text
    folder = tmp_path / "compare"
    assert (folder / "table.txt").read_text() == text
    written = json.loads((folder / "compare.json").read_text())
    assert written["worlds"]["plant"]["INDI"]["finished"] == 2
    assert written["worlds"]["plant"]["E2E"]["trainings"] == 2
    names = {"table.txt", "compare.json", "compare.png", "config.yaml"}
    assert names <= {path.name for path in folder.iterdir()}
