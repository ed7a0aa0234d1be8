"""All the checks of a folder, in order."""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.export.targets import AS_FILE, INDIFLIGHT
from quadjax.export.verify import (
    checks_arm,
    checks_bits,
    checks_flight,
    checks_indiflight,
    checks_loader,
    checks_qjp,
    checks_static,
)
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import Folder, read_folder
from quadjax.export.verify.result import Result, run_check

Check = Callable[[Context], str]

SOURCES = "sources"
CHECKS: dict[str, Check] = {
    "range proof": checks_bits.check_proof,
    "warnings, host": checks_bits.check_warnings,
    "NumPy = JAX": checks_bits.check_jax,
    "NumPy = C, host": checks_bits.check_host,
    "hostile inputs": checks_bits.check_hostile,
    "accuracy": checks_bits.check_accuracy,
    "mutations": checks_bits.check_mutations,
    "own race": checks_flight.check_own_race,
    "own flights": checks_flight.check_own_flights,
    "observation": checks_flight.check_observation,
    "gate logic": checks_flight.check_gates,
    "estimator": checks_flight.check_estimator,
    "highest rpm": checks_flight.check_battery,
    **checks_arm.arm_checks(),
    "against float C": checks_arm.check_against_float,
    "a step on board": checks_arm.check_step,
    "memory": checks_arm.check_memory,
    "warnings, gcc armel": checks_arm.check_warnings_bebop,
    "QEMU armel": checks_arm.check_qemu_armel,
    "QEMU armhf": checks_arm.check_qemu_armhf,
    **checks_arm.board_checks(),
    "ASan and UBSan": checks_static.check_sanitizers,
    "Frama-C EVA": checks_static.check_eva,
    "cppcheck": checks_static.check_cppcheck,
    "closed loop": checks_flight.check_closed_loop,
}
# All checks of a policy as a file. None builds the generated C, which such an export lacks.
OF_FILES: dict[str, Check] = {
    name: CHECKS[name]
    for name in ("range proof", "NumPy = JAX", "accuracy", "own race", "own flights")
    + ("observation", "gate logic", "closed loop")
}
OF_FILES |= checks_qjp.folder_checks() | {
    "against float C": checks_loader.check_against_float,
    "a step on board": checks_loader.check_step,
    "memory": checks_loader.check_memory,
    "Frama-C EVA": checks_loader.check_eva,
    "cppcheck": checks_loader.check_cppcheck,
}
# Checks of one autopilot only.
AUTOPILOTS: dict[str, dict[str, Check]] = {
    INDIFLIGHT: {
        "INDIflight, warnings": checks_indiflight.check_warnings,
        "INDIflight, any state": checks_indiflight.check_any_state,
        "INDIflight, M7": checks_indiflight.check_machine,
        "INDIflight, Frama-C": checks_indiflight.check_eva,
        "INDIflight, races": checks_indiflight.check_races,
    },
}
# Checks of one processor only.
PROCESSORS = {build.name: build.processor for build in checks_arm.BUILDS} | dict.fromkeys(
    ("warnings, gcc armel", "QEMU armel", "QEMU armhf"), "Cortex-A9"
)
PROCESSORS |= {f"QEMU {processor}": processor for processor in checks_arm.BOARDS}


def checks_of(folder: Folder) -> dict[str, Check]:
    """The checks for the processor and the autopilot that a folder was exported for."""
    target = folder.target
    if target.autopilot in AS_FILE:
        return OF_FILES
    others = {name for name, processor in PROCESSORS.items() if processor != target.processor}
    common = {name: check for name, check in CHECKS.items() if name not in others}
    return common | AUTOPILOTS.get(target.autopilot or "", {})


def verify(
    path: Path | str,
    vectors: int = 5_000,
    runs: int = 0,
    announce: Callable[[str], None] = lambda _: None,
    only: Sequence[str] | None = None,
    allow_unfinished: bool = False,
    allow_other_race: bool = False,
    report: Callable[[Result], None] = lambda _: None,
    mutations: int = checks_qjp.MUTATIONS,
    config: Config | Path | str | None = None,
) -> list[Result]:
    """Verify an exported folder: build and run it with the tools of this machine.

    Args:
        path: a folder that ``export_c`` wrote.
        vectors: number of vectors on which every build must agree.
        runs: flights of the closed loop, 0 for none.
        announce: called with the name of every check before it runs.
        only: names of the checks to run besides that of the sources, as ``checks_of`` has them;
            all if not given.
        allow_unfinished: accept a policy that was exported although it does not finish its race.
        allow_other_race: accept an export for another race than the one in the policy file.
        report: called with every result.
        mutations: number of mutated .qjp files.
        config: of the race, where that of the folder names code.

    Returns:
        A result for each check, in order.

    Raises:
        InputError: no such folder, or a file in it that is missing, damaged or not what the
            converter writes, or a name in ``only`` that is no check of its target; nothing is
            compiled.
    """
    enable_compilation_cache()
    folder = read_folder(Path(path), config)
    checks = checks_of(folder)
    unknown = [name for name in only or () if name not in checks]
    if unknown:
        raise InputError(f"check {unknown[0]!r}: no such check, allowed: {', '.join(checks)}")
    chosen = [name for name in checks if only is None or name in only]
    announce(SOURCES)
    results = [run_check(SOURCES, lambda: check_sources(folder))]
    report(results[0])
    with tempfile.TemporaryDirectory() as work:
        context = Context(_copied(folder, Path(work) / "c"), Path(work), vectors, runs)
        context.mutations = mutations
        context.allow_unfinished, context.allow_other_race = allow_unfinished, allow_other_race
        for name in chosen:
            announce(name)
            results.append(run_check(name, functools.partial(checks[name], context)))
            report(results[-1])
    return results


def check_sources(folder: Folder) -> str:
    """Every file is, byte for byte, what the converter writes; ``read_folder`` checks it."""
    return f"{len(folder.expected)} files as the converter writes them"


def _copied(folder: Folder, path: Path) -> Folder:
    """The folder with its sources in ``path``: other files of the user's are not compiled."""
    for file, text in folder.expected.items():
        write_text(path / file, text)
    return dataclasses.replace(folder, path=path)
