"""The command quadjax: subcommands, help, exit status, Ctrl-C, one-line errors."""

import errno
import gc
import os
import re
import runpy
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

import quadjax
from quadjax.cli import call
from quadjax.cli.output import resuming_command
from quadjax.core.errors import InputError, as_command, warn
from quadjax.core.imports import load_object, user_numbers
from quadjax.core.interruptions import interruptions, repeat_lost
from quadjax.core.resources import policy_names, preset_names
from tests.commands import run
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]


def test_the_version_is_that_of_the_package(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"quadjax {quadjax.__version__}\n"


def test_what_is_shipped_is_listed(capsys):
    assert run("show") == 0
    text = capsys.readouterr().out
    first = text.partition("parts of")[0].splitlines()[1:]
    names = [line for line in first if re.match(r"  \w", line)]
    assert [line.split()[0] for line in names] == quadjax.presets()
    assert all(len(line.split()) > 2 for line in names)
    for each in (*preset_names("tracks"), *preset_names("vehicles"), *policy_names()):
        assert each in text


@pytest.mark.parametrize(
    ("name", "words", "wanted"),
    [
        ("quadjax train", ["a b.yaml", "--overwrite"], "quadjax train 'a b.yaml' --resume"),
        (
            "python my scripts/x.py",
            ["--name", "#1"],
            "python 'my scripts/x.py' --name '#1' --resume",
        ),
    ],
)
def test_a_command_that_resumes_is_the_one_given_quoted_for_a_shell(name, words, wanted):
    def command(*words: str, name: str = "", overwrite: bool = False) -> None:
        assert resuming_command() == wanted

    call(command, name, words)


SHOWN = {
    "e2e.npz": "network 24-64-64-64-4, relu",
    "figure8": "figure8: 6 gates, a lap of",
    "bebop1": "Parrot Bebop 1",
    "cyberzoo effects.ground=0.5": "  ground: 0.5\n",
    "standin": "control_rate: 500",
    f"{ROOT}/configs/fit/standin.yaml": "  files: [runs/standin_logs/*.csv]\n",
}


@pytest.mark.parametrize("name", SHOWN)
def test_a_name_is_shown_by_its_kind(name, capsys):
    assert run("show", *name.split()) == 0
    printed = capsys.readouterr()
    assert SHOWN[name] in printed.out
    assert ("standin is also a fit config: quadjax show " in printed.err) == (name == "standin")


@pytest.mark.parametrize("script", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_a_script_of_the_benchmarks_is_short_and_has_help(script, capsys):
    text = script.read_text()
    assert len(text.splitlines()) <= 110
    if "__main__" in text:
        assert run_script(script.stem, "--help") == 0
        assert "Usage:" in capsys.readouterr().out
        assert run_script(script.stem, "--nosuch") == 2
        assert re.fullmatch("error: .+\n", capsys.readouterr().err)


def test_a_warning_is_printed_once_for_each_text(capsys):
    """Also where a library changes the filters in between, which makes Python forget them."""

    def main():
        for text in ("one", "two", "one"):
            warn(text)
            with warnings.catch_warnings():
                warnings.simplefilter("error", DeprecationWarning)

    assert as_command(main)() == 0
    assert capsys.readouterr().err == "warning: one\nwarning: two\n"


IN_THE_TYPE = """
evaluate e2e --policy e2e --drones 1001
evaluate e2e --policy e2e --drones 3 --runs 4
evaluate e2e --policy e2e --body 0
evaluate e2e --policy e2e --range position=8
evaluate e2e --policy e2e --fixed-point --range position=3
evaluate e2e --policy e2e --conditions nosuch
compare standin --drones 10 --runs 25
compare nosuch
export e2e --output out --range position
export e2e --output out --range a=1 --range a=2
export e2e --output out --sample-rate 0
export e2e --output out --cutoff nan
sil e2e --nan height=0.1
sil e2e --nan position=2
sil e2e --nan position=0.1 --nan position=0.2
--help
""".strip().splitlines()


def test_the_help_and_the_check_of_an_option_import_no_jax():
    code = f"import sys, quadjax.cli; print([quadjax.cli.run(x.split()) for x in {IN_THE_TYPE}])"
    code += "; print('jax' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.stdout.endswith(f"{[2] * (len(IN_THE_TYPE) - 1) + [0]}\nFalse\n"), done.stderr
    assert done.stderr.count("error: ") == done.stderr.count("\n") == len(IN_THE_TYPE) - 1


@pytest.mark.parametrize("script", sorted((ROOT / "scripts").glob("*.py")), ids=lambda p: p.stem)
def test_a_script_is_its_subcommand(script, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(script), run_name="__main__")
    assert not end.value.code and f"Usage: quadjax {script.stem}" in capsys.readouterr().out


def raising(error):
    def main():
        raise error

    return main


class JaxRuntimeError(RuntimeError):
    """Named as that of JAX."""


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), "/x: Permission denied"),
        (MemoryError("Unable to allocate 522. GiB"), "not enough memory (Unable to allocate"),
        (JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory"), "not enough memory"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_system_errors_are_one_line_and_status_2(error, says, capsys):
    assert as_command(raising(error))() == 2
    text = capsys.readouterr().err
    assert says in text and text.count("\n") == 1


@pytest.mark.parametrize("kind", [KeyError, OverflowError, JaxRuntimeError])
def test_faults_of_the_program_are_raised(monkeypatch, kind):
    with pytest.raises(kind):
        as_command(raising(kind("x")))()
    monkeypatch.setenv("QUADJAX_DEBUG", "1")
    with pytest.raises(InputError):
        as_command(raising(InputError("x")))()


REFUSED = {  # the command line refuses modules and names that do not exist
    "../math:pi": "allowed",
    "leaves:x": r"cannot be imported \(SystemExit: 3\)",
    "broken_module:x": r"cannot be imported \(ZeroDivisionError: division by zero\)",
}


def test_an_object_of_a_module_next_to_the_config(tmp_path, monkeypatch):
    (tmp_path / "my_terms.py").write_text("class Terms:\n    weight = 3\n")
    (tmp_path / "broken_module.py").write_text("1 / 0\n")
    (tmp_path / "leaves.py").write_text("import sys\n\nsys.exit(3)\n")
    monkeypatch.chdir(tmp_path)
    assert load_object("my_terms:Terms.weight", "reward.terms") == 3
    with pytest.raises(InputError, match="my_terms.py has no 'Trems'; did you mean Terms"):
        load_object("my_terms:Trems", "reward.terms")
    for path, message in REFUSED.items():
        with pytest.raises(InputError, match=message) as caught:
            load_object(path, "reward.terms")
        assert "\n" not in str(caught.value)


def test_an_error_in_a_user_s_module_names_its_line(tmp_path, monkeypatch):
    (tmp_path / "blames.py").write_text("def wrong(step):\n    return 1 / 0\n")
    monkeypatch.chdir(tmp_path)
    wrong = load_object("blames:wrong", "key")
    with pytest.raises(InputError, match=f"{tmp_path / 'blames.py'}:2; QUADJAX_DEBUG=1"):
        user_numbers("term", wrong, None)
    with pytest.raises(ZeroDivisionError):
        as_command(wrong)(None)


def test_the_first_sets_an_event_and_the_second_raises(capfd):
    before = signal.getsignal(signal.SIGINT)
    with interruptions() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(10)
        assert "Ctrl-C again ends without saving" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            stop.wait(10)
            signal.pause()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_an_interrupt_during_imports_is_quiet(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "quadjax", "train", "e2e"]
        + ["--output", str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    imported = (line.rpartition("|")[2].strip() for line in process.stderr)
    assert any(name.startswith("jax.") for name in imported)
    process.send_signal(signal.SIGINT)
    try:
        _, error = process.communicate(timeout=20)
    except subprocess.TimeoutExpired:  # on a busy machine it was past the imports: it saves first
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Traceback" not in error


def test_an_interruption_that_a_callback_swallows_is_repeated(monkeypatch, capfd):
    """As of JAX's callback of the garbage collector: nothing is printed, and the command ends."""

    def lose(phase, info):
        gc.callbacks.remove(lose)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    repeat_lost()
    gc.callbacks.append(lose)
    with pytest.raises(KeyboardInterrupt):
        gc.collect()
        time.sleep(20.0)
    assert capfd.readouterr().err == ""
