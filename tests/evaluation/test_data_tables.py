"""Lines of tables that are computed from several rows."""

from benchmarks import data_tables


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
