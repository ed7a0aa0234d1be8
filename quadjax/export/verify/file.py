"""All the checks of a single ``.qjp`` file, without the folder it was exported to."""

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

from quadjax.core.errors import prefixed, reading
from quadjax.core.files import check_file
from quadjax.export.qjp.read import MOST_BYTES
from quadjax.export.verify.checks_qjp import MUTATIONS, QJP_CHECKS
from quadjax.export.verify.loader import QjpContext
from quadjax.export.verify.result import Result, run_check

PROCESSORS = ("Cortex-M7", "Cortex-M4")


def verify_file(
    path: Path | str,
    vectors: int = 5_000,
    mutations: int = MUTATIONS,
    announce: Callable[[str], None] = lambda _: None,
    report: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """Check a ``.qjp`` file in Python, and with the C loader of this version.

    Args:
        path: the file.
        vectors: number of inputs and states on which all must agree.
        mutations: number of mutated files.
        announce: called with the name of every check before it runs.
        report: called with every result.

    Returns:
        A result for each check, in order.

    Raises:
        InputError: a file that the reader rejects.
    """
    check_file(path)
    with reading(path), open(path, "rb") as stream:
        data = stream.read(MOST_BYTES)
    results = []
    with tempfile.TemporaryDirectory() as work:
        with prefixed(str(path)):
            context = QjpContext.make(data, Path(work), vectors, mutations, PROCESSORS)
        for name, check in QJP_CHECKS.items():
            announce(name)
            results.append(run_check(name, functools.partial(check, context)))
            report(results[-1])
    return results
