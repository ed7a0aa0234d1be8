"""The whole way: a policy file to a folder of C, verified, and what is refused on it."""

import dataclasses
import errno
import functools
import json
import re
import shutil
import signal
from pathlib import Path

import pytest

from quadjax import __version__
from quadjax.cli.export import verification
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.export import convert, emulator, flights
from quadjax.export.conversion import sha256
from quadjax.export.convert import export_c
from quadjax.export.folder import read_folder
from quadjax.export.read import read_qjp, unpack
from quadjax.export.verify import checks, run, toolchain
from quadjax.export.verify.build import Library
from quadjax.export.verify.checks import CHECKS
from quadjax.export.verify.result import FAILED, PASSED, SKIPPED, Result
from quadjax.export.words import pack
from quadjax.policy.file import Policy
from tests.commands import run as command
from tests.export.support import WIDE, made_policy, random_rollouts, tree_of

COUNT = 2000
ALLOWED = {  # skipped checks of the folder, whose race and flights its options allow
    "own race": "allowed by allow_other_race=True",
    "own flights": "allowed by allow_unfinished=True",
}


def check_all(results):
    """All passed, but for what the export allows and what a missing tool justifies."""
    for result in results:
        if result.verdict == SKIPPED and result.check in ALLOWED:
            assert result.figure.endswith(ALLOWED[result.check])
        elif result.verdict == SKIPPED:
            module = re.match(r"no (?:compiler or emulator for ARM|(\w+); pip)", result.figure)
            assert module and not toolchain.has_module(module[1] or "ziglang"), result.figure
        else:
            assert result.verdict == PASSED, result.figure


def verdicts(folder, *only, **options):
    return [result.verdict for result in run.verify(folder, COUNT, only=only, **options)]


def test_the_fast_checks_of_an_exported_folder(exported):
    assert verdicts(exported, "range proof", "NumPy = C") == [PASSED] * 3


@pytest.mark.slow
def test_all_checks_of_an_exported_folder(flown):
    results = run.verify(flown, COUNT, 8, allow_unfinished=True, allow_other_race=True)
    check_all(results)
    assert [r.check for r in results] == ["files", *CHECKS]
    figures = {result.check: result.figure for result in results}
    refused = run.verify(flown, COUNT, 8, only=("own flights",))[-1]  # of real flights
    assert refused.verdict == FAILED and "0 of 32 flights finish 6 laps" in refused.figure
    assert "instructions" in figures["processor"] and "missed" in figures["simulator"]


def test_a_million_vectors_are_checked_in_parts(exported, monkeypatch):
    sizes = []

    def forward(self, q):
        sizes.append(len(q))
        return emulator.forward_rows(self._policy.network, q)

    monkeypatch.setattr(Library, "forward", forward)
    monkeypatch.setattr(checks, "VECTORS", 1000)
    assert verdicts(exported, "NumPy = C") == [PASSED, PASSED]
    parts = sizes[:-1]  # the last one is compared with float64
    assert len(parts) == 2 and max(parts) < 1700 and sum(parts) > COUNT


def test_a_file_is_verified_by_itself(exported, tmp_path, capsys):
    path = tmp_path / "racer.qjp"
    shutil.copy(exported / "made.qjp", path)
    assert verdicts(path, "range proof", "NumPy = C") == [PASSED] * 3
    path.write_bytes(path.read_bytes()[:-1] + b"\0")
    with pytest.raises(InputError, match="racer.qjp: changed since it was written"):
        run.verify(path)
    assert command("verify", path, "--runs", 1) == 2
    assert "--runs has no effect on a .qjp file" in capsys.readouterr().err


def test_files_of_the_first_version_stay_readable():
    old = read_qjp(Path(__file__).parent / "version_1.qjp")
    assert old.network.model.name == "racing" and old.race.gates > 2 and len(old.cases.inputs) > 8
    assert pack(unpack(pack(old))) == pack(old)


def test_the_target_decides_what_is_written(exported):
    folder = read_folder(exported)
    options = dataclasses.replace(folder.options, target="cortex-m7")
    other, own = dataclasses.replace(folder, options=options).files(), folder.files()
    assert {name.split("/")[0] for name in other} == {"c", "made.qjp"}
    assert {name.split("/")[0] for name in own} == {"paparazzi", "made.qjp"}
    assert other["c/qj_network.c"] == own["paparazzi/qj_network.c"]
    assert b"static const int32_t made_words[" in own["paparazzi/made.h"]
    assert "QUADJAX_WORDS made_words" in own["paparazzi/quadjax_policy.h"].decode()
    module = own["paparazzi/quadjax.xml"].decode()
    for name in (Path(name).name for name in own if name.endswith(".c")):
        assert f'name="{name}"' in module or name == "qj_angles.c"
    written = {p.relative_to(exported).as_posix() for p in exported.rglob("*") if p.is_file()}
    others = {"made_report.json", "made_report.txt", "policy.npz", "config.yaml", "residual.npz"}
    assert written - {".lock", ".quadjax.json"} == {*own, *others}


def test_a_planted_header_is_not_compiled(exported, tmp_path):
    copy = shutil.copytree(exported, tmp_path / "copy")
    (copy / "paparazzi/stdint.h").write_text("#error planted\n")
    assert verdicts(copy, "NumPy = C") == [PASSED, PASSED]


DAMAGED = {  # file: how it is damaged, and the message
    "made.qjp": ("cut", "made.qjp: "),
    "made_report.json": ("other", "made_report.json"),
    "policy.npz": ("empty", "policy.npz"),
    "config.yaml": ("missing", "config.yaml: no such file"),
    "paparazzi/quadjax.xml": ("cut", "quadjax.xml: not what the converter writes"),
    "paparazzi/qj_race.c": ("longer", "qj_race.c: not what the converter writes .*compiled$"),
    ".quadjax.json": ("cut", "quadjax.json"),
}


@pytest.mark.parametrize("file", DAMAGED)
def test_a_damaged_file_is_one_line_and_nothing_is_compiled(exported, tmp_path, monkeypatch, file):
    copy = shutil.copytree(exported, tmp_path / "copy")
    path, (damage, message) = copy / file, DAMAGED[file]
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        longer = content + b"\n#error planted\n"
        cut = {"cut": content[: len(content) // 2], "empty": b"", "other": b"\0[", "longer": longer}
        path.write_bytes(cut[damage])
    monkeypatch.setattr(toolchain.Compiler, "build", lambda *_: pytest.fail("compiled"))
    with pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*$"):
        run.verify(copy, COUNT)


ALLOWANCES = {
    "own flights": ("allow_unfinished", "0 of 32 flights finish 6 laps of track triangle"),
    "own race": ("allow_other_race", "trained in another race than config.yaml: gate_test is sq"),
}


@pytest.mark.parametrize("check", ALLOWANCES)
def test_what_the_export_allowed_fails_unless_allowed_again(exported, no_flights, check):
    option, message = ALLOWANCES[check]
    found = [run.verify(exported, COUNT, only=(check,), **{option: x})[-1] for x in (False, True)]
    assert [result.verdict for result in found] == [FAILED, SKIPPED]
    assert message in found[0].figure


def test_a_folder_holds_one_export(tmp_path, no_flights):
    policy, out = made_policy(8, "rate", gain=0.5), tmp_path / "c"
    options = {"ranges": WIDE | {"rates": 8.0, "velocity": 32.0}, "allow_unfinished": True}
    export_c(policy, out, name="first", **options)
    for stale in ("first_estimator.c", "first_estimator.h", "residual.npz", "rollouts.npz"):
        (out / stale).write_text("of a motor-level policy that was exported before")
    for name, message in (
        ("first", "c holds an export already: replace it .overwrite=True. or .*folder .--output"),
        ("second", "holds an export named 'first'"),
    ):
        with pytest.raises(InputError, match=message):
            export_c(policy, out, name=name, **options)
    export_c(policy, out, name="first", overwrite=True, **options)
    names = {path.name for path in out.iterdir()}
    assert not {name for name in names if "estimator" in name or name.startswith("second")}
    assert not names & {"residual.npz", "rollouts.npz"}
    assert read_folder(out).options.name == "first"


def test_refuses_a_range_that_its_own_flights_leave(tmp_path, monkeypatch):
    monkeypatch.setattr(flights, "simulate", lambda own: random_rollouts(own, velocity=20.0))
    with pytest.raises(InputError, match="own flights leave the declared range.*velocity"):
        export_c(made_policy(8), tmp_path / "c", allow_unfinished=True)
    assert not (tmp_path / "c").exists()


def test_a_full_disk_is_one_line_and_leaves_the_earlier_export(tmp_path, monkeypatch, no_flights):
    policy, out, write = made_policy(8), tmp_path / "c", convert.write_bytes
    for left in (0, 9):  # files that the disk has room for
        count = iter(range(left))

        def limited(path, text, count=count):
            if next(count, None) is None:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(path, text)

        monkeypatch.setattr(convert, "write_bytes", limited)
        with pytest.raises(InputError, match="c: cannot be written .No space left on device.$"):
            export_c(policy, out, ranges=WIDE, allow_unfinished=True)
        assert not out.exists()
    monkeypatch.setattr(convert, "write_bytes", write)
    export_c(policy, out, ranges=WIDE, allow_unfinished=True)
    (out / "paparazzi" / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr(convert, "write_json", lambda *_: limited(out, ""))
    with pytest.raises(InputError):
        export_c(made_policy(8, gain=2.0), out, ranges=WIDE, allow_unfinished=True, overwrite=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("during", ["writing", "replacing"])
def test_an_interrupted_export_is_whole_or_nothing(during, tmp_path, no_flights, monkeypatch):
    policy, out = made_policy(8), tmp_path / "c"
    options = {"ranges": WIDE, "allow_unfinished": True}
    write, move, count = convert.write_bytes, Path.replace, iter(range(3))

    def interrupted(function, *arguments):
        if next(count, None) is None:
            signal.raise_signal(signal.SIGINT)
        return function(*arguments)

    with monkeypatch.context() as patch:
        if during == "writing":
            patch.setattr(convert, "write_bytes", functools.partial(interrupted, write))
        else:
            patch.setattr(Path, "replace", lambda *paths: interrupted(move, *paths))
        with pytest.raises(KeyboardInterrupt):
            export_c(policy, out, name="first", **options)
    if during == "replacing":
        assert read_folder(out).options.name == "first"
    else:
        assert not out.exists()


def test_ctrl_c_on_the_emulator_ends_the_verification(exported, monkeypatch):
    machine = pytest.importorskip("quadjax.export.verify.machine")
    if not toolchain.has_module("ziglang"):
        pytest.skip("no compiler for ARM")
    block = machine.Machine._block

    def interrupted(self, *place):
        signal.raise_signal(signal.SIGINT)
        return block(self, *place)

    monkeypatch.setattr(machine.Machine, "_block", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.verify(exported, COUNT, only=("processor",))


def test_a_verification_ends_with_the_next_command(exported, monkeypatch, capsys):
    monkeypatch.setattr(run, "verify", lambda *_, **options: [Result("files", PASSED, "")])
    assert command("verify", exported) == 0
    assert capsys.readouterr().out.endswith(f"\nNext: quadjax sil {exported}\n")


def test_folders_of_other_kinds_are_refused(exported, tmp_path):
    with pytest.raises(InputError, match="report.json"):
        read_folder(tmp_path)
    with pytest.raises(InputError, match="check 'own flight': no such check, allowed: range proof"):
        run.verify(exported, COUNT, only=("own flight",))
    (tmp_path / ".quadjax.json").write_text('{"kind": "training"}')
    for use in (read_folder, lambda folder: export_c(made_policy(8), folder)):
        with pytest.raises(InputError, match="holds a run, not an export"):
            use(tmp_path)


def test_a_policy_that_does_not_finish_its_race_is_refused(tmp_path, no_flights):
    finish = "0 of 32 flights finish 6 laps of track square4 .*; allow_unfinished=True accepts it"
    with pytest.raises(InputError, match=finish):
        export_c(made_policy(8), tmp_path / "c", ranges=WIDE)
    assert not (tmp_path / "c").exists()


def test_the_race_has_the_residual_that_the_policy_names(tmp_path, no_flights):
    exported = export_c(PRETRAINED / "e2e.npz", tmp_path / "c", allow_unfinished=True)
    assert exported.converted.own.residual is not None
    assert sha256(tmp_path / "c/residual.npz") == sha256(PRETRAINED / "standin_residual.npz")


GATES = ", ".join(f"{{position: [{x}, 0, -1]}}" for x in (3, 0, 1, 2))
OTHER_RACES = {
    f"track.gates=[{GATES}]": r"track.position.x is \[ 2.* in training, \[3.* here",
    "track=figure8": "the number of gates is 4 in training, 6 here",
    "vehicle.constants.k_w=4e-8": "vehicle.constants.k_w is .* in training, .*e-08 here",
    "rules.time_step=0.005": "time_step is 0.0.* in training, 0.00.* here",
    "rules.gate_test=world_box": "gate_test is square in training, world_box here",
    "vehicle.residual=standin_residual.npz": "vehicle.residual.* is none in .*, other num.* here",
}


def test_another_race_than_that_of_the_policy_file_is_refused(tmp_path):
    trained = load_config("e2e")
    policy = dataclasses.replace(Policy.load(PRETRAINED / "e2e.npz"), config=tree_of(trained))
    refused = [
        (
            policy,
            load_config("e2e", [override]),
            f"trained in another race than config: {text}; all",
        )
        for override, text in OTHER_RACES.items()
    ]
    refused.append((PRETRAINED / "e2e.npz", "e2e", "standin_residual.npz in training, no residual"))
    other = "e2e.yaml: indi.npz: a policy for the rate .* is motor"
    refused.append((PRETRAINED / "indi.npz", CONFIGS / "e2e.yaml", other))
    for own, config, message in refused:
        with pytest.raises(InputError, match=message):
            export_c(own, tmp_path / "c", config)


def test_the_report_says_what_was_exported(exported):
    report = json.loads((exported / "made_report.json").read_text())
    assert report["policy_sha256"] == sha256(exported / "policy.npz")
    origin = report["provenance"]
    assert origin["quadjax"] == __version__ and origin["seed"] == 0
    assert origin["policy"]["sha256"] == report["policy_sha256"]
    assert report["options"]["name"] == "made"
    command = verification(Path("out/my_policy"), True, False)
    assert command == "quadjax verify out/my_policy --allow-unfinished"
