"""Rows of results: the numbers of the documentation, in ``benchmarks/results/NAME.json``.

The command that measures writes its rows with ``write``. A row has ``name``, ``command``,
``seeds``, its numbers, and the settings behind them:

- ``config``: preset and overrides of the training, as of ``load``: ``["e2e", "+residual"]``;
- ``race``: those of the race of the flights, if it is not that of the training;
- ``plant``: plant and its overrides, as of ``load_plant_config``: ``["cyberzoo", "drone=3"]``;
- ``policy``: a shipped policy: ``"e2e.npz"``.

``write`` adds ``commit``, ``machine`` and ``hash``, that of the numbers which each setting resolves
to; ``configs.json`` has these numbers. A row whose settings now resolve to others is stale, unless
``kept`` says what was different. A published row has ``source`` in place of the command.
"""

import json
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.settings import Tree, differences, hash_of, settings
from quadjax.core.errors import InputError, short
from quadjax.core.files import read_text, write_text
from quadjax.core.provenance import provenance

RESULTS = Path(__file__).parent / "results"
CONFIGS = "configs"  # the file of the numbers, by their hash
SHOWN = 4  # keys of a message


def names() -> list[str]:
    """The files of rows."""
    return sorted({path.stem for path in RESULTS.glob("*.json")} - {CONFIGS})


def read(name: str) -> list[Tree]:
    """The rows of a file; none where there is no file."""
    return _load(name) or []


def stamp(row: Tree) -> dict[str, str]:
    """The hash of the present numbers of each setting of a row."""
    return {key: hash_of(tree) for key, tree in settings(row).items()}


def write(name: str, rows: Iterable[Tree]) -> None:
    """Stamp rows and put them into a file: in the place of the row of the same name, or at its end.

    A row with ``kept`` keeps its hash. ``commit`` and ``machine`` are those of now, unless given.
    """
    trees, merged = _load(CONFIGS) or {}, {row["name"]: row for row in read(name)}
    for row in rows:
        if "kept" not in row:
            trees |= {hash_of(tree): tree for tree in settings(row).values()}
            origin = {} if "source" in row else {"commit": commit(), "machine": device()}
            row = row | {"hash": stamp(row)} | {k: row.get(k, x) for k, x in origin.items()}
        merged[row["name"]] = row
    lines = [json.dumps(row) for row in merged.values()]
    write_text(RESULTS / f"{name}.json", "[\n" + ",\n".join(lines) + "\n]\n")
    used = {each for file in names() for row in read(file) for each in row["hash"].values()}
    lines = [f'"{key}": {json.dumps(trees[key])}' for key in sorted(used & trees.keys())]
    write_text(RESULTS / f"{CONFIGS}.json", "{\n" + ",\n".join(lines) + "\n}\n")


def changes(row: Tree) -> dict[str, tuple[Any, Any]]:
    """Former and present value of each key of a row's settings that differs."""
    trees, changed = _load(CONFIGS) or {}, {}
    for setting, now in settings(row).items():
        found = differences(trees.get(row["hash"].get(setting), {}), now)
        prefix = "" if setting == "config" else f"{setting}."
        changed |= {f"{prefix}{key}": pair for key, pair in found.items()}
    return changed


def stale(row: Tree) -> str:
    """Why a row is not of its present settings, in one line; empty if it is, or if it is kept."""
    try:
        if "kept" in row or row["hash"] == stamp(row):
            return ""
    except InputError as error:
        return f"{row['name']}: {error}"
    pairs = {key: [short(x, text=str) for x in pair] for key, pair in changes(row).items()}
    texts = [f"{key} {then}, now {now}" for key, (then, now) in pairs.items()]
    more = [f"and {len(texts) - SHOWN} more"] if len(texts) > SHOWN else []
    return f"{row['name']}: measured with former settings ({'; '.join(texts[:SHOWN] + more)})"


def device() -> str:
    """This machine, as in the ``provenance`` of a result."""
    return str(provenance()["device"])


def commit() -> str:
    """The commit of this checkout, with ``-dirty`` if more than rows and pages differs from it."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(RESULTS.parent), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    changed = git("status", "--porcelain", "-uno", "--", ":/", ":!/benchmarks/results", ":!/**.md")
    return git("rev-parse", "--short=7", "HEAD") + ("-dirty" if changed else "")


def _load(name: str) -> Any:
    path = RESULTS / f"{name}.json"
    try:
        return json.loads(read_text(path)) if path.exists() else None
    except ValueError as error:
        raise InputError(f"{path}: not JSON: {error}") from error
