"""What commands refuse before any work: outputs that would replace other files, and bad options."""

import io
import os
import warnings
from pathlib import Path

import pytest
from rich.console import Console

from quadjax.cli import output
from quadjax.cli.options import JsonFile, check_outputs, is_override
from quadjax.core.errors import InputError, run_command
from quadjax.core.folders import claim
from quadjax.core.resources import CONFIGS, PRETRAINED
from tests.commands import run


def refusal(capsys, *arguments):
    """The one line on stderr of a refused command."""
    assert run(*arguments) == 2
    error = capsys.readouterr().err.lstrip("\n")  # which a progress bar prints
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "e2e", "--output=--"),
        ("train", "e2e", "--seeds=--"),
        ("evaluate", "e2e", "--policy=--"),
        ("export", "p.npz", "--output", "o", "--range=--"),
    ],
    ids=lambda words: words[-1],
)
def test_an_option_of_two_dashes_is_refused(arguments, capsys):
    assert f"{arguments[-1]}: expected a value" in refusal(capsys, *arguments)


@pytest.mark.parametrize(
    "arguments", [["x" * 5000], ["e2e", "--name", "x" * 5000], ["e2e", "=" + "x, " * 3000]]
)
def test_long_values_are_cut(arguments, capsys):
    assert len(refusal(capsys, "train", *arguments)) < 1100


def test_the_url_of_a_database_is_told_with_its_password(tmp_path, capsys):
    error = refusal(
        capsys, "sweep", "learning_rate", "storage=postgres://bob:x@h/db", "--output", tmp_path
    )
    assert "USER:PASSWORD@HOST:PORT" in error and "bob:x" not in error


def test_messages_about_the_compilation_cache_are_not_shown(capsys):
    with warnings.catch_warnings(record=True) as shown:
        text = "Error reading persistent compilation cache entry for 'f': truncated"
        run_command(lambda: warnings.warn(text, stacklevel=2))
    assert not shown


@pytest.mark.parametrize("other", ["policy", "config", "figure", "override", "link"])
def test_an_output_does_not_replace_another_file_of_the_command(tmp_path, capsys, other):
    policy, config, states = tmp_path / "p.npz", tmp_path / "c.yaml", tmp_path / "s.npz"
    policy.write_text("mine")
    config.write_text("base: e2e")
    (tmp_path / "l.npz").symlink_to(policy)
    extra = {
        "policy": ("--states", policy),
        "config": ("--json", config),
        "figure": ("--figure", tmp_path / "a.png", "--signals", tmp_path / "." / "a.png"),
        "override": (f"vehicle.residual={states}", "--states", states),
        "link": ("--states", tmp_path / "l.npz"),
    }[other]
    error = refusal(capsys, "evaluate", config, "--policy", policy, *extra)
    assert "is a link" in error if other == "link" else "is also" in error
    assert policy.read_text() == "mine" and config.read_text() == "base: e2e"


def test_the_text_of_an_override_is_a_file_only_for_keys_of_files():
    def command(*overrides: str, json: JsonFile = None) -> None:
        """A command with an output."""

    check_outputs(command, {"json": Path("a.json"), "overrides": ("seed=1", "name=a.json")})
    for key in ("vehicle.residual", "track", "overrides.vehicle.file"):
        words = ("seed=1", f"{key}=./a.json")
        with pytest.raises(InputError, match="--json a.json: is also overrides"):
            check_outputs(command, {"json": Path("a.json"), "overrides": words})


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


@pytest.mark.parametrize("folder", ["nosuch", "nosuch/deeper", "file"])
def test_the_folder_of_an_output_has_to_exist(tmp_path, capsys, monkeypatch, folder):
    (tmp_path / "file").write_text("")
    seen = []
    monkeypatch.setattr(os, "mkdir", lambda *arguments, **_: seen.append(arguments))
    error = refusal(capsys, "show", "square4", "--figure", tmp_path / folder / "x.png")
    assert f"there is no folder {tmp_path / folder}" in error
    assert not seen and [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_path_with_an_equals_sign_is_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, tmp_path / "lr=0.1"):
        folder.mkdir(exist_ok=True)
        (folder / "a=b.npz").write_text("no policy")
    for file in ("a=b.npz", "lr=0.1/a=b.npz"):
        assert run("evaluate", "--policy", file) == 2
        assert f"error: {file}: not an .npz file\n" in capsys.readouterr().err
        assert file in refusal(capsys, "import", "e2e", file, "--output", "out.npz")
    Path("a=b.yaml").write_text("base: e2e\nname: mine\n")
    overrides = ["seed=3", f"vehicle={CONFIGS / 'vehicles/bebop1.yaml'}"]
    assert [is_override(word) for word in ("a=b.yaml", *overrides)] == [False, True, True]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_an_output_does_not_replace_a_pipe(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    error = refusal(capsys, "evaluate", "e2e", "--policy", "p.npz", "--json", tmp_path / "pipe")
    assert "not a regular file" in error and (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("export", PRETRAINED / "e2e.npz", "--output"), "policy.npz"),
        (("export", PRETRAINED / "e2e.npz", "--name", "mine", "--output"), "mine.c"),
        (("logs", "--output"), "flight_0.csv"),
        (("logs", "--random-residual", "1", "--output"), "residual.npz"),
        (("sweep", "learning_rate", "name=one", "--report", "--output"), "report.md"),
        (("sweep", "learning_rate", "name=one", "--output"), "trials"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_somebody_s_files_are_not_replaced(tmp_path, capsys, arguments, file):
    folder = tmp_path / "one"
    folder.mkdir()
    (folder / file).write_text("mine")
    output = tmp_path if arguments[0] == "sweep" else folder
    error = refusal(capsys, *arguments, output)
    assert file in error and "--overwrite" in error
    assert [path.name for path in folder.iterdir()] == [file]


@pytest.mark.parametrize(
    ("arguments", "kind", "file"),
    [
        (("replay", "log.csv", "--vehicle", "bebop1.yaml"), "replay", "replay.json"),
        (("sil", "one"), "flight", "sil.json"),
        (("compare", "standin"), "comparison", "compare.json"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_earlier_results_are_replaced_only_with_overwrite(tmp_path, capsys, arguments, kind, file):
    """They are refused at once, before logs are read, C is compiled or flights are simulated."""
    name, *words = [tmp_path if word == "one" else word for word in arguments]
    folder = tmp_path / name
    folder.mkdir()
    (folder / file).write_text("earlier")
    error = refusal(capsys, name, *words, "--output", tmp_path)
    assert f"holds no {kind}, but {file}: choose another folder, or replace" in error
    assert (folder / file).read_text() == "earlier" and len(list(folder.iterdir())) == 1


def test_the_steps_of_a_command_are_lines_where_there_is_no_terminal(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(output.time, "monotonic", lambda: now[0])
    text = io.StringIO()
    with output.steps(Console(file=text)) as report:
        for wait, line in ((0.0, "compiling"), (1.0, "too soon"), (4.5, "3 s flown")):
            now[0] += wait
            report(line)
    assert text.getvalue() == "compiling\n3 s flown\n"


def test_view_says_what_it_simulates(tmp_path, capsys, monkeypatch):
    def evaluate(*options, **more):
        raise InputError("enough")

    monkeypatch.setattr("quadjax.dashboard.sources.evaluate", evaluate)
    assert run("view", "e2e", "--race", "e2e", "--output", tmp_path / "a.html") == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"simulating {PRETRAINED / 'e2e.npz'}", "error: enough"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "nosuch.npz", "--output", "one"),
        ("logs", "--vehicle", "abc", "--output", "one"),
        ("evaluate", "e2e", "--policy", "nosuch.npz", "--json", "one/a.json"),
        ("compare", "standin", "--ablation", "n" * 300, "--output", "one"),
        ("compare", "standin", "--parts", "nap", "--output", "one"),
    ],
    ids=lambda words: " ".join(words)[:24],
)
@pytest.mark.parametrize("existing", [False, True])
def test_a_refused_command_leaves_nothing(tmp_path, capsys, monkeypatch, arguments, existing):
    monkeypatch.chdir(tmp_path)
    if existing:
        (tmp_path / "one").mkdir()
        (tmp_path / "one" / "notes").write_text("mine")
    refusal(capsys, *arguments)
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == (["one", "one/notes"] if existing else [])


def test_a_failure_removes_copies_of_inputs_and_nothing_else(tmp_path):
    (tmp_path / "old").mkdir()
    folder = tmp_path / "a" / "new"
    with pytest.raises(InputError), claim(folder, "training"):
        (folder / "config.yaml").write_text("a copy")
        raise InputError("refused")
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
