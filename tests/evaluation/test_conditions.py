"""Conditions: their files, drones that differ from the model, and starts."""

import json
import math
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import quadjax
from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import preset_names
from quadjax.core.vectors import Rotors, Vec3
from quadjax.evaluation import plants, published
from quadjax.evaluation.conditions import Condition, Damaged, damaged, read_conditions
from quadjax.evaluation.rows import Row, Speeds, speed_record, speeds_of
from quadjax.evaluation.simulate import start_before_gate, unseen_tracks
from quadjax.evaluation.table import condition_table, policy_table
from quadjax.plant.config import PlantConfig
from quadjax.race.laps import fly_race, laps_of, starting_states
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.rigid_body import RigidBodyState
from tests import reference as ref
from tests.commands import run
from tests.evaluation.support import flights, random_policy, rate_race, script, scripted
from tests.race.support import BLANK

RPM = np.array([7000.0, 7600.0, 8000.0, 7300.0])
RACE = load_config("e2e +residual", ["evaluate.laps=6"])


@pytest.mark.parametrize("name", preset_names("conditions"))
def test_shipped_lists_are_valid(name):
    listed = read_conditions(name)
    plant = None if listed.plant is None else PlantConfig()
    races = {condition.label: race for condition, race, _ in listed.expand(RACE, plant)}
    assert set(races) >= {condition.label for condition in listed.conditions}


REFUSED = """
conditions: [] | conditions is
conditions: [{label: a}, {label: a}] | two have the label 'a'
conditions: [{label: a, thrust: 0.9}] | unknown key conditions[0].thrust
{columns: [laps], conditions: [{label: a}]} | columns has 'laps', allowed: crashed
{laps: 2, seconds: 3, conditions: [{label: a}]} | allowed: one of laps, gates, seconds
conditions: [{label: a, overrides: [vehicle.mass=1]}] | condition a: vehicle.mass: unknown key
conditions: [{label: a, overrides: ["vehicle.mismatch={kw: 2}"]}] | a: unknown key vehicle.mismatch
conditions: [{label: a, overrides: [wind]}] | condition a: wind is not of the form key=value
{overrides: [wind=1], conditions: [{label: a}]} | wind
{plant: standin, conditions: [{label: a, only: [wind]}]} | a: only has 'wind', allowed: inflow
{plant: standin, conditions: [{label: a, plant: [wind=1]}]} | a: plant: unknown key wind
{plant: standin, conditions: [{label: a, damage: {}}]} | a: has damage, allowed: without a plant
conditions: [{label: a, plant: [effects.gusts=0]}] | a: changes the plant, allowed: with a plant
"""


def test_a_list_that_cannot_be_used_is_refused(tmp_path, monkeypatch):
    """By its file, also where the command has read it before."""
    monkeypatch.chdir(tmp_path)
    for row in REFUSED.strip().splitlines():
        text, message = row.split(" | ")
        Path("mine.yaml").write_text(text)
        with pytest.raises(InputError, match=f"^mine.yaml: .*{re.escape(message)}") as caught:
            quadjax.evaluate("e2e", "e2e", conditions="mine.yaml")
        with pytest.raises(InputError, match=re.escape(str(caught.value))):
            quadjax.evaluate("e2e", "e2e", conditions=read_conditions("mine.yaml"))


def test_a_condition_changes_the_simulated_drone_only():
    words = ("vehicle.mismatch={k_w: 0.96}", "disturbance.moment_bias=[0.01, 0, 0]")
    race = Condition(label="a", overrides=(*words, "track=figure8")).race(RACE)
    assert race.vehicle.mismatch == {"k_w": 0.96}
    assert race.disturbance.moment_bias == (0.01, 0.0, 0.0)
    assert race.vehicle.constants == RACE.vehicle.constants and race.track.name == "figure8"
    assert Condition(label="a").race(RACE) == RACE


def test_each_condition_of_the_plant_changes_one_thing():
    listed = read_conditions("plants").conditions
    plants = {condition.label: condition.on_plant(PlantConfig()) for condition in listed}
    assert plants.pop("all effects") == PlantConfig()
    on = PlantConfig().effects.model_dump()
    for name in on:
        assert plants.pop(f"without {name}").effects.model_dump() == on | {name: 0.0}
        alone = plants.pop(f"only {name}")
        assert alone.effects.model_dump() == dict.fromkeys(on, 0.0) | {name: 1.0}
        assert alone.delay.command == alone.delay.measurement == 0.0
    still, true = plants.pop("without delays"), plants.pop("with true states")
    assert still.delay.command == still.delay.measurement == 0.0
    assert still.effects == PlantConfig().effects
    assert true.navigation == true.disturbance == "ground_truth"
    delayed = plants.pop("only delays")
    assert not any(delayed.effects.model_dump().values()) and delayed.delay.command > 0.0
    assert plants.pop("no effect, no delay").delay.command == 0.0
    assert {name: plant.battery.charge for name, plant in plants.items()} == {
        f"charge {x:g}": (x, x) for x in (1.0, 0.6, 0.2)
    }


def test_arguments_come_before_the_list_and_the_list_before_the_config():
    listed = read_conditions("spread")
    protocol = listed.resolve(RACE, seed=3)
    assert (protocol.seconds, protocol.runs, protocol.start) == (12, 1000, "before_gate")
    protocol = listed.resolve(RACE, laps=2, runs=7, start="hover")
    assert (protocol.seconds, protocol.laps, protocol.runs) == (None, 2, 7)
    assert (protocol.start, protocol.deterministic) == ("hover", True)
    tracks = unseen_tracks(RACE, 9)
    assert (tracks.seed, tracks.count) == (256, 9)
    listed = read_conditions("protocols")
    last = listed.resolve(RACE, seed=5, start="around").apply(listed.conditions[-1])
    assert (last.start, last.seed, last.deterministic, last.laps) == ("random", 7, False, 6)


def rates_and_force(model):
    """Angular acceleration and specific force of a drone at rest, and its propellers'."""
    params = VehicleParams(MotorConstants(**{k: jnp.float32(v) for k, v in ref.MOTOR.items()}))
    zero = Vec3.zero()
    rpm = Rotors(*(jnp.float32(x) for x in RPM))
    state = RigidBodyState(zero, zero, zero, zero, rpm, zero, zero)
    after = model.derivative(params, state, Rotors.same(jnp.float32(8000.0)))
    force = model.specific_force(params, state)
    return [
        np.array([float(x) for x in v.components()]) for v in (after.rates, force, after.actuators)
    ]


@pytest.mark.parametrize("imbalance", [(0.0, 0.0), (1.2e-3, -0.7e-3)])
def test_weaker_rotors_and_a_shifted_mass(imbalance):
    c, factors = ref.MOTOR, np.array([0.85, 1.0, 0.9, 1.0])
    model = Damaged(disturbed=True, rotors=tuple(factors), imbalance=imbalance)
    rates, force, spin = rates_and_force(model)
    squares, slowed = factors * RPM**2, np.sqrt(factors) * RPM
    np.testing.assert_allclose(spin, (8000.0 - RPM) / c["tau"], rtol=1e-4)
    np.testing.assert_allclose(force, [0.0, 0.0, -c["k_w"] * squares.sum()], rtol=1e-5)
    x, y = imbalance
    yaw = c["k_r1"] * slowed @ [-1, 1, -1, 1]
    moment = [
        c["k_p"] * squares @ [1, -1, -1, 1] - y * force[2],
        c["k_q"] * squares @ [1, 1, -1, -1] + x * force[2],
        yaw + c["k_r2"] * (np.sqrt(factors) * spin) @ [-1, 1, -1, 1],
    ]
    inertia = [c["i_xx"], c["i_yy"], c["i_zz"]]
    np.testing.assert_allclose(rates, np.divide(moment, inertia), rtol=2e-3, atol=2e-3)


def test_without_damage_it_is_the_model_and_other_models_have_none():
    found = rates_and_force(Damaged(disturbed=True))
    for value, expected in zip(found, rates_and_force(motor.MODEL), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-6)
    listed = read_conditions("damage", ["rotor 1: 15% less thrust"])
    assert damaged(motor.MODEL, listed.conditions[0].damage).rotors == (0.85, 1, 1, 1)
    with pytest.raises(InputError, match="damage: the vehicle is rate, allowed: motor"):
        quadjax.evaluate("indi", "indi", conditions=listed, runs=1)
    with pytest.raises(InputError, match="from hover"):
        quadjax.evaluate("e2e", "e2e", plant="standin", start="random", runs=1)


def test_flights_start_before_the_gates():
    environment, params = make_race(load_config(BLANK, ["randomization.all=0.2"]))
    keys = jax.random.split(jax.random.key(0), 400)
    one = jax.vmap(lambda key: start_before_gate(environment, params, key))
    state = jax.tree.map(np.asarray, jax.jit(one)(keys))
    drone = state.drone
    place = np.stack([drone.position.x, drone.position.y, drone.position.z], 1)
    yaw = np.asarray(ref.GATE_YAW)[state.target]
    behind = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
    np.testing.assert_allclose(place, ref.GATES[state.target] - behind, atol=1e-5)
    assert set(state.target) == {0, 1, 2, 3}
    for values, half in (
        (drone.velocity.x, 0.5),
        (drone.euler.x, math.pi / 9),
        (drone.euler.z, math.pi),
        (drone.rates.y, 0.1),
        (state.constants.k_w / ref.MOTOR["k_w"] - 1, 0.2),
    ):
        assert 0.95 * half < np.abs(values).max() <= half * (1 + 1e-5)


@pytest.mark.slow
def test_the_speeds_of_a_race_are_those_of_its_flight():
    _, environment, params = rate_race()
    states = starting_states(environment, params, jax.random.key(0), 2, True, around=True)
    key = jax.random.key(1)
    both = (True, speed_record)
    (flown, trace), (_, record) = (
        fly_race(environment, scripted, 1, 250, what, params, script(), states, key)
        for what in both
    )
    to_first, highest, above = speeds_of(record, laps_of(environment, flown, 0.01, 8.0), 0.01, 2.0)
    # Flights that follow on at the end of the script, and their states after each step.
    assert np.all((highest > 2.0) & (above > 0.2) & (above < 2.5))
    first = [int(np.flatnonzero(target != target[0])[0]) for target in trace.target.T]
    np.testing.assert_allclose(to_first, 0.01 * np.array(first))
    assert np.all(to_first > 0.2) and abs(to_first[0] - to_first[1]) > 0.01
    for number, position in enumerate(np.moveaxis(np.asarray(trace.position), 2, 0)):
        speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / 0.01
        assert highest[number] == pytest.approx(speed.max(), rel=0.02)
        assert above[number] == pytest.approx(0.01 * (speed > 2.0).sum(), abs=0.05)


def test_tables_of_conditions_and_of_policies():
    speeds = Speeds(*(np.array(x) for x in ([0.9, 0.0], [31.26, 40.0], [6.914, 9.0])))
    row = Row("mine", flights(12.734, np.nan), "±0%", speeds=speeds, speed_limit=28.0)
    none = Row("mine", flights(np.nan), "±10%")
    listed = read_conditions("races")
    lines = condition_table([row, none], listed.title, listed.columns).format("markdown")
    assert "| ±0% | 1 of 2 | 12.73 s | 11.83 s | 31.3 m/s | 6.91 s | 1 hit a gate |" in lines
    assert "| ±10% | 0 of 1 | - | - | - | - | 1 hit a gate |" in lines
    rows = [
        Row(name, flights(2.0, 2.2), condition, published=beside)
        for name, time in (("one", published.INDI), ("two", published.INDI), ("three", None))
        for condition, beside in (("mean", None), ("sampled", time))
    ]
    lines = policy_table(rows, "total").format("markdown").splitlines()
    assert ["published" in line for line in lines[2:6]] == [False, False, True, False]
    assert lines[4] == "| published INDI simulated, sampled |  | 17.14 |"
    assert lines[2] == "| one | 2.10 (2) | 2.10 (2) |" and "of 2 flights" in lines[-1]


@pytest.mark.slow
def test_without_the_estimate_flights_fail_under_moments_and_are_slower_with_damage():
    listed = read_conditions("damage", ["all three, negative", "rotor 4: 15% less thrust"])
    fly = {"deterministic": True, "runs": 2, "conditions": listed}
    races = {name: RACE.at("observation.disturbance", name) for name in ("estimated", "none")}
    adaptive = quadjax.evaluate("e2e_residual_disturbance", races["estimated"], **fly)
    assert [row.finished for row in adaptive.rows] == [2, 2]
    zeros = quadjax.evaluate("e2e_residual_disturbance", races["none"], **fly)
    assert [row.finished for row in zeros.rows] == [0, 2]
    assert zeros.rows[1].total > adaptive.rows[1].total + 1.0


@pytest.mark.slow
def test_more_drones_crash_with_larger_errors(tmp_path):
    def study(name, *options):
        files = ("--policy", "e2e_fastest", "--json", tmp_path / "found.json")
        options = ("--conditions", name, "--runs", 60, *options)
        assert run("evaluate", "e2e +fastest", *files, *options) == 0
        return json.loads((tmp_path / "found.json").read_text())["flights"]

    found = study("spread", "--seconds", 7)
    assert [each["label"] for each in found] == ["±0%", "±10%", "±20%", "±30%"]
    assert found[0]["crashed"] < found[-1]["crashed"] <= 60
    assert 1.9 < found[0]["lap"] < 2.3
    found = study("races", "--gates", 6)
    assert found[0]["finished"] > found[-1]["finished"]
    assert 2.0 < found[0]["between"] < found[0]["time"] < 4.5
    assert 5.0 < found[0]["highest_speed"] < 15.0 and found[0]["seconds_above"] is None


@pytest.fixture
def plants_flown(monkeypatch):
    """Seed and runs of every flight on a plant."""
    flown, fly_plan = [], plants.fly_plan

    def fly(plan, seed):
        flown.append((seed, plan.runs))
        return fly_plan(plan, seed)

    monkeypatch.setattr(plants, "fly_plan", fly)
    return flown


@pytest.mark.slow
def test_every_drawn_plant_has_its_own_noise_and_its_share_of_the_runs(plants_flown):
    numbers = {"drones": 2, "runs": 4, "laps": 1, "seed": 7}
    flown = quadjax.evaluate("e2e", "e2e", plant="standin", **numbers)
    assert plants_flown == [(7, 4)]
    assert (flown.row.drones, flown.row.runs, len(flown.row.drone_totals)) == (2, 4, 2)
    assert flown.best["motor_command"].shape == (len(flown.best.time), 4)


@pytest.mark.slow
def test_on_a_plant_several_policies_fly_the_protocols_that_it_has(plants_flown, capsys):
    policies = ("--policy", "e2e", "--policy", "indi")
    assert run("evaluate", *policies, "--plant", "standin", "--laps", 1, "--runs", 2) == 0
    text = capsys.readouterr().out
    assert "| policy | mean | sampled |" in text and plants_flown == [(1, 2)] * 4
    assert "Not flown on the plant, which has no such start: mean, random; sampled, random." in text


@pytest.mark.slow
def test_a_policy_that_crashes_is_a_result_with_files_and_a_row_of_a_table(tmp_path, capsys):
    random_policy().save(tmp_path / "one.npz")
    file = tmp_path / "a.json"
    policy = ("--policy", tmp_path / "one.npz", "--laps", 1, "--runs", 2, "--json", file)
    drawn = ("--figures", tmp_path)
    assert run("evaluate", "e2e", *policy, *drawn, "vehicle.constants.k_w=4.5e-8") == 0
    text = capsys.readouterr().out
    assert "sampled, 2 runs" in text and "0/2" in text
    result = json.loads(file.read_text())
    assert result["runs"] == 2 and result["finished"] == 0 and len(result["crashes"]) == 2
    for name in ("trajectory", "perspective", "signals"):
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.size[0] > 300
    assert run("evaluate", "e2e", *policy, "--policy", "e2e") == 0
    text = capsys.readouterr().out
    assert "| one | " in text and "| e2e | " in text
    result = json.loads(file.read_text())
    assert [row["runs"] for row in result["flights"]] == [2] * 8
    assert result["provenance"]["config"]["name"] == "e2e"
