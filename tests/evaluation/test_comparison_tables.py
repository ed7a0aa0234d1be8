"""Tables and figure of the comparison of E2E with INDI, from rows made by hand."""

import numpy as np
import pytest

from benchmarks import interventions, tournament
from benchmarks.comparison_tables import contenders, flights, lead_rows, steps
from benchmarks.plant_tables import charged, looped
from benchmarks.steps import STEPS
from benchmarks.waterfall import PATH, figure_of
from quadjax.core.errors import InputError

NONE = [None, None]


def row(contender, scope, seed, laps, drone=None, **more):
    """A row with flights (drones, flights) of these laps."""
    return {
        "contender": contender,
        "scope": scope,
        "seeds": [seed],
        "drone": drone,
        "laps": laps,
        "mean action, finished": 1,
    } | more


ALL = [
    row("E2E", "all", 0, [[[1.0, 2.0], [1.0, 3.0]], [[2.0, 2.0], NONE]]),
    row("E2E", "all", 1, [[[1.0, 2.0], [1.0, 2.0]], [[2.0, 2.0], [2.0, 2.0]]]),
    row("INDI", "all", 0, [[[2.0, 2.0], [2.0, 3.0]], [[3.0, 3.0], [3.0, 3.0]]]),
]
EACH = [
    row("E2E", "each", 0, [[[1.0, 1.0]]], 4),
    row("E2E", "each", 0, [[[1.0, 3.0]]], 0),
    row("E2E", "each", 1, [[[1.0, 9.0]]], 0),  # of one drone so far
    row("INDI", "each", 0, [[[2.0, 2.0]]], 0),
    row("INDI", "each", 0, [[[2.0, 3.0]]], 4),
]


def test_flights_are_of_drones_and_of_the_seeds_that_all_drones_have():
    assert flights(ALL[:2]).shape == (2, 2, 2, 2)
    found = flights(EACH[:3])
    assert found.tolist() == [[[[1.0, 3.0]]], [[[1.0, 1.0]]]]
    assert np.isnan(flights(ALL[:1])[1, 0, 1]).all()


def test_a_flight_that_does_not_finish_counts_as_35_s():
    lines = contenders({"tournament": ALL + EACH})
    assert [line["contender"] for line in lines] == [
        "E2E, one for all",
        "INDI, one for all",
        "E2E, one for each",
        "INDI, one for each",
    ]
    first = lines[0]
    assert first["score, s"] == pytest.approx((3 + 4 + 4 + 35 + 3 + 3 + 4 + 4) / 8)
    assert first["of each seed, s"] == "11.50, 3.50"
    assert first["time, s"] == "3.57" and first["finished"] == "87.5%"
    assert first["drones and seeds"] == "2, 2" and lines[2]["drones and seeds"] == "2, 1"


def test_the_lead_is_that_of_e2e_on_the_same_drone():
    shared, own = lead_rows({"tournament": ALL + EACH})
    assert shared["score, s"].startswith("-2.25 [")  # 5.25 of INDI less 7.5
    assert own["time, s"].startswith("+1.50 [") and own["first lap, s"].startswith("+1.00")


def test_steps_and_charges_have_a_line_each():
    data = [row("", "", seed, [[[1.0, 2.0]]], step="INDI, 13 m/s^2") for seed in (0, 1)]
    (line,) = steps({"interventions": data}, STEPS)
    assert (line["contender"], line["drones and seeds"]) == ("INDI, 13 m/s²", "1, 2")
    made = {"name": "e2e battery.charge=[0.2, 0.2]", "policy": "e2e.npz"}
    made |= {"plant": ["cyberzoo", "battery.charge=[0.2, 0.2]"]}
    made |= {"total": {"sampled": [15.5]}, "finished": {"sampled": [99]}}
    rows = [made, made | {"plant": ["cyberzoo"]}]
    assert charged({"plant": rows}) == [{"name": "e2e", "charge 0.2": "15.50 (99)"}]
    assert looped({"plant": rows}) == []
    rows = [x | {"policy": "indi_cyberzoo.npz"} for x in rows]
    assert looped({"plant": rows}) == [{"inner loop": "as flown", "sampled loop": "15.50 (99)"}]


def test_the_figure_has_a_line_for_each_step_that_has_rows():
    laps = [[[1.0, 2.0], [1.0, 3.0]], [[2.0, 2.0], NONE]]
    data = [row("", "", seed, laps, step=step) for step in PATH[-2:] for seed in (0, 1)]
    (axes,) = figure_of(data).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == list(PATH[-2:])
    assert set(PATH) <= set(STEPS)


def test_a_drone_that_the_plant_lacks_is_refused():
    with pytest.raises(InputError, match=r"drones: 20, allowed: 0 to 19"):
        tournament.tournament(drones=(3, 20), scopes=("each",))


def test_a_row_names_the_command_that_makes_it():
    one = tournament.row_of("INDI", 3, 2)
    assert one["name"] == "INDI, drone 3, seed 2" and one["plant"] == ["cyberzoo", "drone=3"]
    words = "--scopes each --contenders INDI --seeds 2 --drones 3"
    assert one["command"] == f"python -m benchmarks.tournament {words}"
    step = interventions.row_of("E2E, 11000 rpm", 0)
    assert step["config"] == ["e2e_cyberzoo", "vehicle.constants.rpm_max=11000"]
