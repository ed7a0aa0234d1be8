"""What ``quadjax train`` writes and prints of a run, and the trainings of several seeds."""

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
from quadjax.evaluation.advice import look, next_step
from quadjax.evaluation.curves import check_lengths, learning_figure, training_figure
from quadjax.evaluation.evaluate import evaluate
from quadjax.evaluation.published import first_under, published_total
from quadjax.evaluation.result import Evaluation, merge_evaluations
from quadjax.policy.file import Policy
from quadjax.training.folder import check_same
from quadjax.training.result import Run, is_finished, read_metrics, read_summary
from quadjax.training.score import GUIDE, no_lap

LAST_EVALUATIONS, FINISHED_SHARE = 3, 0.9  # of a training; flights that have to finish
COLUMNS = {  # key of a result: title, scale and format of the cell
    "seed": ("seed", 1.0, ".0f"),
    "seconds": ("train s", 1.0, ".0f"),
    "steps": ("M steps", 1e-6, ".1f"),
    "first_seconds": ("<{reference:.2f} at s", 1.0, ".0f"),
    "first_steps": ("at M steps", 1e-6, ".1f"),
    "last": ("last", 1.0, ".2f"),
    "best": ("best", 1.0, ".2f"),
    "flying_lap": ("best lap", 1.0, ".2f"),
    "memory_mib": ("MiB", 1.0, ".0f"),
}


def write_evaluation(run: Run) -> str:
    """Evaluate the best policy of a run, and write its laps and the figures to the folder.

    Returns:
        The lap table, and steps, time, memory and the folder of the run, as text.
    """
    config, folder, metrics = run.config, run.folder, run.metrics
    published, episodes = published_total(config), _episodes(config)
    results = []
    for file, mean in (("laps", False), ("laps_deterministic", True)):
        file_name = str(folder / "policy.npz")
        result = evaluate(run.policy, config, deterministic=mean, name=file_name, **episodes)
        write_json(folder / f"{file}.json", result.to_json())
        results.append(result)
    save_figure(result.plot(), folder / "trajectory.png")
    lines = [merge_evaluations(results).table()]
    if len(metrics["steps"]):
        curves = training_figure({config.name: metrics}, config.name, published)
        save_figure(curves, folder / "curves.png")
    else:
        path = folder / "metrics.csv"
        lines.append(f"{path}: no rows, so there are no curves of the training")
    lines += _effort(run, published)
    if episodes:
        best, last = (run.summary[f"{which}_episode_reward"] for which in ("best", "last"))
        lines += [f"reward of an episode: best {best}, last {last}", look(run)]
    elif run.summary["best_lap_total"] is None:
        crashes = [why for result in results for why in result.laps.crashes]
        lines += [no_lap(crashes, run.summary["steps"]), look(run)]
    else:
        lines += [*_last_evaluations(run), *next_step(run, results[-1].flights)]
    return "\n".join(filter(None, lines))


def _last_evaluations(run: Run) -> list[str]:
    """A line where few flights of the last evaluations of a training finish."""
    shares = run.metrics.get("finished", np.ones(1))[-LAST_EVALUATIONS:]
    if shares.mean() >= FINISHED_SHARE:
        return []
    listed = ", ".join(f"{100.0 * share:.0f}%" for share in shares)
    best, steps = (_amount(run.summary[key]) for key in ("best_steps", "steps"))
    return [
        f"at the end of the training only {listed} of the flights finish; policy.npz is that of "
        f"{best} steps, of {steps}; see {GUIDE}"
    ]


def _episodes(config: Config) -> dict[str, Any]:
    """How a policy is evaluated whose score is the reward: in episodes, not in laps."""
    seconds = config.training_limits.episode_steps * config.rules.time_step
    return {"seconds": seconds, "start": "random"} if config.run.score == "reward" else {}


def _effort(run: Run, published: tuple[str, float] | None) -> list[str]:
    """Steps, time, memory and the folder of a run, and when it was under a published time."""
    summary, devices = run.summary, run.summary["devices"]
    memory = summary.get("peak_memory_mib")
    line = (
        f"trained {_amount(summary['steps'])} steps in {summary['seconds']:.0f} s on "
        f"{devices} device{'' if devices == 1 else 's'}"
    )
    lines = [line if memory is None else f"{line}, peak memory {memory:.0f} MiB"]
    if published and (first := first_under(run.metrics, published[1])):
        seconds, steps = first
        lines.append(
            f"the lap total was first under {published[1]:.2f} s after {seconds:.0f} s of training "
            f"({_amount(steps)} steps)"
        )
    return [*lines, f"policy, figures and metrics are in {run.folder}"]


def _amount(number: int) -> str:
    return f"{number / 1e6:.1f} million" if number >= 1e5 else f"{number:,}"


def load_configs(files: Sequence[str], overrides: Sequence[str]) -> dict[str, Config]:
    """Configs by their names.

    Raises:
        InputError: a config that cannot be used, two of one name, or lap times that cannot
            be compared.
    """
    by_name: dict[str, Config] = {}
    for config in (load_config(file, overrides) for file in files):
        if config.name in by_name:
            raise InputError(
                f"two of the configs are named {config.name}, expected names that differ"
            )
        by_name[config.name] = config
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
        InputError: as ``load_configs`` and ``train_once``.
    """
    configs = load_configs(files, overrides)
    groups: dict[str, list[Path]] = {}
    for file, name in zip(files, configs, strict=True):
        changes = [[f"seed={seed}", f"name={name}_seed{seed}"] for seed in seeds]
        groups[name] = [train_once(file, [*overrides, *x], output, overwrite) for x in changes]
    code = [name for config in configs.values() for name in names_of_code(config)]
    figure = figure or output / f"{'_and_'.join(configs)}_seeds.png"
    save_figure(learning_figure(groups, code), figure)
    yield "", figure
    for name, folders in groups.items():
        results = [evaluate_seed(folder, runs, code) for folder in folders]
        listed = [
            numbers | {"flights": [row.to_json() for row in flights.rows]}
            for numbers, flights in results
        ]
        path = output / f"{name}_seeds.json"
        write_json(path, {"results": listed, "provenance": provenance(configs[name])})
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


def evaluate_seed(
    run: Path, runs: int, code: Collection[str] = ()
) -> tuple[dict[str, Any], Evaluation]:
    """Evaluate the best policy of a finished training under ``configs/conditions/protocols.yaml``.

    With ``run.score: reward``, in sampled episodes from random starts.

    Args:
        run: the folder of the training.
        runs: number of flights of each kind.
        code: names ``module:OBJECT`` that may be imported from the run's config.

    Returns:
        Numbers of the training, None where there is none: ``seed``; ``seconds``, with imports and
        compilation; ``steps``; ``reference``, the published time of all laps of this race, s;
        ``first_seconds`` and ``first_steps`` of the first score under it; ``last`` and ``best``
        score, see ``run.score``; ``flying_lap``, the fastest lap of the mean flights, s;
        ``memory_mib``. And the flights.
    """
    config = load_config(run / "config.yaml", code=code)
    summary = read_summary(run)
    how = _episodes(config) or {"conditions": "protocols"}
    flights = evaluate(
        Policy.load(run / "policy.npz", config), config, runs=runs, name=run.name, **how
    )
    published = published_total(config)
    first = published and first_under(read_metrics(run / "metrics.csv"), published[1])
    seconds, steps = first or (None, None)
    times = flights.lap_times
    fastest = round(float(np.nanmin(times)), 3) if np.isfinite(times).any() else None
    numbers = {key: summary[key] for key in ("seed", "seconds", "steps")}
    numbers |= {"reference": published and published[1]}
    numbers |= {"first_seconds": seconds, "first_steps": steps, "flying_lap": fastest}
    numbers |= {which: summary[f"{which}_{config.run.score_name}"] for which in ("last", "best")}
    return numbers | {"memory_mib": summary["peak_memory_mib"]}, flights


def format_seeds(results: Sequence[tuple[dict[str, Any], Evaluation]]) -> str:
    """Markdown tables of training and of flights, one line per seed; see ``evaluate_seed``.

    A published time is in the tables only if there is one.
    """
    reference = results[0][0]["reference"]
    columns = {k: c for k, c in COLUMNS.items() if reference or not k.startswith("first")}
    rows = [[title.format(reference=reference) for title, _, _ in columns.values()]]
    for numbers, _ in results:
        cells = ((numbers[key], scale, form) for key, (_, scale, form) in columns.items())
        rows.append(["-" if x is None else f"{scale * x:{form}}" for x, scale, form in cells])
    return f"{table(rows)}\n\n{merge_evaluations([flights for _, flights in results]).table()}"
