"""All the checks of a folder, in order."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.export.verify import checks_arm, checks_bits, checks_flight, checks_static
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import read_folder
from quadjax.export.verify.result import Result, run_check

Check = Callable[[Context], str]

CHECKS: tuple[tuple[str, Check], ...] = (
    ("sources", checks_bits.check_sources),
    ("range proof", checks_bits.check_proof),
    ("warnings, host", checks_bits.check_warnings),
    ("NumPy = JAX", checks_bits.check_jax),
    ("NumPy = C, host", checks_bits.check_host),
    ("hostile inputs", checks_bits.check_hostile),
    ("accuracy", checks_bits.check_accuracy),
    ("mutations", checks_bits.check_mutations),
    ("observation", checks_flight.check_observation),
    ("gate logic", checks_flight.check_gates),
    ("estimator", checks_flight.check_estimator),
    ("Cortex-A9 scalar, zig", checks_arm.check_zig_scalar),
    ("Cortex-A9 NEON, zig", checks_arm.check_zig_neon),
    ("Cortex-A9 scalar, gcc", checks_arm.check_bebop_scalar),
    ("Cortex-A9 NEON, gcc", checks_arm.check_bebop_neon),
    ("against float C", checks_arm.check_against_float),
    ("a step on board", checks_arm.check_step),
    ("warnings, gcc armel", checks_arm.check_warnings_bebop),
    ("QEMU armel", checks_arm.check_qemu_armel),
    ("QEMU armhf", checks_arm.check_qemu_armhf),
    ("ASan and UBSan", checks_static.check_sanitizers),
    ("Frama-C EVA", checks_static.check_eva),
    ("cppcheck", checks_static.check_cppcheck),
)


def verify(
    path: Path,
    vectors: int = 5_000,
    runs: int = 0,
    announce: Callable[[str], None] = lambda _: None,
    only: Sequence[str] | None = None,
) -> list[Result]:
    """Verify an exported folder.

    Args:
        path: what ``export_c.py`` wrote.
        vectors: how many vectors every build must agree on.
        runs: flights of the closed loop, 0 for none.
        announce: told the name of every check before it runs.
        only: names of the checks to run, as in ``CHECKS``; all if not given.

    Raises:
        InputError: no such folder, or one that cannot be read.
    """
    folder = read_folder(path)
    checks = (*CHECKS, ("closed loop", lambda c: checks_flight.check_closed_loop(c, runs)))
    results = []
    with tempfile.TemporaryDirectory() as work:
        context = Context(folder, Path(work), vectors)
        for name, check in checks:
            if only is not None and name not in only:
                continue
            announce(name)
            results.append(run_check(name, lambda check=check: check(context)))
    return results
