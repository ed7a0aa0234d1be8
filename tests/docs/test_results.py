"""The pages have the numbers of benchmarks/results, and those are of the present settings."""

import copy
import json
from types import SimpleNamespace

import pytest

import quadjax
from benchmarks import columns, lap_rows, pages, results, rows, tables
from benchmarks.settings import NO_EFFECT, SETTINGS, hash_of, plain
from quadjax.core.errors import InputError
from quadjax.core.section_keys import value_at
from tests.docs.pages import PAGES, ROOT
from tests.frozen import __main__ as frozen
from tests.scripts import run_script

DATA = {name: rows.read(name) for name in rows.names()}
ROWS = [(name, row) for name, some in DATA.items() for row in some]
E2E = {"name": "e2e", "command": "-", "config": ["e2e"], "seeds": [0], "time": "9 s"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of rows, and no pages."""
    monkeypatch.setattr(rows, "RESULTS", tmp_path)
    monkeypatch.setattr(results, "PAGES", [])
    monkeypatch.setattr(rows, "commit", lambda: "1234567")
    return tmp_path


def test_the_pages_have_the_tables_of_the_rows():
    drawn = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert pages.render(DATA, text) == text, "run: make results"
        drawn |= {match[2] for match in pages.BLOCK.finditer(text)}
        assert page in pages.PAGES or not pages.BLOCK.search(text)
    assert drawn == {*tables.TABLES, "measured"}


def test_a_page_follows_the_rows():
    changed, readme = copy.deepcopy(DATA), (ROOT / "README.md").read_text(encoding="utf-8")
    times = changed["presets"][0]["total"]["mean"]
    times[:] = [time - 0.01 for time in times]
    assert "13.99 (13.82-14.06)" in pages.render(changed, readme)
    changed["presets"][0]["kept"] = "measured with former settings, `learner.std=0.3`"
    note = "`e2e`: the published reward: measured with former settings, `learner.std=0.3`.\n"
    assert note in pages.render(changed, readme)


def test_a_column_may_be_a_key_of_the_row():
    row = {"of seeds": [1.0, 3.0, 2.0], "of one": 0.125, "count": 7, "word": "none"}
    cells = [columns.cell(row, column) for column in row]
    assert cells == ["2.00 (1.00-3.00)", "0.12", "7", "none"]


def test_the_text_of_the_readme_has_numbers_of_rows():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = [row["total"]["sampled"] for row in DATA["table1"] if row["seeds"] == [None]]
    assert len(found) == 4
    assert all(f"{time}" in readme for times in found for time in times)


def test_a_row_says_where_its_numbers_come_from():
    """And it has one for each seed."""
    for file, row in ROWS:
        origin = {"command", "commit", "machine"} if "source" not in row else {"source"}
        assert not ({"name", "seeds", "hash"} | origin) - row.keys(), row["name"]
        assert row["hash"].keys() == set(SETTINGS) & row.keys() != set(), row["name"]
        total, finished = (list(row.get(key, {}).values()) for key in ("total", "finished"))
        numbers = [*total, *finished, row.get("noise", row["seeds"])]
        assert {len(each) for each in numbers} == {len(row["seeds"])}, row["name"]
        assert all(0 <= n <= row["flights"] for each in finished for n in each), row["name"]
        assert [other["name"] for other in DATA[file]].count(row["name"]) == 1


def test_a_row_is_of_its_present_settings():
    lines = [text for _, row in ROWS if (text := rows.stale(row))]
    assert not lines, "\n".join(lines)
    stored = json.loads((rows.RESULTS / "configs.json").read_text(encoding="utf-8"))
    assert stored.keys() == {each for _, row in ROWS for each in row["hash"].values()}
    assert all(hash_of(tree) == key for key, tree in stored.items())


def test_a_row_is_kept_only_if_its_settings_were_others():
    kept = [row for _, row in ROWS if "kept" in row]
    plain_rows = [{key: row[key] for key in row if key != "kept"} for row in kept]
    assert all(rows.stale(row) for row in plain_rows)


def test_a_preset_that_has_gone_is_named():
    line = rows.stale(DATA["presets"][0] | {"config": ["nosuch"]})
    assert line.startswith("e2e: nosuch: no such file") and "\n" not in line


CHANGED = {  # words in place of those of a row: what its line says
    "learner.std=0.5": "learner.std 0.3, now 0.5",
    "start.heading=inside_turn": "start.heading north, now inside_turn",
    "schedules.learner.std=null": "schedules.learner.std.linear ['value', 0.05], now absent",
    "track=figure8": "track.gates.0.position [2.0, -1.5, -1.5], now ",
    "vehicle.residual=standin_residual.npz": "vehicle.residual absent, now 078aad",
}


@pytest.mark.parametrize("word", CHANGED)
def test_a_changed_preset_is_named_with_its_key_and_values(word, folder):
    rows.write("some", [E2E])
    row = rows.read("some")[0]
    line = rows.stale(row | {"config": ["e2e", word]})
    assert line.startswith("e2e: measured with former settings (")
    assert CHANGED[word] in line
    assert "\n" not in line


def test_keys_without_an_effect_do_not_change_a_row(folder):
    rows.write("some", [E2E])
    row = rows.read("some")[0]
    words = ["seed=3", "name=other", "run.devices=1", "run.checkpoint_seconds=9", "evaluate.runs=9"]
    assert rows.stale(row | {"config": ["e2e", *words]}) == ""
    config = quadjax.load("e2e")
    assert all(value_at(config, key, "missing") != "missing" for key in NO_EFFECT)


def test_flights_of_a_given_policy_depend_on_the_race_only(folder):
    row = {"name": "e2e.npz", "command": "-", "race": ["e2e"], "policy": "e2e.npz", "seeds": [1]}
    rows.write("shipped", [row])
    row = rows.read("shipped")[0]
    assert rows.stale(row | {"race": ["e2e", "learner.std=0.5", "reward.gate=5"]}) == ""
    assert "race.rules.time_step 0.01" in rows.stale(
        row | {"race": ["e2e", "rules.time_step=0.02"]}
    )
    assert "policy.sha256 " in rows.stale(row | {"policy": "indi.npz"})
    line = rows.stale(row | {"policy": "nosuch.npz"})
    assert line == "e2e.npz: policy: nosuch.npz: no such file in quadjax/pretrained"


def test_a_plant_is_its_numbers_and_those_of_its_vehicle(folder):
    rows.write("plant", [E2E | {"plant": ["cyberzoo", "drone=3"]}])
    row = rows.read("plant")[0]
    assert rows.stale(row) == ""
    assert "plant.drone 3, now 4" in rows.stale(row | {"plant": ["cyberzoo", "drone=4"]})
    rows.write("plant", [E2E | {"plant": ["standin"]}])
    row = rows.read("plant")[0]
    other = rows.stale(row | {"plant": ["standin", "vehicle=bebop1_authors"]})
    assert "plant.vehicle.models.rate.thrust_max 15.0, now 16.0" in other


def test_rows_are_written_in_their_place(folder):
    rows.write("some", [E2E, E2E | {"name": "indi", "config": ["indi"]}])
    rows.write("some", [E2E | {"time": "8 s", "config": ["e2e", "learner.std=0.5"]}])
    first, second = rows.read("some")
    assert (first["name"], first["time"], second["name"]) == ("e2e", "8 s", "indi")
    assert (first["commit"], first["machine"]) == ("1234567", rows.device())
    stored = json.loads((folder / "configs.json").read_text(encoding="utf-8"))
    assert stored.keys() == {first["hash"]["config"], second["hash"]["config"]}
    rows.write("some", [first | {"kept": "former", "config": ["e2e"]}])
    assert rows.read("some")[0]["hash"] == first["hash"]
    assert not list(folder.glob(".*"))
    assert rows.names() == ["some"] and rows.read("none") == []


def restructured(folder, change):
    """A row that was measured with another tree of settings."""
    rows.write("some", [E2E])
    tree = plain(quadjax.load("e2e"))
    change(tree)
    row = rows.read("some")[0] | {"hash": {"config": hash_of(tree)}}
    (folder / "some.json").write_text(json.dumps([row]))
    (folder / "configs.json").write_text(json.dumps({hash_of(tree): tree}))
    return row


def remove_gate(tree):
    """A key that has gone since, and one that has come."""
    del tree["reward"]["time"]
    tree["reward"]["camera"] = 0.0


@pytest.mark.parametrize(("count", "status"), [(0, 0), (1, 2)])
def test_a_change_of_structure_keeps_rows_if_no_frozen_number_differs(
    count, status, folder, monkeypatch, capsys
):
    row = restructured(folder, remove_gate)
    line = rows.stale(row)
    assert "reward.camera 0.0, now absent" in line and "reward.time absent, now 0.0" in line
    monkeypatch.setattr(frozen, "compare", lambda parts: count)
    monkeypatch.setattr(frozen, "read", lambda: [{"machine": frozen.machine()}])
    assert run_script("results", "restamp") == status
    assert (rows.stale(rows.read("some")[0]) == "") == (status == 0)
    printed = capsys.readouterr().err
    assert printed == ("error: restamp: frozen numbers differ, allowed: no difference\n" * count)


def test_another_value_is_no_change_of_structure(folder, monkeypatch, capsys):
    row = restructured(folder, lambda tree: tree["learner"].update(std=0.7))
    monkeypatch.setattr(frozen, "compare", lambda parts: 0)
    assert run_script("results", "restamp") == 2
    assert capsys.readouterr().err == "error: some/e2e: learner.std was 0.7, is 0.3\n"
    assert rows.read("some") == [row]
    assert run_script("results", "keep", "e2e") == 0
    kept = rows.read("some")[0]
    assert kept == row | {"kept": "measured with former settings, `learner.std=0.7`"}
    assert rows.stale(kept) == ""


def test_frozen_numbers_of_another_machine_do_not_suffice(folder, monkeypatch, capsys):
    restructured(folder, remove_gate)
    monkeypatch.setattr(frozen, "read", lambda: [{"machine": "another"}])
    assert run_script("results", "restamp") == 2
    assert "no frozen numbers of this kind of machine" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nosuch"], "nosuch: allowed: measure ROW [POLICY...], keep ROW, restamp"),
        (
            ["measure", "nosuch"],
            "nosuch: 0 rows have this name, allowed: presets/e2e, shipped/e2e.npz",
        ),
        (["measure", "e2e"], "e2e: allowed: one or several POLICY"),
        (["measure", "e2e.npz", "e2e"], "e2e.npz: allowed: no POLICY"),
        (["keep", "e2e"], "e2e: measured with its present settings"),
    ],
)
def test_bad_words_are_one_line(words, line, folder, capsys):
    rows.write("presets", [E2E])
    rows.write("shipped", [E2E | {"name": "e2e.npz", "policy": "e2e.npz"}])
    assert run_script("results", *words) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {line}") and printed.count("\n") == 1


def test_runs_have_the_settings_of_their_row(tmp_path, monkeypatch):
    run = SimpleNamespace(config=quadjax.load("e2e", ["learner.std=0.5"]), folder="r", policy=None)
    monkeypatch.setattr(quadjax.Run, "load", lambda path: run)
    with pytest.raises(InputError, match=r"^r: learner.std is 0.5, in e2e 0.3$"):
        lap_rows.flown(E2E, [str(tmp_path)])


def test_a_shipped_policy_is_flown(monkeypatch):
    """By four protocols, in the race and with the options of its row."""
    row = next(row for row in DATA["body"] if row["name"] == "indi.npz hall")
    flown = []

    def evaluate(policy, race, **options):
        flown.append((race.rules.gate_frame, options))
        numbers = SimpleNamespace(total=float("nan"), finished=0, runs=100)
        return type("Flown", (dict,), {"rows": [numbers]})(
            dict.fromkeys(columns.CONDITIONS, numbers)
        )

    monkeypatch.setattr(quadjax, "evaluate", evaluate)
    monkeypatch.setattr(rows, "commit", lambda: row["commit"])
    new = lap_rows.flown(row | {"kept": "former"}, [])
    assert flown == [(0.2, {"conditions": "protocols", "body_radius": 0.19})]
    assert "kept" not in new and new["seeds"] == row["seeds"] == [0] and new["flights"] == 100
    assert new["total"]["mean"] == [None] and new["finished"]["mean"] == [0]
    assert new.keys() == row.keys()
