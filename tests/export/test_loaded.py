"""Verification of a policy as a file: the checks build the C that the autopilot flies."""

import dataclasses

import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export.convert import export_c
from quadjax.export.verify import run, toolchain
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.result import FAILED, PASSED, SKIPPED, run_check
from tests.export.test_autopilots import without_rotors
from tests.export.test_layouts import converted_in, made

RUN = {"qjp": "qjp", "px4": "px4/src/modules/quadjax_policy", "crazyflie": "crazyflie/src"}


def context_of(target, folder, race="published racing"):
    policy, own = without_rotors() if target == "crazyflie" else made(race)
    converted = converted_in(folder / "c", policy, own, target)
    (folder / "work").mkdir()
    read = Folder(**vars(converted), path=folder / "c", expected=converted.sources())
    return Context(read, folder / "work", 200, 0, True, True, mutations=200)


@pytest.fixture(scope="module")
def px4(tmp_path_factory):
    return context_of("px4", tmp_path_factory.mktemp("px4"))


def test_a_policy_as_a_file_has_no_generated_c(px4):
    folder = px4.folder
    assert not [name for name in folder.expected if "made" in name] and not folder.files
    checks = run.checks_of(folder)
    built = {"NumPy = C, host", "hostile inputs", "mutations", "Cortex-M7 zig", "QEMU Cortex-M7"}
    assert not built & set(checks)
    same = {"a step on board", "memory", "against float C", "Frama-C EVA", "cppcheck"}
    assert same <= set(checks) and not same & {
        name for name in checks if checks[name] is run.CHECKS.get(name)
    }


@pytest.mark.slow
def test_memory_is_that_of_the_loader_and_the_words(px4, monkeypatch):
    built, build = set(), toolchain.Compiler.build

    def spy(self, sources, output, extra=()):
        built.update(source.name for source in sources)
        return build(self, sources, output, extra)

    monkeypatch.setattr(toolchain.Compiler, "build", spy)
    result = run_check("memory", lambda: run.checks_of(px4.folder)["memory"](px4))
    if result.verdict == SKIPPED:
        pytest.skip(result.figure)
    words = len(px4.folder.binaries()["made.qjp"])
    assert result.verdict == PASSED and f"words {words:,} B in RAM" in result.figure
    assert "without QuadjaxPolicy.cpp" in result.figure
    loader = {"qjp_pilot.c", "qjp_load.c", "qjp_check.c", "qjp_run.c", "qjp_sha256.c"}
    assert built == loader | {"memory.c"}


def test_a_fault_of_the_c_that_flies_is_seen(px4, tmp_path):
    file = f"{RUN['px4']}/qjp_run.c"
    text = px4.folder.expected[file]
    right = "gate[QJP_GATE_COSINE] * x + gate"
    assert text.count(right) == 1
    changed = px4.folder.expected | {file: text.replace(right, right.replace("+", "-"))}
    for expected, verdict in ((px4.folder.expected, PASSED), (changed, FAILED)):
        folder = dataclasses.replace(px4.folder, expected=expected)
        work = tmp_path / verdict
        work.mkdir()
        context = Context(folder, work, 200)
        check = run.checks_of(folder)["observation"]
        result = run_check("observation", lambda check=check, context=context: check(context))
        assert result.verdict == verdict, result.figure


def test_numbers_of_an_estimator_that_a_file_lacks_are_refused(tmp_path):
    with pytest.raises(InputError, match="sample rate 500 Hz has no effect: --target qjp"):
        export_c(PRETRAINED / "e2e.npz", tmp_path / "out", sample_rate=500.0, target="qjp")
