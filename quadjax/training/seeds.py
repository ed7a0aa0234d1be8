"""The same config over several seeds: one training result means nothing by itself."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.loading import load_config
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.evaluation.learning_curves import check_laps
from quadjax.policy import pilot
from quadjax.policy.file import read_policy
from quadjax.training.folder import check_same

TRAIN = Path(__file__).resolve().parents[2] / "scripts" / "train.py"


@dataclasses.dataclass(frozen=True)
class SeedResult:
    """What one seed came to; times in seconds."""

    seed: int
    seconds: float  # of training, imports and compilation included
    steps: int
    reference: float | None  # s for all laps, of the published policy of this race
    first_seconds: float | None  # of training until the first flight under the reference
    first_steps: int | None
    last: float | None  # all laps, deterministic from hover, the last policy
    best: float | None  # the same, the best policy
    flying_lap: float | None  # fastest lap of the best policy's flight
    sampled: float | None  # all laps, mean of the sampled flights from hover
    sampled_finished: int  # of the sampled flights from random starts
    sampled_runs: int
    memory_mib: float


def configs_of(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Config files by the name of their config, and the ``key=value`` words beside them.

    Raises:
        InputError: a config that cannot be used, none, two of one name, or some whose lap times
            cannot be compared.
    """
    changes = [word for word in words if "=" in word and "/" not in word.partition("=")[0]]
    files = [word for word in words if word not in changes]
    configs = [load_config(path, changes) for path in files]
    names = [config.name for config in configs]
    if not names:
        raise InputError("no config: expected at least one YAML file (try --help)")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two of the configs are named {name}, expected names that differ")
    check_laps({config.name: config.evaluate.laps for config in configs})
    return dict(zip(names, files, strict=True)), changes


def train_seed(config: str, words: Sequence[str], seed: int, runs: Path) -> Path:
    """Train one seed in a process of its own; the folder of its run.

    Goes on with a run that was begun, and leaves a finished one of the same config as it is.

    Raises:
        InputError: a run of that name and another config is there, or the training failed; it has
            said why.
        KeyboardInterrupt: the training was stopped; it has saved.
    """
    name = f"{load_config(config, words).name}_seed{seed}"
    own = [*words, f"seed={seed}", f"name={name}"]
    check_same(load_config(config, own), runs / name)
    summary = runs / name / "summary.json"
    if not (summary.exists() and json.loads(summary.read_text())["finished"]):
        command = [sys.executable, str(TRAIN), config, *own, "--resume", "--runs", str(runs)]
        status = subprocess.run(command, check=False).returncode
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status:
            raise InputError(f"training seed {seed} failed with status {status}")
    return runs / name


def judge_seed(run: Path, flights: int) -> SeedResult:
    """Fly a finished run's best policy: from hover, and sampled from random starts."""
    config = load_config(run / "config.yaml")
    summary = json.loads((run / "summary.json").read_text())
    policy = read_policy(run / "policy.npz")
    laps = config.evaluate.laps
    mean, _ = pilot.fly_policy(config, policy, pilot.Race(laps, 1, True, 0), True)
    hover, _ = pilot.fly_policy(config, policy, pilot.Race(laps, flights, True, 1), False)
    random, _ = pilot.fly_policy(config, policy, pilot.Race(laps, flights, False, 2), False)
    first = summary["first_under"] or {"total": None, "seconds": None, "steps": None}
    done = hover.totals[np.isfinite(hover.totals)]
    return SeedResult(
        seed=summary["seed"],
        seconds=summary["seconds"],
        steps=summary["steps"],
        reference=first["total"],
        first_seconds=first["seconds"],
        first_steps=first["steps"],
        last=summary["last_lap_total"],
        best=summary["best_lap_total"],
        flying_lap=_lowest(mean.lap_times),
        sampled=float(done.mean()) if done.size else None,
        sampled_finished=random.finished,
        sampled_runs=flights,
        memory_mib=summary["peak_memory_mib"],
    )


def _lowest(times: np.ndarray) -> float | None:
    flown = times[np.isfinite(times)]
    return round(float(flown.min()), 3) if flown.size else None


COLUMNS = (
    ("seed", lambda r: str(r.seed)),
    ("train s", lambda r: f"{r.seconds:.0f}"),
    ("M steps", lambda r: f"{r.steps / 1e6:.1f}"),
    ("<{reference} at s", lambda r: _cell(r.first_seconds, 0)),
    ("at M steps", lambda r: _cell(r.first_steps and r.first_steps / 1e6, 1)),
    ("last", lambda r: _cell(r.last, 2)),
    ("best", lambda r: _cell(r.best, 2)),
    ("best lap", lambda r: _cell(r.flying_lap, 2)),
    ("sampled", lambda r: _cell(r.sampled, 2)),
    ("random starts", lambda r: f"{r.sampled_finished}/{r.sampled_runs}"),
    ("MiB", lambda r: f"{r.memory_mib:.0f}"),
)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def format_seeds(results: Sequence[SeedResult]) -> str:
    """A Markdown table, one line per seed."""
    reference = _cell(results[0].reference, 2)
    head = "| " + " | ".join(title.format(reference=reference) for title, _ in COLUMNS) + " |"
    rule = "|" + "---|" * len(COLUMNS)
    lines = ["| " + " | ".join(show(r) for _, show in COLUMNS) + " |" for r in results]
    return "\n".join([head, rule, *lines])
