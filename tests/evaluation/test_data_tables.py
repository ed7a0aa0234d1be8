"""Lines of tables that are computed from several rows."""

from benchmarks import data_tables
from quadjax.core.files import write_json


def row(track: str, vehicle: str, laps: list[float | None]) -> data_tables.Tree:
    name = f"e2e_race {vehicle} {track}"
    words = ["e2e_race", f"track={track}", f"vehicle={vehicle}"]
    crashed = [float(x) for x in range(len(laps))]
    return {"name": name, "config": words, "lap, s": laps, "crashed, %": crashed}


def test_laps_of_policies_are_medians_and_a_missing_one_is_shown():
    best = data_tables.read_best("best_known")["figure8_tudelft", "5inch"].seconds
    rows = [
        row("figure8_tudelft", "5inch", [1.3 * best, 1.1 * best, 1.2 * best]),
        row("figure8_tudelft", "3inch", [2.0, None, 2.0]),
    ]
    (line,) = data_tables.laps_of_policies({"tracks": rows})
    assert line["track"] == "`figure8_tudelft`" and line["Bebop 1"] == "-"
    assert line["5-inch"] == f"{1.2 * best:.3f}, 20.0, 1.0"
    assert line["3-inch"] == "-, -, 1.0"


def test_flights_without_an_effect_are_on_its_line_in_any_order(tmp_path, monkeypatch):
    def entry(log: float, seconds: float) -> dict[str, float | str]:
        return {"log_likelihood": log, "text": f"E2E {seconds} s, lap 1 2.0, 90%"}

    found = {"without mass, again": entry(-3.0, 13.0), "without mass": entry(-2.0, 12.0)}
    write_json(tmp_path / "effects.json", {"all": entry(-1.0, 11.0)} | found)
    monkeypatch.setattr(data_tables, "EFFECTS", tmp_path / "effects.json")
    whole, mass = data_tables.ablations(None)
    assert (whole["without"], whole["E2E"], whole["again, E2E"]) == ("nothing", "11.0 (90%)", "")
    assert (mass["without"], mass["log-likelihood"], mass["E2E"]) == ("`mass`", "-2", "12.0 (90%)")
    assert (mass["again, log-likelihood"], mass["again, E2E"]) == ("-3", "13.0 (90%)")
