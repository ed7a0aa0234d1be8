"""The whole way: a policy file to a folder of C, verified, and what is refused on it."""

import dataclasses
import errno
import functools
import json
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from quadjax import __version__
from quadjax.cli.export import verification
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export import convert, verify
from quadjax.export.compiler import Compiler
from quadjax.export.conversion import sha256
from quadjax.export.convert import export_c
from quadjax.export.folder import read_folder
from quadjax.export.suitability import target_of
from quadjax.export.verify import CHECKS, FAILED, PASSED, SKIPPED
from quadjax.race.track import gates_ahead
from tests.commands import run as command
from tests.export.support import made

COUNT = 2000
ALLOWANCES = {  # option that allows what fails, and why it fails
    "allow_unfinished": "0 of 32 flights finish 6 laps of track figure8",
    "allow_other_race": "trained in another race than config.yaml: vehicle.constants.k_h",
}


def verdicts(folder, **options):
    return {row.check: row for row in verify.verify(folder, COUNT, **options)}


@pytest.fixture
def copied(exported, tmp_path):
    """A copy of an exported folder, to change it."""
    return shutil.copytree(exported, tmp_path / "copy")


def export(folder, race="e2e", **options):
    """Export a made-up policy, which does not finish its race."""
    return export_c(made(race)[0], folder, allow_unfinished=True, **options)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_all_checks_of_an_exported_folder(flown):
    """All pass, but for what the export allows."""
    results = verdicts(flown, **dict.fromkeys(ALLOWANCES, True))
    assert list(results) == list(CHECKS) and len(CHECKS) == 6
    assert all(row.verdict == PASSED for name, row in results.items() if name != "gates"), results
    assert results["gates"].figure == "no flight passes a gate"
    for option, reason in ALLOWANCES.items():
        figure = results["race and flights"].figure
        assert reason in figure and f"allowed by --{option.replace('_', '-')}" in figure
    assert all(len(row.text(16).splitlines()) == 1 for row in results.values())


@pytest.mark.slow
def test_a_gate_ahead_that_faces_the_other_way(tmp_path):
    """Rounding decides between pi and -pi: float64 can differ from float32 and C."""
    track = made("half turns")[1].params.track
    (facing,) = np.nonzero(np.abs(np.abs(gates_ahead(track, 2)[1]) - np.pi) < 1e-6)
    assert len(facing) == 6
    wide = {"position": 64.0, "velocity": 128.0, "rates": 1024.0}
    export(tmp_path / "c", "half turns", ranges=wide)
    assert verdicts(tmp_path / "c")["observation"].verdict == PASSED


@pytest.mark.parametrize("option", ALLOWANCES)
def test_what_the_export_allowed_fails_unless_allowed_again(exported, no_flights, option):
    others = {name: name != option for name in ALLOWANCES}
    row = verdicts(exported, **others)["race and flights"]
    assert row.verdict == FAILED and ALLOWANCES[option] in row.figure


def test_a_million_vectors_are_checked_in_parts(exported, no_flights, monkeypatch):
    sizes, same = [], verify._same

    def counted(what, values, expected):
        sizes.append(len(values))
        same(what, values, expected)

    monkeypatch.setattr(verify, "_same", counted)
    monkeypatch.setattr(verify, "VECTORS", 1000)
    assert verdicts(exported)["network"].verdict == PASSED
    assert len(sizes) == 2 * 2 + 1 and max(sizes) < 2500 and sum(sizes[:-1:2]) > COUNT


def test_the_command_says_what_to_do_next(exported, tmp_path, capsys, monkeypatch, no_flights):
    folder = shutil.copytree(exported, tmp_path / "aus #1")
    assert command("verify", folder) == 1  # its race is another one, and it does not finish
    out = capsys.readouterr().out
    assert len(out.splitlines()) == 6 and "race and flights  FAIL" in out
    allowed = [f"--{option.replace('_', '-')}" for option in ALLOWANCES]
    monkeypatch.setitem(CHECKS, "gates", lambda c: "no flights")
    assert command("verify", folder, *allowed, "--json", tmp_path / "v.json") == 0
    assert capsys.readouterr().out.endswith(f"\nNext: quadjax sil '{folder}'\n")
    rows = json.loads((tmp_path / "v.json").read_text())["results"]
    assert [row["check"] for row in rows] == list(CHECKS)
    assert verification(folder, True, False) == f"quadjax verify '{folder}' --allow-unfinished"


def test_a_policy_without_estimators_skips_their_check(tmp_path, no_flights):
    export(tmp_path / "c", "indi")
    assert verdicts(tmp_path / "c")["estimators"].verdict == SKIPPED


def test_the_target_decides_what_is_written(exported):
    folder = read_folder(exported)
    options = dataclasses.replace(folder.options, target="cortex-m7")
    other, files = dataclasses.replace(folder, options=options).files, folder.files
    assert {name.split("/")[0] for name in other} == {"c"}
    assert {name.split("/")[0] for name in files} == {"paparazzi"}
    assert other["c/qj_network.c"] == files["paparazzi/qj_network.c"]
    assert b"static const qj_policy made_policy = {" in files["paparazzi/made.h"]
    assert b"QUADJAX_POLICY made_policy" in files["paparazzi/quadjax_policy.h"]
    module = files["paparazzi/quadjax.xml"].decode()
    for name in (Path(name).name for name in files if name.endswith(".c")):
        assert f'name="{name}"' in module
    assert target_of("cortex-a9", "racing").folder == "c"  # for which Paparazzi has no glue
    written = {path.relative_to(exported).as_posix() for path in contents(exported)}
    others = {"made_report.json", "made_report.txt", "policy.npz", "config.yaml", "residual.npz"}
    assert written - {".lock", ".quadjax.json"} == {*files, *others}


def test_the_report_says_what_was_exported(exported):
    report = json.loads((exported / "made_report.json").read_text())
    assert report["policy_sha256"] == sha256(exported / "policy.npz")
    origin = report["provenance"]
    assert origin["quadjax"] == __version__ and origin["seed"] == 0
    assert origin["policy"]["sha256"] == report["policy_sha256"]
    assert report["options"]["name"] == "made"
    again = verification(Path("out/my_policy"), True, False)
    assert again == "quadjax verify out/my_policy --allow-unfinished"


def test_a_planted_header_is_not_compiled(copied, no_flights):
    (copied / "paparazzi/stdint.h").write_text("#error planted\n")
    assert verdicts(copied)["network"].verdict == PASSED


def test_each_input_of_the_header_has_a_comment(exported):
    """Of a policy with everything: the reader needs no other file."""
    text, layout = (exported / "paparazzi/made.h").read_text(), made("everything")[0].layout
    for label in layout.labels:
        assert re.search(rf"}}, /\* {re.escape(label)}(, .*)? \*/", text), label
    for words in ("SHA-256", "Commands 3000..11000 rpm", "gate 0 */", ".gate_test = QJ_WORLD_BOX"):
        assert words in text


DAMAGED = {  # file: its contents from those that it had, None: removed; and the message
    "paparazzi/made.h": (lambda data: data[: len(data) // 2], "made.h: not what the converter"),
    "made_report.json": (lambda data: b"\0[", "made_report.json"),
    "policy.npz": (lambda data: b"", "policy.npz"),
    "config.yaml": (None, "config.yaml: no such file"),
    "paparazzi/quadjax.xml": (lambda data: data[:9], "quadjax.xml: not what the converter writes"),
    "paparazzi/qj_race.c": (
        lambda data: data + b"\n#error planted\n",
        "qj_race.c: not what the converter writes .*compiled$",
    ),
    ".quadjax.json": (lambda data: data[: len(data) // 2], "quadjax.json"),
}


@pytest.mark.parametrize("file", DAMAGED)
def test_a_damaged_file_is_one_line_and_nothing_is_compiled(copied, monkeypatch, file):
    path, (change, message) = copied / file, DAMAGED[file]
    data = path.read_bytes()
    path.unlink()
    if change is not None:
        path.write_bytes(change(data))
    monkeypatch.setattr(Compiler, "build", lambda *_: pytest.fail("compiled"))
    with pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*$"):
        verify.verify(copied, COUNT)


WRONG = {"sample_rate": 0, "cutoff": 1e9, "target": "avr", "name": "../made", "ranges": [1]}


def test_a_report_with_a_wrong_option_is_one_line(copied):
    report = json.loads((copied / "made_report.json").read_text())
    changed = [{**report, "options": {**report["options"], name: x}} for name, x in WRONG.items()]
    for damaged in (*changed, {"options": report["options"]}):
        (copied / "made_report.json").write_text(json.dumps(damaged))
        fault = "'policy' is missing" if "policy" not in damaged else ""
        with pytest.raises(InputError, match=f"made_report.json: not a report .*{fault}"):
            read_folder(copied)


def test_folders_of_other_kinds_are_refused(exported, tmp_path):
    with pytest.raises(InputError, match="report.json"):
        read_folder(tmp_path)
    (tmp_path / ".quadjax.json").write_text('{"kind": "training"}')
    for use in (read_folder, export):
        with pytest.raises(InputError, match="holds a run, not an export"):
            use(tmp_path)


def test_a_folder_holds_one_export(tmp_path, no_flights):
    out = tmp_path / "c"
    export(out, "indi", name="first")
    (out / "c").mkdir()
    stale = (out / "residual.npz", out / "c/first.h")
    for path in stale:
        path.write_text("of a motor-level policy that was exported before, for another target")
    for name, message in (
        ("first", "c holds an export already: replace it .--overwrite. or .*folder .--output"),
        ("second", "holds an export named 'first'"),
    ):
        with pytest.raises(InputError, match=message):
            export(out, "indi", name=name)
    export(out, "indi", name="first", overwrite=True)
    assert not any(path.exists() for path in (*stale, out / "c"))
    assert not any(path.name.startswith("second") for path in out.rglob("*"))
    assert read_folder(out).options.name == "first"


def test_a_full_disk_is_one_line_and_leaves_the_earlier_export(tmp_path, monkeypatch, no_flights):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "c"
    with monkeypatch.context() as patch:
        patch.setattr(convert, "write_json", full)  # the last file
        with pytest.raises(InputError, match="c: cannot be written .No space left on device.$"):
            export(out)
        assert not out.exists()
    export(out)
    (out / "paparazzi" / "notes.txt").write_text("mine")
    before = contents(out)
    monkeypatch.setattr(convert, "write_json", full)
    with pytest.raises(InputError):
        export(out, "indi", overwrite=True)
    assert contents(out) == before


@pytest.mark.parametrize("during", ["writing", "replacing"])
def test_an_interrupted_export_is_whole_or_nothing(during, tmp_path, no_flights, monkeypatch):
    out, count = tmp_path / "c", iter(range(3))

    def interrupted(function, *arguments):
        if next(count, None) is None:
            signal.raise_signal(signal.SIGINT)
        return function(*arguments)

    with monkeypatch.context() as patch:
        if during == "writing":
            write = functools.partial(interrupted, convert.write_bytes)
            patch.setattr(convert, "write_bytes", write)
        else:
            move = Path.replace
            patch.setattr(Path, "replace", lambda *paths: interrupted(move, *paths))
        with pytest.raises(KeyboardInterrupt):
            export(out, name="first")
    if during == "replacing":
        assert read_folder(out).options.name == "first"
    else:
        assert not out.exists()


@pytest.mark.slow
def test_a_policy_is_named_as_on_the_command_line(tmp_path):
    """By a shipped name, or as the folder of a run."""
    folder = tmp_path / "racer"
    folder.mkdir()
    shutil.copy(PRETRAINED / "indi.npz", folder / "policy.npz")
    for policy, name in (("indi", "indi"), (folder, "policy")):
        export = export_c(policy, tmp_path / name)
        assert repr(export) == f"Export({name!r} in {tmp_path / name})"
        assert export.report["policy"] == f"{name}.npz"
        assert (tmp_path / name / f"{name}_report.json").is_file()
