"""Tables and figures of flights from trajectories and flight logs."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.figures import trajectory_figure
from quadjax.evaluation.report import Report
from quadjax.evaluation.responses import error_figure, response
from quadjax.evaluation.sources import load_groups
from quadjax.evaluation.table import flights_table
from quadjax.fitting.signals import first_order
from quadjax.flights import load, save
from tests.commands import run
from tests.flights.support import circle

RACE = load_config("e2e")
STEP = 0.01


def states_file(path, seconds, crash_after=None, vehicle="motor"):
    """A file of ``evaluate --states``: two laps of a circle through the gates for each lap time.

    The first flight may crash after some seconds.
    """
    flights = []
    for lap in seconds:
        flight = circle(str(lap), lap, model=vehicle, gates=RACE.track.gates, ahead=0.0)
        flights.append(flight.replace(lap_ends=lap * np.array([1.0, 2.0])))
    if crash_after is not None:
        flights[0] = flights[0].opening(crash_after).replace(crash="hit a gate")
    save(flights, path)
    return path


@pytest.fixture(scope="module")
def groups(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flights")
    states_file(folder / "fast.npz", [3.0, 2.8, 2.9])
    states_file(folder / "slow.npz", [4.0, 4.2], crash_after=5.0, vehicle="rate")
    words = [f"E2E simulated={folder}/fast.npz", f"{folder}/slow.npz"]
    return load_groups(words, RACE.track)


def test_the_table_has_every_flight_the_fastest_in_bold(groups, monkeypatch):
    text, latex = (flights_table(groups).format(kind) for kind in ("text", "latex"))
    lines = [line.split() for line in text.splitlines()]
    assert ["2", "*2.80*", "*2.80*", "*5.60*"] in lines and ["1", "3.00", "3.00", "6.00"] in lines
    assert ["mean", "of", "3", "2.90", "2.90", "5.80"] in lines
    assert "hit a gate" in text and text.count("*2.80*") == 2
    assert r"\textbf{5.60}" in latex and latex.count(r"\textbf") == 3 + 3
    assert latex.count("&") % 3 == 0 and r"\midrule" in latex
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert flights_table(groups).format("text") == text  # in a notebook too


def test_a_file_is_not_taken_for_a_pattern(tmp_path):
    for name, seconds in (("a.npz", 3.0), ("[a].npz", 4.0)):
        states_file(tmp_path / name, [seconds])
    (flights,) = load_groups([f"{tmp_path}/[a].npz"], RACE.track).values()
    assert [flight.total for flight in flights] == [8.0]


def test_a_table_of_flights_is_not_taken_for_a_log(tmp_path):
    states_file(tmp_path / "a.npz", [3.0])
    save(load(tmp_path / "a.npz"), tmp_path / "a.csv")
    expected = (
        "a.csv: a table of flights has no gates, allowed: the file of evaluate --states FILE.npz"
    )
    with pytest.raises(InputError, match=expected):
        load_groups([str(tmp_path / "a.csv")], RACE.track)


def test_a_report_has_the_gates_that_were_flown(groups):
    other = load_config("e2e", ["track=figure8"])
    assert Report(groups, other).gates == RACE.track.gates
    elsewhere = [groups["slow"][0].replace(gates=other.track.gates)]
    with pytest.raises(InputError, match="slow and there: flights on different tracks"):
        _ = Report(groups | {"there": elsewhere}, RACE).gates


def test_gaps_are_behind_the_first_of_the_flights_that_finish(groups):
    axes = Report(groups, RACE).gaps().axes[0]
    drawn = [line for line in axes.lines if len(line.get_xdata()) > 2]
    assert len(drawn) == 5
    fastest, slower = drawn[1].get_ydata(), drawn[0].get_ydata()
    np.testing.assert_allclose(fastest, 0.0, atol=1e-9)
    assert slower[-1] == pytest.approx(0.4, abs=0.02) and np.all(np.diff(slower) > -0.02)
    assert "(s)" in axes.get_ylabel() and axes.get_legend() is None


def test_every_figure_names_the_drone_the_track_and_which_flights(groups):
    flown = {
        label: [f.replace(source={"race": "5-inch, ring"}) for f in group]
        for label, group in groups.items()
    }
    for report, wanted in (
        (Report(groups, RACE), f"{RACE.vehicle.name}, {RACE.track.name}"),
        (
            Report(flown, RACE, "the first 5 of 10 flights of each"),
            "5-inch, ring; the first 5 of 10",
        ),
    ):
        for draw in (report.boxes, report.gaps, report.trajectories):
            figure = draw()
            title = figure.get_suptitle() or figure.axes[0].get_title("left")
            assert title.startswith(wanted)
        assert ("the first 5 of 10 flights" in report.table()) == bool(report.note)


def test_trajectories_share_axes_and_one_color_scale(groups):
    *panels, bar = trajectory_figure(groups, RACE.track.gates).axes
    scales = {tuple(np.round(c.get_clim(), 9)) for axes in panels for c in axes.collections}
    assert len(scales) == 1 and "m/s" in bar.get_ylabel()
    assert len({axes.get_xlim() for axes in panels}) == 1
    titles = [axes.get_title("left") for axes in panels if axes.get_title("left")]
    assert "5.60 s, 2 laps, fastest of 3" in titles[0] and len(titles) == 2


def test_boxes_have_units_and_every_flight(groups):
    panels = Report(groups, RACE).boxes().axes
    labels = [axes.get_xlabel() for axes in panels]
    assert labels == ["lap 1 (s)", "lap 2 (s)", "total of 2 laps (s)"]
    dots = [[len(line.get_xdata()) for line in a.lines if line.get_marker() == "o"] for a in panels]
    assert panels[0].get_ylim()[0] > panels[0].get_ylim()[1]  # the first group is at the top
    assert dots == [[3, 2], [3, 1], [3, 1]]
    first = {
        label: [f.replace(lap_ends=f.lap_ends[:1]) for f in flights]
        for label, flights in groups.items()
    }
    assert [axes.get_xlabel() for axes in Report(first, RACE).boxes().axes] == ["lap 1 (s)"]


def test_errors_are_to_the_first_order_response_of_the_commands(groups):
    e2e, indi = groups["E2E simulated"][0], groups["slow"][0]
    constants = RACE.vehicle.with_model("rate").constants
    signals = response(e2e, RACE.vehicle)
    np.testing.assert_allclose(signals.error, 0.0, atol=1e-6)
    assert (signals.low[0], signals.high[0], signals.units[0]) == (3000, 11000, "rpm")
    command = np.random.default_rng(0).uniform(-2, 2, indi["command"].shape)
    indi = indi.with_signals(command=command)
    signals = response(indi, RACE.vehicle)
    rates, thrust = indi["rates"], indi["actuators"][:, :1]
    followed = first_order(command[:, :3], rates[0], constants["tau_rate"], STEP)
    np.testing.assert_allclose(signals.error[:, :3], rates - followed, atol=1e-6)
    limited = np.clip(command[:, 3:], 0.0, 15.0)
    lifted = first_order(limited, thrust[0], constants["tau_thrust"], STEP)
    np.testing.assert_allclose(signals.error[:, 3:], thrust - lifted, atol=1e-6)
    assert tuple(signals.units) == ("rad/s",) * 3 + ("m/s^2",) and signals.names[3] == "thrust"
    own = RACE.vehicle.with_model("rate").constants | {"thrust_max": 18.0, "tau_thrust": 0.05}
    command = command + [0.0, 0.0, 0.0, 16.0]  # 14 to 18 m/s^2
    strong = indi.with_signals(command=command).of_drone(own)  # next to a drone of 15 m/s^2
    reported = Report({"weak": [indi], "strong": [strong]}, RACE).responses()
    assert [signals.high[3] for _, signals in reported.values()] == [15.0, 18.0]
    lifted = first_order(command[:, 3:], thrust[0], 0.05, STEP)
    np.testing.assert_allclose(reported["strong"][1].error[:, 3:], thrust - lifted, atol=1e-6)
    np.testing.assert_array_equal(reported["weak"][1].error, signals.error)
    names = dict(Report(groups, RACE).figures())
    assert {"errors_1", "errors_2"} <= set(names)
    ticks = [line for line in names["errors_1"].axes[1].lines if len(line.get_xdata()) == 2]
    assert len(ticks) >= 8


def test_one_signal_without_unit_and_measurements_is_drawn(groups):
    flight = groups["E2E simulated"][0]
    signals, one = response(flight, RACE.vehicle), {"names": ["motor"], "units": [""]}
    one |= {name: getattr(signals, name)[:, :1] for name in ("command", "model")}
    one |= {"actual": np.full_like(one["model"], np.nan), "low": [0.0], "high": [1.0]}
    left, right = error_figure(flight, dataclasses.replace(signals, **one), 4).axes
    assert (left.get_ylabel(), right.get_title("right")) == ("motor", "measured: no values")


@pytest.mark.slow
def test_the_command_writes_pdf_svg_and_png(tmp_path, capsys):
    path, out = states_file(tmp_path / "a.npz", [3.0]), tmp_path / "out"
    assert run("report", f"E2E={path}", "--output", out) == 0
    assert "3.00" in capsys.readouterr().out
    names = {file.name for file in out.iterdir()}
    for name in ("boxes", "gaps", "trajectories", "errors_1"):
        assert {f"{name}.pdf", f"{name}.svg", f"{name}.png"} <= names
    with Image.open(out / "trajectories.png") as image:
        assert min(image.size) > 200
    result = json.loads((out / "report.json").read_text())
    assert result["groups"]["E2E"][0]["laps"] == [3.0, 3.0] and "provenance" in result
    slower = states_file(tmp_path / "b.npz", [3.5], vehicle="racing")
    again = ("report", slower, "--output", out)
    assert run(*again) == 2
    assert "replace them (--overwrite)" in capsys.readouterr().err
    assert json.loads((out / "report.json").read_text()) == result
    (out / "notes").write_text("mine")
    assert run(*again, "--overwrite") == 0
    names = {file.name for file in out.iterdir()}
    assert {"notes", "gaps.png"} <= names and "errors_1.png" not in names
    # A race whose vehicle file has no constants of the flights' model: no errors of commands.
    (tmp_path / "race.yaml").write_text("base: e2e_race\nvehicle: a2rl\n")
    where = ("--output", tmp_path / "racing")
    assert run("report", f"E2E={path}", "--race", tmp_path / "race.yaml", *where) == 0
    names = {file.stem for file in (tmp_path / "racing").iterdir()}
    assert {"boxes", "gaps", "trajectories", "table", "report"} <= names
    assert not any(name.startswith("errors") for name in names)


def test_flights_without_a_lap_are_refused(tmp_path, capsys):
    states_file(tmp_path / "b.npz", [3.0], crash_after=0.5)
    for file, says in ((PRETRAINED / "e2e.npz", "format is"), (tmp_path / "b.npz", "no flight")):
        assert run("report", file, "--output", tmp_path / "out") == 2
        assert says in capsys.readouterr().err and not (tmp_path / "out").exists()
