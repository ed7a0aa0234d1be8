"""The whole way: a policy file to a folder of C, verified, and into an autopilot."""

import dataclasses
import errno
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from quadjax import __version__
from quadjax.cli import call
from quadjax.cli.export import export, verification
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.export import convert, flights
from quadjax.export.conversion import sha256
from quadjax.export.convert import export_c
from quadjax.export.race_source import own_race
from quadjax.export.read import read_qjp, unpack
from quadjax.export.verify import run, toolchain
from quadjax.export.verify.checks import CHECKS
from quadjax.export.verify.folder import read_folder
from quadjax.export.verify.result import FAILED, PASSED, SKIPPED
from quadjax.export.words import pack
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from tests.commands import run as command
from tests.export.support import TRACK, WIDE, made_policy, random_rollouts, tree_of

COUNT = 2000


def justified(reason):
    """Whether a check may be skipped: the tools that its reason names are not on this machine."""
    host = {"cc", "gcc", "clang"}
    arm = {"arm-linux-gnueabi-gcc", "arm-linux-gnueabihf-gcc"}
    several = {
        "no C compiler on": host | {"ziglang"},
        "needs gcc or clang": host,
        "no compiler for ARM": arm | {"ziglang"},
    }
    tools = next((names for start, names in several.items() if reason.startswith(start)), None)
    if tools is None:
        named = re.match(r"no ([\w-]+)(?: on this machine|; pip install)", reason)
        tools = {named[1]} if named else set()
    return bool(tools) and not any(shutil.which(t) or toolchain.has_module(t) for t in tools)


def test_only_a_missing_tool_justifies_a_skipped_check():
    assert justified("no no-such-tool on this machine")
    assert not justified("no sh on this machine")
    assert not justified("no numpy; pip install -e '.[verify]'")
    assert not justified("another reason")


ALLOWED = {  # skipped checks of the folder, whose race and flights its options allow
    "own race": "allowed by allow_other_race=True",
    "own flights": "allowed by allow_unfinished=True",
}


def check_all(results):
    for result in results:
        if result.verdict == SKIPPED and result.check in ALLOWED:
            assert result.figure.endswith(ALLOWED[result.check])
        elif result.verdict == SKIPPED:
            assert result.figure.startswith("the policy observes nothing that is estimated") or (
                justified(result.figure)
            ), f"skipped without need: {result.figure}"
        else:
            assert result.verdict == PASSED, result.figure


def test_the_fast_checks_of_an_exported_folder(exported):
    results = run.verify(exported, COUNT, only=("range proof", "NumPy = C"))
    check_all(results)
    assert [r.check for r in results] == ["files", "range proof", "NumPy = C"]


@pytest.mark.slow
def test_all_checks_of_an_exported_folder(flown):
    results = run.verify(flown, COUNT, 8, allow_unfinished=True, allow_other_race=True)
    check_all(results)
    assert [r.check for r in results] == ["files", *CHECKS]
    figures = {result.check: result.figure for result in results}
    assert "instructions" in figures["processor"] and "missed" in figures["simulator"]


def test_a_file_is_verified_by_itself(exported, tmp_path, capsys):
    path = tmp_path / "racer.qjp"
    shutil.copy(exported / "made.qjp", path)
    results = run.verify(path, COUNT, only=("range proof", "NumPy = C"))
    assert [result.verdict for result in results] == [PASSED] * 3, results
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


def test_a_tampered_source_fails_and_nothing_is_compiled(exported, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    source = copy / "paparazzi/qj_race.c"
    source.write_text(source.read_text() + "\n#error planted\n")
    monkeypatch.setattr(toolchain.Compiler, "build", lambda *_: pytest.fail("compiled"))
    with pytest.raises(InputError, match="qj_race.c: not what the converter writes .*compiled$"):
        run.verify(copy, COUNT)


def test_a_planted_header_is_not_compiled(exported, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    (copy / "paparazzi/stdint.h").write_text("#error planted\n")
    results = run.verify(copy, COUNT, only=("NumPy = C",))
    assert [result.verdict for result in results] == [PASSED, PASSED]


DAMAGED = {  # file: how it is damaged
    "rollouts.npz": "cut",
    "made_report.json": "other",
    "policy.npz": "empty",
    "config.yaml": "missing",
    "paparazzi/quadjax.xml": "cut",
    ".quadjax.json": "cut",
}


@pytest.mark.parametrize("file", DAMAGED)
def test_a_damaged_file_is_one_line(exported, tmp_path, file):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    path, damage = copy / file, DAMAGED[file]
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        damages = {"cut": content[: len(content) // 2], "empty": b"", "other": b"\0["}
        path.write_bytes(damages[damage])
    with pytest.raises(InputError, match=r"^[^\n]+$"):
        run.verify(copy, COUNT)


def test_rollouts_of_another_policy_are_refused(exported, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    arrays = {"observations": np.zeros((3, 5)), "states": np.zeros((3, 5)), "targets": np.zeros(3)}
    write_npz(copy / "rollouts.npz", arrays, {"format": "quadjax-rollouts/1"})
    with pytest.raises(InputError, match=r"rollouts.npz: its arrays do not fit"):
        run.verify(copy, COUNT)


def test_a_check_that_does_not_exist_is_refused(exported):
    with pytest.raises(InputError, match="check 'own flight': no such check, allowed: range proof"):
        run.verify(exported, COUNT, only=("own flight",))


def test_an_unfinished_policy_fails_unless_allowed(exported, no_flights):
    found = [
        run.verify(exported, COUNT, only=("own flights",), allow_unfinished=allowed)[-1]
        for allowed in (False, True)
    ]
    assert [result.verdict for result in found] == [FAILED, SKIPPED]
    assert "0 of 32 flights finish 6 laps of track triangle" in found[0].figure


def test_an_export_for_another_race_fails_unless_allowed(exported):
    found = [
        run.verify(exported, COUNT, only=("own race",), allow_other_race=allowed)[-1]
        for allowed in (False, True)
    ]
    assert [result.verdict for result in found] == [FAILED, SKIPPED]
    assert "trained in another race than config.yaml: gate_test is square in" in found[0].figure


def test_what_lies_in_the_folder(exported):
    names = {p.relative_to(exported).as_posix() for p in exported.rglob("*") if p.is_file()}
    expected = {"made.qjp", "made_report.json", "made_report.txt", "policy.npz", "config.yaml"}
    expected |= {"rollouts.npz", "paparazzi/made.h", "paparazzi/qj.h", "paparazzi/qj_pilot.c"}
    expected |= {"paparazzi/quadjax.xml", "paparazzi/quadjax_module.c"}
    assert expected <= names


def test_a_folder_holds_one_export(tmp_path, no_flights):
    policy, out = made_policy(8, "rate", gain=0.5), tmp_path / "c"
    ranges = WIDE | {"rates": 8.0, "velocity": 32.0}
    export_c(policy, out, ranges=ranges, name="first", allow_unfinished=True)
    for stale in ("first_estimator.c", "first_estimator.h", "residual.npz"):
        (out / stale).write_text("of a motor-level policy that was exported before")
    export_c(policy, out, ranges=ranges, name="first", allow_unfinished=True)
    assert not list(out.glob("*estimator*")) and not (out / "residual.npz").exists()
    assert read_folder(out).name == "first"
    with pytest.raises(InputError, match="holds an export named 'first'"):
        export_c(policy, out, ranges=ranges, name="second", allow_unfinished=True)
    assert not list(out.glob("second*"))


def test_the_module_names_every_source(exported):
    text = (exported / "paparazzi" / "quadjax.xml").read_text()
    for source in (exported / "paparazzi").glob("*.c"):
        assert f'name="{source.name}"' in text or source.name == "qj_angles.c"
    assert 'freq="512"' in text


def test_refuses_a_range_that_its_own_flights_leave(tmp_path, monkeypatch):
    monkeypatch.setattr(flights, "simulate", lambda own: random_rollouts(own, velocity=20.0))
    with pytest.raises(InputError, match="own flights leave the declared range.*velocity"):
        export_c(made_policy(8), tmp_path / "c", allow_unfinished=True)
    assert not (tmp_path / "c").exists()


ONE_LINE = {
    "missing.npz": "missing.npz",
    "policy.npz --range velocity=3": "power of two",
    "policy.npz --name _x": "identifier",
    f"policy.npz --name {'a' * 300}": "identifier",
    "policy.npz --name qj": "files of the runtime have such names",
    "policy.npz --name quadjax_policy": "files of the runtime have such names",
    "policy.npz --track nowhere.yaml": "nowhere.yaml",
    "policy.npz": "policy.npz: 0 of 32 flights finish 6 laps of track square4",
    "nan.npz": "layer 1, row 6",
    "tanh.npz": "layer 0, row 0",
    "huge.npz": r"kernel_3 has 1e\+30, allowed: up to",
}


def test_one_line_on_the_command_line(tmp_path, monkeypatch, no_flights):
    monkeypatch.chdir(tmp_path)
    policy = made_policy(8)
    policy.save(tmp_path / "policy.npz")
    dataclasses.replace(policy, activation="tanh").save(tmp_path / "tanh.npz")
    for name, layer, row, value in (("nan", 1, 6, np.nan), ("huge", 3, 2, 1e30)):
        broken = made_policy(8)
        broken.layers[layer][0][2, row] = value
        broken.save(tmp_path / f"{name}.npz")
    for words, expected in ONE_LINE.items():
        with pytest.raises(InputError, match=expected):
            call(export, "quadjax export", [*words.split(), "--output", "c"])
        assert not (tmp_path / "c").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_one_line(tmp_path):
    (tmp_path / "c").mkdir(mode=0o500)
    with pytest.raises(InputError, match="cannot be written"):
        export_c(made_policy(8), tmp_path / "c", ranges=WIDE, allow_unfinished=True)


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
    monkeypatch.setattr(convert, "write_npz", lambda *_: limited(out, ""))
    with pytest.raises(InputError):
        export_c(made_policy(8, gain=2.0), out, ranges=WIDE, allow_unfinished=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_some_checks_alone(exported):
    results = run.verify(exported, COUNT, only=("range proof",))
    assert [result.check for result in results] == ["files", "range proof"]
    assert all(result.verdict == PASSED for result in results)


def test_verify_refuses_another_folder(tmp_path):
    with pytest.raises(InputError, match="report.json"):
        read_folder(tmp_path)
    (tmp_path / "x_report.json").write_text("{}")
    with pytest.raises(InputError):
        read_folder(tmp_path)


def shipped(folder, name):
    return Path(shutil.copy(PRETRAINED / name, folder))


@pytest.mark.slow
def test_a_policy_that_does_not_finish_its_race_is_refused(tmp_path):
    policy = shipped(tmp_path, "e2e_nominal.npz")
    (tmp_path / "triangle.yaml").write_text(TRACK)
    config = tmp_path / "config.yaml"
    config.write_text(
        f"base: {CONFIGS / 'e2e.yaml'}\ntrack: {{file: {tmp_path / 'triangle.yaml'}}}\n"
    )
    with pytest.raises(InputError, match="trained in another race than .*; allow_other_race=True"):
        export_c(policy, tmp_path / "c", config)
    finish = "of 32 flights finish 6 laps of track triangle .*; allow_unfinished=True accepts it"
    with pytest.raises(InputError, match=finish):
        export_c(policy, tmp_path / "c", config, allow_other_race=True)


@pytest.mark.slow
def test_the_race_has_the_residual_that_the_policy_names(tmp_path):
    policy = shipped(tmp_path, "e2e.npz")
    exported = export_c(policy, tmp_path / "c")
    residual = PRETRAINED / "standin_residual.npz"
    assert exported.converted.own.residual is not None
    assert sha256(tmp_path / "c" / "residual.npz") == sha256(residual)
    found = run.verify(tmp_path / "c", COUNT, only=("own flights",))
    assert [result.verdict for result in found] == [PASSED, PASSED]


def test_a_config_of_another_vehicle_is_refused(tmp_path):
    policy = shipped(tmp_path, "indi.npz")
    with pytest.raises(InputError, match="e2e.yaml: indi.npz: a policy for the rate .* is motor"):
        export_c(policy, tmp_path / "c", CONFIGS / "e2e.yaml")


def test_the_race_is_the_one_in_the_policy_file(tmp_path):
    (tmp_path / "triangle.yaml").write_text(TRACK)
    config = load_config("e2e +residual", [f"track={tmp_path / 'triangle.yaml'}"])
    policy = dataclasses.replace(
        Policy.load(PRETRAINED / "e2e_nominal.npz"), config=tree_of(config)
    )
    (tmp_path / "triangle.yaml").unlink()
    config, origin = race_of_policy(policy)
    assert origin == "the policy file's config"
    own = own_race(config, policy, origin)
    assert own.params.track.yaw.shape == (3,)
    assert own.params.vehicle.residual is not None


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
    for override, difference in OTHER_RACES.items():
        config = load_config("e2e", [override])
        message = f"policy.npz: trained in another race than config: {difference}; allow_other"
        with pytest.raises(InputError, match=message):
            export_c(policy, tmp_path / "c", config)


def test_a_residual_that_the_policy_names_may_not_be_left_out(tmp_path):
    policy = shipped(tmp_path, "e2e.npz")
    with pytest.raises(InputError, match="standin_residual.npz in training, no residual here"):
        export_c(policy, tmp_path / "c", "e2e")


def test_a_folder_of_another_kind_is_refused(tmp_path):
    (tmp_path / ".quadjax.json").write_text('{"kind": "training"}')
    for use in (read_folder, lambda folder: export_c(made_policy(8), folder)):
        with pytest.raises(InputError, match="holds results of training"):
            use(tmp_path)


def test_the_report_says_what_was_exported(exported):
    report = json.loads((exported / "made_report.json").read_text())
    assert report["policy_sha256"] == sha256(exported / "policy.npz")
    origin = report["provenance"]
    assert origin["quadjax"] == __version__ and origin["seed"] == 0
    assert origin["policy"]["sha256"] == report["policy_sha256"]
    assert report["options"]["name"] == "made"


def test_the_next_command_names_the_folder_and_its_allowances():
    assert (
        verification(Path("out/my_policy"), True, False)
        == "quadjax verify out/my_policy --allow-unfinished"
    )
