"""The whole way: a policy file to a folder of C, verified, and into an autopilot."""

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS
from quadjax.export import convert_policy
from quadjax.export.convert_policy import Request, write_folder
from quadjax.export.flights import own_race
from quadjax.export.verify import checks_bits, checks_flight, run
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import read_folder
from quadjax.export.verify.result import FAILED, PASSED, run_check
from quadjax.export.verify.toolchain import WARNINGS
from quadjax.policy.file import write_policy
from quadjax.vehicle.residual_file import write_residual
from tests.export.support import WIDE, made_policy, made_residual, need

REPOSITORY = Path(__file__).resolve().parents[2]
STUBS = Path(__file__).parent / "paparazzi_stubs"
COUNT = 2000


TRACK = """\
gates:
  - {position: [2.0, -1.5, -1.5], yaw_deg: 45, size: [1.2, 0.8]}
  - {position: [2.0, 1.5, -1.5], yaw_deg: 135}
  - {position: [-2.0, -1.5, -1.5], yaw_deg: 315}
"""


def export(folder, vehicle="motor"):
    """A made-up policy exported; its flights are short, so its ranges are wide.

    The motor-level one has a residual, a track of its own, the authors' gate test and a vehicle
    without some effects.
    """
    policy, out = folder / "policy.npz", folder / "c"
    write_policy(policy, made_policy(24, vehicle, gain=0.5))
    if vehicle == "rate":
        ranges = WIDE | {"rates": 8.0, "velocity": 32.0}
        write_folder(Request(policy=policy, out=out, ranges=ranges, name="made"))
        return out
    write_residual(folder / "made_up.npz", made_residual(np.random.default_rng(0), 0.1), {})
    config, track = folder / "config.yaml", folder / "triangle.yaml"
    track.write_text(TRACK)
    config.write_text(
        f"base: {CONFIGS / 'e2e.yaml'}\nepisode: {{gate_test: world_box}}\nvehicle:\n"
        f"  residual: {folder / 'made_up.npz'}\n  motor: {{k_h: 0.0, k_r2: 0.0}}\n"
    )
    write_folder(Request(policy, out, WIDE, name="made", track=str(track), config=config))
    for path in (config, track, folder / "made_up.npz", policy):
        path.unlink()  # the folder stands by itself
    return out


@pytest.fixture(scope="module", params=["motor", "rate"])
def exported(request, tmp_path_factory):
    return export(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def context(exported, tmp_path_factory):
    return Context(read_folder(exported), tmp_path_factory.mktemp("work"), COUNT)


CHECKS = {**dict(run.CHECKS), "closed loop": lambda c: checks_flight.check_closed_loop(c, 8)}


@pytest.mark.parametrize("name", CHECKS)
def test_a_check_of_an_exported_folder(name, context):
    result = run_check(name, lambda: CHECKS[name](context))
    if result.verdict == "left out":
        pytest.skip(result.figure)
    assert result.verdict != FAILED, result.figure


def test_a_tampered_source_fails(exported, context, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    source = copy / "made.c"
    source.write_text(source.read_text().replace("sum >> 32", "sum >> 31", 1))
    tampered = Context(read_folder(copy), tmp_path, COUNT)
    for check in (checks_bits.check_sources, checks_bits.check_host):
        assert run_check("", lambda check=check: check(tampered)).verdict == FAILED


def test_what_lies_in_the_folder(exported):
    names = {p.relative_to(exported).as_posix() for p in exported.rglob("*") if p.is_file()}
    expected = {"made.c", "made.h", "made_race.c", "made_race.h", "made_report.json"}
    expected |= {"made_report.txt", "policy.npz", "config.yaml", "flown.npz"}
    expected |= {"paparazzi/made.xml", "paparazzi/made_module.c", "paparazzi/made_module.h"}
    assert expected <= names


def test_a_folder_holds_one_export(tmp_path):
    policy, out = tmp_path / "policy.npz", tmp_path / "c"
    write_policy(policy, made_policy(8, "rate", gain=0.5))
    ranges = WIDE | {"rates": 8.0, "velocity": 32.0}
    out.mkdir()
    for stale in ("first_estimator.c", "first_estimator.h", "residual.npz"):
        (out / stale).write_text("of an E2E policy that was exported before")
    for _ in range(2):
        write_folder(Request(policy=policy, out=out, ranges=ranges, name="first"))
    assert not list(out.glob("*estimator*")) and not (out / "residual.npz").exists()
    assert read_folder(out).name == "first"
    with pytest.raises(InputError, match="holds an export named 'first'"):
        write_folder(Request(policy=policy, out=out, ranges=ranges, name="second"))
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
    command = "uint16_t" if (exported / "made_estimator.c").exists() else "float"
    defines = ["-DPREFLIGHT_CHECKS=1", "-DPERIODIC_TELEMETRY=1", f"-DCOMMAND={command}"]
    include = [f"-I{tmp_path}", f"-I{modules}", f"-isystem{STUBS}"]
    words = [compiler, "-std=gnu99", "-O2", *defines, *include]
    objects = []
    for source in modules.glob("*.c"):
        objects.append(tmp_path / f"{source.stem}.o")
        subprocess.run([*words, *WARNINGS, "-c", source, "-o", objects[-1]], check=True)
    program = tmp_path / "autopilot"
    subprocess.run([*words, STUBS / "autopilot_main.c", *objects, "-o", program], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_the_paparazzi_module_flies(exported, tmp_path):
    mismatches, fails, before, flies, motors, sent, command = module_run(exported, tmp_path, False)
    assert (mismatches, fails, before, flies, motors) == ("0", "0", "0", "1", "1")
    motor = (exported / "made_estimator.c").exists()
    assert int(sent) == (14 if motor else 13)
    if motor:
        assert 3000 <= float(command) <= 11000
    else:
        assert abs(float(command)) <= 3


def test_the_paparazzi_module_refuses_to_arm(exported, tmp_path):
    mismatches, fails, before, flies, motors, _, command = module_run(exported, tmp_path, True)
    assert int(mismatches) > 0
    assert (fails, before, flies, motors, command) == ("1", "0", "0", "0", "0")


def test_the_module_names_every_source(exported):
    text = (exported / "paparazzi" / "made.xml").read_text()
    for source in exported.glob("*.c"):
        assert f'name="{source.name}"' in text
    assert 'freq="512"' in text


def test_refuses_a_range_that_its_own_flights_leave(tmp_path):
    policy = tmp_path / "policy.npz"
    write_policy(policy, made_policy(24, gain=0.5))
    request = Request(policy, tmp_path / "c", WIDE | {"velocity": 0.125})
    with pytest.raises(InputError, match="own flights leave the declared range.*velocity"):
        write_folder(request)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    "words, said",
    [
        (["missing.npz"], "missing.npz"),
        (["policy.npz", "--range", "velocity=3"], "power of two"),
        (["policy.npz", "--name", "No Name"], "identifier"),
        (["policy.npz", "--track", "nowhere.yaml"], "nowhere.yaml"),
        (["nan.npz"], "layer 1, row 6"),
        (["tanh.npz"], "layer 0, row 0"),
        (["huge.npz"], "layer 3, row 2"),
    ],
)
def test_one_line_on_the_command_line(words, said, tmp_path):
    policy = made_policy(8)
    write_policy(tmp_path / "policy.npz", policy)
    write_policy(tmp_path / "tanh.npz", dataclasses.replace(policy, activation="tanh"))
    for name, layer, row, value in (("nan", 1, 6, np.nan), ("huge", 3, 2, 1e30)):
        broken = made_policy(8)
        broken.layers[layer][0][2, row] = value
        write_policy(tmp_path / f"{name}.npz", broken)
    script = REPOSITORY / "scripts" / "export_c.py"
    done = subprocess.run(
        [sys.executable, script, *words, "--output", "c"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(REPOSITORY), "PATH": "", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert said in done.stderr and done.stderr.count("\n") == 1


def test_a_shipped_residual_goes_by_its_name_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy, config = made_policy(24), CONFIGS / "e2e.yaml"
    own = own_race(policy, config, None)
    shipped = REPOSITORY / "quadjax" / "pretrained" / own.config.vehicle.residual
    request = Request(tmp_path / "policy.npz", tmp_path / "c", {}, config=config)
    tables, found = convert_policy._estimator(request, own)
    assert tables is not None and found == convert_policy.sha256(shipped)


def test_some_checks_alone(exported):
    results = run.verify(exported, COUNT, only=("range proof", "sources"))
    assert [result.check for result in results] == ["sources", "range proof"]
    assert all(result.verdict == PASSED for result in results)


def test_verify_refuses_another_folder(tmp_path):
    with pytest.raises(InputError, match="report.json"):
        read_folder(tmp_path)
    (tmp_path / "x_report.json").write_text("{}")
    with pytest.raises(InputError):
        read_folder(tmp_path)
