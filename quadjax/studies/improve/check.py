"""What learning from flights changes: flights that nothing is learned from, on one or more plants.

The flights of a plant are those of the policy before the first round, after the last one, and, if
wanted, of the first policy fine-tuned on the plant's own numbers (``reference``).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.files import write_json, write_text
from quadjax.core.markdown import table
from quadjax.core.plotting import save_figure
from quadjax.fitting.flight_log import read_log
from quadjax.studies.drawn_plants import drawn
from quadjax.studies.improve.figures import improvement_figure
from quadjax.studies.improve.flights import Flown, fly
from quadjax.studies.improve.model import Model, constant_lines, error_lines
from quadjax.studies.improve.reference import plant_model
from quadjax.studies.improve.rounds import Round, rounds_table
from quadjax.studies.improve.run import (
    Progress,
    Report,
    Setting,
    improve,
    learn,
    start,
    tune,
)

CHECK_SEED = 10_000  # of flights that are learned from by no round
REFERENCE = "reference"
NAMES = ("before", "after", REFERENCE)
COLUMNS = (
    *("plant", "before, s", "after, s", "reference, s", "flight, s", "computing, s", "models"),
)
TIMES = ("flight", "computing")  # of a result, seconds


@dataclasses.dataclass(frozen=True)
class Result:
    """What was learned on one plant.

    Attributes:
        seed: of the plant's constants.
        rounds: of flying and learning.
        check: flights by name: before, after, and reference.
    """

    seed: int
    rounds: list[Round]
    check: dict[str, Flown]

    @property
    def flight(self) -> float:
        """Seconds of flight that were learned from."""
        return sum(sum(done.flown.seconds) for done in self.rounds)

    @property
    def computing(self) -> float:
        """Seconds of fits and trainings."""
        return sum(done.computing for done in self.rounds)

    def to_json(self) -> dict[str, Any]:
        """The numbers of a figure."""
        rounds = [
            {
                "flown": dataclasses.asdict(done.flown),
                "model": done.state,
                "change": done.found and done.found.change,
                "margin": done.margin,
                "computing": done.computing,
            }
            for done in self.rounds
        ]
        check = {name: dataclasses.asdict(flown) for name, flown in self.check.items()}
        return {"plant": self.seed, "rounds": rounds, "check": check}


def results_of(setting: Setting, plants: int | None, folder: Path, report: Report) -> str:
    """The rounds on one plant or several, or the fit of real logs, as text and ``table.txt``.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    if setting.logs:
        learned = learn(setting, folder, report)
        lines = [*constant_lines(Model.of(setting.race), learned.model), "", *error_lines(learned)]
        refused = learned.refused
        text = "\n".join(
            [*lines, "", f"rejected: {refused}" if refused else "accepted; policy.npz"]
        )
    elif plants:
        text = plants_table(improve_plants(setting, folder, plants, report))
    else:
        rounds = improve(setting, folder, report)
        text = rounds_table(rounds, checked(setting, rounds, folder, report))
    write_text(folder / "table.txt", text + "\n")
    return text


def checked(
    setting: Setting, rounds: Sequence[Round], folder: Path, report: Report
) -> dict[str, Flown]:
    """Flights of the first and the last policy on the plant, which nothing is learned from.

    Raises:
        StoppedError: the training of the reference was interrupted; it is saved.
    """
    last = folder / "policy.npz"
    if not setting.check:
        return {}
    found = {
        "before": _check(setting, setting.policy, folder, "before", report),
        "after": _check(setting, last, folder, f"after_{len(rounds)}", report),
    }
    if setting.reference:
        policy = _reference(setting, rounds, folder / REFERENCE, report)
        name = f"{REFERENCE}_{len(rounds)}"
        found[REFERENCE] = _check(setting, policy, folder, name, report)
    return found


def _check(setting: Setting, policy: Path, folder: Path, name: str, report: Report) -> Flown:
    """Flights of one policy."""
    path = folder / f"check_{setting.check}_{name}.json"
    if not path.exists():
        assert setting.plant is not None
        report(f"checking the policy: {name}")
        options = (setting.check, setting.laps, CHECK_SEED + setting.seed)
        fly(setting.race, setting.plant, policy, *options).save(path)
    return Flown.load(path)


def _reference(setting: Setting, rounds: Sequence[Round], folder: Path, report: Report) -> Path:
    """The first policy, fine-tuned on the plant's own numbers with the steps of all rounds."""
    assert setting.plant is not None
    seed = CHECK_SEED + 1 + setting.seed
    options = (setting.fit, folder, seed, lambda line: report(f"reference: {line}"))
    model = plant_model(setting.race, setting.plant, setting.policy, *options)
    longer = dataclasses.replace(setting, steps=setting.steps * len(rounds))
    logs = [read_log(file, setting.fit.logs) for file in model.logs]
    first = Progress(setting.policy, model, rounds[-1].margin)
    place = folder / f"rounds_{len(rounds)}"
    place.mkdir(exist_ok=True)
    return tune(longer, first, logs, place, report)


def improve_plants(setting: Setting, folder: Path, count: int, report: Report) -> list[Result]:
    """Learn on ``count`` drawn plants, each from the first policy, in ``folder/plant_SEED``.

    The plants have the seeds from that of the setting's plant on. Steps whose results are in the
    folder are not repeated; ``plants.json`` has all numbers, ``plants.png`` the figure.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    assert setting.plant is not None
    results = []
    for plant in drawn(setting.plant, count):
        seed, own = plant.constants.seed, dataclasses.replace(setting, plant=plant)
        place = folder / f"plant_{seed}"
        place.mkdir(exist_ok=True)
        start(own, place)

        def say(line: str, seed: int = seed) -> None:
            report(f"plant {seed}: {line}")

        rounds = improve(own, place, say)
        results.append(Result(seed, rounds, checked(own, rounds, place, say)))
        write_json(folder / "plants.json", [result.to_json() for result in results])
    if setting.check:
        figure = improvement_figure({setting.race.name: [each.to_json() for each in results]})
        save_figure(figure, folder / "plants.png")
    return results


def plants_table(results: Sequence[Result]) -> str:
    """A row for each plant, and the mean over all, as a Markdown table."""
    rows: list[Sequence[str]] = [COLUMNS]
    for result in results:
        cells = [_cell([result.check.get(name)]) for name in NAMES]
        models = ", ".join(done.state for done in result.rounds)
        times = (f"{result.flight:.0f}", f"{result.computing:.0f}")
        rows.append((str(result.seed), *cells, *times, models))
    finished = [r for r in results if all(flown.finished for flown in r.check.values())]
    parts = ([[r.check.get(name) for r in rs] for rs in (results, finished)] for name in NAMES)
    cells = [_cell(*part) for part in parts]
    means = [f"{np.mean([getattr(r, name) for r in results]):.0f}" for name in TIMES]
    rows.append(("all", *cells, *means, ""))
    crashes = sum(bool(c) for r in results for done in r.rounds for c in done.flown.crashes)
    notes = [f"crashes in the rounds: {crashes}"]
    if len(finished) < len(results):
        count = f"{len(finished)} of {len(results)}"
        notes.append(f"means over the {count} plants on which every policy finishes")
    pairs = [(r.check["after"], r.check[REFERENCE]) for r in results if REFERENCE in r.check]
    gaps = [own.mean - other.mean for own, other in pairs if own.finished and other.finished]
    if gaps:
        notes.append(
            f"time after minus that of the reference: {np.mean(gaps):+.2f} s, "
            f"{min(gaps):+.2f} to {max(gaps):+.2f} s"
        )
    return "\n".join([table(rows), "", *notes])


def _cell(flown: Sequence[Flown | None], timed: Sequence[Flown | None] | None = None) -> str:
    """Mean over plants of the mean time of all laps, and how many flights of all finished.

    Args:
        flown: of all plants, whose flights are counted.
        timed: of the plants whose times are averaged; all if not given.
    """
    known = [part for part in flown if part is not None]
    if not known:
        return "-"
    means = [part.mean for part in (flown if timed is None else timed) if part and part.finished]
    time = f"{np.mean(means):.2f}" if means else "-"
    done, runs = sum(p.finished for p in known), sum(len(p.totals) for p in known)
    return f"{time} ({done} of {runs})"
