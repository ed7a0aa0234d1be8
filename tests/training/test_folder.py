"""The folder of a run: locked, of one kind, and never cleared of other people's files."""

import dataclasses
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.folders import claim, kind_of, replacement
from quadjax.core.resources import PRETRAINED
from quadjax.core.yaml_files import to_yaml
from quadjax.training.folder import check_same, prepare_folder
from quadjax.training.result import (
    SUMMARY,
    MetricsFile,
    Run,
    is_finished,
    read_metrics,
    saved_rows,
)
from tests.commands import run
from tests.evaluation.support import random_policy
from tests.race.support import BLANK

NAMED = {  # key of a config: name of its file
    "track": "mine.yaml",
    "vehicle": "drone.yaml",
    "vehicle.residual": "r.npz",
    "run.initial_policy": "p.npz",
}


def write_files(folder):
    """A track, a vehicle, a residual and a policy; returns the residual's bytes."""
    gates = "[{position: [1, 0, -1.5]}, {position: [3, 0, -1.5]}]"
    write_text(folder / "mine.yaml", f"name: mine\ngates: {gates}\n")
    motor = load_config("e2e").vehicle.constants | {"tau": 0.05}
    write_text(folder / "drone.yaml", to_yaml({"name": "drone", "motor": motor}))
    random_policy().save(folder / "p.npz")
    residual = (PRETRAINED / "standin_residual.npz").read_bytes()
    (folder / "r.npz").write_bytes(residual)
    return residual


def test_a_run_prints_as_one_line(tmp_path):
    summary = {"steps": 1_500_000, "best_lap_total": 17.125}
    run = Run(load_config("e2e"), tmp_path, random_policy(), True, summary)
    wanted = f"Run({str(tmp_path)!r}: best_lap_total 17.125, 1,500,000 steps)"
    assert repr(run) == wanted
    stopped = dataclasses.replace(run, finished=False)
    assert repr(stopped) == wanted.replace(" steps)", " steps, not finished)")


HOLD = """
import sys, time
from quadjax.core.folders import claim
with claim(sys.argv[1], "training"):
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_folder_in_use_is_refused_until_the_process_is_gone(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    with pytest.raises(InputError, match="in use by another process"):
        with claim(tmp_path / "run", "training"):
            pass
    process.kill()
    process.communicate()
    with claim(tmp_path / "run", "training"):
        assert kind_of(tmp_path / "run") == "training"


COMMANDS = {
    "training": ("train", BLANK, "--name", "one", "--output"),
    "fit": ("fit", "{}", "--name", "one", "--output"),
    "sweep": ("sweep", "learning_rate", "name=one", "executor.workers=1", "--output"),
    "comparison": ("compare", "standin", "--name", "one", "--output"),
    "export": ("export", PRETRAINED / "e2e_residual.npz", "--output"),
}


@pytest.mark.parametrize("kind", COMMANDS)
def test_of_two_commands_in_one_folder_the_second_is_refused(tmp_path, capsys, kind):
    """One line and status 2; also for a command of another kind."""
    (tmp_path / "log.csv").write_text("time\n")
    (tmp_path / "fit.yaml").write_text(f"logs: {{files: [{tmp_path}/log.csv]}}\n")
    command = [str(word).format(tmp_path / "fit.yaml") for word in COMMANDS[kind]]
    output = tmp_path / "one" if kind == "export" else tmp_path
    for other, says in (
        (kind, "in use by another process"),
        ("notes", "holds a notes, not a"),
    ):
        with claim(tmp_path / "one", other):
            (tmp_path / "one" / "notes.txt").write_text("mine")
            assert run(*command, output) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error
        shutil.rmtree(tmp_path / "one")


def test_a_new_folder_is_removed_after_a_failure_that_wrote_nothing(tmp_path):
    with pytest.raises(KeyError), claim(tmp_path / "one", "fit"):
        raise KeyError
    with pytest.raises(KeyError), claim(tmp_path / "two", "fit"):
        (tmp_path / "two" / "report.txt").write_text("")
        raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["two"]


def test_results_replace_earlier_ones_only_when_they_are_complete(tmp_path):
    for name in ("report.txt", "notes.txt"):
        (tmp_path / name).write_text("before")
    (tmp_path / ".new-killed").mkdir()
    with pytest.raises(OSError), replacement(tmp_path, ["report.*"]) as new:
        (new / "report.txt").write_text("half")
        raise OSError("no space left")
    assert {path.name for path in tmp_path.iterdir()} == {"report.txt", "notes.txt"}
    assert (tmp_path / "report.txt").read_text() == "before"
    with replacement(tmp_path, ["report.*"]) as new:
        (new / "report.json").write_text("{}")
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "notes.txt"}


def test_a_run_of_another_config_names_the_key(tmp_path):
    config = load_config(BLANK)
    prepare_folder(config, tmp_path, resume=False, overwrite=False)
    check_same(config, tmp_path)
    check_same(load_config(BLANK, ["run.devices=1", "run.compilation_cache=false"]), tmp_path)
    saved = (tmp_path / "config.yaml").read_text()
    older = "".join(x for x in saved.splitlines(keepends=True) if "compilation_cache" not in x)
    older = "".join(x for x in older.splitlines(keepends=True) if "quaternion" not in x)
    assert older != saved  # written before the two keys existed
    (tmp_path / "config.yaml").write_text(older)
    check_same(config, tmp_path)
    with pytest.raises(InputError, match="seed: 0, the new config seed: 3"):
        check_same(load_config(BLANK, ["seed=3"]), tmp_path)


REPLACED = r"already contains a run.*\(--resume\), replace it \(--overwrite\)"


def test_a_policy_without_its_checkpoints_is_a_run(tmp_path):
    (tmp_path / "policy.npz").write_bytes(b"of another training")
    for resume, says in ((False, REPLACED), (True, "no checkpoint")):
        with pytest.raises(InputError, match=says):
            prepare_folder(load_config(BLANK), tmp_path, resume=resume, overwrite=False)
    assert not (tmp_path / "config.yaml").exists()


def test_a_run_has_plain_numbers_in_place_of_units_of_the_race(tmp_path):
    config = load_config("e2e_race")
    prepare_folder(config, tmp_path, resume=False, overwrite=False)
    check_same(config, tmp_path)
    assert "leg" not in (tmp_path / "config.yaml").read_text().replace("along_leg", "")
    with pytest.raises(InputError, match="reward.progress"):
        check_same(load_config("e2e_race", ["reward.progress=13 per leg"]), tmp_path)


def test_a_run_keeps_the_files_of_its_config(tmp_path):
    """Its folder is moved; later a file that it was started with is changed."""
    files, run, moved = (tmp_path / name for name in ("files", "run", "moved"))
    residual = write_files(files)
    overrides = [f"{key}={files / name}" for key, name in NAMED.items()]
    prepare_folder(load_config("e2e", overrides), run, resume=False, overwrite=False)
    shutil.rmtree(files)
    run.rename(moved)
    config = load_config(moved / "config.yaml")
    assert (moved / "inputs/residual.npz").read_bytes() == residual
    assert prepare_folder(config, moved, resume=True, overwrite=False) == config
    (moved / "notes.txt").write_text("mine")
    assert prepare_folder(config, moved, resume=False, overwrite=True) == config
    assert (moved / "notes.txt").read_text() == "mine"
    (moved / "inputs/residual.npz").write_bytes((PRETRAINED / "e2e_residual.npz").read_bytes())
    write_files(files)
    with pytest.raises(InputError, match="residual.npz differs from vehicle.residual"):
        check_same(load_config("e2e", overrides), moved)


SUMMARY_1 = dict.fromkeys(SUMMARY, 1) | {"finished": True, "name": "run"}
DAMAGED_SUMMARIES = ["[1]", "[" * 99999]
DAMAGED_SUMMARIES += [json.dumps(SUMMARY_1 | each) for each in ({"steps": "x"}, {"seed": None})]


DAMAGED_METRICS = ["steps,seconds\n1,x\n", "seconds\n1\n", "steps,seconds\n1,2,3\n"]
DAMAGED_METRICS += ["steps,seconds\n1\n2,3\n", "steps,seconds\nx,\n", "steps,s\n1," + "1" * 200_000]


def test_a_damaged_file_of_a_run_is_one_line(tmp_path):
    (tmp_path / "checkpoints/latest/3").mkdir(parents=True)

    def prepare(folder):
        prepare_folder(load_config(BLANK), folder, resume=True, overwrite=False)

    def rows(folder):
        saved_rows(folder / "metrics.csv")

    for name, read, texts in (
        ("config.yaml", prepare, ("", "seed: 7")),
        ("summary.json", is_finished, DAMAGED_SUMMARIES),
        ("metrics.csv", rows, DAMAGED_METRICS),
    ):
        for text in texts:
            (tmp_path / name).write_text(text)
            with pytest.raises(InputError, match=name) as caught:
                read(tmp_path)
            assert "\n" not in str(caught.value)
            assert name != "summary.json" or "remove it and resume" in str(caught.value)


def test_a_resumed_run_drops_the_rows_after_its_checkpoint(tmp_path):
    """Also a last row that is cut off."""
    for text, kept in (
        ("", []),
        ("steps,seconds\r\n12", []),
        ("steps,seconds\n100,1\n200,2\n40", [1, 2]),
        ("steps,seconds\n100,1\n200,2\n300,3\n", [1, 2]),
    ):
        (tmp_path / "metrics.csv").write_text(text)
        metrics = MetricsFile(tmp_path, 200, False)
        metrics.write({"steps": 300, "seconds": 9.0})
        metrics.close()
        assert [row["seconds"] for row in saved_rows(tmp_path / "metrics.csv")] == [*kept, 9]


def test_a_row_with_other_metrics_keeps_the_columns_of_the_earlier_ones(tmp_path):
    """Such as after an update of quadjax; a cell without a value is NaN."""
    path = tmp_path / "metrics.csv"
    path.write_text("steps,old,loss\n100,7,1\n")
    metrics = MetricsFile(tmp_path, 100, False)
    metrics.write({"steps": 200, "loss": 2.0, "new": 3.0})
    metrics.close()
    for _ in range(2):  # read by a run that resumes again, too
        found = read_metrics(path)
        assert set(found) == {"steps", "loss", "new", "old"}
        np.testing.assert_array_equal(found["loss"][:2], [1, 2])
        np.testing.assert_array_equal(found["old"][:2], [7, np.nan])
        np.testing.assert_array_equal(found["new"][:2], [np.nan, 3])
        metrics = MetricsFile(tmp_path, 200, False)
        metrics.write({"steps": 300, "loss": 4.0, "new": 5.0})
