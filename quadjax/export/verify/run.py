"""All the checks of a folder or of a ``.qjp`` file, in order."""

import functools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.export.folder import read_folder
from quadjax.export.read import read_qjp
from quadjax.export.targets import TARGETS
from quadjax.export.verify.checks import CHECKS, OF_A_FILE, Context
from quadjax.export.verify.result import Result, run_check
from quadjax.export.words import pack

FILES = "files"


def verify(
    path: Path | str,
    vectors: int = 5_000,
    runs: int = 0,
    announce: Callable[[str], None] = lambda _: None,
    only: Sequence[str] | None = None,
    allow_unfinished: bool = False,
    allow_other_race: bool = False,
    report: Callable[[Result], None] = lambda _: None,
    config: Config | Path | str | None = None,
) -> list[Result]:
    """Verify an exported folder, or a ``.qjp`` file by itself, with the tools of this machine.

    The C that is built and run is the one that the target flies.

    Args:
        path: a folder that ``export_c`` wrote, or a ``.qjp`` file.
        vectors: number of inputs on which C and NumPy must agree.
        runs: flights of the closed loop, 0 for none.
        announce: called with the name of every check before it runs.
        only: names of the checks to run besides that of the files; all if not given.
        allow_unfinished: accept a policy that was exported although it does not finish its race.
        allow_other_race: accept an export for another race than the one in the policy file.
        report: called with every result.
        config: of the race, where that of the folder names code.

    Returns:
        A result for each check, in order.

    Raises:
        InputError: no such folder or file, or one that is damaged or not what the converter writes,
            or a name in ``only`` that is no check; nothing is compiled.
    """
    enable_compilation_cache()
    path, converted, files = Path(path), None, None
    names: tuple[str, ...]
    if path.suffix == ".qjp":
        fixed, names, target = read_qjp(path), OF_A_FILE, TARGETS["qjp"]
        words, text = pack(fixed), "1 file"
    else:
        converted, names = read_folder(path, config), tuple(CHECKS)
        fixed, words, target = converted.fixed, converted.words, converted.target
        every = converted.files()
        files = {name: data for name, data in every.items() if "/" in name}
        text = f"{len(every)} files as the converter writes them"
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise InputError(f"check {unknown[0]!r}: no such check, allowed: {', '.join(names)}")
    announce(FILES)
    results = [run_check(FILES, lambda: text)]
    report(results[0])
    with tempfile.TemporaryDirectory() as work:
        sources = (fixed, words, target, files, Path(work), vectors, converted)
        context = Context(path, *sources, runs, allow_unfinished, allow_other_race)
        for name in (name for name in names if only is None or name in only):
            announce(name)
            results.append(run_check(name, functools.partial(CHECKS[name], context)))
            report(results[-1])
    return results
