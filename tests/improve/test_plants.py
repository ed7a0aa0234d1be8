"""The benchmark that gathers the flights of several plants."""

import json

import pytest

from benchmarks.improve_figure import improvement_figure
from benchmarks.improve_plants import plants_table, read


def flown(*totals):
    crashes = ["" if total else "hit a gate" for total in totals]
    return {"seconds": [9.0] * len(totals), "totals": list(totals), "crashes": crashes}


def folder_of(path, after, refused=""):
    place = path / "round_1"
    place.mkdir(parents=True)
    (place / "flights.json").write_text(json.dumps(flown(8.5, None)))
    (place / "model.json").write_text(json.dumps({"refused": refused, "before": {"Mx": 1.0}}))
    (path / "check_2_before.json").write_text(json.dumps(flown(9.0, 9.2)))
    (path / "check_2_after_1.json").write_text(json.dumps(flown(*after)))
    return path


def test_means_over_plants_are_of_those_on_which_every_policy_finishes(tmp_path):
    plants = [read(folder_of(tmp_path / "1", (8.0, None)))]
    plants.append(read(folder_of(tmp_path / "2", (None, None), "too large")))
    text = plants_table(plants)
    assert "| 1 | 9.10 (2 of 2) | 8.00 (1 of 2) | - | accepted |" in text
    assert "| 2 | 9.10 (2 of 2) | - (0 of 2) | - | rejected |" in text
    assert "| mean of 1 of 2 | 9.10 | 8.00 | - |  |" in text
    times, shares = improvement_figure({"policy": plants[:1]}).axes
    assert times.lines[-1].get_ydata() == pytest.approx([9.1, 8.0])
    assert shares.lines[-1].get_ydata() == pytest.approx([100.0, 50.0])
