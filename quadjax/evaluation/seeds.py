"""Train configs with several seeds and tabulate the results."""

import dataclasses
import subprocess
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.loading import load_config, names_of_code
from quadjax.config.schema import Config
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.files import write_json
from quadjax.core.markdown import table
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.evaluation.curves import check_lengths, learning_figure
from quadjax.evaluation.evaluate import Evaluation, evaluate, joined
from quadjax.evaluation.published import first_under, published_total
from quadjax.policy.file import Policy
from quadjax.training.folder import check_same
from quadjax.training.result import is_finished, read_metrics, read_summary


@dataclasses.dataclass(frozen=True)
class SeedResult:
    """The result of one seed; times in seconds."""

    seed: int
    seconds: float  # of training, imports and compilation included
    steps: int
    reference: float | None  # s for all laps, of the published policy of this race
    first_seconds: float | None  # of training until the first score under the reference
    first_steps: int | None
    last: float | None  # score of the last policy, see run.score
    best: float | None  # the same, the best policy
    flying_lap: float | None  # fastest lap of the mean flights of the best policy
    flights: Evaluation  # of the best policy, under configs/conditions/protocols.yaml
    memory_mib: float | None  # None where the system does not report it

    def to_json(self) -> dict[str, Any]:
        """The result as JSON takes it."""
        return vars(self) | {"flights": [row.to_json() for row in self.flights.rows]}


def configs_of(files: Sequence[str], overrides: Sequence[str]) -> dict[str, Config]:
    """Configs by their names.

    Raises:
        InputError: a config that cannot be used, two of one name, or lap times that cannot
            be compared.
    """
    configs = [load_config(file, overrides) for file in files]
    by_name = {config.name: config for config in configs}
    if len(by_name) < len(configs):
        names = [config.name for config in configs]
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two of the configs are named {double}, expected names that differ")
    check_lengths({name: config.evaluate.length for name, config in by_name.items()})
    return by_name


def train_seeds(
    files: Sequence[str],
    overrides: Sequence[str],
    seeds: Iterable[int],
    runs: int,
    output: Path,
    figure: Path | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[str, Path]]:
    """Train each config with each seed, draw the learning curves, and tabulate.

    Args:
        files: presets or files of configs.
        overrides: of all of them.
        seeds: of the trainings, which run one after the other.
        runs: flights of each kind in the tables.
        output: folder of the runs.
        figure: of the learning curves; ``NAMES_seeds.png`` in ``output`` if not given.
        overwrite: train finished runs again.

    Yields:
        Pairs ``(text, path)``: first an empty text and the figure, then for each config its tables
        and its JSON file.

    Raises:
        InputError: as ``configs_of`` and ``train_once``.
    """
    configs = configs_of(files, overrides)
    groups: dict[str, list[Path]] = {}
    for file, name in zip(files, configs, strict=True):
        words = [[*overrides, f"seed={seed}", f"name={name}_seed{seed}"] for seed in seeds]
        groups[name] = [
            train_once(file, seed_overrides, output, overwrite) for seed_overrides in words
        ]
    code = [name for config in configs.values() for name in names_of_code(config)]
    figure = figure or output / f"{'_and_'.join(configs)}_seeds.png"
    save_figure(learning_figure(groups, code), figure)
    yield "", figure
    for name, folders in groups.items():
        results = [evaluate_seed(folder, runs, code) for folder in folders]
        record = {"results": [result.to_json() for result in results]}
        path = output / f"{name}_seeds.json"
        write_json(path, record | {"provenance": provenance(configs[name])})
        yield f"\n{name}\n\n{format_seeds(results)}\n", path


def train_once(
    config: str, overrides: Sequence[str], output: Path, overwrite: bool = False
) -> Path:
    """Train in a separate process; returns the folder of the run.

    Resumes a run that was stopped, and leaves a finished one of the same config as it is.

    Raises:
        InputError: there is a run of that name with another config, or the training failed (its
            message has been printed).
        KeyboardInterrupt: the training was interrupted; it has saved.
    """
    settings = load_config(config, overrides)
    folder = output / settings.name
    if not overwrite:
        check_same(settings, folder)
        if is_finished(folder):
            return folder
    how = "--overwrite" if overwrite else "--resume"
    command = [sys.executable, "-m", "quadjax", "train", config, *overrides, how]
    status = subprocess.run([*command, "--output", str(output)], check=False).returncode
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status:
        raise InputError(f"training {settings.name} failed with status {status}")
    return folder


def evaluate_seed(run: Path, runs: int, code: Collection[str] = ()) -> SeedResult:
    """Evaluate the best policy of a finished training: from hover, and from random starts.

    Args:
        run: the folder of the training.
        runs: number of flights of each kind.
        code: names ``module:OBJECT`` that may be imported from the run's config.
    """
    config = load_config(run / "config.yaml", code=code)
    summary = read_summary(run)
    policy = Policy.load(run / "policy.npz")
    flights = evaluate(policy, config, conditions="protocols", runs=runs, name=run.name)
    published = published_total(config)
    reference = None if published is None else published[1]
    first = reference and first_under(read_metrics(run / "metrics.csv"), reference)
    first_seconds, first_steps = first or (None, None)
    return SeedResult(
        seed=summary["seed"],
        seconds=summary["seconds"],
        steps=summary["steps"],
        reference=reference,
        first_seconds=first_seconds,
        first_steps=first_steps,
        last=summary["last_lap_total"],
        best=summary["best_lap_total"],
        flying_lap=_lowest(flights["mean"].laps.lap_times),
        flights=flights,
        memory_mib=summary["peak_memory_mib"],
    )


def _lowest(times: np.ndarray) -> float | None:
    finished = times[np.isfinite(times)]
    return round(float(finished.min()), 3) if finished.size else None


COLUMNS = (
    ("seed", lambda r: str(r.seed)),
    ("train s", lambda r: f"{r.seconds:.0f}"),
    ("M steps", lambda r: f"{r.steps / 1e6:.1f}"),
    ("<{reference} at s", lambda r: _cell(r.first_seconds, 0)),
    ("at M steps", lambda r: _cell(r.first_steps and r.first_steps / 1e6, 1)),
    ("last", lambda r: _cell(r.last, 2)),
    ("best", lambda r: _cell(r.best, 2)),
    ("best lap", lambda r: _cell(r.flying_lap, 2)),
    ("MiB", lambda r: _cell(r.memory_mib, 0)),
)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def format_seeds(results: Sequence[SeedResult]) -> str:
    """Markdown tables of training and of flights, one line per seed.

    The published time is there only where there is one.
    """
    reference = results[0].reference
    columns = [c for c in COLUMNS if reference is not None or not c[0].startswith(("<", "at"))]
    titles = [title.format(reference=_cell(reference, 2)) for title, _ in columns]
    training = table([titles, *([show(result) for _, show in columns] for result in results)])
    return f"{training}\n\n{joined([result.flights for result in results]).table()}"
