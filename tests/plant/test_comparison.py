"""The comparison's numbers: progress, first-order models, and the ablation's list."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors
from quadjax.fitting.signals import first_order
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import Flights
from quadjax.plant.races import race_config
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.studies import comparison
from quadjax.studies.ablation import VARIANTS, present
from quadjax.studies.comparison import (
    Compared,
    Setting,
    contender,
    lead,
    limit_fractions,
)
from quadjax.studies.comparison_run import table_text
from quadjax.studies.drawn_plants import (
    OnPlants,
    common_flights,
    conditions,
    drawn,
    interval,
    plants_table,
)
from tests.commands import run

ROOT = Path(__file__).resolve().parents[2]


def compared(name: str, file: str, lap: float, crashes: tuple[str, ...]) -> Compared:
    """Six laps of ``lap`` s simulated and 0.1 s more on the plant; all rpm commands at 11000."""
    simulated = Laps(np.full((2, 6), lap), ("", ""), np.full(2, 6 * lap), 48.0)
    times = np.full((len(crashes), 6), lap + 0.1)
    times[[bool(crash) for crash in crashes], 3:] = np.nan
    flown = Laps(times, crashes, np.nansum(times, axis=1), 48.0)
    over = np.zeros((10, 1), bool)
    frames = SimpleNamespace(rpm_command=Rotors.same(np.full((10, 1), 11000.0)), over=over)
    trace = SimpleNamespace(command=np.full((10, 4, 1), 7000.0), over=over)
    own = contender(name, str(ROOT / "quadjax" / "pretrained" / file))
    return Compared(own, simulated, trace, Flights(flown, frames, 0.002))


def test_the_table_has_flights_of_this_comparison_only():
    setting = Setting(load_config("e2e +residual"), PlantConfig(), runs=6)
    e2e = compared("E2E", "e2e.npz", 2.5, ("",) * 5 + ("hit a gate",))
    indi = compared("INDI", "indi.npz", 2.75, ("",) * 6)
    text = table_text(setting, e2e, indi)
    for line in (
        "E2E stand-in plant,",
        "5/6",
        "E2E's lead over INDI: +1.50 s simulated, +1.50 s on the stand-in plant; "
        "first lap +0.25 -> +0.25 s, each later lap +0.25 -> +0.25 s",
        "0% simulated, 100% on the stand-in plant",
        "E2E on the stand-in plant, early ends: hit a gate 1",
    ):
        assert line in text, text
    assert "published" not in text and "flown" not in text
    assert limit_fractions(setting, e2e) == (1.0, 0.0)
    assert limit_fractions(setting, indi) == (1.0, None)


def test_no_lead_where_nobody_finished():
    e2e = compared("E2E", "e2e.npz", 2.5, ("",) * 6)
    indi = compared("INDI", "indi.npz", 2.75, ("hit a gate",) * 6)
    assert lead(e2e, indi).endswith("INDI finished no run on the stand-in plant")


def test_each_condition_of_the_plant_changes_one_thing():
    plants = conditions(PlantConfig())
    assert plants.pop("all effects") == PlantConfig()
    on = PlantConfig().effects.model_dump()
    for name in on:
        assert plants.pop(f"without {name}").effects.model_dump() == on | {name: 0.0}
        alone = plants.pop(f"only {name}")
        assert alone.effects.model_dump() == dict.fromkeys(on, 0.0) | {name: 1.0}
        assert alone.delay.command == alone.delay.measurement == 0.0
    still, known = plants.pop("without delays"), plants.pop("with true states")
    assert still.delay.command == still.delay.measurement == 0.0
    assert still.effects == PlantConfig().effects
    assert known.navigation == known.disturbance == "ground_truth"
    delayed, none = plants.pop("only delays"), plants.pop("no effect, no delay")
    assert not any(delayed.effects.model_dump().values()) and delayed.delay.command > 0.0
    assert none.delay.command == 0.0
    assert {name: plant.battery.charge for name, plant in plants.items()} == {
        f"charge {x:g}": (x, x) for x in (1.0, 0.6, 0.2)
    }


def test_commands_mean_what_the_policy_was_trained_with():
    limits = load_config("indi", ["vehicle.constants.thrust_max=20"])
    policy = Policy.load(ROOT / "quadjax" / "pretrained" / "indi_shac.npz")
    own = dataclasses.replace(policy, config=limits.model_dump(mode="json", by_alias=True))
    found = race_config(load_config("e2e +residual"), own).vehicle
    assert found.model == "rate" and found.constants["thrust_max"] == 20.0


def test_drawn_plants_differ_in_their_constants_only():
    first, second = drawn(PlantConfig(), 2)
    assert first == PlantConfig() and second.constants.seed == first.constants.seed + 1
    assert second.replace(constants=first.constants) == first


def test_intervals_are_students():
    """Of 1, 2, .. 5: mean 3, standard error sqrt(2.5 / 5), and 2.776 of them for 4 degrees."""
    mean, width = interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0, np.nan]))
    assert mean == 3.0 and width == pytest.approx(2.776 * np.sqrt(0.5), rel=1e-3)
    assert np.isnan(interval(np.array([np.nan]))[0]) and np.isnan(interval(np.array([2.0]))[1])


def test_the_table_of_plants_has_both_and_the_lead():
    def flown(lap, crashed):
        times = np.full((2, 6), lap)
        times[0, 3:] = np.nan if crashed else lap
        return Laps(times, ("hit a gate" if crashed else "", ""), np.full(2, 6 * lap), 48.0)

    e2e = {"all effects": OnPlants((flown(2.4, False), flown(2.5, True)))}
    indi = {"all effects": OnPlants((flown(2.9, False), flown(3.0, False)))}
    assert (e2e["all effects"].finished, e2e["all effects"].runs) == (3, 4)
    text = plants_table(e2e, indi, 2)
    assert "14.70 ± 3.81" in text and "3/4" in text and "4/4" in text
    assert "E2E, all effects, early ends: hit a gate 1\n" in text
    assert "+3.00 ± 0.00 s; first lap\n+0.50 ± 0.00 s, each later lap +0.50 ± 0.00 s" in text
    assert max(map(len, text.splitlines())) <= 80


def test_contenders_are_compared_on_the_flights_that_both_finish():
    """E2E finishes the fast plant alone, INDI both: without INDI's slow plant it is slower."""

    def flown(*laps):
        times = np.array(laps)[:, None] * np.ones(6)
        return Laps(times, tuple("" if x == x else "hit a gate" for x in laps), 6 * times[0], 48.0)

    e2e = {"all effects": OnPlants((flown(2.5, np.nan), flown(np.nan, np.nan)))}
    indi = {"all effects": OnPlants((flown(2.4, 3.0), flown(3.0, 3.0)))}
    text = plants_table(e2e, indi, 2)
    assert "all effects 15.00 1/4 14.40 4/4" in " ".join(text.split())
    assert "all effects: both finish 1 of 4 flights, on 1 of 2 plants" in text
    assert "E2E's lead, all effects: -0.60 s; first lap\n-0.10 s" in text
    pair = common_flights(e2e["all effects"], indi["all effects"])
    for own, total in zip(pair, (15.0, 14.4), strict=True):
        np.testing.assert_allclose(own.totals, [total, np.nan])


def test_every_drawn_plant_has_its_own_noise_and_its_share_of_the_runs(monkeypatch):
    seen = []

    def fly(setting, plant, own):
        seen.append((plant.constants.seed, setting.seed, setting.runs))
        return SimpleNamespace(laps=None)

    monkeypatch.setattr(comparison, "fly", fly)
    setting = Setting(load_config("e2e +residual"), PlantConfig(), runs=6, seed=7, plants=3)
    comparison.fly_drawn(setting, PlantConfig(), None)
    assert [number for number, _, _ in seen] == [1, 2, 3]
    assert len({seed for _, seed, _ in seen}) == 3 and {runs for *_, runs in seen} == {2}
    with pytest.raises(InputError, match=r"runs is 7, allowed: multiples of plants \(3\)"):
        comparison.fly_drawn(dataclasses.replace(setting, runs=7), PlantConfig(), None)


def test_a_first_order_lag_of_held_commands():
    dt, tau = 0.002, 0.06
    command = np.full((200, 2), 5.0)
    made = first_order(command, np.array([1.0, 5.0]), tau, dt)
    time = dt * np.arange(200)
    np.testing.assert_allclose(made[:, 0], 5.0 - 4.0 * np.exp(-time / tau), rtol=1e-9)
    np.testing.assert_allclose(made[:, 1], 5.0)


def test_the_ablation_has_what_the_paper_argues():
    lines = {(variant.group, variant.label) for variant in VARIANTS}
    assert {("residual", "with"), ("residual", "without")} <= lines
    assert {("disturbance", x) for x in ("ground_truth", "estimated", "none")} <= lines
    assert {("randomization", f"{x}%") for x in (0, 10, 20, 30)} <= lines


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: f"{v.group} {v.label}")
def test_its_policies_can_be_trained(variant, monkeypatch):
    """Its arguments are a valid config, but for a residual that is made elsewhere."""
    monkeypatch.chdir(ROOT)
    config, *arguments = variant.training
    read = load_config(config, [f"name={variant.policy}", *arguments])
    assert read.name == variant.policy and read.vehicle.model == "motor"
    assert variant.policy in variant.command() and config in variant.command()


def test_what_is_missing_is_known(tmp_path):
    (tmp_path / "e2e_ground_truth.npz").write_bytes(b"")
    have, missing = present(tmp_path)
    assert {variant.policy for variant in have} == {"e2e_ground_truth"} and len(have) == 3
    assert len(have) + len(missing) == len(VARIANTS)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["--parts", "tables"], "--parts"),
        (["--conditions", "calm"], "--conditions"),
        (["--parts", "table", "--conditions", "all effects"], "--conditions has no effect"),
        (["--e2e", "missing.npz"], "missing.npz"),
        (["--e2e", "INDI"], "a policy for the rate"),
        (["effects.wind=1"], "effects.wind"),
        (["--runs", "0"], "--runs"),
        (["--runs", "25"], "--runs is 25, allowed: multiples of --plants (10)"),
        (["--name", "../../zz"], "'../../zz'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, arguments, names):
    indi = str(ROOT / "quadjax" / "pretrained" / "indi.npz")
    given = [indi if word == "INDI" else word for word in arguments]
    assert run("compare", ROOT / "configs" / "plant" / "standin.yaml", *given) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and names in lines[0]


@pytest.mark.slow
def test_the_command_flies_draws_and_writes(tmp_path, capsys):
    folder = tmp_path / "ablation"
    folder.mkdir()
    policy = ROOT / "quadjax" / "pretrained" / "ablation" / "e2e_residual.npz"
    (folder / policy.name).write_bytes(policy.read_bytes())
    arguments = ["--runs", 2, "--laps", 1, "--parts", "table", "ablation", "--ablation", folder]
    plant = ROOT / "configs" / "plant" / "standin.yaml"
    assert run("compare", plant, *arguments, "--output", tmp_path) == 0
    assert "residual: with" in capsys.readouterr().out
    written = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert written["INDI"]["stand-in plant"]["finished"] == 2
    assert written["ablation"]["residual: with"]["finished"] == 2
    names = {path.name for path in (tmp_path / "compare" / "report").iterdir()}
    assert {"gaps.png", "trajectories.pdf", "errors_4.svg", "table.tex"} <= names
    assert len(written["rms error to the first-order response"]["INDI stand-in plant"]) == 3
