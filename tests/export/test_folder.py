"""The whole way: a policy file to a folder of C, verified, and into an autopilot."""

import dataclasses
import errno
import json
import os
import re
import shutil
import subprocess
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
from quadjax.export.conversion import check_symbols, sha256
from quadjax.export.convert import export_c
from quadjax.export.race_source import own_race
from quadjax.export.verify import run, toolchain
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import read_folder
from quadjax.export.verify.result import FAILED, PASSED, SKIPPED, run_check
from quadjax.export.verify.toolchain import WARNINGS
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from tests.export.support import TRACK, WIDE, made_policy, need, random_rollouts, tree_of
from tests.export.test_layouts import converted_in, made

STUBS = Path(__file__).parent / "paparazzi_stubs"
COUNT = 2000


@pytest.fixture(scope="module")
def context(exported, tmp_path_factory):
    return Context(read_folder(exported), tmp_path_factory.mktemp("work"), COUNT, 8, True, True)


@pytest.fixture(scope="module")
def context_flown(flown, tmp_path_factory):
    return Context(read_folder(flown), tmp_path_factory.mktemp("work"), COUNT, 8, True, True)


FAST = ("NumPy = JAX", "NumPy = C, host", "hostile inputs", "accuracy", "observation")
OF_THE_VEHICLE = (  # what a rate-level policy has of its own
    "NumPy = C, host",
    "hostile inputs",
    "observation",
    "gate logic",
    "Cortex-A9 NEON, zig",
    "closed loop",
)


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


def check(name, context):
    result = run_check(name, lambda: run.CHECKS[name](context))
    if name in ALLOWED:
        assert result.verdict == SKIPPED and result.figure.endswith(ALLOWED[name])
        return
    if result.verdict == SKIPPED:
        assert justified(result.figure), f"skipped without need: {result.figure}"
        pytest.skip(result.figure)
    assert result.verdict != FAILED, result.figure


@pytest.mark.parametrize("name", FAST)
def test_a_check_of_an_exported_folder(name, context):
    check(name, context)


SLOW = [("motor", name) for name in run.CHECKS if name not in FAST]
SLOW += [("motor", "observation"), *(("rate", name) for name in OF_THE_VEHICLE)]


@pytest.mark.slow
@pytest.mark.parametrize("flown, name", SLOW, indirect=["flown"])
def test_a_slow_check_of_an_exported_folder(name, context_flown):
    check(name, context_flown)


def test_the_target_decides_what_is_written_and_checked(exported, tmp_path):
    folder = read_folder(exported)
    other = dataclasses.replace(folder.options, target="cortex-m7")
    other = dataclasses.replace(folder, options=other)
    bare = {file: text for file, text in folder.sources().items() if "/" not in file}
    assert other.sources() == bare != folder.sources()
    assert "Cortex-M7 zig" in run.checks_of(other) and "Cortex-M7 zig" not in run.checks_of(folder)
    assert "Cortex-A9 NEON, zig" in run.checks_of(folder)
    assert "Cortex-A9 NEON, zig" not in run.checks_of(other)


def test_a_tampered_source_fails_and_nothing_is_compiled(exported, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    source = copy / "made_race.c"
    source.write_text(source.read_text() + "\n#error planted\n")
    monkeypatch.setattr(toolchain.Compiler, "build", lambda *_: pytest.fail("compiled"))
    with pytest.raises(InputError, match="made_race.c: not what the converter writes .*compiled$"):
        run.verify(copy, COUNT)


def test_a_planted_header_is_not_compiled(exported, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    (copy / "stdint.h").write_text("#error planted\n")
    results = run.verify(copy, COUNT, only=("hostile inputs",))
    assert [result.verdict for result in results] == [PASSED, PASSED]


DAMAGED = {  # file: how it is damaged
    "rollouts.npz": "cut",
    "made_report.json": "other",
    "policy.npz": "empty",
    "config.yaml": "missing",
    "paparazzi/made.xml": "cut",
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
    expected = {"made.c", "made.h", "made_race.c", "made_race.h", "made_report.json"}
    expected |= {"made_report.txt", "policy.npz", "config.yaml", "rollouts.npz"}
    expected |= {"paparazzi/made.xml", "paparazzi/made_module.c", "paparazzi/made_module.h"}
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


def module_run(exported, tmp_path, broken):
    """Build the Paparazzi module with stand-ins for Paparazzi, and run it once."""
    compiler = need("gcc")
    modules = tmp_path / "modules" / "made"
    modules.mkdir(parents=True)
    for path in [*exported.glob("*.[ch]"), *exported.glob("paparazzi/*.[ch]")]:
        shutil.copy(path, modules)
    if broken:
        source = modules / "made.c"
        source.write_text(source.read_text().replace("sum >> 32", "sum >> 31", 1))
    number = "uint16_t" if (exported / "made_estimator.c").exists() else "float"
    defines = ["-DPREFLIGHT_CHECKS=1", "-DPERIODIC_TELEMETRY=1", f"-DCOMMAND={number}"]
    include = [f"-I{tmp_path}", f"-I{modules}", f"-isystem{STUBS}"]
    command = [compiler, "-std=gnu99", "-O2", *defines, *include]
    objects = []
    for source in modules.glob("*.c"):
        objects.append(tmp_path / f"{source.stem}.o")
        subprocess.run([*command, *WARNINGS, "-c", source, "-o", objects[-1]], check=True)
    program = tmp_path / "autopilot"
    subprocess.run([*command, STUBS / "autopilot_main.c", *objects, "-o", program], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    return done.stdout.split()


def flies(exported, tmp_path):
    """The number of values sent, and the first command, of a module that flies."""
    *found, motors, sent, command, steps = module_run(exported, tmp_path, False)
    assert (found, motors, steps) == (["0", "0", "0", "1"], "1", "20")
    return int(sent), float(command)


def test_the_paparazzi_module_flies(exported, tmp_path):
    sent, command = flies(exported, tmp_path)
    assert sent == 16 and 3000 <= command <= 11000


@pytest.mark.slow
@pytest.mark.parametrize("flown", ["rate"], indirect=True)
def test_the_paparazzi_module_of_a_rate_level_policy_flies(flown, tmp_path):
    sent, command = flies(flown, tmp_path)
    assert sent == 13 and abs(command) <= 3


@pytest.mark.slow
def test_the_paparazzi_module_refuses_to_arm(exported, tmp_path):
    mismatches, fails, before, flies, motors, _, command, _ = module_run(exported, tmp_path, True)
    assert int(mismatches) > 0
    assert (fails, before, flies, motors, command) == ("1", "0", "0", "0", "0")


@pytest.mark.slow
def test_the_module_holds_the_last_action_at_the_rate_of_the_training(tmp_path):
    policy, own = made("indi and more")
    folder = tmp_path / "c"
    converted = converted_in(folder, policy, own, "cortex-a9")
    assert not converted.race.history and policy.layout.counts_steps
    *_, steps = module_run(folder, tmp_path, False)
    assert steps == "4"  # in 20 calls at 512 Hz, of 0.01 s
    slow = dataclasses.replace(converted.race, time_step=0.003)
    with pytest.raises(InputError, match="earlier steps of 0.003 s, allowed: whole periods of 512"):
        dataclasses.replace(converted, race=slow).sources()


def test_the_module_names_every_source(exported):
    text = (exported / "paparazzi" / "made.xml").read_text()
    for source in exported.glob("*.c"):
        assert f'name="{source.name}"' in text
    assert 'freq="512"' in text


def test_refuses_a_range_that_its_own_flights_leave(tmp_path, monkeypatch):
    monkeypatch.setattr(flights, "simulate", lambda own: random_rollouts(own, velocity=20.0))
    with pytest.raises(InputError, match="own flights leave the declared range.*velocity"):
        export_c(made_policy(8), tmp_path / "c", allow_unfinished=True)
    assert not (tmp_path / "c").exists()


ONE_LINE = {
    "missing.npz": "missing.npz",
    "policy.npz --range velocity=3": "power of two",
    "policy.npz --name while": "C keyword",
    "policy.npz --name uint8": "C keyword",
    "policy.npz --name errno": "C keyword",
    "policy.npz --name _x": "identifier",
    f"policy.npz --name {'a' * 300}": "identifier",
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
    policy, out, write = made_policy(8), tmp_path / "c", convert.write_text
    for left in (0, 9):  # files that the disk has room for
        count = iter(range(left))

        def limited(path, text, count=count):
            if next(count, None) is None:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(path, text)

        monkeypatch.setattr(convert, "write_text", limited)
        with pytest.raises(InputError, match="c: cannot be written .No space left on device.$"):
            export_c(policy, out, ranges=WIDE, allow_unfinished=True)
        assert not out.exists()
    monkeypatch.setattr(convert, "write_text", write)
    export_c(policy, out, ranges=WIDE, allow_unfinished=True)
    (out / "paparazzi" / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr(convert, "write_npz", lambda *_: limited(out, ""))
    with pytest.raises(InputError):
        export_c(made_policy(8, gain=2.0), out, ranges=WIDE, allow_unfinished=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_some_checks_alone(exported):
    results = run.verify(exported, COUNT, only=("range proof",))
    assert [result.check for result in results] == ["sources", "range proof"]
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
    assert exported.converted.residual_hash == sha256(PRETRAINED / "standin_residual.npz")
    assert "subtract_residual" in (tmp_path / "c" / "e2e_estimator.c").read_text()
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


def test_a_name_that_makes_two_symbols_the_same_is_refused(exported):
    folder = read_folder(exported)
    check_symbols(folder)
    for name in ("test", "output"):
        renamed = dataclasses.replace(folder, origin=dataclasses.replace(folder.origin, name=name))
        expected = f"--name {name}: the C code has another symbol {name}_command"
        with pytest.raises(InputError, match=expected):
            check_symbols(renamed)


def test_a_folder_of_another_kind_is_refused(tmp_path):
    (tmp_path / ".quadjax.json").write_text('{"kind": "training"}')
    for use in (read_folder, lambda folder: export_c(made_policy(8), folder)):
        with pytest.raises(InputError, match="holds a training"):
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
