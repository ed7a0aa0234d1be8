"""What commands refuse before any work: outputs that would replace other files, and bad options."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from quadjax.cli import output
from quadjax.cli.files import is_override
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, PRETRAINED
from tests.commands import run


def refusal(capsys, *arguments):
    """The one line on stderr of a refused command."""
    assert run(*arguments) == 2
    error = capsys.readouterr().err.lstrip("\n")  # which a progress bar prints
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


@pytest.mark.parametrize("other", ["policy", "config", "override", "link", "pipe"])
def test_an_output_does_not_replace_another_file_of_the_command(tmp_path, capsys, other):
    policy, config, states = tmp_path / "p.npz", tmp_path / "c.json", tmp_path / "s.npz"
    policy.write_text("mine")
    config.write_text("base: e2e")
    (tmp_path / "l.npz").symlink_to(policy)
    os.mkfifo(pipe := tmp_path / "pipe.json")
    extra = {
        "policy": ("--states", policy),
        "config": ("--json", config),
        "override": (f"vehicle.residual={states}", "--states", states),
        "link": ("--states", tmp_path / "l.npz"),
        "pipe": ("--json", pipe),
    }[other]
    error = refusal(capsys, "evaluate", config, "--policy", policy, *extra)
    says = {"link": "is a link", "pipe": "not a regular file"}.get(other, "is also")
    assert says in error and pipe.is_fifo()
    assert policy.read_text() == "mine" and config.read_text() == "base: e2e"


def test_a_picture_replaces_no_file_and_no_target_of_a_link(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / "link.png").symlink_to(tmp_path / "thesis.txt")
    (tmp_path / "old.png").write_text("mine")
    command = ("show", "square4", "--figure")
    assert "is a link" in refusal(capsys, *command, tmp_path / "link.png", "--overwrite")
    assert "--overwrite" in refusal(capsys, *command, tmp_path / "old.png")
    assert (tmp_path / "thesis.txt").read_text() == (tmp_path / "old.png").read_text() == "mine"
    assert run(*command, tmp_path / "old.png", "--overwrite") == 0
    assert (tmp_path / "old.png").read_bytes().startswith(b"\x89PNG")


def test_a_path_with_an_equals_sign_is_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, tmp_path / "lr=0.1"):
        folder.mkdir(exist_ok=True)
        (folder / "a=b.npz").write_text("no policy")
    for file in ("a=b.npz", "lr=0.1/a=b.npz"):
        assert run("evaluate", "--policy", file) == 2
        error = f"error: {file}: is text, expected an archive of NumPy arrays (.npz)\n"
        assert error in capsys.readouterr().err
        assert file in refusal(capsys, "import", "e2e", file, "--output", "out.npz")
    Path("a=b.yaml").write_text("base: e2e\nname: mine\n")
    overrides = ["seed=3", f"vehicle={CONFIGS / 'vehicles/bebop1.yaml'}"]
    assert [is_override(word) for word in ("a=b.yaml", *overrides)] == [False, True, True]


SOMEBODYS = """
export e2e --output one | thesis.tex | --overwrite
export e2e --name mine --output one | mine.c | --overwrite
logs exact --policy e2e --output one | e2e_0.csv | --overwrite
sweep learning_rate name=one --report --output . | report.md | --overwrite
sweep learning_rate name=one --output . | trials | --overwrite
replay log.csv --vehicle bebop1.yaml --name one --output . | replay.json | holds no replay, but
sil indi --name one --output . | sil.json | holds no flight, but
compare standin --name one --output . | compare.json | holds no comparison, but
""".strip().splitlines()


def test_somebody_s_files_are_not_replaced(tmp_path, capsys, monkeypatch):
    """They are refused at once, before logs are read, C is compiled or flights are simulated."""
    for number, row in enumerate(SOMEBODYS):
        command, file, expected = row.split(" | ")
        folder = tmp_path / str(number) / "one"
        folder.mkdir(parents=True)
        (folder / file).write_text("mine")
        monkeypatch.chdir(folder.parent)
        error = refusal(capsys, *command.split())
        assert file in error and expected in error, row
        assert [path.name for path in folder.iterdir()] == [file]
        assert (folder / file).read_text() == "mine"


WRITERS = ["export e2e", "train e2e", "sil e2e", "fit standin", "sweep learning_rate"]


def test_a_folder_without_permission_is_refused_at_once(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    for command in (*WRITERS[1:], "compare standin"):  # to runs
        assert "error: --output: runs" in refusal(capsys, *command.split())
    for command in WRITERS:
        error = refusal(capsys, *command.split(), "--output", "new/one")
        assert "--output: new/one: no permission in ., allowed: a folder" in error
    assert run("sweep", "learning_rate", "--check") == 0  # writes nothing
    figures = ("evaluate", "e2e", "--policy", "e2e", "--figures", "new")
    assert "--figures: new: no permission in ." in refusal(capsys, *figures)


def test_a_command_of_a_notebook_has_no_terminal(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a Jupyter kernel does
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    assert output.stderr().is_terminal
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    assert not output.stderr().is_terminal


def test_a_long_step_of_a_command_is_one_line_where_there_is_no_terminal(monkeypatch):
    monkeypatch.setattr(output, "LINE_AFTER_S", 0.2)
    text = io.StringIO()
    with output.steps(Console(file=text)) as report:
        report("building")
        report("run 1 of 2")
        for seconds in range(1, 5):
            time.sleep(0.3)
            report(f"run 1 of 2: {seconds} s flown")
        report("run 2 of 2: 1 s flown")
        report("run 2 of 2: 2 s flown")
        time.sleep(0.4)
        report("drawing")
    time.sleep(0.4)
    assert text.getvalue() == "run 1 of 2\nrun 2 of 2: 2 s flown\n"


def test_view_says_what_it_simulates(tmp_path, capsys, monkeypatch):
    def evaluate(*options, **more):
        time.sleep(0.5)
        raise InputError("enough")

    monkeypatch.setattr(output, "LINE_AFTER_S", 0.1)
    monkeypatch.setattr("quadjax.evaluation.sources.evaluate", evaluate)
    assert run("view", "e2e", "--race", "e2e", "--output", tmp_path / "a.html") == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"simulating {PRETRAINED / 'e2e.npz'}", "error: enough"]


@pytest.mark.parametrize("command", [["show"], ["show", "e2e"]])
def test_lists_fit_a_terminal(command, capsys):
    assert run(*command) == 0
    lines = capsys.readouterr().out.splitlines()
    text = [line for line in lines if command == ["show"] or line.lstrip().startswith("#")]
    assert len(text) > 10 and max(map(len, text)) < 80


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_nothing_is_lost_where_the_environment_fits_no_output(encoding, tmp_path):
    """A stream that cannot write a character, and a backend of Matplotlib that is none."""
    track = (CONFIGS / "tracks/square4.yaml").read_text()
    (tmp_path / "λ飛.yaml").write_text(track.replace("name: square4", "name: λ飛 ü"))
    environment = {"PYTHONIOENCODING": encoding, "MPLBACKEND": "nonsense"}
    done = subprocess.run(
        [sys.executable, "-m", "quadjax", "show", "λ飛.yaml", "--figure", "λ飛.png"],
        cwd=tmp_path,
        capture_output=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])} | environment,
    )
    wanted = "λ飛 ü".encode(encoding, errors="replace")
    assert done.returncode == 0 and wanted in done.stdout, done.stderr
    assert done.stderr.endswith("wrote λ飛.png\n".encode(encoding, errors="backslashreplace"))
    assert (tmp_path / "λ飛.png").read_bytes().startswith(b"\x89PNG")
