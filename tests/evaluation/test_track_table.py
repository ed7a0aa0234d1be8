"""The benchmark of tracks and drones."""

import json

import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.studies.track_table import BestLap, Case, Row, lap_rows, read_best
from tests.scripts import run_script


def row(**changes):
    values = {"track": "square4", "vehicle": "bebop1", "lap": 2.1, "finished": 9, "runs": 10}
    return Row(**{**values, "speed": 7.26, "crash": "", **changes})


def test_laps_stand_next_to_the_best_known_ones():
    best = {
        ("square4", "bebop1"): BestLap(
            track="square4", vehicle="bebop1", seconds=2.0, source="by hand"
        )
    }
    text = lap_rows([row(), row(track="mine"), row(lap=None, crash="hit a gate")], best)
    lines = text.splitlines()
    assert lines[2] == "| square4 | bebop1 | 2.100 s | 2.000 s (1) | 5.0% | 9 of 10 | 7.3 m/s |"
    assert lines[3] == "| mine | bebop1 | 2.100 s | - | - | 9 of 10 | 7.3 m/s |"
    assert "| hit a gate | 2.000 s (1) | - |" in lines[4] and lines[-1] == "(1) by hand"


def test_a_case_is_a_track_and_a_drone():
    assert Case("random_3", "5inch").overrides == ["track.generate.seed=3", "vehicle=5inch"]
    assert Case("dir/mine.yaml", "bebop1").overrides == ["track=dir/mine.yaml", "vehicle=bebop1"]
    assert Case("dir/mine.yaml", "own.yaml").name == "mine_own"


def test_best_known_laps_are_read_from_a_file(tmp_path):
    shipped = read_best("best_known")
    assert shipped["square4", "bebop1"].seconds == 2.0385
    assert all(lap.source for lap in shipped.values())
    file = tmp_path / "own.yaml"
    lap = "{track: a, vehicle: b, seconds: 3.0, source: mine}"
    file.write_text(f"laps: [{lap}]\n")
    assert read_best(file)["a", "b"].seconds == 3.0
    file.write_text(f"laps: [{lap}, {lap}]\n")
    with pytest.raises(InputError, match="two laps of a with b, allowed: one"):
        read_best(file)
    file.write_text("laps: [{track: a, vehicle: b, seconds: -1}]\n")
    with pytest.raises(InputError, match=r"laps\[0\].seconds is -1, allowed: greater than 0"):
        read_best(file)


@pytest.mark.slow
def test_the_command_resumes_and_writes_table_and_pictures(tmp_path, capsys):
    policy = str(PRETRAINED / "e2e_fastest.npz")
    own = ["--tracks", "square4", "random_1", "--drones", "bebop1", "--runs", "4"]
    command = ["tracks", "e2e +fastest", "--policy", policy, *own]
    assert run_script(*command, "--output", tmp_path) == 0
    text = capsys.readouterr().out
    assert "| square4 | bebop1 | 2.0" in text and (tmp_path / "tracks.md").read_text() == text
    result = tmp_path / "random_1_bebop1" / "result.json"
    assert (tmp_path / "square4_bebop1" / "lap.png").stat().st_size > 1000
    changed = json.loads(result.read_text()) | {"speed": 99.0}
    result.write_text(json.dumps(changed))
    assert run_script(*command, "--output", tmp_path) == 0
    assert "99.0 m/s" in capsys.readouterr().out  # read from the folder, not flown again
