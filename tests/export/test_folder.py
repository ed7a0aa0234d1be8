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
from quadjax.cli import export as export_command
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.export import convert
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
from quadjax.vehicle.residual_file import write_residual
from tests.export.support import WIDE, made_policy, made_residual, need, with_highest_rpm
from tests.export.test_layouts import converted_in, made

STUBS = Path(__file__).parent / "paparazzi_stubs"
COUNT = 2000


TRACK = """\
gates:
  - {position: [2.0, -1.5, -1.5], yaw_deg: 45, size: [1.2, 0.8]}
  - {position: [2.0, 1.5, -1.5], yaw_deg: 135}
  - {position: [-2.0, -1.5, -1.5], yaw_deg: 315}
"""


def tree_of(config):
    """A config as policy files contain it."""
    return config.model_dump(mode="json", by_alias=True)


def export(folder, vehicle="motor"):
    """A made-up policy exported; it does not finish its race, and its ranges are wide.

    The motor-level one was trained in another race than the one of the export, which has a
    residual, a track of its own, the authors' gate test and a vehicle without some effects. It
    observes the highest propeller speed of a battery.
    """
    policy, out = folder / "policy.npz", folder / "c"
    preset, battery = ("e2e", ["battery.charge=[0.1, 1]"]) if vehicle == "motor" else ("indi", [])
    own = made_policy(24, vehicle, gain=0.5)
    own = with_highest_rpm(own) if vehicle == "motor" else own
    dataclasses.replace(own, config=tree_of(load_config(preset, battery))).save(policy)
    if vehicle == "rate":
        ranges = WIDE | {"rates": 8.0, "velocity": 32.0}
        export_c(policy, out, ranges=ranges, name="made", allow_unfinished=True)
        return out
    write_residual(folder / "made_up.npz", made_residual(np.random.default_rng(0), 0.1), {})
    config, track = folder / "config.yaml", folder / "triangle.yaml"
    track.write_text(TRACK)
    config.write_text(
        f"base: {CONFIGS / 'e2e.yaml'}\nrules: {{gate_test: world_box}}\n"
        "battery: {charge: [0.1, 1]}\nvehicle:\n"
        f"  residual: {folder / 'made_up.npz'}\n  constants: {{k_h: 0.0, k_r2: 0.0}}\n"
    )
    allowed = {"allow_unfinished": True, "allow_other_race": True}
    export_c(policy, out, config, WIDE, "made", track=str(track), **allowed)
    for path in (config, track, folder / "made_up.npz", policy):
        path.unlink()  # the folder needs nothing from outside
    return out


@pytest.fixture(scope="module", params=["motor", "rate"])
def exported(request, tmp_path_factory):
    return export(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def context(exported, tmp_path_factory):
    return Context(read_folder(exported), tmp_path_factory.mktemp("work"), COUNT, 8, True, True)


FAST = (
    "range proof",
    "own race",
    "NumPy = JAX",
    "NumPy = C, host",
    "hostile inputs",
    "accuracy",
    "observation",
    "gate logic",
    "estimator",
    "highest rpm",
    "closed loop",
)


def justified(reason, context):
    """Whether a check may be skipped: the tools that its reason names are not on this machine."""
    if reason.startswith("the vehicle has no external"):
        return context.folder.estimator is None
    if reason.startswith("the policy does not observe the highest"):
        return context.folder.battery is None
    if reason.endswith("allowed by allow_unfinished=True"):
        return context.allow_unfinished
    if reason.endswith("allowed by allow_other_race=True"):
        return context.allow_other_race and context.folder.estimator is not None
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


def test_only_a_missing_tool_justifies_a_skipped_check(context):
    assert justified("no no-such-tool on this machine", context)
    assert not justified("no sh on this machine", context)
    assert not justified("no numpy; pip install -e '.[verify]'", context)
    assert not justified("another reason", context)
    rate = justified("the vehicle has no external disturbances", context)
    assert rate == (context.folder.estimator is None)


def check(name, context):
    result = run_check(name, lambda: run.CHECKS[name](context))
    if result.verdict == SKIPPED:
        assert justified(result.figure, context), f"skipped without need: {result.figure}"
        pytest.skip(result.figure)
    assert result.verdict != FAILED, result.figure


@pytest.mark.parametrize("name", FAST)
def test_a_check_of_an_exported_folder(name, context):
    check(name, context)


def test_the_target_decides_what_is_written_and_checked(exported, tmp_path):
    folder = read_folder(exported)
    other = dataclasses.replace(folder.options, target="cortex-m7")
    other = dataclasses.replace(folder, options=other)
    bare = {file: text for file, text in folder.sources().items() if "/" not in file}
    assert other.sources() == bare != folder.sources()
    assert "Cortex-M7 zig" in run.checks_of(other) and "Cortex-M7 zig" not in run.checks_of(folder)
    assert "Cortex-A9 NEON, zig" in run.checks_of(folder)
    assert "Cortex-A9 NEON, zig" not in run.checks_of(other)


def test_an_unknown_target_is_one_line(tmp_path):
    with pytest.raises(InputError, match="--target avr: no such target, allowed: cortex-a9"):
        export_c(made_policy(8), tmp_path / "out", target="avr")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in run.CHECKS if name not in FAST])
def test_a_slow_check_of_an_exported_folder(name, context):
    check(name, context)


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


INPUTS = ["rollouts.npz", "made_report.json", "policy.npz", "config.yaml"]
DAMAGES = [(file, damage) for file in INPUTS for damage in ("cut", "empty", "other", "missing")]
OUTPUTS = ["made.h", "made_race.c", "made_report.txt", "paparazzi/made.xml"]
DAMAGES += [*zip(OUTPUTS, ("cut", "empty", "other", "missing"), strict=True)]


@pytest.mark.parametrize("file, damage", [*DAMAGES, (".quadjax.json", "cut")])
def test_a_damaged_file_is_one_line(exported, tmp_path, file, damage):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    path = copy / file
    content = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(
            {"cut": content[: len(content) // 2], "empty": b"", "other": b"\0["}[damage]
        )
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


def test_an_unfinished_policy_fails_unless_allowed(exported):
    found = [
        run.verify(exported, COUNT, only=("own flights",), allow_unfinished=allowed)[-1]
        for allowed in (False, True)
    ]
    assert [result.verdict for result in found] == [FAILED, SKIPPED]
    assert "of 32 flights finish 6 laps" in found[0].figure


def test_an_export_for_another_race_fails_unless_allowed(exported):
    found = [
        run.verify(exported, COUNT, only=("own race",), allow_other_race=allowed)[-1]
        for allowed in (False, True)
    ]
    if read_folder(exported).estimator is None:  # the race of the policy file
        assert [result.verdict for result in found] == [PASSED, PASSED]
        assert "those of the policy file" in found[0].figure
        return
    assert [result.verdict for result in found] == [FAILED, SKIPPED]
    assert "trained in another race than config.yaml: gate_test is square in" in found[0].figure


def test_what_lies_in_the_folder(exported):
    names = {p.relative_to(exported).as_posix() for p in exported.rglob("*") if p.is_file()}
    expected = {"made.c", "made.h", "made_race.c", "made_race.h", "made_report.json"}
    expected |= {"made_report.txt", "policy.npz", "config.yaml", "rollouts.npz"}
    expected |= {"paparazzi/made.xml", "paparazzi/made_module.c", "paparazzi/made_module.h"}
    assert expected <= names


def test_a_folder_holds_one_export(tmp_path):
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


def test_the_paparazzi_module_flies(exported, tmp_path):
    mismatches, fails, before, flies, motors, sent, command, steps = module_run(
        exported, tmp_path, False
    )
    assert (mismatches, fails, before, flies, motors) == ("0", "0", "0", "1", "1") and steps == "20"
    motor = (exported / "made_estimator.c").exists()
    assert int(sent) == (16 if motor else 13)
    if motor:
        assert 3000 <= float(command) <= 11000
    else:
        assert abs(float(command)) <= 3


def test_the_paparazzi_module_refuses_to_arm(exported, tmp_path):
    mismatches, fails, before, flies, motors, _, command, _ = module_run(exported, tmp_path, True)
    assert int(mismatches) > 0
    assert (fails, before, flies, motors, command) == ("1", "0", "0", "0", "0")


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


def test_refuses_a_range_that_its_own_flights_leave(tmp_path):
    with pytest.raises(InputError, match="own flights leave the declared range.*velocity"):
        export_c(
            made_policy(24, gain=0.5),
            tmp_path / "c",
            ranges=WIDE | {"velocity": 0.125},
            allow_unfinished=True,
        )
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["missing.npz"], "missing.npz"),
        (["policy.npz", "--range", "velocity=3"], "power of two"),
        (["policy.npz", "--name", "No Name"], "identifier"),
        (["policy.npz", "--name", "stdint"], "C keyword"),
        (["policy.npz", "--name", "while"], "C keyword"),
        (["policy.npz", "--name", "uint8"], "C keyword"),
        (["policy.npz", "--name", "errno"], "C keyword"),
        (["policy.npz", "--name", "_x"], "identifier"),
        (["policy.npz", "--name", "a" * 300], "identifier"),
        (["policy.npz", "--track", "nowhere.yaml"], "nowhere.yaml"),
        (["policy.npz"], r"policy.npz: 0 of 32 flights finish 6 laps of track square4"),
        (["nan.npz"], "layer 1, row 6"),
        (["tanh.npz"], "layer 0, row 0"),
        (["huge.npz"], r"kernel_3 has 1e\+30, allowed: up to"),
    ],
)
def test_one_line_on_the_command_line(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = made_policy(8)
    policy.save(tmp_path / "policy.npz")
    dataclasses.replace(policy, activation="tanh").save(tmp_path / "tanh.npz")
    for name, layer, row, value in (("nan", 1, 6, np.nan), ("huge", 3, 2, 1e30)):
        broken = made_policy(8)
        broken.layers[layer][0][2, row] = value
        broken.save(tmp_path / f"{name}.npz")
    with pytest.raises(InputError, match=said):
        export_command.main([*arguments, "--output", "c"])
    assert not (tmp_path / "c").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_one_line(tmp_path):
    (tmp_path / "c").mkdir(mode=0o500)
    with pytest.raises(InputError, match="cannot be written"):
        export_c(made_policy(8), tmp_path / "c", ranges=WIDE, allow_unfinished=True)


def test_a_full_disk_is_one_line_and_leaves_the_earlier_export(tmp_path, monkeypatch):
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
    config = load_config(CONFIGS / "e2e.yaml", [f"track={tmp_path / 'triangle.yaml'}"])
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


@pytest.mark.parametrize(
    "override, difference",
    [
        (f"track.gates=[{GATES}]", r"track.position.x is \[ 2.* in training, \[3.* here"),
        ("track=figure8", "the number of gates is 4 in training, 6 here"),
        ("vehicle.constants.k_w=4e-8", "vehicle.constants.k_w is .* in training, .*e-08 here"),
        ("rules.time_step=0.005", "time_step is 0.0.* in training, 0.00.* here"),
        ("rules.gate_test=world_box", "gate_test is square in training, world_box here"),
        (
            "vehicle.residual=standin_residual.npz",
            "vehicle.residual.* is none in .*, other numbers here",
        ),
    ],
)
def test_another_race_than_that_of_the_policy_file_is_refused(override, difference, tmp_path):
    trained = load_config("e2e_shac")
    policy = dataclasses.replace(Policy.load(PRETRAINED / "e2e.npz"), config=tree_of(trained))
    config = load_config("e2e_shac", [override])
    message = f"policy.npz: trained in another race than config: {difference}; allow_other"
    with pytest.raises(InputError, match=message):
        export_c(policy, tmp_path / "c", config)


def test_a_residual_that_the_policy_names_may_not_be_left_out(tmp_path):
    policy = shipped(tmp_path, "e2e.npz")
    with pytest.raises(InputError, match="standin_residual.npz in training, no residual here"):
        export_c(policy, tmp_path / "c", "e2e_shac")


@pytest.mark.parametrize("name, symbol", [("test", "test_command"), ("output", "output_command")])
def test_a_name_that_makes_two_symbols_the_same_is_refused(exported, name, symbol):
    folder = read_folder(exported)
    check_symbols(folder)
    renamed = dataclasses.replace(folder, origin=dataclasses.replace(folder.origin, name=name))
    with pytest.raises(InputError, match=f"--name {name}: the C code has another symbol {symbol}"):
        check_symbols(renamed)


def test_a_vehicle_model_without_c_is_refused(tmp_path):
    policy = dataclasses.replace(made_policy(8), vehicle="own")
    with pytest.raises(InputError, match="vehicle model 'own' has no C"):
        export_c(policy, tmp_path / "c")


def test_a_folder_of_another_kind_is_refused(tmp_path):
    (tmp_path / "checkpoints").mkdir()
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
    from argparse import Namespace

    from quadjax.cli.export import verification

    options = Namespace(output=Path("out/my_policy"), allow_unfinished=True, allow_other_race=False)
    assert verification(options) == "quadjax verify out/my_policy --allow-unfinished"
